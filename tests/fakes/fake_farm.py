"""A farm that renders nothing: samples made in no time, whose every bit is known from their
seed.
"""

from collections.abc import Generator, Sequence

import numpy as np

from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.samples import Samples

SHAPES = {
    "depth_m": (4, 5),
    "intensity": (4, 5),
    "image": (4, 4),
    "object_depth_m": (4, 4),
    "scene": (6,),
}


def samples_of(seeds: Sequence[int]) -> Samples:
    """Noise by seed, with NaN where the first value of a map would be."""
    noise = [np.random.default_rng(seed) for seed in seeds]
    arrays = {
        name: np.stack([one.random(shape, np.float32) for one in noise])
        for name, shape in SHAPES.items()
    }
    arrays["depth_m"][:, 0, 0] = np.nan
    arrays["image"] = arrays["image"].astype(np.float16)
    names = np.array([f"kind-{seed % 3}" for seed in seeds], object)
    return {**arrays, "seed": np.asarray(seeds, np.int64), "category": names}


class FakeFarm:
    """Makes pieces in an order of its own, and may fail after some of them."""

    def __init__(
        self,
        order: int | None = None,
        fails_after: int | None = None,
        error: BaseException | None = None,
    ) -> None:
        self.order = order
        self.fails_after = fails_after
        self.error = error or KeyboardInterrupt()
        self.made: list[range] = []
        self.closed = False

    def __call__(
        self, plan: DatasetPlan, pieces: Sequence[range]
    ) -> Generator[tuple[range, Samples]]:
        del plan
        order = (
            range(len(pieces))
            if self.order is None
            else np.random.default_rng(self.order).permutation(len(pieces))
        )
        try:
            for number, k in enumerate(order):
                if number == self.fails_after:
                    raise self.error
                self.made.append(pieces[k])
                yield pieces[k], samples_of(pieces[k])
        finally:
            self.closed = True

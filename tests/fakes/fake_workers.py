"""Worker pool of a dataset build that renders nothing.

It stands for `dataset.build`'s processes and `dataset.ray_backend`'s cluster, both called farms
there: a callable that takes a plan and ranges of seeds (pieces) and yields each piece's samples.
These samples are noise, made in no time, and every bit of them follows from their seed.
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
"""Shape of one sample's arrays, smaller than a real one's."""


def samples_of(seeds: Sequence[int]) -> Samples:
    """Return the samples of seeds: noise, and NaN as the first depth of each map."""
    noise = [np.random.default_rng(seed) for seed in seeds]
    arrays = {
        name: np.stack([one.random(shape, np.float32) for one in noise])
        for name, shape in SHAPES.items()
    }
    arrays["depth_m"][:, 0, 0] = np.nan
    arrays["image"] = arrays["image"].astype(np.float16)
    names = np.array([f"kind-{seed % 3}" for seed in seeds], object)
    return {**arrays, "seed": np.asarray(seeds, np.int64), "category": names}


class FakeWorkers:
    """Pool that delivers pieces in order or shuffled, and may fail after some of them."""

    def __init__(
        self,
        order: int | None = None,
        fails_after: int | None = None,
        error: BaseException | None = None,
    ) -> None:
        self.order = order
        """Seed of the shuffle; None keeps the order of the pieces."""
        self.fails_after = fails_after
        """Number of pieces after which `error` is raised; None for never."""
        self.error = error or KeyboardInterrupt()
        self.made: list[range] = []
        """Pieces delivered so far."""
        self.closed = False

    def __call__(
        self, plan: DatasetPlan, pieces: Sequence[range]
    ) -> Generator[tuple[range, Samples]]:
        """Yield each piece with its samples."""
        del plan
        order = np.arange(len(pieces))
        if self.order is not None:
            order = np.random.default_rng(self.order).permutation(len(pieces))
        try:
            for number, index in enumerate(order):
                if number == self.fails_after:
                    raise self.error
                self.made.append(pieces[index])
                yield pieces[index], samples_of(pieces[index])
        finally:
            self.closed = True

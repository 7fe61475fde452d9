"""Samples made by a Ray cluster: the same ones, by the workers of many machines; one that dies is replaced.

Each machine needs this nlos-cam, and a folder of meshes at the same path. Shards are written by the one who asked.
"""

from collections.abc import Generator, Sequence
from importlib.metadata import version
from itertools import islice
from typing import Any

from nlos_cam.dataset.build import one_thread
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.samples import Samples, make_samples
from nlos_cam.errors import NlosCamError, SceneError, WorkersLostError

TRIES = 5
"""Deaths of its worker that a piece survives."""
VERSION = version("nlos-cam")
AHEAD = 3
"""Pieces asked for at a time, for each processor of the cluster: what waits is little, and nobody waits."""


def cluster(address: str) -> "RayFarm":
    """The farm of a cluster by its address: `auto`, HOST:PORT, ray://HOST:PORT, or `local` for one of its own.

    Raises WorkersLostError where Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise WorkersLostError("--ray needs Ray, which is not installed: pip install 'nlos-cam[many]'") from error
    return RayFarm(ray, address)


class RayFarm:
    """A farm on a cluster; it is connected while samples are made."""

    def __init__(self, ray: Any, address: str) -> None:
        self._ray, self._address = ray, address

    def __call__(self, plan: DatasetPlan, pieces: Sequence[range]) -> Generator[tuple[range, Samples]]:
        """Make the samples of ranges of seeds, in any order. Raises WorkersLostError where nobody can."""
        if not pieces:
            return
        self._connect()
        try:
            yield from self._made(plan, pieces)
        except self._ray.exceptions.RayError as error:
            raise _foreseen(error) from error
        finally:
            self._ray.shutdown()

    def _connect(self) -> None:
        try:
            self._ray.init(address=self._address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            raise WorkersLostError(
                f"no Ray cluster at {self._address!r} ({' '.join(str(error).split()):.120}): start one with "
                "`ray start --head`, or leave out --ray"
            ) from error

    def _made(self, plan: DatasetPlan, pieces: Sequence[range]) -> Generator[tuple[range, Samples]]:
        ray, coming = self._ray, iter(pieces)
        work = ray.remote(num_cpus=1, max_retries=TRIES)(make_piece)
        ahead = AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
        waiting = {work.remote(plan, piece, VERSION): piece for piece in islice(coming, ahead)}
        while waiting:
            (ready, *_), _ = ray.wait([*waiting], num_returns=1)
            yield waiting.pop(ready), ray.get(ready)
            waiting |= {work.remote(plan, piece, VERSION): piece for piece in islice(coming, 1)}


def make_piece(plan: DatasetPlan, piece: range, wanted: str) -> Samples:
    """What a worker does. Raises SceneError where its machine has another nlos-cam than the one who asks."""
    if wanted != VERSION:
        raise SceneError(f"a worker has nlos-cam {VERSION}, not {wanted}: install the same everywhere")
    one_thread()
    return make_samples(plan, piece)


def _foreseen(error: Exception) -> NlosCamError:
    """A worker's own error as it was, or that workers are lost."""
    cause = getattr(error, "cause", None)
    if isinstance(cause, NlosCamError):
        return cause
    problem = " ".join(str(error).split())
    return WorkersLostError(f"the Ray cluster gave up ({problem:.200}): finished shards are kept; build again")

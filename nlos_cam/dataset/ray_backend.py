"""Ray cluster as a farm: equal samples by the workers of many machines; a dead worker is replaced.

Each machine needs this version of nlos-cam, and a folder of meshes at the same path. The caller
writes the shards.
"""

from collections.abc import Generator, Sequence
from contextlib import chdir
from itertools import islice
from typing import Any

from nlos_cam import __version__
from nlos_cam.dataset.plan import OBJECTS_VERSION, DatasetPlan
from nlos_cam.dataset.samples import Samples, make_samples
from nlos_cam.dataset.worker import use_one_thread
from nlos_cam.errors import NlosCamError, SceneError, WorkersLostError
from nlos_cam.processes import package_folder, safe_children
from nlos_cam.render import RENDERING_VERSION

MAX_RETRIES = 5
"""Deaths of its worker that a piece survives."""
VERSION = __version__
PIECES_PER_CPU = 3
"""Pieces submitted ahead for each processor of the cluster: no worker waits, and few results do."""


def ray_farm(address: str) -> "RayFarm":
    """Return the farm of a cluster by its address: `auto`, HOST:PORT, ray://HOST:PORT, or `local`
    to start one.

    Raises WorkersLostError where Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise WorkersLostError(
            "--ray needs Ray, which is not installed: pip install 'nlos-cam[many]'"
        ) from error
    return RayFarm(ray, address)


class RayFarm:
    """Farm on a Ray cluster: it connects when samples are requested, and disconnects when the
    generator is closed.
    """

    def __init__(self, ray: Any, address: str) -> None:
        self._ray = ray
        self._address = address
        self.workers = 1
        """Processors of the cluster, once it was connected to."""

    def __call__(
        self, plan: DatasetPlan, pieces: Sequence[range]
    ) -> Generator[tuple[range, Samples]]:
        """Yield the samples of ranges of seeds, in any order. Raises WorkersLostError where the
        cluster fails.
        """
        if not pieces:
            return
        self._connect()
        try:
            yield from self._make(plan, pieces)
        except self._ray.exceptions.RayError as error:
            raise _cause(error) from error
        finally:
            self._ray.shutdown()

    def _connect(self) -> None:
        try:
            # Ray gives its workers the current folder to import from.
            with safe_children(), chdir(package_folder()):
                self._ray.init(address=self._address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            raise WorkersLostError(
                f"no Ray cluster lets us in at {self._address!r}"
                f" ({' '.join(str(error).split()):.120}): start one with `ray start --head`, set"
                " the RAY_AUTH_TOKEN that it has, or omit --ray"
            ) from error

    def _make(self, plan: DatasetPlan, pieces: Sequence[range]) -> Generator[tuple[range, Samples]]:
        ray = self._ray
        remaining = iter(pieces)
        work = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(make_piece)
        self.workers = max(1, int(ray.cluster_resources().get("CPU", 1)))
        ahead = PIECES_PER_CPU * self.workers
        waiting = {work.remote(plan, piece, VERSION): piece for piece in islice(remaining, ahead)}
        while waiting:
            (ready, *_), _ = ray.wait([*waiting], num_returns=1)
            yield waiting.pop(ready), ray.get(ready)
            waiting |= {work.remote(plan, piece, VERSION): piece for piece in islice(remaining, 1)}


def make_piece(plan: DatasetPlan, piece: range, wanted: str) -> Samples:
    """Return samples, as a worker. Raises SceneError where this machine has another version than
    `wanted`, or would make other bits by the plan.
    """
    if wanted != VERSION:
        raise SceneError(
            f"a worker has nlos-cam {VERSION}, not {wanted}: install the same version on every"
            " machine"
        )
    # between two releases, commits of the same version number may differ in these
    own = RENDERING_VERSION, OBJECTS_VERSION
    planned = plan.rendering_version, plan.objects.version
    if own != planned:
        raise SceneError(
            f"a worker has renderer {own[0]} and objects {own[1]}, the plan renderer {planned[0]}"
            f" and objects {planned[1]}: install the same commit on every machine"
        )
    use_one_thread()
    return make_samples(plan, piece)


def _cause(error: Exception) -> NlosCamError:
    """Return a worker's own error, or WorkersLostError."""
    cause = getattr(error, "cause", None)
    if isinstance(cause, NlosCamError):
        return cause
    problem = " ".join(str(error).split())
    return WorkersLostError(
        f"the Ray cluster failed ({problem:.200}): finished shards are kept; build again"
    )

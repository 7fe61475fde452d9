"""Dataset builds: equal shards for any workers, order or interruption, in processes or by Ray;
damage is rebuilt.
"""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from multiprocessing import active_children, get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numba
import numpy as np
import pytest
from fake_workers import FakeWorkers, samples_of
from nlos_calibration import load_rig

import nlos_cam
from nlos_cam import errors
from nlos_cam.dataset import (
    HELD_OUT_SEED,
    TEST_SEED,
    BuildReport,
    DatasetPlan,
    build_dataset,
    open_dataset,
    ray_backend,
    worker,
)
from nlos_cam.dataset import build as dataset
from nlos_cam.dataset.build import SEEDS_END, in_batches, processes
from nlos_cam.dataset.locked import LOCKED
from nlos_cam.dataset.ray_backend import PIECES_PER_CPU, RayFarm, make_piece
from nlos_cam.dataset.samples import Samples, make_samples
from nlos_cam.dataset.shards import SHARD_PATTERN, only_builder, store
from nlos_cam.errors import SceneError, WorkersLostError

Patch = pytest.MonkeyPatch
PLAN = DatasetPlan(load_rig("paper-rig"), 40, accuracy="draft")
COUNT = 23
LAST = "shard-000000060.h5"  # the last shard holds three objects, the others five
BLAS = "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
PARENT = """
import multiprocessing, time
from threading import Thread
from nlos_cam.dataset.worker import end_with_parent
def wait(connection):
    Thread(target=end_with_parent, daemon=True).start()
    connection.send("ready")
    time.sleep(60)
if __name__ == "__main__":
    mine, other = multiprocessing.get_context("fork").Pipe()
    child = multiprocessing.get_context("fork").Process(target=wait, args=(other,))
    child.start()
    mine.recv()
    print(child.pid, flush=True)
    time.sleep(60)
"""
Shards = dict[str, bytes]


@pytest.fixture(autouse=True, scope="module")
def _small_shards() -> Iterator[None]:
    with Patch.context() as patch:
        patch.setattr(dataset, "SHARD", 5)
        patch.setattr(dataset, "PIECE", 2)
        yield


def _build(folder: Path, farm: Any = None, count: int = COUNT, **others: Any) -> BuildReport:
    options = {
        "workers": 1,
        "on_progress": lambda *_: None,
        "farm": farm or FakeWorkers(),
        **others,
    }
    return build_dataset(options.pop("plan", PLAN), count, folder, **options)


def _bytes(folder: Path) -> Shards:
    return {
        path.name: path.read_bytes() for path in folder.glob("*") if not path.name.startswith(".")
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Shards:
    """Shards of an undisturbed build."""
    _build(folder := tmp_path_factory.mktemp("whole"))
    return _bytes(folder)


@pytest.fixture
def finished(tmp_path: Path, whole: Shards) -> Path:
    """Folder of an undisturbed build."""
    (folder := tmp_path / "finished").mkdir()
    for name, content in whole.items():
        (folder / name).write_bytes(content)
    return folder


def test_build_stores_samples_in_seed_order(tmp_path: Path) -> None:
    built = _build(tmp_path)

    found = open_dataset(tmp_path)

    assert built.objects == COUNT
    assert built.made == COUNT
    assert built.damaged == ()
    assert len(found) == COUNT
    assert found.plan == PLAN

    for name, values in samples_of(range(40, 40 + COUNT)).items():
        np.testing.assert_array_equal(found.column(name), values)


@pytest.mark.parametrize("first_seed", [SEEDS_END - 4, 2**63, 10**20])
def test_build_refuses_seeds_that_no_shard_is_named_by(tmp_path: Path, first_seed: int) -> None:
    with pytest.raises(SceneError, match="too large"):
        _build(tmp_path / "out", plan=replace(PLAN, first_seed=first_seed), count=5)

    _build(tmp_path / "below", plan=replace(PLAN, first_seed=SEEDS_END - 5), count=5)


@pytest.mark.parametrize("reserved", [HELD_OUT_SEED, TEST_SEED])
def test_build_keeps_reserved_seeds_out_of_others(tmp_path: Path, reserved: int) -> None:
    with pytest.raises(SceneError, match=str(reserved)):
        _build(tmp_path / "out", plan=replace(PLAN, first_seed=reserved - 4), count=5)
    assert not (tmp_path / "out").exists()

    _build(tmp_path / "below", plan=replace(PLAN, first_seed=reserved - 5), count=5)
    _build(tmp_path / "from", plan=replace(PLAN, first_seed=reserved), count=5)


def test_build_reports_progress(tmp_path: Path) -> None:
    progress: list[tuple[int, int]] = []

    _build(tmp_path, on_progress=lambda *at: progress.append(at))

    done = (0, 2, 4, 5, 7, 9, 10, 12, 14, 15, 17, 19, 20, 22, 23)

    assert progress == [(count, COUNT) for count in done]


@pytest.mark.parametrize("after", [0, 1, 2, 3, 7, 11, 13])
@pytest.mark.parametrize("order", [None, 3])
def test_interrupted_build_resumes_without_making_a_sample_twice(
    tmp_path: Path, whole: Shards, after: int, order: int | None
) -> None:
    farm = FakeWorkers(order, fails_after=after)
    rest = FakeWorkers()
    with pytest.raises(KeyboardInterrupt):
        _build(tmp_path, farm)
    kept = _bytes(tmp_path)

    assert farm.closed
    assert kept.items() <= whole.items()

    built = _build(tmp_path, rest)

    again = [seed for piece in rest.made for seed in piece]
    lacking = COUNT - sum(3 if name == LAST else 5 for name in kept)

    assert _bytes(tmp_path) == whole
    assert len(again) == len(set(again)) == built.made == lacking


@pytest.mark.parametrize("after", [0, 1, 2, 3, 7, 11, 13])
def test_interrupted_build_keeps_every_finished_shard(tmp_path: Path, after: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        _build(tmp_path, FakeWorkers(fails_after=after))

    assert len(_bytes(tmp_path)) == after // 3  # a shard is made in three pieces


def _cut(path: Path, keep: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.99])
def test_build_replaces_damaged_shard(finished: Path, whole: Shards, keep: float) -> None:
    warnings = list[str]()
    path = finished / "shard-000000045.h5"
    _cut(path, keep)

    built = _build(finished, on_warning=warnings.append)

    assert [str(path) in line for line in warnings] == [True]
    assert built.made == 5
    assert built.damaged == (path,)
    assert _bytes(finished) == whole


def test_build_leaves_damaged_shard_that_it_does_not_need(finished: Path, whole: Shards) -> None:
    warnings = list[str]()
    path = finished / LAST
    _cut(path, 0.0)

    built = _build(finished, count=10, on_warning=warnings.append)

    assert [str(path) in line for line in warnings] == [True]
    assert built.made == 0
    assert built.damaged == ()
    assert _bytes(finished) != whole


@pytest.mark.parametrize("first", [1, 5, 7, 22])
def test_build_grows_dataset_to_count(tmp_path: Path, whole: Shards, first: int) -> None:
    """7 objects leave a shard half full, which a larger count must fill."""
    _build(tmp_path, count=first)

    assert len(open_dataset(tmp_path)) == first

    grown = _build(tmp_path)

    assert grown.made == COUNT - first // 5 * 5
    assert _bytes(tmp_path) == whole


def test_build_checks_finished_dataset_and_leaves_it_alone(finished: Path, whole: Shards) -> None:
    farm = FakeWorkers()
    checked = list[tuple[int, int]]()

    built = _build(finished, farm, on_check=lambda *at: checked.append(at))

    assert farm.made == []
    assert built.made == 0
    assert checked == [(k, 5) for k in range(1, 6)]
    assert _bytes(finished) == whole


def test_build_refuses_another_plan(finished: Path, whole: Shards) -> None:
    rig = PLAN.rig.model_copy(update={"name": "other"})

    with pytest.raises(errors.RecordingError, match=r"rig.*accuracy"):
        _build(finished, plan=replace(PLAN, accuracy="fine", rig=rig))

    assert _bytes(finished) == whole


def test_build_refuses_another_shard_size(
    finished: Path, whole: Shards, monkeypatch: Patch
) -> None:
    monkeypatch.setattr(dataset, "SHARD", 4)

    with pytest.raises(errors.RecordingError, match=r"shard-000000040\.h5"):
        _build(finished)

    assert _bytes(finished) == whole


def test_build_refuses_dataset_of_a_newer_program(finished: Path) -> None:
    newer = PLAN.provenance.replace('{"rig"', '{"lens": 1, "rig"', 1)
    store(finished / "shard-000000040.h5", samples_of(range(40, 45)), newer, "")
    before = _bytes(finished)

    with pytest.raises(errors.RecordingError, match="lens"):
        _build(finished)

    assert _bytes(finished) == before


def test_build_locks_its_folder(tmp_path: Path) -> None:
    with only_builder(tmp_path), pytest.raises(errors.FolderBusyError, match=str(os.getpid())):
        _build(tmp_path)


def test_build_leaves_shards_alone_in_its_folder(tmp_path: Path) -> None:
    _build(tmp_path)

    assert {path.suffix for path in tmp_path.iterdir()} == {".h5"}


def test_build_refuses_a_file_as_its_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("here")

    with pytest.raises(errors.OutputExistsError, match="--out"):
        _build(tmp_path / "file")


def test_build_keeps_shards_if_object_fails(tmp_path: Path, whole: Shards) -> None:
    farm = FakeWorkers(fails_after=4, error=errors.SceneError("cup.stl shows nothing"))

    with pytest.raises(errors.SceneError, match=r"cup\.stl"):
        _build(tmp_path, farm)

    assert farm.closed
    assert len(_bytes(tmp_path)) == 1

    _build(tmp_path)

    assert _bytes(tmp_path) == whole


def test_build_keeps_shards_if_disk_is_full(
    tmp_path: Path, whole: Shards, monkeypatch: Patch
) -> None:
    farm = FakeWorkers()
    stores = iter([*[store] * 3, Mock(side_effect=errors.DiskFullError("full")), *[store] * 9])
    monkeypatch.setattr(dataset, "store", lambda *given: next(stores)(*given))  # noqa: PLW0108

    with pytest.raises(errors.DiskFullError):
        _build(tmp_path, farm)

    assert farm.closed
    assert len(list(tmp_path.glob(SHARD_PATTERN))) == 3

    _build(tmp_path)

    assert _bytes(tmp_path) == whole


MAKER = "nlos_cam.dataset.samples.make_samples"


def _dying(counter: Path, dies_at: Sequence[int]) -> Callable[[object, range], Samples]:
    """Return a maker of samples whose process is killed at some of its calls, counted over all
    processes.
    """

    def make(_: object, piece: range) -> Samples:
        with counter.open("a", encoding="utf-8") as file:
            file.write(".")
        if counter.stat().st_size in dies_at:
            os.kill(os.getpid(), signal.SIGKILL)
        return samples_of(piece)

    return make


@pytest.fixture
def _forked(monkeypatch: Patch) -> None:
    monkeypatch.setattr(worker, "CONTEXT", get_context("fork"))
    monkeypatch.setattr(worker, "begin_worker", lambda: None)


@pytest.mark.usefixtures("_forked")
# Two workers may leave gaps in every shard.
@pytest.mark.parametrize(("workers", "least"), [(1, 2), (2, 0)])
def test_processes_give_up_where_workers_die_again_and_again(
    tmp_path: Path, whole: Shards, monkeypatch: Patch, workers: int, least: int
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(MAKER, _dying(tmp_path / "calls", range(7, 100)))

    with pytest.raises(errors.WorkersLostError, match=r"code -9\).*--workers"):
        _build(out, processes(workers))

    assert _bytes(out).items() <= whole.items()
    assert least <= len(_bytes(out)) <= 2
    assert not active_children()


@pytest.mark.usefixtures("_forked")
@pytest.mark.parametrize("workers", [1, 2])
def test_processes_replace_killed_workers(
    tmp_path: Path, whole: Shards, monkeypatch: Patch, workers: int
) -> None:
    monkeypatch.setattr(MAKER, _dying(tmp_path / "calls", [2, 6]))

    _build(tmp_path / "out", processes(workers))

    assert _bytes(tmp_path / "out") == whole
    assert not active_children()


@pytest.mark.usefixtures("_forked")
def test_build_resumes_after_processes_gave_up(
    tmp_path: Path, whole: Shards, monkeypatch: Patch
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(MAKER, _dying(tmp_path / "calls", range(7, 100)))
    with pytest.raises(errors.WorkersLostError):
        _build(out, processes(2))
    monkeypatch.setattr(MAKER, _dying(tmp_path / "later", [2, 6]))

    _build(out, processes(2))

    assert _bytes(out) == whole


@pytest.mark.usefixtures("_forked")
def test_processes_raise_what_a_worker_raised(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(MAKER, Mock(side_effect=SceneError("no such object")))

    with pytest.raises(SceneError, match="no such object") as raised:
        _build(tmp_path / "out", processes(2))

    assert "make_samples" in raised.value.__notes__[0]  # where in the worker
    assert not active_children()


@pytest.mark.usefixtures("_forked")
def test_processes_say_where_none_can_start(tmp_path: Path, monkeypatch: Patch) -> None:
    refusal = Mock(side_effect=OSError(errno.EAGAIN, "Resource temporarily unavailable"))
    monkeypatch.setattr(worker.CONTEXT.Process, "start", refusal)

    with pytest.raises(errors.WorkersLostError, match="Resource temporarily unavailable"):
        _build(tmp_path / "out", processes(2))

    assert not active_children()


@pytest.mark.usefixtures("_forked")
def test_closing_ends_workers_while_they_send(monkeypatch: Patch) -> None:
    def large(_: object, piece: range) -> Samples:
        return {"depth_m": np.zeros((len(piece), 1_000_000))}  # more than a pipe holds

    monkeypatch.setattr(MAKER, large)
    made = processes(2)(PLAN, PIECES)
    next(made)

    made.close()

    assert not active_children()


@pytest.mark.usefixtures("_forked")
def test_all_pieces_come_before_any_process_is_waited_for(monkeypatch: Patch) -> None:
    """A process without work takes a second to end: a pace that counted it would be too low."""
    monkeypatch.setattr(MAKER, lambda _, piece: samples_of(piece))
    waited_for: list[object] = []
    end = worker.Worker.end
    monkeypatch.setattr(worker.Worker, "end", lambda self: (waited_for.append(self), end(self))[1])

    before = [len(waited_for) for _ in processes(2)(PLAN, PIECES)]

    assert before == [0] * len(PIECES)
    assert len(waited_for) == 2
    assert not active_children()


@pytest.mark.slow
def test_processes_make_the_samples_of_one_process(tmp_path: Path) -> None:
    build_dataset(PLAN, 4, tmp_path, workers=2, on_progress=lambda *_: None)

    found = open_dataset(tmp_path)
    for name, values in make_samples(PLAN, range(40, 44)).items():
        np.testing.assert_array_equal(found.column(name), values)

    assert not active_children()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_worker_ends_with_killed_parent() -> None:
    command = [sys.executable, "-c", PARENT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout.readline().strip().isdigit()

        parent.send_signal(signal.SIGKILL)
        parent.wait()

        assert parent.stdout.read() == ""  # end of file: the worker held this pipe open, and ended


@pytest.fixture
def _begun(monkeypatch: Patch) -> Iterator[None]:
    """As in a worker that has begun; put back afterwards."""
    monkeypatch.setattr(worker, "parent_process", lambda: None)
    for name in BLAS:
        monkeypatch.setenv(name, "2")
    threads = numba.get_num_threads()
    handler = signal.getsignal(signal.SIGINT)
    try:
        worker.begin_worker()
        yield
    finally:
        numba.set_num_threads(threads)
        signal.signal(signal.SIGINT, handler)


@pytest.mark.usefixtures("_begun")
def test_worker_has_one_thread() -> None:
    assert numba.get_num_threads() == 1
    assert {os.environ[name] for name in BLAS} == {"1"}


@pytest.mark.usefixtures("_begun")
def test_worker_ignores_interrupts() -> None:
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


@pytest.mark.parametrize(
    ("modules", "without"),
    [
        # BLAS counts processors when numpy is imported: after begin_worker.
        ("nlos_cam.cli.main, nlos_cam.dataset.worker", "numpy"),
        pytest.param("nlos_cam.dataset.samples", "torch", marks=pytest.mark.slow),
    ],
)
def test_module_does_not_import(modules: str, without: str) -> None:
    program = f"import sys, {modules}; raise SystemExit({without!r} in sys.modules)"

    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


PIECES = [range(k, k + 2) for k in range(0, 40, 2)]
CLUSTER = """
import sys
from pathlib import Path
import numpy as np
from ray.cluster_utils import Cluster
from nlos_cam.cli.main import main
from nlos_cam.dataset import open_dataset
from nlos_cam.dataset.samples import make_samples

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
cluster.add_node(num_cpus=1)
assert len(cluster.list_all_nodes()) == 2
build = f"dataset build --ray {cluster.address} --count 20 --accuracy draft --out"
assert main([*build.split(), sys.argv[1]]) == 0
found = open_dataset(Path(sys.argv[1]))
expected = make_samples(found.plan, range(20))
for name in ("depth_m", "intensity", "image", "seed"):
    np.testing.assert_array_equal(found.column(name), expected[name])
cluster.shutdown()
"""
"""Two workers on the loopback, as two machines would be, and the command for them."""


class RayError(Exception):
    cause: Exception | None = None


class FakeRay:
    """The part of Ray that the farm uses, in this process; results arrive last first."""

    exceptions = SimpleNamespace(RayError=RayError)
    cluster_resources = Mock(return_value={"CPU": 2.0})

    def __init__(self, fails: RayError | None = None) -> None:
        self.fails = fails
        self.running = False
        self.most_waiting = 0

    def init(self, address: str, **_: object) -> None:
        if address == "nowhere":
            raise ConnectionError("could not\nfind any running Ray instance")
        self.running = True

    def shutdown(self) -> None:
        self.running = False

    def remote(self, **options: object) -> Callable[..., Any]:
        assert options == {"num_cpus": 1, "max_retries": ray_backend.MAX_RETRIES}
        return lambda work: SimpleNamespace(remote=lambda *arguments: (work, arguments))

    def wait(self, waiting: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        assert num_returns == 1
        self.most_waiting = max(self.most_waiting, len(waiting))
        return waiting[-1:], waiting[:-1]

    def get(self, ready: tuple[Callable[..., Any], tuple[Any, ...]]) -> Any:
        if self.fails:
            raise self.fails
        return ready[0](*ready[1])


@pytest.fixture(autouse=True)
def _nothing_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_backend, "make_samples", lambda _, piece: samples_of(piece))
    monkeypatch.setattr(ray_backend, "use_one_thread", lambda: None)


def test_ray_farm_makes_every_piece_once() -> None:
    made = dict(RayFarm(FakeRay(), "auto")(PLAN, PIECES))

    assert sorted(made, key=lambda piece: piece.start) == PIECES

    for piece, samples in made.items():
        np.testing.assert_array_equal(samples["depth_m"], samples_of(piece)["depth_m"])


def test_ray_farm_keeps_few_pieces_waiting_and_leaves_cluster() -> None:
    ray = FakeRay()
    farm = RayFarm(ray, "auto")

    list(farm(PLAN, PIECES))

    assert farm.workers == 2
    assert ray.most_waiting == 2 * PIECES_PER_CPU
    assert not ray.running


def test_closed_ray_farm_leaves_cluster() -> None:
    ray = FakeRay()
    making = RayFarm(ray, "auto")(PLAN, PIECES)
    next(making)

    assert ray.running

    making.close()

    assert not ray.running


def test_ray_farm_with_nothing_to_make_needs_no_cluster() -> None:
    assert list(RayFarm(FakeRay(), "nowhere")(PLAN, [])) == []


def test_ray_farm_names_missing_cluster() -> None:
    with pytest.raises(WorkersLostError, match="nowhere") as caught:
        list(RayFarm(FakeRay(), "nowhere")(PLAN, PIECES))

    assert "\n" not in str(caught.value)


def test_ray_farm_raises_error_of_failed_worker() -> None:
    failed = RayError("a long traceback")
    failed.cause = SceneError("cup.stl is empty")

    with pytest.raises(SceneError, match=r"^cup\.stl is empty$"):
        list(RayFarm(FakeRay(failed), "auto")(PLAN, PIECES))


def test_ray_farm_raises_error_of_lost_worker_and_leaves_cluster() -> None:
    ray = FakeRay(RayError("the worker\ndied"))

    with pytest.raises(WorkersLostError, match="the worker died"):
        list(RayFarm(ray, "auto")(PLAN, PIECES))

    assert not ray.running


def test_ray_worker_of_the_same_version_makes_samples() -> None:
    made = make_piece(PLAN, range(1), nlos_cam.__version__)

    assert made.keys() == samples_of(range(1)).keys()


def test_ray_worker_of_another_version_is_refused() -> None:
    with pytest.raises(SceneError, match=rf"{nlos_cam.__version__}.*9\.9"):
        make_piece(PLAN, range(1), "9.9")


@pytest.mark.parametrize(
    "plan",
    [
        replace(PLAN, rendering_version=PLAN.rendering_version + 1),
        replace(PLAN, objects=replace(PLAN.objects, version=PLAN.objects.version + 1)),
    ],
    ids=["renderer", "objects"],
)
def test_ray_worker_of_another_renderer_is_refused(plan: DatasetPlan) -> None:
    with pytest.raises(SceneError, match="same commit on every machine"):
        make_piece(plan, range(1), nlos_cam.__version__)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray (the extra `many`)")
def test_cluster_of_two_machines_makes_equal_samples(tmp_path: Path) -> None:
    """Runs in a process of its own, since Ray leaves threads behind."""
    command = [sys.executable, "-c", CLUSTER, str(tmp_path / "data")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=280)

    assert done.returncode == 0, done.stdout + done.stderr


def test_batches_of_locked_differences_are_refused_by_name() -> None:
    with pytest.raises(SceneError, match="torch renders no locked differences"):
        next(in_batches("torch")(replace(PLAN, accuracy=LOCKED), [range(40, 42)]))


def test_torch_renders_the_same_samples_in_batches() -> None:
    ((seeds, batch),) = in_batches("torch")(PLAN, [range(40, 42)])
    one_by_one = make_samples(PLAN, seeds)

    for name in ("image", "object_depth_m", "seed", "scene"):
        np.testing.assert_array_equal(batch[name], one_by_one[name])
    off_m = np.abs(batch["depth_m"] - one_by_one["depth_m"])
    # a tie of two bins may have another winner
    assert (np.nan_to_num(off_m) > 1e-4).mean() < 0.02
    np.testing.assert_allclose(batch["intensity"].mean(), one_by_one["intensity"].mean(), rtol=1e-3)

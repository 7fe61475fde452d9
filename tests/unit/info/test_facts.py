"""Facts that `info` gives of each kind, of files whose content is known."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_workers import samples_of
from made_benches import make_bench
from made_turns import made_plan, made_turns
from made_up_moments import moment, with_result
from nlos_calibration import load_rig
from rewritten_bags import Messages, rewrite

from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.detect import Session
from nlos_cam.errors import RecordingError
from nlos_cam.info import Description, describe
from nlos_cam.live import FrameLog
from nlos_cam.reconstruct import Verdict
from nlos_cam.recording import ReplayCamera, SidecarFile, sidecar_path
from nlos_cam.recording.quality import Quality
from nlos_cam.recording.sidecar import summary_of
from nlos_cam.transients import Transient, save_transient
from nlos_cam.transients.transient import Layout
from nlos_cam.view import SESSION_MARK

ROOT = Path(__file__).parents[3]
RIG = load_rig("paper-rig")


def described(path: Path, *, verify: bool = False) -> Description:
    found = describe(path, verify=verify)
    assert found.problem == ""
    return found


def test_bench_has_camera_stations_weights_and_next_command(tmp_path: Path) -> None:
    found = described(make_bench(tmp_path / "bench"))

    assert found.kind == "bench"
    assert found.facts["camera"] == "f0123456"
    assert found.facts["station main"].endswith("occluder detected")
    assert found.facts["weights"].startswith("none")
    assert found.next == [f"nlos-cam live --camera l515 --bench {tmp_path / 'bench'}"]


def test_record_of_a_bench_leads_to_its_folder(tmp_path: Path) -> None:
    found = described(make_bench(tmp_path / "bench") / "bench.toml")

    assert found.kind == "record of a bench"
    assert found.next == [f"nlos-cam info {tmp_path / 'bench'}"]


@pytest.mark.parametrize(
    ("path", "kind", "following"),
    [
        ("models/recipes/paper-rig-direct.toml", "training recipe", "nlos-cam train direct"),
        ("calibration/nlos_calibration/rigs/paper-rig.toml", "rig", "nlos-cam render cup --rig"),
    ],
)
def test_packaged_file_has_its_kind_and_next_command(path: str, kind: str, following: str) -> None:
    found = described(ROOT / path)

    assert found.kind == kind
    assert found.next[0].startswith(following)


def test_saved_view_is_played_next(tmp_path: Path) -> None:
    path = tmp_path / "view.html"
    path.write_bytes(b"<!-- " + SESSION_MARK + b" -->")

    assert described(path).kind == "saved view"
    assert described(path).next == [f"nlos-cam view {path}"]


@pytest.fixture
def recording(noise_bag: Path, tmp_path: Path) -> Path:
    """A recording with its sidecar."""
    path = Path(shutil.copy(noise_bag, tmp_path / "run.bag"))
    with ReplayCamera(path) as camera:
        sidecar = SidecarFile(sidecar_path(path), camera, label="cup")
    sidecar.finish("complete", summary_of(None, Quality(), {}))
    return path


def test_recording_names_its_device_and_label(recording: Path) -> None:
    found = described(recording)

    assert found.facts["device"] == "Simulated L515 simulated"
    assert (found.facts["label"], found.facts["state"]) == ("cup", "complete")
    assert found.made_by.startswith("nlos-cam ")
    assert [line.split()[1] for line in found.next] == ["replay", "export"]


def test_sidecar_leads_to_its_recording_while_that_is_there(recording: Path) -> None:
    found = described(sidecar_path(recording))

    assert found.kind == "sidecar of a recording"
    assert found.next == [f"nlos-cam info {recording}"]
    assert "frames" not in found.facts  # it was not verified

    recording.unlink()

    assert "run.bag is missing" in describe(sidecar_path(recording), verify=False).problem


def test_damaged_recording_is_not_replayed_next(noise_bag: Path, tmp_path: Path) -> None:
    def cut(topic: str, time_ns: int, raw: bytes) -> Messages:
        yield time_ns, raw[:-9] if topic.endswith("Depth_0/image/data") else raw

    found = describe(rewrite(noise_bag, tmp_path / "cut.bag", cut), verify=True)

    assert found.problem
    assert [line.split()[1] for line in found.next] == ["export"]


def test_stream_of_an_unknown_encoding_is_called_unreadable(
    noise_bag: Path, tmp_path: Path
) -> None:
    def other(topic: str, time_ns: int, raw: bytes) -> Messages:
        yield time_ns, raw.replace(b"8UC1", b"9UC9") if "Infrared" in topic else raw

    facts = described(rewrite(noise_bag, tmp_path / "odd.bag", other)).facts

    assert facts["infrared"].endswith("9UC9 (not readable)")
    assert facts["depth"].endswith("z16")


def test_empty_result_says_that_it_has_no_frames(tmp_path: Path) -> None:
    path = tmp_path / "none.npz"
    np.savez(path, frame_number=[], timestamp_s=[], pixels=[], encoding="z16")
    assert described(path).facts["frames"] == "none"


@pytest.mark.parametrize("has_page", [False, True])
def test_replay_opens_its_page_where_it_has_one(tmp_path: Path, has_page: bool) -> None:
    frames = {"frame_number": [3], "timestamp_s": [0.0], "rig_name": "a", "rig_checksum": "b"}
    seen = {"depth_m": [1.0], "verdict": ["object seen"], "origin_m": [0.0, 0.0]}
    np.savez(tmp_path / "reconstruction.npz", **frames, **seen)
    if has_page:
        (tmp_path / "report.html").touch()

    assert (f"open {tmp_path / 'report.html'}" in described(tmp_path).next) == has_page


def test_run_has_the_last_figures_of_its_log(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("epoch,loss\n1,0.5\n2,0.25\n")
    assert described(tmp_path).facts == {
        "epochs": "2",
        "state": "not finished: the same command resumes",
        "last loss": "0.25",
    }


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_log_of_a_live_run_has_its_frames_and_verdicts(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    with FrameLog(path) as log:
        for number in range(3):
            log.add(with_result(moment(number), verdict=Verdict.SEEN if number else None))
    with path.open("a") as file:
        file.write('{"frame' if suffix == ".jsonl" else "3,0.1,")  # a killed run
    found = described(path)

    assert found.kind == "log of a live run"
    assert found.facts["frames"] == "3"
    assert (found.facts["no verdict"], found.facts["object seen"]) == ("1 frame", "2 frames")


def test_table_that_is_no_log_is_of_no_known_kind(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("a,b\n1,2\n")
    with pytest.raises(RecordingError, match="no known kind"):
        describe(tmp_path / "mine.csv")


def test_work_of_adapt_has_its_minutes(tmp_path: Path) -> None:
    stages = [{"minutes": 1.0, "objects": 1000}, {"minutes": 9.0, "objects": 5000}]
    work = make_bench(tmp_path / "my bench") / "adapt"
    (work / "stage-1" / "weights").mkdir(parents=True)
    (work / "plan.json").write_text(json.dumps({"rig_checksum": "bbd36036f151", "stages": stages}))
    found = described(work)

    assert found.facts["minutes"] == "10 in 2 stages, 1 done"
    assert found.next == [f"nlos-cam adapt '{tmp_path / 'my bench'}' --minutes 10"]

    elsewhere = Path(shutil.copytree(work, tmp_path / "adapted-rig" / "adapt"))
    assert described(elsewhere).next == []


@pytest.mark.parametrize(
    ("iou", "text"),
    [
        ({"value": 0.5, "low": 0.4, "high": 0.6}, "0.500 (0.400 to 0.600)"),
        ({"value": 0.5, "low": None, "high": None}, "0.500 (one object: no interval)"),
        ({"value": None, "low": None, "high": None}, "none"),
    ],
)
def test_evaluation_has_its_silhouette_iou(
    tmp_path: Path, iou: dict[str, float | None], text: str
) -> None:
    (tmp_path / "figures.json").write_text(json.dumps({"bars": {}, "silhouette_iou": iou}))
    assert described(tmp_path).facts["silhouette IoU"] == text


def test_export_says_which_streams_are_images_or_arrays(tmp_path: Path) -> None:
    streams = {"depth": {}, "infrared": {}, "color": {}}
    (tmp_path / "export.json").write_text(json.dumps({"recording": "a", "streams": streams}))
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "000001.png").touch()
    (tmp_path / "infrared.npz").touch()
    facts = described(tmp_path).facts

    assert [facts[name] for name in streams] == ["1 images", "arrays", "left out"]


@pytest.fixture
def store_shard(tmp_path: Path) -> Callable[..., Path]:
    """Store a shard of a dataset; return its path."""

    def write(first: int, plan: int = 40) -> Path:
        path = shard_path(tmp_path, first)
        store(path, samples_of(range(first, first + 3)), DatasetPlan(RIG, plan).provenance, "made")
        return path

    return write


def test_dataset_has_seeds_gaps_and_other_plans(
    store_shard: Callable[..., Path], tmp_path: Path
) -> None:
    shard = described(store_shard(40))

    assert shard.facts["objects"] == "3, seeds 40 to 42"
    assert "other plans" not in described(tmp_path).facts

    store_shard(46, plan=41)
    facts = described(tmp_path).facts

    assert facts["seeds"] == "40 to 48, with gaps"
    assert facts["other plans"].startswith("1 shard")


def test_verify_finds_the_shard_whose_bytes_were_changed(
    store_shard: Callable[..., Path], tmp_path: Path
) -> None:
    shard = store_shard(40)
    with h5py.File(shard, "r+") as file:
        file["intensity"][...] = file["intensity"][...] + 1

    assert describe(tmp_path, verify=False).problem == ""
    assert shard.name in describe(tmp_path, verify=True).problem


def test_verify_reads_every_turn_of_a_detection(tmp_path: Path) -> None:
    session = Session.start(tmp_path / "session", made_plan())
    turn = session.path(1)
    made_turns(session.plan)[1].save(turn)
    turn.write_bytes(turn.read_bytes()[:-200])

    assert describe(session.folder, verify=False).problem == ""
    assert turn.name in describe(session.folder, verify=True).problem


@pytest.mark.parametrize("verify", [False, True])
def test_what_was_checked_names_verify_unless_all_was(
    store_shard: Callable[..., Path], noise_bag: Path, tmp_path: Path, verify: bool
) -> None:
    arrays = tmp_path / "a.npz"
    np.savez(arrays, x=[1.0])
    for path in (store_shard(40), tmp_path, noise_bag, arrays):
        assert ("--verify" in described(path, verify=verify).checked) == (not verify)


@pytest.mark.parametrize(
    ("whole", "legs"), [(True, "all, from the laser"), (False, "from wall to wall")]
)
def test_transient_has_legs_bins_and_extent(tmp_path: Path, whole: bool, legs: str) -> None:
    grid_m = np.array([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0]])
    made = Transient(
        np.ones((5, 2), np.float32),
        Layout.T_Si,
        grid_m,
        grid_m,
        0.01,
        first_and_last=whole,
        laser_m=np.array([0.0, 0.0, 0.2]),
        detector_m=np.array([0.0, 0.0, 0.2]),
    )
    path = tmp_path / "light.hdf5"
    save_transient(path, made)
    facts = described(path).facts

    assert facts["legs"].startswith(legs)
    assert "5 bins of 10 mm (33.36 ps)" in facts["path length"]
    assert facts["laser points"] == "2: x 0.100 to 0.300 m, y 0.000 m, z 0.000 m"


def test_frames_of_arrays_last_from_the_first_to_the_last(tmp_path: Path) -> None:
    path = tmp_path / "frames.npz"
    depth_m = np.ones((3, 4, 5), np.float32)
    np.savez(path, depth_m=depth_m, frame_number=[7, 8, 9], timestamp_s=[101.0, 101.5, 103.0])

    facts = described(path).facts

    assert facts["frames"] == "3, numbers 7 to 9"
    assert facts["duration"] == "2.0 s"


def test_bytes_in_place_of_a_table_are_said_to_be_binary(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(bytes(range(256)))

    assert "binary file, not a .toml file" in describe(path).problem

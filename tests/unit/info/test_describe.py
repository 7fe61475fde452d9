"""Description of files and folders: every kind is known, whole or damaged, and no content ends in
another error.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from fake_workers import samples_of
from made_benches import make_bench
from made_turns import made_plan, made_turns
from nlos_calibration.rig import load_rig
from nlos_models import shipped_folder

from nlos_cam.bench import write_weights
from nlos_cam.calibrate import WallFiles, write_record
from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.detect import Session
from nlos_cam.errors import RecordingError
from nlos_cam.info import Description, describe
from nlos_cam.objects import SurfaceMesh
from nlos_cam.recording import BagReader, ExportOptions, export_recording
from nlos_cam.report import Document

RIG = load_rig("paper-rig")
FRAMES = {
    "frame_number": [3, 4],
    "timestamp_s": [0.0, 0.1],
    "rig_name": "paper-rig",
    "rig_checksum": "abc",
}
ARRAYS = {
    "result of a replay": {
        **FRAMES,
        "depth_m": [1.0],
        "verdict": ["object seen", ""],
        "origin_m": [0.0, 0.0],
    },
    "difference maps of a replay": {**FRAMES, "depth_m": [1.0], "reference_sha256": "abc"},
    "rendering": {"object_depth_m": [np.nan, 1.0], "margin": [1.0], "radiometry": "paper"},
    "frame saved from the live page": {
        "depth_m": [1.0],
        "lidar_depth_m": [1.0],
        "infrared": [1],
        "frame_number": 3,
        "timestamp_s": 0.1,
        "verdict": "object seen",
    },
    "exported stream": {**FRAMES, "pixels": [[1]], "encoding": "z16"},
    "mesh of a hidden surface": {"vertices_m": np.zeros((3, 3)), "faces": np.zeros((1, 3))},
    "arrays of another program": {"x": [1.0]},
}


@pytest.fixture(scope="module")
def files(
    tmp_path_factory: pytest.TempPathFactory, noise_bag: Path, measured: Callable
) -> dict[str, Path]:
    """A file or folder of every kind, by its kind."""
    folder = tmp_path_factory.mktemp("kinds")
    made = {kind: folder / f"{k}.npz" for k, kind in enumerate(ARRAYS)}
    for kind, path in made.items():
        np.savez(path, **ARRAYS[kind])  # pyright: ignore[reportArgumentType]
    (folder / "data").mkdir()
    made["dataset shard"] = shard_path(folder / "data", 40)
    store(
        made["dataset shard"],
        samples_of(range(40, 43)),
        DatasetPlan(RIG, 40).provenance,
        "nlos-cam dataset build",
    )
    made["dataset"] = folder / "data"
    made["wall record"] = folder / "wall.toml"
    wall = measured()
    write_record(
        WallFiles.beside(made["wall record"], overwrite=False), wall.record, wall.reference
    )
    made["reference of a bare wall"] = folder / "wall.npz"
    made["recording of a lidar"] = noise_bag
    made["export of a recording"] = folder / "exported"
    bag = BagReader(noise_bag)
    options = ExportOptions(every=10)
    export_recording(bag, made["export of a recording"], options, stop=Event())
    made["report"] = folder / "report.html"
    made["report"].write_text(Document("a", "b", []).as_html())
    made["scene of the simulated camera"] = Path(__file__).parents[3] / "examples" / "faults.toml"
    made["weights"] = shipped_folder()
    for name, content, kind in (
        ("figures.json", '{"objects": 3, "bars": {}}', "evaluation"),
        ("tradeoff.json", '{"machine": "a", "pareto_front": []}', "trade-off"),
        ("log.csv", "epoch,loss\n1,0.5\n", "training run"),
    ):
        (folder / kind).mkdir()
        (folder / kind / name).write_text(content)
        made[kind] = folder / kind
    made["figures of an evaluation"] = made["evaluation"] / "figures.json"
    made["table of a trade-off"] = made["trade-off"] / "tradeoff.json"
    for name, content, kind in (
        ("plan.json", '{"rig_checksum": "a", "pace": {}, "stages": []}', "plan of an adaptation"),
        ("cup.truth.toml", 'category = "cup"\n', "object of labelled recordings"),
        ("empty-log.csv", "frame_number,published_s,latency_ms\n", "log of a live run"),
    ):
        made[kind] = folder / name
        made[kind].write_text(content)
    session = Session.start(folder / "detection", made_plan())
    made_turns(session.plan)[0].save(session.path(0))
    made["detection"] = session.folder
    made["plan of a detection"] = session.folder / "detection.json"
    made["turn of a detection"] = session.path(0)
    made["mesh"] = folder / "triangle.obj"
    made["mesh"].write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n")
    made["files of single frames"] = folder / "objects"
    made["files of single frames"].mkdir()
    surface = SurfaceMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    made["point cloud"] = made["files of single frames"] / "000003-points.ply"
    made["point cloud"].write_bytes(surface.points_only.as_bytes(".ply"))
    made["recordings"] = folder / "recordings"
    made["recordings"].mkdir()
    shutil.copy(noise_bag, made["recordings"] / "a.bag")
    return made


KINDS = [
    *ARRAYS,
    *(
        "dataset shard",
        "dataset",
        "wall record",
        "reference of a bare wall",
        "recording of a lidar",
        "report",
    ),
    *(
        "export of a recording",
        "scene of the simulated camera",
        "weights",
        "evaluation",
        "trade-off",
        "training run",
    ),
    *("figures of an evaluation", "table of a trade-off"),
    *("detection", "plan of a detection", "turn of a detection"),
    *("plan of an adaptation", "object of labelled recordings", "log of a live run"),
    *("mesh", "point cloud", "files of single frames", "recordings"),
]


@pytest.mark.parametrize("verify", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_known_and_whole(files: dict[str, Path], kind: str, verify: bool) -> None:
    found = describe(files[kind], verify=verify)

    assert found.kind == kind
    assert found.problem == ""
    assert found.created
    assert all(line.split(" ")[0] in {"nlos-cam", "open"} for line in found.next)


def test_recording_has_its_frames_and_duration(files: dict[str, Path]) -> None:
    facts = describe(files["recording of a lidar"]).facts

    assert facts["depth"].startswith("20 frames, 30 per second")
    assert facts["duration"] == "0.6 s"


def test_mesh_has_its_triangles_and_its_size(files: dict[str, Path]) -> None:
    facts = describe(files["mesh"]).facts

    assert facts["triangles"] == "1"
    assert facts["size"].startswith("1 x 2 x 0 ")
    assert describe(files["point cloud"]).facts == {"points": "3"}


def test_points_that_were_cut_are_not_whole(files: dict[str, Path], tmp_path: Path) -> None:
    content = files["point cloud"].read_bytes()
    for name, kept in (("whole.ply", content), ("cut.ply", content[:-1])):
        (tmp_path / name).write_bytes(kept)

    assert describe(tmp_path / "whole.ply").problem == ""
    assert "cut.ply is cut short" in describe(tmp_path / "cut.ply").problem


def test_folder_of_frames_counts_each_ending(tmp_path: Path) -> None:
    for name in ("000001.ply", "000001-points.ply", "000003-2.ply", "1234567.csv"):
        (tmp_path / name).touch()

    facts = describe(tmp_path).facts

    assert facts == {
        "-points.ply": "1 file",
        ".csv": "1 file",
        ".ply": "2 files",
        "frames": "1 to 1234567",
    }


def test_one_damaged_recording_makes_a_folder_damaged(noise_bag: Path, tmp_path: Path) -> None:
    shutil.copy(noise_bag, tmp_path / "whole.bag")
    (tmp_path / "cut.bag").write_bytes(noise_bag.read_bytes()[:100])

    found = describe(tmp_path)

    assert "cut.bag" in found.problem
    assert found.facts["recordings"] == "2"


def test_sample_is_the_packaged_recording() -> None:
    assert describe(Path("sample")).facts["depth"].startswith("8 frames")


def test_dataset_has_its_objects_and_its_command(files: dict[str, Path]) -> None:
    assert describe(files["dataset"]).facts["objects"] == "3 in 1 shard"
    assert "nlos-cam dataset build" in describe(files["dataset shard"]).made_by


def test_replay_has_its_frames_and_verdicts(files: dict[str, Path]) -> None:
    replay = describe(files["result of a replay"]).facts

    assert replay["frames"] == "2, numbers 3 to 4"
    assert replay["verdicts"] == "none 1, object seen 1"


def test_wall_record_has_its_verdict(files: dict[str, Path]) -> None:
    assert describe(files["wall record"]).facts["verdict"].startswith("good")


def test_pipes_and_arrays_that_would_fill_memory_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "wall.toml")
    with pytest.raises(RecordingError, match="neither a file"):
        describe(tmp_path / "wall.toml")
    monkeypatch.setattr("nlos_cam.info.files.MAX_ARRAY_BYTES", 1000)
    np.savez_compressed(
        tmp_path / "bomb.npz", vertices_m=np.zeros((1000, 3)), faces=np.zeros((1, 3))
    )

    assert "bomb.npz holds more" in describe(tmp_path / "bomb.npz").problem


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda content: content[: len(content) // 2],
    "empty": lambda _: b"",
    "noise": lambda content: np.random.default_rng(0).bytes(min(len(content), 10_000)),
    "flipped": lambda content: bytes(
        byte ^ (at % 97 == 0) for at, byte in enumerate(content[:200_000])
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_file_has_one_line_that_says_so(
    files: dict[str, Path], tmp_path: Path, kind: str, damage: str
) -> None:
    if files[kind].is_dir():
        marks = {
            "dataset": "shard-*.h5",
            "weights": "checkpoint.json",
            "training run": "log.csv",
            "recordings": "*.bag",
            "files of single frames": "*.ply",
        }
        source = next(files[kind].glob(marks.get(kind, "*.json")))
        place = tmp_path
    else:
        source = files[kind]
        place = tmp_path / files[kind].name
    (tmp_path / source.name).write_bytes(DAMAGES[damage](source.read_bytes()))
    try:
        found = describe(place, verify=True)
    except RecordingError as error:
        found = Description("none", problem=str(error))

    assert "\n" not in found.problem
    assert "Traceback" not in found.problem

    unread = {"training run", "scene of the simulated camera", "files of single frames"}
    if damage in {"cut", "noise"} and kind not in unread:
        assert str(place) in found.problem or source.name in found.problem


def test_field_that_no_log_has_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(f"epoch,loss\n1,{'5' * 200_000}\n")

    assert "is damaged" in describe(tmp_path).problem


def test_changed_weights_and_lone_wall_records_are_damaged(
    files: dict[str, Path], tmp_path: Path
) -> None:
    (tmp_path / "wall.toml").write_bytes(files["wall record"].read_bytes())

    assert "wall.npz is missing" in describe(tmp_path / "wall.toml").problem

    (tmp_path / "checkpoint.json").write_bytes((shipped_folder() / "checkpoint.json").read_bytes())
    (tmp_path / "a.safetensors").write_bytes(b"a")
    (tmp_path / "SHA256SUMS").write_text(f"{hashlib.sha256(b'a').hexdigest()}  a.safetensors\n")

    assert describe(tmp_path).problem == ""

    (tmp_path / "a.safetensors").write_bytes(b"b")

    assert "a.safetensors is damaged" in describe(tmp_path).problem

    (tmp_path / "a.safetensors").unlink()

    assert "a.safetensors is missing" in describe(tmp_path).problem

    (tmp_path / "SHA256SUMS").unlink()

    assert "no networks" in describe(tmp_path).problem


def test_verify_reads_what_a_record_names(files: dict[str, Path], tmp_path: Path) -> None:
    for suffix in (".toml", ".npz"):
        path = files["wall record"].with_suffix(suffix)
        (tmp_path / path.name).write_bytes(path.read_bytes())

    assert describe(tmp_path / "wall.toml", verify=True).problem == ""

    (tmp_path / "wall.npz").write_bytes((tmp_path / "wall.npz").read_bytes()[:-500])

    assert "wall.npz" in describe(tmp_path / "wall.toml", verify=True).problem

    (tmp_path / "bench.toml").write_text("bench_version = 99\ncreated = 'nonsense'\n")

    assert describe(tmp_path / "bench.toml").problem


def test_verify_reads_the_weights_of_a_bench(tmp_path: Path) -> None:
    bench = make_bench(tmp_path / "bench")
    write_weights(bench, shipped_folder())

    assert describe(bench, verify=True).problem == ""

    (bench / "weights" / "direct.safetensors").write_bytes(b"changed")

    assert "direct.safetensors" in describe(bench, verify=True).problem


def test_checksums_of_a_finished_run_are_compared(tmp_path: Path) -> None:
    shutil.copytree(shipped_folder(), tmp_path / "run")
    (tmp_path / "run" / "log.csv").write_text("epoch,loss\n1,0.5\n")

    assert describe(tmp_path / "run").problem == ""

    (tmp_path / "run" / "direct.safetensors").write_bytes(b"changed")

    assert "direct.safetensors is damaged" in describe(tmp_path / "run").problem


@pytest.mark.parametrize(
    "name", ["thesis.txt", "a.npy", "folder", "notes.toml", "list.json", "page.html", "view.rrd"]
)
def test_unknown_file_names_the_known_kinds(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.mkdir() if name == "folder" else path.write_text("[]" if name == "list.json" else "")
    with pytest.raises(RecordingError, match="known kind"):
        describe(path)
    with pytest.raises(RecordingError, match="does not exist"):
        describe(tmp_path / "nothing.bag")


def test_recording_of_another_camera_is_described(real_bag: Path) -> None:
    found = describe(real_bag, verify=True)

    assert found.kind == "recording of a RealSense camera"
    assert found.problem == ""
    assert "D435" in found.facts["device"]
    assert found.facts["depth"].endswith("640 x 480, z16")


def test_command_prints_json_without_importing_torch(files: dict[str, Path]) -> None:
    program = (
        "import sys; from nlos_cam.cli.main import main; code = main(sys.argv[1:]); "
        "print(code, *{'torch', 'matplotlib', 'h5py'} & {*sys.modules})"
    )
    run = [sys.executable, "-c", program, "info", str(files["recording of a lidar"]), "--json"]
    answer, ended = subprocess.run(
        run, capture_output=True, text=True, check=True
    ).stdout.splitlines()

    assert ended == "0"

    found = json.loads(answer)
    size = files["recording of a lidar"].stat().st_size

    assert (found["kind"], found["whole"], found["bytes"]) == ("recording of a lidar", True, size)

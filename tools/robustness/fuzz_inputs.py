"""Whole files of every format that nlos-cam reads, and for each the actions that read it when
damaged.

Inputs of the group "light" are read without torch, those of "torch" with it: a process holds one
group.
"""

import hashlib
import io
import json
import os
import re
import shutil
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from nlos_calibration import load_rig, load_wall, reference
from nlos_models import load_record, shipped_folder
from nlos_models.training import load_recipe
from noise_recordings import record
from program_state import program_digest
from rosbags.rosbag1 import Reader

from nlos_cam.bench import load_bench
from nlos_cam.camera import open_camera, simulated_world
from nlos_cam.cli.config import read_settings
from nlos_cam.cli.main import main
from nlos_cam.errors import NlosCamError
from nlos_cam.files import checksums_of, load_cached
from nlos_cam.objects import SurfaceMesh, read_depth_map, read_mesh
from nlos_cam.recording import load_sidecar
from nlos_cam.render import bare_wall_scene, load_scene
from nlos_cam.transients import load_transient
from nlos_cam.view import RecordedView

ROOT = Path(__file__).parents[2]
EXIT_CODES = {0, 1, 2, 3, 4}
MAX_LINES = 12
PROGRESS = re.compile(r": (\d+/\d+.*)?\d+ s$")
"""Lines that a slow command prints now and then."""
DONE = "done"
"""File that marks a complete folder of files, with the checksum of the program that made them."""
RARE = 0.05
"""Share of the recordings that also go through the slow commands."""
SCENE = (
    'name = "a"\nrig = "paper-rig"\n[object]\ncategory = "cup"\nsize_m = 0.1\n[motion]\nposes ='
    " 2\nturn_deg = 9\n"
)
SETTINGS = (
    'camera = "sim"\nwall = "wall.toml"\nweights = "runs"\nview_port = 9000\ncache = "cache"\n'
)
DATASET_ARRAYS = "depth_m", "intensity", "image", "seed"

Action = Callable[[Path, Path, np.random.Generator], None]
"""Reads a damaged file, may write into an empty folder; raises an error of the project's trees, or
nothing.
"""


class Input(NamedTuple):
    """Whole file to be damaged, in a folder with what belongs to it, and what reads it."""

    path: Path
    action: Action


class WrongResultError(AssertionError):
    """A damaged file was accepted as whole."""


def command(*arguments: str | Path) -> dict[str, Any] | None:
    """Run a command; return its JSON object, or None where it refused in a line. Raises
    AssertionError otherwise.
    """
    out = io.StringIO()
    err = io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([*map(str, arguments), "--json"])
    lines = [line for line in err.getvalue().splitlines() if not PROGRESS.search(line)]
    if code not in EXIT_CODES or len(lines) > MAX_LINES or "Traceback" in err.getvalue():
        raise AssertionError(
            f"{arguments[0]} ends with {code} and {len(lines)} lines: {err.getvalue()[-300:]}"
        )
    if "out of memory" in err.getvalue():
        raise MemoryError(err.getvalue()[-300:])
    result = json.loads(out.getvalue().splitlines()[-1], parse_constant=_refuse_constant)
    return result if code == 0 else None


def _refuse_constant(name: str) -> None:
    raise AssertionError(f"{name} in JSON")


def _refuse(count: int) -> None:
    if count:
        raise NlosCamError(f"refused by {count} commands")


def read_recording(path: Path, folder: Path, random: np.random.Generator) -> None:
    """Export, repair and describe a recording, now and then replay it, measure the wall, and check
    the results.
    """
    exported = command("export", path, "--out", folder / "export", "--ply")
    refused = 0
    if exported:
        json.loads(
            (folder / "export" / "export.json").read_text(encoding="utf-8"),
            parse_constant=_refuse_constant,
        )
        for stream, count in exported["frames"].items():
            if len(list((folder / "export" / stream).iterdir())) != count:
                raise WrongResultError(f"reported {count} {stream}, and wrote others")
    refused += exported is None
    if repaired := command("repair", path, "--out", folder / "repaired.bag"):
        with Reader(folder / "repaired.bag") as reader:
            images = [each for each in reader.connections if each.topic.endswith("/image/data")]
            found = [(each.topic, time_ns) for each, time_ns, _ in reader.messages(images)]
        if sum(repaired["recovered_frames"].values()) != len(found):
            raise WrongResultError(
                f"repair claims {repaired['recovered_frames']}, {len(found)} can be read"
            )
    refused += repaired is None
    refused += command("info", path) is None
    if random.random() < RARE:
        command("calibrate", "--bag", path, "--out", folder / "wall.toml")
        refused += command("replay", path, "--out", folder / "replayed") is None
    with open_camera(f"bag:{path}") as camera:
        for frame in camera:
            if any(image.shape != frame.depth_m.shape for image in (frame.ir, frame.confidence)):
                raise WrongResultError(f"frame {frame.frame_number} is not whole")
    _refuse(refused)


def read_text(
    path: Path, _folder: Path, _random: np.random.Generator, load: Callable[[Path], Any]
) -> None:
    """Describe a file of any kind, and load it."""
    command("info", path)
    load(path)


def read_reference(path: Path) -> None:
    """Load a bare-wall reference, with the checksum that its record would have now."""
    reference.load_reference(path, hashlib.sha256(path.read_bytes()).hexdigest())


def read_replayed(path: Path, folder: Path, _random: np.random.Generator) -> None:
    """Describe and export the result of a replay."""
    refused = command("info", path) is None
    refused += command("export", path, "--object", "ply,csv", "--out", folder / "object") is None
    _refuse(refused)


def read_transient(path: Path, folder: Path, _random: np.random.Generator) -> None:
    """Describe, draw and load a transient, whose counts have to be finite."""
    command("info", path)
    command("info", path, "--out", folder / "look.html")
    if not np.isfinite(load_transient(path).histograms).all():
        raise WrongResultError("light that is not finite was accepted")


def read_detection(path: Path, _folder: Path, _random: np.random.Generator) -> None:
    """Describe the folder of a detection, and analyze its turns again."""
    refused = command("info", path.parent) is None
    refused += command("detect", path.parent) is None
    _refuse(refused)


def read_bench(path: Path, _folder: Path, _random: np.random.Generator) -> None:
    """Describe a bench folder, and load it."""
    command("info", path.parent)
    load_bench(path.parent)


def read_cache(path: Path, _folder: Path, _random: np.random.Generator, content: bytes) -> None:
    """Read a cached world whose file may be damaged: it has to be as made, and whole the next
    time.
    """
    entry = path.with_name("0123456789ab.npz")
    made = list[int]()

    def make() -> bytes:
        made.append(1)
        return content

    wanted = simulated_world._unpack(content)  # noqa: SLF001  what the cache's reader makes of it
    for _ in range(2):
        echoes, truths = load_cached(entry, simulated_world._unpack, make)  # noqa: SLF001
        same = [
            np.array_equal(one.peak, two.peak) for one, two in zip(echoes, wanted[0], strict=True)
        ]
        if not all(same) or len(truths) != len(wanted[1]) or len(made) > 1:
            raise WrongResultError("another world came out of the cache, or the damage stayed")


def read_shard(
    path: Path, _folder: Path, _random: np.random.Generator, whole: dict[str, Any]
) -> None:
    """Read a dataset of one shard; any array that comes out has to be the original's."""
    from nlos_cam.dataset import open_dataset, shards

    command("info", path.parent)
    for head in shards.shards_of(path.parent):
        shards.check_arrays(head)
    found = open_dataset(path.parent)
    for name in DATASET_ARRAYS:
        if not np.array_equal(
            found.column(name), whole[name], equal_nan=whole[name].dtype.kind == "f"
        ):
            raise WrongResultError(f"{name} differs and was accepted")


def is_listed(path: Path) -> bool:
    """Return whether a file has the checksum that SHA256SUMS beside it says."""
    return hashlib.sha256(path.read_bytes()).hexdigest() == checksums_of(path.parent).get(path.name)


def read_weights(path: Path, _folder: Path, _random: np.random.Generator) -> None:
    """Load networks from a folder of weights, whose checksum may have been made right."""
    from nlos_models import load_network, load_uncertainty_network

    command("info", path.parent)
    network, _ = load_network(path.parent)
    load_uncertainty_network(path.parent)
    if not is_listed(path):
        raise WrongResultError("changed weights were accepted")
    if not all(tensor.isfinite().all() for tensor in network.state_dict().values()):
        raise WrongResultError("weights that are not finite were accepted")


def read_state(path: Path, _folder: Path, _random: np.random.Generator) -> None:
    """Read the last state of a training run."""
    from nlos_models.training import run_files

    run_files.read_last(path.parent, lambda _: None)


def read_label(path: Path, _folder: Path, _random: np.random.Generator) -> None:
    """Return the depth map of the hidden object that a file beside a recording describes."""
    from nlos_cam.dataset import labelled

    # the part of `dataset label` that reads the file
    labelled._placed(path, "short", load_rig("paper-rig"))  # noqa: SLF001


def make(*arguments: str | Path) -> None:
    """Run a command that makes a whole file. Raises RuntimeError where it refuses."""
    if command(*arguments) is None:
        raise RuntimeError(f"{' '.join(map(str, arguments))} made nothing")


def make_files(home: Path) -> None:
    """Write the whole files that commands make, into an empty folder; to be called in a process of
    its own.
    """
    os.environ["NLOS_CAM_CACHE"] = str(home / "cache")
    for name in ("packed", "plain"):
        record(home / f"{name}.bag", packed=name == "packed", frames=4)
    make(
        "dataset",
        "build",
        "--count",
        "3",
        "--accuracy",
        "draft",
        "--workers",
        "1",
        "--out",
        home / "data",
    )
    make("calibrate", "--wall", "sim:bare-wall", "--frames", "8", "--out", home / "wall.toml")
    make("capture", "sim:bare-wall", "--frames", "3", "--label", "cup", "--out", home / "short.bag")
    make("replay", home / "short.bag", "--out", home / "replayed")
    make("render", "cup", "--accuracy", "draft", "--out", home / "cup.npz")
    transient = "--capture", "confocal", "--wall-cells", "8", "--transient", home / "light.hdf5"
    make("render", "cup", "--accuracy", "draft", *transient)
    make("calibrate", "--wall", "sim:bare-wall", "--frames", "8", "--bench", home / "bench")
    few = "--turns", "16", "--frames", "2", "--seed", "0", "--alpha", "0.2"
    make("detect", "sim", *few, "--out", home / "detection")
    saved = "--seconds", "2", "--save-view", home / "session.html"
    make("live", "sim:bare-wall", "--no-view", *saved)
    scene = bare_wall_scene()
    world = simulated_world.pack_loop(
        *(simulated_world.read_packaged(scene) or simulated_world.render_loop(scene))
    )
    load_cached(home / "worlds" / "0123456789ab.npz", bytes, lambda: world)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    vertices_m = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.cos(3 * angle)], axis=1)
    faces = np.stack([np.zeros(10, int), np.arange(1, 11), np.arange(2, 12)], axis=1)
    mesh = SurfaceMesh(vertices_m, faces)
    for suffix in ("obj", "ply"):
        mesh.save(home / f"mesh.{suffix}")
    trimesh.Trimesh(vertices_m, faces).export(home / "mesh.stl")
    np.save(home / "depth.npy", np.full((16, 16), 0.3, np.float32))
    (home / DONE).write_text(program_digest(), encoding="utf-8")


def link_or_copy(source: str, target: str) -> None:
    """Give a file a second name, or copy it to another file system."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy(source, target)


def make_inputs(home: Path, group: str) -> dict[str, Input]:
    """Return the inputs of a group by name, each in a folder of its own beside the files of
    `make_files`.
    """
    inputs = dict[str, Input]()
    places = home / group
    shutil.rmtree(places, ignore_errors=True)
    places.mkdir()

    def place(name: str, source: Path | bytes, action: Action, beside: Path | None = None) -> None:
        folder = places / name
        if beside:
            shutil.copytree(beside, folder, copy_function=link_or_copy)
        else:
            folder.mkdir()
        path = folder / (source.name if isinstance(source, Path) else name)
        if not path.exists():
            path.write_bytes(source.read_bytes() if isinstance(source, Path) else source)
        inputs[name] = Input(path, action)

    weights = shipped_folder()
    if group == "torch":
        _place_torch(home, weights, place)
        return inputs
    for name in ("packed.bag", "plain.bag"):
        place(name, home / name, read_recording)
    readers: Mapping[str, tuple[Path | bytes, Callable[[Path], Any]]] = {
        "wall.npz": (home / "wall.npz", read_reference),
        "wall.toml": (home / "wall.toml", load_wall),
        "rig.toml": (next(ROOT.rglob("rigs/paper-rig.toml")), load_rig),
        "recipe.toml": (next((ROOT / "models/recipes").glob("*vae*.toml")), load_recipe),
        "scene.toml": (SCENE.encode(), load_scene),
        "nlos-cam.toml": (
            SETTINGS.encode(),
            lambda path: read_settings({}, path.parent, path.parent),
        ),
        "sidecar.json": (home / "short.json", load_sidecar),
        "rendering.npz": (home / "cup.npz", lambda _: None),
        "session.html": (home / "session.html", RecordedView),
        "depth.npy": (home / "depth.npy", read_depth_map),
        **{name: (home / name, read_mesh) for name in ("mesh.obj", "mesh.ply", "mesh.stl")},
    }
    for name, (source, load) in readers.items():
        place(name, source, partial(read_text, load=load))
    place("light.hdf5", home / "light.hdf5", read_transient)
    place("bench.toml", home / "bench" / "bench.toml", read_bench, home / "bench")
    for name in ("detection.json", "turn-0001.npz"):
        place(name, home / "detection" / name, read_detection, home / "detection")
    place("reconstruction.npz", home / "replayed" / "reconstruction.npz", read_replayed)
    entry = next((home / "worlds").iterdir())
    place("world.npz", entry, partial(read_cache, content=entry.read_bytes()))
    for name in ("checkpoint.json", "doubt.json"):
        place(
            name,
            weights / name,
            partial(read_text, load=lambda path: load_record(path.parent)),
            weights,
        )
    describe = partial(read_text, load=lambda path: command("info", path.parent))
    place("figures.json", ROOT / "docs" / "figures" / "figures.json", describe)
    return inputs


def _place_torch(home: Path, direct: Path, place: Callable[..., None]) -> None:
    import torch
    from nlos_models.training import run_files

    from nlos_cam.dataset import open_dataset

    found = open_dataset(home / "data")
    whole = {name: found.column(name) for name in DATASET_ARRAYS}
    shard = next((home / "data").glob("*.h5"))
    place("shard.h5", shard, partial(read_shard, whole=whole), home / "data")
    paper = shipped_folder("paper")
    for weights, name in (
        (direct, "direct.safetensors"),
        (direct, "doubt.safetensors"),
        (paper, "preprocess.safetensors"),
        (paper, "compressor.safetensors"),
    ):
        place(name, weights / name, read_weights, weights)
    state = {"recipe": "{}", "module": {"x": torch.zeros(3)}, "epoch": 1, "rows": [{"loss": 1.0}]}
    torch.save(state, content := io.BytesIO())
    place(
        run_files.LAST, hashlib.sha256(content.getvalue()).digest() + content.getvalue(), read_state
    )
    place("short.truth.toml", b'category = "cup"\nsize_m = 0.15\nseed = 1\n', read_label)

"""Wrong command lines: each ends with its exit code and one line that names the fault; nothing is
written.
"""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from nlos_cam.cli.main import main

INTERNALS = (
    "Traceback",
    "Input should",
    "Value error",
    "codec",
    "Errno",
    "{'",
    "validation error",
    "<class",
)
"""Phrases of the interpreter and of libraries, which say nothing to a user."""
SCENES = {
    "scene.toml": 'name = "cup"\nrig = "paper-rig"\n[object]\ncategory = "cup"\n',
    "wall.toml": "schema_version = 3\nframes = 60\n",
    "rig.toml": 'name = "mine"\n[lidar]\ndistance_m = -1.0\n',
    "recipe.toml": 'task = "vae"\nbatch = "many"\n',
    "faults.toml": 'name = "wall"\nrig = "bare-wall"\n[[faults]]\nkind = "explode"\nat_frame = 1\n',
    "empty.toml": "",
    "broken.toml": "name = \n",
}
USAGE = """
liev | live
--wersion | version
live --secs 3 | --seconds
live --seconds | needs a value
live --seconds inf --camera l615 | l615
view sample --seconds inf | 1e+09
live --seconds 0 | 0.1
live --seconds x | number
live --view-port 0 | 65535
live --average 1.5 | whole number
live --no-view --open | --no-view
live --record run.mp4 | .bag
live --log run.txt | .csv
live --save-view view.png | view.png
live sim sim:bare-wall | unexpected
live sim --camera l515 | l515
live simm | sim
live sim: | colon
live webcam | webcam
live sim:bare-wal | sim:bare-wall
live -v -q | --quiet
capture --seconds 1 --frames 2 | --frames
capture --takes 2 | --takes
capture --takes 3 --frames 1 --label a --label b | --label
capture --out run.mp4 | .bag
capture --frames 2 --pause-s 1 | --takes
replay | missing
replay random.bag --object fbx | fbx
replay random.bag --every 2 | --object
repair run.bag --out run.txt | .bag
calibrate | --wall
calibrate --wall --occluder wall.toml | --wall
calibrate --wall sim --bag run.bag | --bag
calibrate --wall --occluder-x-m 0.2 | together
calibrate --wall --occluder-x-m inf --occluder-gap-m 0.1 | to 100
calibrate --wall --board --square-mm inf | to 1000
calibrate --wall --board --tape-m 0.2 | --tape-m
calibrate --wall --square-mm 30 | --board
calibrate --wall --paper a4 | --board
calibrate --occluder wall.toml --board | --board
calibrate --occluder wall.toml --watch | --watch
calibrate --wall --watch --bag run.bag | --watch
calibrate --occluder wall.toml --tape-m 0.2 | --tape-m
calibrate --occluder wall.toml --out wall.toml --overwrite | wall.toml
board --paper a5 | a4
board --out board.txt | .pdf
render cupp | Did you mean 'cup'
render cup --rig paper-rgi | paper-rig
render cup --accuracy perfect | draft
render cup --effects rain | rain
render cup --effects three-bonce | three-bounce
render cup --pulse-ns 1e9 | 100
render cup --size-m nan | --size-m
render cup --up z | --up
render cup --up w | y or z
render cup --albedo 1.5 | --albedo
render cup --albedo 0.1,0.2 | --albedo
render cup --exponent 0 | --exponent
render cup --max-error 0.1 --accuracy fine | --accuracy
render none.stl --seed 1 | --seed
render plate.npy --size-m 0.1 --up z | --size-m
render cup --out maps.txt | .npz
render cup --scene paper --rig paper-rig | --rig
render cup --specular 0.3 | --material
render cup --material lambertian --exponent 4 | --exponent
render cup --capture confocal | --capture
render cup --noise-seed 1 | --transient
render cup --transient cup.hdf5 --photons 0 | --photons
render cup --transient cup.hdf5 --noise-seed 3 | --photons
render cup --transient cup.hdf5 --capture confocal --backend torch | --backend
dataset | build, label
dataset bild | build, label
dataset build --count 1 | --out
dataset build --out d --count 1 --scene scene.toml --rig paper-rig | --rig
dataset build --out d --count 1 --objects meshes --without hat | --without
dataset build --out d --count 1 --without hatt | hat
train vae | --recipe
train vae --recipe recipe.toml | --out
train vae --recipe vea --out d | vae
train compressor --recipe recipe.toml --out d --dataset x | --held-out
evaluate --dataset d --count 3 | --count
evaluate --training d --no-nearest | --no-nearest
evaluate --dataset d --rig paper-rig | --rig
evaluate --dataset d --training ./d | --training
tradeoff render --seed 3 | --object
info --verify | --verify
info --out slice.png | --out
doctor --fix | no option
"""
FILES = """
live none.bag | none.bag
live random.bag | random.bag
live zero.bag | zero.bag
live folder.bag | folder.bag
live loop.bag | loop.bag
live sim:none.toml | none.toml
live sim:binary.toml | binary
live sim:empty.toml | name
live sim:broken.toml | broken.toml
live sim:faults.toml | faults.0.kind
live sim:wall.toml | wall record
live sim:folder.toml | folder.toml
capture --wall binary.toml | binary
replay zero.bag | zero.bag
export zero.bag | zero.bag
repair none.bag | none.bag
repair random.bag | random.bag
view none.bag | none.bag
calibrate --wall --bag none.bag | none.bag
calibrate --occluder none.toml | none.toml
calibrate --occluder scene.toml | scene
render none.stl | none.stl
render none.npy | none.npy
render words.npy | words.npy
render words.stl | words.stl
render wide.npy | wide.npy
render folder.stl | folder.stl
render cup --rig none.toml | none.toml
render cup --rig rig.toml | rig.toml
render cup --rig scene.toml | scene
render cup --scene wall.toml | wall record
dataset label none --out d | none
dataset label precious --out d | precious
train vae --recipe none.toml --out d | none.toml
train vae --recipe recipe.toml --out d | recipe.toml
train vae --recipe scene.toml --out d | scene
evaluate --weights none | none
evaluate --weights precious | precious
"""
OTHERS = """
render cup --effects tilt | light
render cup --rig bare-wall | object_box
render cup --x-m 1 | cup
render cup --size-m 0.002 | cup
render cup --front-m 0.5 | 0.5 m
render cup --max-error -1 | -1
render cup --beams-per-cell 0 | 0
render cup --out taken.npz | --overwrite
render cup --out precious/thesis.txt/a.npz | precious
board --out taken.pdf | --overwrite
capture bag:none.bag --seconds 1 | recording
capture run.bag --frames 1 | recording
export random.bag --out precious | precious
export random.bag --out taken.npz | taken.npz
repair random.bag --out random.bag --overwrite | random.bag
dataset build --out precious --count 1 | precious
dataset build --out d --count 1 --objects nowhere | nowhere
dataset build --out d --count 1 --rig bare-wall | object_box
dataset build --out d --count 1 --rig-spread-mm 500 | 500
tradeoff render --out taken.npz --overwrite | taken.npz
"""
CASES = [
    (code, *map(str.strip, line.split(" | ")))
    for code, lines in ((2, USAGE), (4, FILES), (1, OTHERS))
    for line in lines.strip().splitlines()
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with every kind of unusable file, whose name has a space and an accent."""
    folder = tmp_path_factory.mktemp("wröng files")
    noise = b"\x85\xff" + np.random.default_rng(5).bytes(5000)
    contents = {name: text.encode() for name, text in SCENES.items()} | {
        "binary.toml": noise,
        "random.bag": noise,
    }
    contents |= dict.fromkeys(("zero.bag", "taken.npz", "taken.pdf"), b"")
    for name, content in (contents | dict.fromkeys(("words.npy", "words.stl"), b"hello")).items():
        (folder / name).write_bytes(content)
    for name in ("folder.bag", "folder.toml", "folder.stl", "precious"):
        (folder / name).mkdir()
    (folder / "precious" / "thesis.txt").write_text("years of work", encoding="utf-8")
    (folder / "loop.bag").symlink_to("loop.bag")
    np.save(folder / "plate.npy", np.full((16, 16), 0.2, np.float32))
    np.save(folder / "wide.npy", np.full((16, 24), 0.2, np.float32))
    return folder


def _listing(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.lstat().st_size for path in folder.rglob("*")}


@pytest.mark.parametrize(("code", "line", "word"), CASES)
def test_wrong_command_has_its_exit_code_and_one_line(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    code: int,
    line: str,
    word: str,
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(folder))
    before = _listing(folder)

    assert main(["--json", *shlex.split(line)]) == code

    shown = capsys.readouterr()
    errors = [text for text in shown.err.splitlines() if text.startswith("error: ")]

    assert len(errors) == 1
    assert word in errors[0]
    assert not [phrase for phrase in INTERNALS if phrase in shown.err]
    assert all(shown.err.splitlines())
    assert json.loads(shown.out.splitlines()[-1])["error"]["message"]
    assert _listing(folder) == before

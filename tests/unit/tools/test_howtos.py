"""Every command that a page of the docs prints is one that the program takes, and those of the
bench page do their work, in order and in the small.
"""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest
from nlos_models.training import packaged_recipes
from typer.main import get_command

from nlos_cam.camera import simulated_world
from nlos_cam.cli.main import build_app, main
from nlos_cam.evaluate import baselines
from nlos_cam.render.scene_file import Motion, paper_scene

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), ROOT / "README.md", *(ROOT / "models" / "cards").glob("*.md")])
STILL = """name = "still"
rig = "paper-rig"
[object]
category = "cup"
seed = 4
"""
TRUTH = 'category = "cup"\nseed = 4\n'
TRANSFER = """```sh
nlos-cam capture --camera l515 --seconds 3 --takes 2 --label rocket --out adaptation/rocket.bag
nlos-cam capture --camera l515 --seconds 3 --label rocket --out held-out/rocket.bag
nlos-cam dataset label adaptation --out data/adaptation
nlos-cam dataset label held-out --frames 1 --out data/held-out
nlos-cam evaluate --dataset data/held-out --out before
nlos-cam train transfer --recipe direct-transfer --dataset data/adaptation \\
    --held-out data/held-out --objects SAMPLES --out runs/fitted
nlos-cam evaluate --dataset data/held-out --weights runs/fitted --out after
```"""
"""From recordings to weights by hand (docs/adapt.md)."""
IN_OTHER_TESTS = {"adapt", "detect"}
"""Commands that take minutes even in the small."""
SMALLER = {
    "--seconds": "0.3",
    "--count": "8",
    "--stills": "1",
    "--takes": "2",
    "--average": "2",
    "--objects": "2",
}
DROPPED = {"--watch", "--open", "--compile", "--accelerator"}
SMALL_RECIPE = {
    "objects": 2,
    "held_out": 1,
    "all_layers_epochs": 1,
    "epochs": 1,
    "batch": 2,
}
Tool = Callable[[str], ModuleType]


def camera_of(words: list[str]) -> str:
    """Return the simulated camera that shows what the command is to look at."""
    if "--wall" in words and words[1] == "calibrate":
        return "sim:bare-wall"
    return "sim:examples/empty.toml" if words[1] == "calibrate" else "sim:still.toml"


def small(words: list[str]) -> list[str]:
    """Return a command with a simulated camera and little to do."""
    words = [word for word in words if word not in DROPPED]
    changed = [words[0]]
    for before, word in pairwise(words):
        new = SMALLER.get(before, word)
        if before == "--camera" and word == "l515":
            new = camera_of(words)
        if before == "--recipe":
            new = small_recipe(word)
        changed.append(new)
    if words[1] == "live":
        return [*changed, "--no-view", *([] if "--seconds" in words else ["--seconds", "0.3"])]
    if words[1] == "capture" and "--takes" in words:
        return [*changed, "--overwrite"]
    return changed


def small_recipe(name: str) -> str:
    """Write a packaged recipe with less to do into this folder, and return its file."""
    text = packaged_recipes()[name].read_text(encoding="utf-8")
    for field, value in SMALL_RECIPE.items():
        text = re.sub(rf"^{field} = .*$", f"{field} = {value}", text, flags=re.MULTILINE)
    Path(f"{name}.toml").write_text(text, encoding="utf-8")
    return f"{name}.toml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with what the reader of a page has, in which little is rendered."""
    made = tmp_path_factory.mktemp("howtos")
    shutil.copytree(ROOT / "examples", made / "examples")
    (made / "still.toml").write_text(STILL, encoding="utf-8")
    airplane = paper_scene().model_copy(update={"motion": Motion(poses=1)})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        patch.setattr(simulated_world.renderer, "paper_scene", lambda: airplane)
        patch.setattr(baselines, "NEIGHBOURS", 4)
        patch.setattr(baselines, "FINGERPRINT_OBJECTS", 1)
        yield made


@pytest.fixture
def follow(tool: Tool, folder: Path) -> Callable[[str], None]:
    """Run the commands of a page, or of a part of it, in order."""
    assert Path.cwd() == folder

    def follow_page(text: str) -> None:
        for words in tool("tutorial").printed_commands(text):
            if words[0] == "python":
                check_script(words)
            elif words[1] not in IN_OTHER_TESTS:
                assert main(small(words)[1:]) == 0, " ".join(words)

    return follow_page


def check_script(words: list[str]) -> None:
    """Check a study's options, which takes minutes to run."""
    script = str(ROOT / words[1])
    command = [sys.executable, script, *words[2:3], "--help"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert [word for word in words if word.startswith("--") and word not in told] == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_commands_of_page_are_taken(tool: Tool, path: Path) -> None:
    tree = get_command(build_app())
    for name, *arguments in tool("tutorial").printed_commands(path.read_text(encoding="utf-8")):
        command = tree
        if Path(name).name != "nlos-cam" or arguments[0].startswith("-"):
            continue
        while below := getattr(command, "commands", {}):
            command = below[arguments.pop(0)]
        words = ["2" if word == "SAMPLES" else word for word in arguments]
        command.make_context(command.name, words)


@pytest.fixture
def bench_page(folder: Path) -> Iterator[tuple[str, str]]:
    """The steps on a bench, and those from recordings alone; their bench is removed afterwards."""
    text = (DOCS / "your-bench.md").read_text(encoding="utf-8")
    steps, alone = text.split("## From recordings alone")
    yield steps, alone
    for made in ("bench", "cup"):
        shutil.rmtree(folder / made, ignore_errors=True)


@pytest.mark.slow
def test_steps_on_a_bench_lead_to_pictures(
    follow: Callable[[str], None], bench_page: tuple[str, str]
) -> None:
    follow(bench_page[0])

    assert {"report.html", "reconstruction.npz"} <= {path.name for path in Path("cup").iterdir()}


@pytest.mark.slow
def test_recordings_alone_lead_to_pictures(
    follow: Callable[[str], None], bench_page: tuple[str, str]
) -> None:
    scenes = {"bare": "bare-wall", "empty": "examples/empty.toml", "cup": "still.toml"}
    for name, scene in scenes.items():
        capture = f"capture sim:{scene} --seconds 2 --overwrite --out {name}.bag"
        assert main(capture.split()) == 0
    follow(bench_page[1])

    assert Path("cup", "report.html").exists()


@pytest.mark.slow
def test_recordings_lead_to_fitted_weights(follow: Callable[[str], None]) -> None:
    for name in ("adaptation", "held-out"):
        Path(name).mkdir()
        Path(name, "rocket.truth.toml").write_text(TRUTH, encoding="utf-8")
    follow(TRANSFER)

    for made in ("before", "after"):
        assert Path(made, "report.html").exists()
    assert Path("runs", "fitted", "network.onnx").exists()
    assert not [*Path("runs").rglob("*.ckpt")]

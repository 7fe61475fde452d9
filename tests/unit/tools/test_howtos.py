"""Every command that a page of the docs prints is one that the program takes, and those of the
how-tos do their work, in order and in the small.
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
import trimesh
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
MESH = 'up = "z"\nsize_m = 0.165\n'
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
    trimesh.creation.box((0.15, 0.1, 0.15)).export(made / "thing.stl")
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
            else:
                assert main(small(words)[1:]) == 0, " ".join(words)

    return follow_page


def check_script(words: list[str]) -> None:
    """Check a study's options, which takes minutes to run."""
    script = str(ROOT / words[1])
    command = [sys.executable, script, *words[2:3], "--help"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert [word for word in words if word.startswith("--") and word not in told] == []


def page(name: str) -> str:
    return (DOCS / f"{name}.md").read_text(encoding="utf-8")


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


@pytest.mark.slow
def test_bench_pages_lead_to_pictures(follow: Callable[[str], None], folder: Path) -> None:
    first, alone = page("your-bench").split("## From recordings alone")
    follow(first)

    assert {"report.html", "reconstruction.npz"} <= {path.name for path in Path("cup").iterdir()}

    for name, scene in {"bare": "bare-wall", "empty": "examples/empty.toml"}.items():
        assert main(["capture", f"sim:{scene}", "--seconds", "2", "--out", f"{name}.bag"]) == 0
    for made in ("bench", "cup"):
        shutil.rmtree(made)
    follow(alone)

    assert (folder / "cup" / "report.html").exists()

    shutil.rmtree("bench")
    follow(page("howto-bench"))

    assert (folder / "thing.npz").exists()
    assert (folder / "cup.npz").exists()


@pytest.mark.slow
def test_transfer_page_leads_to_weights(follow: Callable[[str], None], folder: Path) -> None:
    shutil.rmtree("bench", ignore_errors=True)
    recording, training = page("howto-transfer").split("## 4.")
    follow(recording)
    shutil.copytree("adaptation", "held-out")
    for name in ("adaptation", "held-out"):
        (folder / name / "rocket.truth.toml").write_text(TRUTH, encoding="utf-8")
    follow(training)

    for made in ("before", "after"):
        assert (folder / made / "report.html").exists()
    assert (folder / "runs" / "bench" / "network.onnx").exists()
    assert not [*folder.rglob("*.ckpt")]

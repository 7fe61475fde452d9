"""The docs: broken links are found, generated pages are current, pictures are drawn, the tutorial's
commands run.
"""

import re
import runpy
import shutil
import sys
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import nlos_cam
from nlos_cam.camera import simulated_world
from nlos_cam.cli.main import main
from nlos_cam.render.scene_file import Motion, paper_scene

ROOT = Path(__file__).parents[3]
Tool = Callable[[str], ModuleType]
CONFIG = """
site_name: small
use_directory_urls: false
theme: { name: material, font: false }
validation:
  links: { not_found: warn, anchors: warn, unrecognized_links: warn }
  nav: { omitted_files: info, not_found: warn }
hooks: [build_site.py]
nav: [index.md, Other: other.md]
"""
PAGES = {
    "mkdocs.yml": CONFIG,
    "docs/index.md": "# Start\n\nTo the [other](other.md#a-part), [figures](figures.json).\n",
    "docs/other.md": "# Other\n\n## A part\n",
    "docs/figures.json": "{}",
    "docs/left.md": "# Left\n",
    "docs/decisions/2026-01-01-one.md": "# One\n",
    "README.md": "# Top\n\n[docs](docs/other.md#a-part) [here](#top) ![x](docs/figures.json)"
    " <https://example.org/a>\n",
}


@pytest.fixture
def written(tmp_path: Path) -> Callable[..., Path]:
    """A small project with docs; what is given takes the place of its pages."""

    def make(changed: Mapping[str, str] | None = None) -> Path:
        for name, text in {**PAGES, **(changed or {})}.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text, encoding="utf-8")
        shutil.copy(ROOT / "tools" / "docs" / "build_site.py", tmp_path)
        return tmp_path

    return make


@pytest.mark.slow
def test_whole_docs_have_no_problem_and_every_page_a_place(
    tool: Tool, written: Callable[..., Path]
) -> None:
    root = written()

    assert tool("build_site").problems(root / "site", root) == []

    start = (root / "site" / "index.html").read_text(encoding="utf-8")

    assert 'href="left.html"' in start
    assert 'href="decisions/2026-01-01-one.html"' in start


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "text", "told"),
    [
        ("docs/index.md", "# Start\n\n[gone](gone.md)\n", "gone.md"),
        ("docs/index.md", "# Start\n\n[gone](other.md#gone)\n", "#gone"),
        ("docs/index.md", "# Start\n\n![gone](images/gone.png)\n", "images/gone.png"),
        ("mkdocs.yml", CONFIG.replace("other.md", "gone.md"), "gone.md"),
        ("README.md", "[gone](docs/gone.md)", "docs/gone.md leads to no file"),
        ("README.md", "[gone](docs/other.md#gone)", "leads to no heading of other.md"),
        ("README.md", "[gone](#gone)", "leads to no heading of README.md"),
        ("README.md", "[plain](http://example.org)", "not a full https address"),
        ("README.md", "[cut](https://)", "not a full https address"),
        (
            "docs/index.md",
            '# Start\n\n<script src="https://cdn.example.org/a.js"></script>\n',
            "cdn.example.org",
        ),
    ],
)
def test_each_way_to_break_is_told(
    tool: Tool, written: Callable[..., Path], page: str, text: str, told: str
) -> None:
    root = written({page: text})
    assert any(told in problem for problem in tool("build_site").problems(root / "site", root))


CELLS = """# %% First
# What it does.
print("one")

# %% Second
from pathlib import Path

Path("drawn.png").write_bytes(b"picture")
print("two")
"""


def test_script_with_cells_becomes_a_section_for_each(tool: Tool, tmp_path: Path) -> None:
    script = tmp_path / "cells.py"
    script.write_text(CELLS, encoding="utf-8")
    builder = tool("build_site")
    output, pictures = builder.run_script(script)
    first, second = builder.as_section(script, output, pictures).split("## Second")

    assert first.startswith("## First\n\nWhat it does.\n\n```python\nprint")
    assert "```text\none\n```" in first
    assert "```text\ntwo\n```" in second
    assert "images/built/drawn.png" in second
    assert "images/built/drawn.png" not in first
    assert pictures == {"drawn.png": b"picture"}


def test_the_gate_and_make_run_it(tool: Tool) -> None:
    assert ("python", "tools/docs/build_site.py", "--check") in tool("check").GATES
    assert "tools/docs/build_site.py" in (ROOT / "Makefile").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "name", [pytest.param("reference", marks=pytest.mark.slow), "comparison", "gallery"]
)
def test_page_has_every_command_and_the_measured_figures(tool: Tool, name: str) -> None:
    page = (tool("pages").DOCS / f"{name}.md").read_text(encoding="utf-8")
    assert tool("pages").PAGES[name]() == page, f"run `python tools/docs/pages.py {name}`"


@pytest.mark.slow
def test_stale_page_fails_the_check_until_written(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tool("pages"), "DOCS", tmp_path)
    for arguments, code in ((["--check"], 1), ([], 0), (["--check"], 0)):
        monkeypatch.setattr("sys.argv", ["pages.py", "reference", *arguments])
        assert tool("pages").main() == code

    assert "out of date" in capsys.readouterr().out


def test_table_without_a_place_is_refused(tool: Tool) -> None:
    page = "<!-- one -->\nold\n<!-- end -->\n"

    assert tool("pages").filled(page, {"one": "new\n"}) == "<!-- one -->\nnew\n<!-- end -->\n"
    with pytest.raises(ValueError, match="<!-- two -->"):
        tool("pages").filled(page, {"two": "new\n"})


def test_default_of_nothing_is_shown_as_zero_alone(tool: Tool) -> None:
    def default(value: object) -> str:
        return tool("pages").default_of(
            SimpleNamespace(required=False, show_default=True, default=value)
        )

    assert [default(value) for value in (0, 0.0, 2)] == ["`0`", "`0.0`", "`2`"]
    assert [default(value) for value in (None, False, "")] == ["", "", ""]


PROSE = sorted({*(ROOT / "docs").glob("*.md"), *ROOT.glob("*.md")} - {ROOT / "CHANGELOG.md"})
"""Pages about what is there now."""
PLACE = re.compile(r"`((?:tests|tools|nlos_cam|models|calibration|examples|docs)/[\w./-]+)")


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.stem)
def test_page_names_files_that_are_there(page: Path) -> None:
    named = PLACE.findall(page.read_text(encoding="utf-8"))

    assert [name for name in named if not (ROOT / name.rstrip("/.")).exists()] == []


def test_things_unlike_training_lie_in_the_box_and_are_drawn(tool: Tool, tmp_path: Path) -> None:
    gallery = tool("pictures")
    *things, nothing = gallery.unlike_training()

    assert np.isnan(nothing.depth_m).all()

    for thing in things:
        assert thing.depth_m.shape == (64, 64)
        assert 0.12 <= np.nanmin(thing.depth_m) <= np.nanmax(thing.depth_m) <= 0.4
    image = truth = np.stack([np.eye(64, dtype=np.float32), np.zeros((64, 64), np.float32)])
    gallery.draw_pairs(
        tmp_path / "a.png",
        [("a row", [things[-1], nothing], image, truth, np.array([1.0, np.nan]))],
    )

    assert (tmp_path / "a.png").stat().st_size > 1000


SHORTER = {"--seconds": "0.5", "--count": "2", "--every": "5"}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], int]:
    """Run one command in an empty folder with the examples, in this process, for less long and
    without a browser.
    """
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    airplane = paper_scene().model_copy(
        update={"motion": Motion(poses=1)}
    )  # is rendered once, not ninety times
    monkeypatch.setattr(simulated_world.renderer, "paper_scene", lambda: airplane)

    def call(words: list[str]) -> int:
        if words[0] == "nlos-cam":
            said = [SHORTER.get(before, word) for before, word in pairwise(words)]
            return main([*said, *(["--no-view"] if words[1] == "live" else [])])
        monkeypatch.setattr(sys, "argv", words[1:])
        runpy.run_path(words[1], run_name="__main__")
        return 0

    return call


@pytest.mark.slow
def test_every_command_of_the_tutorial_does_its_work(
    tool: Tool, run: Callable[[list[str]], int]
) -> None:
    tutorial = tool("tutorial")
    commands = tutorial.commands_of(tutorial.PAGE.read_text(encoding="utf-8"))

    assert len(commands) >= 10

    for words in commands:
        assert run(words) == 0, " ".join(words)
    made = [word for words in commands for before, word in pairwise(words) if before == "--out"]

    assert [name for name in made if not Path(name).exists()] == []


def test_every_command_block_is_followed_by_its_answer(tool: Tool) -> None:
    tutorial = tool("tutorial")
    text = tutorial.PAGE.read_text(encoding="utf-8")

    assert text.count("```sh\n") == len(tutorial.STEP.findall(text))
    assert all(found["answer"].strip() for found in tutorial.STEP.finditer(text)), (
        "run `python tools/docs/tutorial.py`"
    )


def test_answers_of_the_tutorial_are_of_todays_weights(tool: Tool) -> None:
    tutorial = tool("tutorial")
    found = tutorial.SOURCE.search(tutorial.PAGE.read_text(encoding="utf-8"))

    assert found is not None
    assert found[0] == tutorial.source(), "run `python tools/docs/tutorial.py`"


def test_the_version_is_the_same_everywhere() -> None:
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE)

    assert cited is not None
    assert cited[1] == nlos_cam.__version__
    assert f"## {nlos_cam.__version__}" in (ROOT / "CHANGELOG.md").read_text("utf-8")

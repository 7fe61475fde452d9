"""The docs builder finds every kind of broken link, and puts every page into the navigation."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[3]
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
    "README.md": "# Top\n\n[docs](docs/other.md#a-part) [here](#top) ![x](docs/figures.json) <https://example.org/a>\n",
}


@pytest.fixture
def docs(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("build_site")


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
def test_whole_docs_have_no_problem_and_every_page_a_place(docs: ModuleType, written: Callable[..., Path]) -> None:
    root = written()
    assert docs.problems(root / "site", root) == []
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
        ("docs/index.md", '# Start\n\n<script src="https://cdn.example.org/a.js"></script>\n', "cdn.example.org"),
    ],
)
def test_each_way_of_being_broken_is_told(
    docs: ModuleType, written: Callable[..., Path], page: str, text: str, told: str
) -> None:
    root = written({page: text})
    assert any(told in problem for problem in docs.problems(root / "site", root))


def test_the_gate_and_make_run_it(tool: Callable[[str], ModuleType]) -> None:
    assert ("python", "tools/docs/build_site.py", "--check") in tool("check").GATES
    assert "tools/docs/build_site.py" in (ROOT / "Makefile").read_text(encoding="utf-8")

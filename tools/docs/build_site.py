"""Docs builder: builds site/ and refuses broken links, anchors, files, and pages that fetch from
other sites.

`make docs` runs it. `--check` builds into a temporary folder: a gate of tools/checks/check.py.
Addresses of other sites are checked for their form only, without a network. mkdocs.yml names this
file as its hook. A line `<!-- run NAME -->` of a page becomes the code of examples/gallery/NAME.py,
its output and its pictures: the build runs it. A script with cells (`# %% Title`, then
comments) becomes a heading, text, code and output for each.
"""

import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote, urlsplit

import markdown
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
OUTSIDE = ("README.md", "CHANGELOG.md", "models/cards/*.md", "calibration/records/*.md")
"""Pages beside docs/, which MkDocs does not read."""
FETCHING = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "link": "href",
    "source": "src",
    "video": "src",
}
"""Elements that a browser follows by itself, and their attribute."""
ADDRESS = re.compile(r"https://[a-z0-9.-]+\.[a-z]{2,}(/\S*)?")
RUN = re.compile(r"<!-- run (\w+) -->")
CELL = re.compile(r"^# %% (.+)$", re.MULTILINE)
PROSE = re.compile(r"\A(?:# .*\n)+", re.MULTILINE)
"""Comments that a cell begins with."""
END_OF_CELL = "\x1e"
SCRIPT_TIMEOUT_S = 600
log = logging.getLogger("mkdocs.hooks.gallery")


class Page(HTMLParser):
    """Links and anchors of a page, and the addresses that a browser would fetch for it."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.fetched: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the references of an element."""
        given = {name: value for name, value in attrs if value}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        self.links += [given[name] for name in ("href", "src") if name in given]
        if (
            tag in FETCHING
            and FETCHING[tag] in given
            and given.get("rel") not in {"canonical", "prev", "next"}
        ):
            self.fetched.append(given[FETCHING[tag]])


def page_of(path: Path) -> Page:
    """Parse a page of Markdown or HTML."""
    text = path.read_text(encoding="utf-8")
    return Page(
        markdown.markdown(text, extensions=["toc", "tables", "fenced_code"])
        if path.suffix == ".md"
        else text
    )


def broken_in(path: Path) -> Iterator[str]:
    """Yield a line for each broken link of a page outside docs/."""
    for link in page_of(path).links:
        parts = urlsplit(link)
        if parts.scheme or parts.netloc:
            if not ADDRESS.fullmatch(link):
                yield f"{link} is not a full https address"
            continue
        target = path.parent / unquote(parts.path) if parts.path else path
        if not target.exists():
            yield f"{link} leads to no file"
        elif (
            parts.fragment
            and target.suffix == ".md"
            and parts.fragment not in page_of(target).anchors
        ):
            yield f"{link} leads to no heading of {target.name}"


def broken_outside(root: Path = ROOT) -> list[str]:
    """Return a line for each broken link of the pages beside docs/."""
    paths = [path for pattern in OUTSIDE for path in sorted(root.glob(pattern))]
    return [f"{path.relative_to(root)}: {problem}" for path in paths for problem in broken_in(path)]


def fetched_elsewhere(site: Path) -> list[str]:
    """Return the addresses on other sites that a browser would fetch for a built site."""
    return [
        f"{path.relative_to(site)} fetches {address}"
        for path in sorted(site.rglob("*.html"))
        for address in page_of(path).fetched
        if urlsplit(address).netloc
    ]


def build(site: Path, root: Path = ROOT) -> list[str]:
    """Build the site; return the warnings of MkDocs, which count as errors."""
    program = Path(sys.executable).with_name("mkdocs")
    run = [
        program,
        "build",
        "--strict",
        "--config-file",
        root / "mkdocs.yml",
        "--site-dir",
        site,
    ]  # --quiet is not strict
    quiet = {
        **os.environ,
        "NO_MKDOCS_2_WARNING": "1",
    }  # Material's advertisement of what comes after it
    ended = subprocess.run(run, cwd=root, env=quiet, capture_output=True, text=True, check=False)
    warned = [
        line
        for line in (ended.stdout + ended.stderr).splitlines()
        if line.strip() and "INFO" not in line
    ]
    return warned or ([f"mkdocs ended with {ended.returncode}"] if ended.returncode else [])


def problems(site: Path, root: Path = ROOT) -> list[str]:
    """Build the docs and return a line for each problem."""
    return broken_outside(root) + (build(site, root) or fetched_elsewhere(site))


def on_config(config: Any) -> Any:
    """Add decisions, newest first, and pages without a place of their own to the navigation; MkDocs
    calls this hook.
    """
    docs = Path(config["docs_dir"])
    named = set(_paths(config["nav"]))
    left = sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))
    left = [path for path in left if path not in named]
    decisions = sorted((path for path in left if path.startswith("decisions/")), reverse=True)
    others = [path for path in left if not path.startswith("decisions/")]
    config["nav"] += [
        {title: pages} for title, pages in (("More", others), ("Decisions", decisions)) if pages
    ]
    return config


def _paths(nav: str | Sequence[Any] | Mapping[str, Any]) -> Iterator[str]:
    """Yield every page that a navigation names."""
    if isinstance(nav, str):
        yield nav
        return
    for each in nav.values() if isinstance(nav, Mapping) else nav:
        yield from _paths(each)


def run_script(script: Path) -> tuple[str, dict[str, bytes]]:
    """Run a script in an empty folder; return its output, with END_OF_CELL before each cell, and its
    pictures by name.

    Raises CalledProcessError if it fails, TimeoutExpired if it takes longer than SCRIPT_TIMEOUT_S.
    """
    code = script.read_text(encoding="utf-8")
    with TemporaryDirectory() as folder:
        marked = CELL.sub(lambda found: f"print({END_OF_CELL!r}, end='')  # {found[1]}", code)
        ended = subprocess.run(
            [sys.executable, "-c", marked],
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
            timeout=SCRIPT_TIMEOUT_S,
        )
        pictures = {path.name: path.read_bytes() for path in sorted(Path(folder).glob("*.png"))}
    return ended.stdout, pictures


def on_files(files: Any, config: Any) -> Any:
    """Run the scripts that pages name, and add their pictures to the site; MkDocs calls this
    hook.
    """
    root = Path(config["config_file_path"]).parent
    shown: dict[str, str] = {}
    for page in files.documentation_pages():
        for name in RUN.findall(page.content_string):
            script = root / "examples" / "gallery" / f"{name}.py"
            try:
                output, pictures = run_script(script)
            except (subprocess.SubprocessError, OSError) as error:
                told = getattr(error, "stderr", None) or error
                log.warning("%s failed: %s", script.name, str(told).strip().splitlines()[-1])
                continue
            for picture, content in pictures.items():
                files.append(File.generated(config, f"images/built/{picture}", content=content))
            shown[name] = as_section(script, output, pictures)
    config["extra"]["scripts"] = shown
    return files


def as_section(script: Path, output: str, pictures: Iterable[str]) -> str:
    """Return a script, its output and its pictures as Markdown, cell by cell if it has some."""
    code = script.read_text(encoding="utf-8").strip()
    if not CELL.search(code):
        return _block(code, output, pictures)
    titles_and_bodies = CELL.split(code)[1:]
    sections: list[str] = []
    for title, body, printed in zip(
        titles_and_bodies[::2],
        titles_and_bodies[1::2],
        output.split(END_OF_CELL)[1:],
        strict=True,
    ):
        prose = PROSE.match(body.lstrip("\n"))
        text = prose[0].replace("# ", "").strip() if prose else ""
        rest = PROSE.sub("", body.lstrip("\n")).strip()
        own = [name for name in pictures if name in body]
        sections.append(f"## {title}\n\n{text}\n\n{_block(rest, printed, own)}")
    return "\n".join(sections)


def _block(code: str, output: str, pictures: Iterable[str]) -> str:
    """Return code, output and pictures as Markdown."""
    drawn = "\n".join(f"![Drawn by this code: {name}](images/built/{name})" for name in pictures)
    printed = f"```text\n{output.strip()}\n```\n\n" if output.strip() else ""
    return f"```python\n{code}\n```\n\n{printed}{drawn}\n"


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Put the scripts' sections in place of their lines; MkDocs calls this hook."""
    del page, files
    shown = config["extra"].get("scripts", {})
    return RUN.sub(lambda found: shown.get(found[1], ""), markdown)


def main() -> int:
    """Build, and print the problems."""
    if "--check" in sys.argv:
        with TemporaryDirectory() as folder:
            found = problems(Path(folder))
    else:
        found = problems(ROOT / "site")
    print(
        "\n".join(found)
        or ("the docs are whole" if "--check" in sys.argv else f"{ROOT / 'site' / 'index.html'}")
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

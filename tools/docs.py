"""Build the docs into site/, and refuse what is broken in them: links, anchors, files, pages that fetch from elsewhere.

`make docs` runs it. `--check` builds into a folder that is thrown away: a gate of tools/check.py. Addresses of other
sites are not visited: that they are well formed is all that is asked without a network.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import unquote, urlsplit

import markdown

ROOT = Path(__file__).parents[1]
OUTSIDE = ("README.md", "CHANGELOG.md", "models/cards/*.md", "calibration/records/*.md")
"""Pages beside docs/, which MkDocs does not see."""
FETCHING = {"script": "src", "img": "src", "iframe": "src", "link": "href", "source": "src", "video": "src"}
"""Elements that a browser follows by itself, and their attribute."""
ADDRESS = re.compile(r"https://[a-z0-9.-]+\.[a-z]{2,}(/\S*)?")


class Page(HTMLParser):
    """The links and anchors of a page, and what a browser would fetch for it."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.fetched: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element refers to."""
        told = {name: value for name, value in attrs if value}
        self.anchors |= {told[name] for name in ("id", "name") if name in told}
        self.links += [told[name] for name in ("href", "src") if name in told]
        if tag in FETCHING and FETCHING[tag] in told and told.get("rel") not in {"canonical", "prev", "next"}:
            self.fetched.append(told[FETCHING[tag]])


def page_of(path: Path) -> Page:
    """A page of Markdown, or of HTML."""
    text = path.read_text(encoding="utf-8")
    return Page(markdown.markdown(text, extensions=["toc", "tables", "fenced_code"]) if path.suffix == ".md" else text)


def broken_in(path: Path) -> Iterator[str]:
    """What is wrong with the links of one page outside docs/, a line each."""
    for link in page_of(path).links:
        parts = urlsplit(link)
        if parts.scheme or parts.netloc:
            if not ADDRESS.fullmatch(link):
                yield f"{link} is not a full https address"
            continue
        target = path.parent / unquote(parts.path) if parts.path else path
        if not target.exists():
            yield f"{link} leads to no file"
        elif parts.fragment and target.suffix == ".md" and parts.fragment not in page_of(target).anchors:
            yield f"{link} leads to no heading of {target.name}"


def broken_outside(root: Path = ROOT) -> list[str]:
    """What is wrong with the pages beside docs/."""
    paths = [path for pattern in OUTSIDE for path in sorted(root.glob(pattern))]
    return [f"{path.relative_to(root)}: {problem}" for path in paths for problem in broken_in(path)]


def fetched_elsewhere(site: Path) -> list[str]:
    """What pages of a built site would have a browser fetch from another."""
    return [
        f"{path.relative_to(site)} fetches {address}"
        for path in sorted(site.rglob("*.html"))
        for address in page_of(path).fetched
        if urlsplit(address).netloc
    ]


def build(site: Path, root: Path = ROOT) -> list[str]:
    """Build the site; what MkDocs warns of is an error, and comes back as lines."""
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
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # Material's advertisement of what comes after it
    ended = subprocess.run(run, cwd=root, env=quiet, capture_output=True, text=True, check=False)
    told = [line for line in (ended.stdout + ended.stderr).splitlines() if line.strip() and "INFO" not in line]
    return told or ([f"mkdocs ended with {ended.returncode}"] if ended.returncode else [])


def problems(site: Path, root: Path = ROOT) -> list[str]:
    """All that is wrong with the docs, once they are built."""
    return broken_outside(root) + (build(site, root) or fetched_elsewhere(site))


def main() -> int:
    """Build, and say what is broken."""
    if "--check" in sys.argv:
        with TemporaryDirectory() as folder:
            found = problems(Path(folder))
    else:
        found = problems(ROOT / "site")
    print("\n".join(found) or ("the docs are whole" if "--check" in sys.argv else f"{ROOT / 'site' / 'index.html'}"))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

"""What MkDocs asks while it builds the docs: every page is in the navigation, whether mkdocs.yml names it or not."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

DECISIONS = "decisions"


def on_config(config: Any) -> Any:
    """Add decisions, newest first, and pages that nobody has put in a place of their own."""
    docs = Path(config["docs_dir"])
    named = set(_paths(config["nav"]))
    left = sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))
    left = [path for path in left if path not in named]
    decisions = sorted((path for path in left if path.startswith(f"{DECISIONS}/")), reverse=True)
    others = [path for path in left if not path.startswith(f"{DECISIONS}/")]
    config["nav"] += [{title: pages} for title, pages in (("More", others), ("Decisions", decisions)) if pages]
    return config


def _paths(nav: str | Sequence[Any] | Mapping[str, Any]) -> Iterator[str]:
    """Every page that a navigation names."""
    if isinstance(nav, str):
        yield nav
        return
    for each in nav.values() if isinstance(nav, Mapping) else nav:
        yield from _paths(each)

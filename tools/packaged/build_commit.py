"""Build step: puts the commit that a wheel or source distribution is made from into the package."""

import runpy
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CommitHook(BuildHookInterface):  # type: ignore[misc, type-arg]
    """Adds nlos_cam/COMMIT; a source distribution hands its own on to the wheel made from it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the commit for the build, where it is known."""
        package = Path(self.root) / "nlos_cam"
        module = runpy.run_path(str(package / "commit.py"))
        commit = module["commit_of"](package)
        if version != "editable" and commit:  # a checkout says it itself
            path = Path(mkdtemp()) / module["BUILT"]
            path.write_text(f"{commit}\n", encoding="utf-8")
            build_data["force_include"][str(path)] = f"nlos_cam/{path.name}"

"""Description of the program itself: what to cite, and to name beside a figure."""

import platform
from typing import TypedDict

from nlos_models import SHIPPED, checksum_of_watched, shipped_folder

from nlos_cam import __version__
from nlos_cam.files import program_commit, program_name
from nlos_cam.render import RENDERING_VERSION


class ProgramFacts(TypedDict):
    """Versions of the program and of what decides its results."""

    program: str
    version: str
    commit: str
    """In full; empty where it is not known."""
    rendering_version: int
    """Changes whenever the renderer's bits do."""
    weights: dict[str, str]
    """Checksum of the tensors of each shipped network, as uncertainty networks record it."""
    python: str


def describe_program() -> ProgramFacts:
    """Return the versions of the program, its renderer and its weights."""
    weights = {name: checksum_of_watched(shipped_folder(name)) for name in SHIPPED}
    return {
        "program": program_name(),
        "version": __version__,
        "commit": program_commit(),
        "rendering_version": RENDERING_VERSION,
        "weights": weights,
        "python": f"{platform.python_version()}, {platform.system().lower()} {platform.machine()}",
    }

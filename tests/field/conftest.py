"""Commands run in an empty folder, as a person would run them."""

from collections.abc import Callable
from pathlib import Path

import pytest
from command_runner import here, run, shown  # noqa: F401  fixtures
from rewritten_bags import Edit, rewrite

from nlos_cam.recording import SAMPLE


@pytest.fixture
def remake(tmp_path: Path) -> Callable[..., Path]:
    """Rewrite a recording."""

    def make(edit: Edit, *, source: Path = SAMPLE, name: str = "other.bag") -> Path:
        return rewrite(source, tmp_path / name, edit)

    return make


@pytest.fixture(scope="session")
def noise(recorded: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record forty small frames."""
    return recorded(tmp_path_factory.mktemp("noise") / "noise.bag", frames=40)

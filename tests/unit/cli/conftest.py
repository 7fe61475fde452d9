from pathlib import Path

import pytest
from command_runner import here, run, shown  # noqa: F401  fixtures


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"

import os
from pathlib import Path

import pytest

from nlos_cam.cli.common import output_path
from nlos_cam.errors import OutputExistsError


def test_a_folder_that_cannot_be_written_to_is_told_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who runs the tests may be somebody who may write anywhere, so the system's answer is given here."""
    out = tmp_path / "wall.toml"
    assert output_path(out, "wall", ".toml", overwrite=False) == out

    def access(path: Path, mode: int) -> bool:
        return not (path == tmp_path and mode == os.W_OK)

    monkeypatch.setattr(os, "access", access)
    with pytest.raises(OutputExistsError, match=r"wall\.toml cannot be written to"):
        output_path(out, "wall", ".toml", overwrite=True)

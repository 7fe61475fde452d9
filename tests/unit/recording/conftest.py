from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def damaged(recorded: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """150 frames, in several compressed chunks; the index is whole, and the last chunk is
    unreadable.
    """
    path = recorded(tmp_path_factory.mktemp("damaged") / "damaged.bag", frames=150)
    content = bytearray(path.read_bytes())
    where = content.rindex(b"compression=lz4") + 200
    content[where : where + 100] = bytes(100)
    path.write_bytes(content)
    return path

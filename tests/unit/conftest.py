import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

TOOLS = Path(__file__).parents[2] / "tools"
DATA = "data/realsense_d435_depth_color_640x480.bag"


@pytest.fixture(scope="session")
def tool() -> Iterator[Callable[[str], ModuleType]]:
    """A module of the tools folder, by name."""
    sys.path.insert(0, str(TOOLS))
    yield importlib.import_module
    sys.path.remove(str(TOOLS))


@pytest.fixture(scope="session")
def noise_bags(tool: Callable[[str], ModuleType], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Forty frames of noise, recorded "packed" and "plain", and each of them "-unindexed" as a kill leaves it."""
    return tool("noise_recordings").make_all(tmp_path_factory.mktemp("noise"))


@pytest.fixture
def real_bag() -> Path:
    """A D435's recording of 2018, in a data folder of the checkout or beside it."""
    root = Path(__file__).parents[2]
    found = [root / DATA, *sorted(root.parent.glob(f"*/{DATA}"))]
    if path := next((path for path in found if path.is_file()), None):
        return path
    pytest.skip(f"no {DATA} in this checkout, or in a folder beside it")

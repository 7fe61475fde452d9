from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_bag() -> Path:
    """A D435's recording, in a data folder of the checkout or beside it; the test skips without one."""
    root, name = Path(__file__).parents[2], "data/realsense_d435_depth_color_640x480.bag"
    found = [root / name, *sorted(root.parent.glob(f"*/{name}"))]
    if path := next((path for path in found if path.is_file()), None):
        return path
    pytest.skip(f"no {name} in this checkout, or in a folder beside it")

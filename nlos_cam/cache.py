"""Where what can be made again is kept."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """NLOS_CAM_CACHE, or nlos-cam's place in the user's cache folder."""
    if chosen := os.environ.get("NLOS_CAM_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "nlos-cam"

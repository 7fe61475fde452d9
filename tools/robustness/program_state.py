"""State of the program that a tool's results are of: a second call goes on with those of the same
program alone.
"""

import hashlib
from functools import cache
from pathlib import Path

from nlos_cam.files import CHECKSUMS

ROOT = Path(__file__).parents[2]
PROGRAM = "nlos_cam", "calibration", "models"
PATTERNS = "*.py", "*.pyi", "*.toml", CHECKSUMS
"""Source files, faces, rigs and recipes, and the checksums of all weights."""


@cache
def program_digest(*more: str) -> str:
    """Return a checksum of the program and its weights, by the files' contents, and of `more`
    folders of the repository.
    """
    digest = hashlib.sha256()
    for folder in (*PROGRAM, *more):
        for pattern in PATTERNS:
            for path in sorted((ROOT / folder).rglob(pattern)):
                digest.update(f"{path.relative_to(ROOT)}\n".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]

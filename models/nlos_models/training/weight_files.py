"""Check of a folder of weights against its checksums, without torch."""

from pathlib import Path

from nlos_cam.files import TENSOR_LIMIT, checksums_of, read_checked


def damaged_files(folder: Path) -> list[str]:
    """Return the names of a folder's weights that its SHA256SUMS lists and that are missing,
    unreadable or different; none where there is no such list.
    """
    damaged: list[str] = []
    for name in checksums_of(folder):
        try:
            read_checked(folder / name, TENSOR_LIMIT)
        except (OSError, ValueError):
            damaged.append(name)
    return damaged

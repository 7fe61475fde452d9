"""The one gate: formatting, lint, types, import layers, the map of files, the docs. `make check` runs it; CI does."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
GATES = (
    ("ruff", "format", "--check"),
    ("ruff", "check"),
    ("pyright",),
    ("lint-imports",),
    ("python", "tools/file_map.py", "--check"),
    ("python", "tools/docs.py", "--check"),
)
LONGEST_FILE = 250


def too_long() -> list[str]:
    """Source files above the house's limit."""
    files = [
        path
        for folder in ("nlos_cam", "calibration", "models", "tools", "examples", "tests")
        for path in (ROOT / folder).rglob("*.py")
    ]
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    return [
        f"{path.relative_to(ROOT)}: {n} lines, at most {LONGEST_FILE}"
        for path, n in lengths.items()
        if n > LONGEST_FILE
    ]


def main() -> int:
    """Run every gate and say which failed."""
    failed = [gate for gate in GATES if subprocess.run([BIN / gate[0], *gate[1:]], cwd=ROOT, check=False).returncode]
    long = too_long()
    print("\n".join([*long, *(f"failed: {' '.join(gate)}" for gate in failed)]) or "every gate is clean")
    return 1 if failed or long else 0


if __name__ == "__main__":
    sys.exit(main())

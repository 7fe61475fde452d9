"""Every gate in one command: formatting, lint, types, import layers, docs, words, length of files (`make check`)."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
GATES = (
    ("ruff", "format", "--check"),
    ("ruff", "check"),
    ("pyright",),
    ("lint-imports",),
    ("python", "tools/docs/build_site.py", "--check"),
    ("python", "tools/checks/words.py"),
)
FOLDERS = "nlos_cam", "calibration", "models", "tools", "examples", "tests"
MAX_LINES = 500


def too_long() -> list[str]:
    """Return one line for every source file above the limit."""
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    return [f"{path.relative_to(ROOT)}: {n} lines, at most {MAX_LINES}" for path, n in lengths.items() if n > MAX_LINES]


def main() -> int:
    """Run every gate and print those that failed."""
    failed = [gate for gate in GATES if subprocess.run([BIN / gate[0], *gate[1:]], cwd=ROOT, check=False).returncode]
    long = too_long()
    print("\n".join([*long, *(f"failed: {' '.join(gate)}" for gate in failed)]) or "every gate is clean")
    return 1 if failed or long else 0


if __name__ == "__main__":
    sys.exit(main())

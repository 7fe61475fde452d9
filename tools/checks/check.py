"""Every gate in one command: formatting, lint, types, import layers, docs, words and density."""

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
    ("python", "tools/checks/density.py"),
)


def main() -> int:
    """Run every gate and print those that failed."""
    failed = [
        gate
        for gate in GATES
        if subprocess.run([BIN / gate[0], *gate[1:]], cwd=ROOT, check=False).returncode
    ]
    print("\n".join(f"failed: {' '.join(gate)}" for gate in failed) or "every gate is clean")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

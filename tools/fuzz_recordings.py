"""Corrupted recordings through everything that reads recordings: docs/fuzz.json (arguments: count, seed).

One that ends in a crash, a hang, too much memory or an error nobody foresaw is told with its seed, and kept: the seed
gives the same damage again, but librealsense stamps a recording with other times in each run.
"""

import json
import sys
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from corruption import corrupt
from fuzz_harness import GOOD, MEMORY_BYTES, TIMEOUT_S, Watched
from noise_recordings import make_all

from nlos_cam.evaluate.render_tradeoff import machine

TOOLS = Path(__file__).parent
DOCS = TOOLS.parent / "docs"


@dataclass
class Findings:
    """What became of the corrupted recordings."""

    verdicts: dict[str, int] = field(default_factory=dict[str, int])
    refused_by: dict[str, int] = field(default_factory=dict[str, int])
    """How many each action refused with one line."""
    bad: list[dict[str, str | int]] = field(default_factory=list[dict[str, str | int]])


def fuzz(recordings: dict[str, Path], actions: Path, count: int, seed: int, keep: Path) -> Findings:
    """Corrupt recordings `count` times and watch the actions on each; bad cases are kept in a folder."""
    findings = Findings()
    contents = {name: path.read_bytes() for name, path in recordings.items()}
    whole = next(iter(recordings.values()))
    with Watched(actions, whole) as watched:
        for number in range(seed, seed + count):
            name = list(contents)[number % len(contents)]
            ways, content = corrupt(contents[name], np.random.default_rng(number))
            path = keep / f"{name}-{number}.bag"
            path.write_bytes(content)
            kind, told = watched.judge(path)
            findings.verdicts[kind] = findings.verdicts.get(kind, 0) + 1
            if kind in GOOD:
                path.unlink()
                for line in told.splitlines():
                    action = line.partition(":")[0]
                    findings.refused_by[action] = findings.refused_by.get(action, 0) + 1
            else:
                findings.bad.append({"seed": number, "recording": name, "ways": ways, "verdict": kind, "told": told})
                print(f"{kind}: seed {number}, {path} ({ways}): {told}")
    return findings


def main() -> None:
    """Fuzz, write, print; exits with 1 where something bad was found."""
    count, seed = (int(sys.argv[i]) if len(sys.argv) > i else default for i, default in ((1, 500), (2, 0)))
    keep = Path(tempfile.mkdtemp(prefix="fuzz-"))
    with tempfile.TemporaryDirectory() as folder:
        findings = fuzz(make_all(Path(folder)), TOOLS / "fuzz_actions.py", count, seed, keep)
    limits = {"timeout_s": TIMEOUT_S, "memory_mib": MEMORY_BYTES >> 20}
    result = {"machine": machine(), "recordings": count, "seed": seed, **limits, **asdict(findings)}
    (DOCS / "fuzz.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=2))
    sys.exit(1 if findings.bad else 0)


if __name__ == "__main__":
    main()

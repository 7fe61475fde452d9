"""Someone records, and the system sets limits."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.files import claim
from nlos_cam.recording import BagReader, load_sidecar, repair_recording

Run = Callable[..., Any]
LIMIT_BYTES = 8 << 20
RESOURCE = pytest.importorskip("resource")
CAPTURE = f"""
import resource
from nlos_cam.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, ({LIMIT_BYTES}, {LIMIT_BYTES}))
raise SystemExit(main(["capture", "--camera", "sim", "--seconds", "3", "--out", "a.bag", "--json"]))
"""


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record for three seconds under a limit on the size of a file; return the folder."""
    folder = tmp_path_factory.mktemp("limited")
    ended = subprocess.run(
        [sys.executable, "-c", CAPTURE], cwd=folder, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    (folder / "answer.json").write_text(ended.stdout.splitlines()[-1])
    return folder


@pytest.mark.slow
def test_limit_on_file_size_is_named(limited: Path) -> None:
    answer = json.loads((limited / "answer.json").read_text())

    assert "limit on a file's size" in answer["error"]["message"]
    assert "free some space" not in answer["error"]["message"]
    assert answer["state"] == "size limit"


@pytest.mark.slow
def test_capture_counts_frames_in_the_file(limited: Path) -> None:
    answer = json.loads((limited / "answer.json").read_text())
    repaired = repair_recording(limited / "a.bag", limited / "repaired.bag")

    assert answer["frames"] == min(repaired.recovered_frames.values()) < 20
    assert answer["streams"] == repaired.recovered_frames


@pytest.mark.slow
def test_sidecar_tells_what_the_file_holds(limited: Path) -> None:
    answer = json.loads((limited / "answer.json").read_text())
    sidecar = load_sidecar(limited / "a.json")

    assert sidecar.state == "size limit"
    assert sidecar.summary.frames == answer["frames"]


HOLD = """
import sys
from pathlib import Path
from nlos_cam.files import claim
with claim(Path("a.bag")):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_info_says_that_a_file_is_being_recorded(run: Run, noise_bags: dict[str, Path]) -> None:
    Path("a.bag").write_bytes(noise_bags["packed-unindexed"].read_bytes())
    with subprocess.Popen(
        [sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout.readline() == b"held\n"
        during = run("info", "a.bag", code=4)["problem"]
        holder.stdin.close()
    after = run("info", "a.bag", code=4)["problem"]

    assert "is being recorded" in during
    assert "killed" in after
    assert "being recorded" not in after


def test_claim_of_this_process_is_not_another_recorder(
    run: Run, noise_bags: dict[str, Path]
) -> None:
    Path("a.bag").write_bytes(noise_bags["packed-unindexed"].read_bytes())
    with claim(Path("a.bag")):
        assert "killed" in run("info", "a.bag", code=4)["problem"]


def test_healthy_file_is_read_while_claimed(noise: Path) -> None:
    with claim(noise):
        assert BagReader(noise).streams

"""Attacks, fuzz and soak of tools/robustness: they notice what they look for, and repeat their
damage from a seed.
"""

import os
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from types import ModuleType
from unittest.mock import Mock

import numpy as np
import pytest
from fake_workers import samples_of
from nlos_calibration.rig import load_rig
from soak import FrameLog, summarize

from nlos_cam.dataset import DatasetPlan
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import RecordingError
from nlos_cam.view.messages import pack
from nlos_cam.view.session_file import element, page_html

Tool = Callable[[str], ModuleType]


NO_SPACE = "error: a.npz cannot be written: free some space"


def starved(tool: Tool, folder: Path, code: int = 1, message: str = NO_SPACE) -> str:
    """Return the fault that is found in a starved `render` that ended so."""
    ended = subprocess.CompletedProcess([], code, "", message)
    render = tool("trials").COMMANDS["render"]
    return tool("starve_commands").wrong_with(render, folder, folder, ended)


def test_starved_command_may_end_with_one_line(tool: Tool, tmp_path: Path) -> None:
    assert starved(tool, tmp_path) == ""


@pytest.mark.parametrize(
    ("code", "message", "fault"),
    [
        (1, "Traceback (most recent call last):\nMemoryError", "Traceback"),
        (1, "one\ntwo\nthree\nfour", "4 lines"),
        (-11, "", "-11"),
        (0, "", "a.npz is not whole"),
    ],
)
def test_starved_command_that_ends_badly_is_noticed(
    tool: Tool, tmp_path: Path, code: int, message: str, fault: str
) -> None:
    assert fault in starved(tool, tmp_path, code, message)


def test_part_left_by_a_starved_command_is_noticed(tool: Tool, tmp_path: Path) -> None:
    (tmp_path / ".a.npz.part").mkdir()
    assert ".a.npz.part" in starved(tool, tmp_path)


def test_broken_output_of_a_starved_command_is_noticed(tool: Tool, tmp_path: Path) -> None:
    (tmp_path / "a.npz").touch()
    assert "not whole" in starved(tool, tmp_path)


def test_findings_of_two_groups_are_joined(tool: Tool) -> None:
    fuzz = tool("fuzz")
    light = fuzz.Findings()
    torch = fuzz.Findings()
    light.add("a.bag", 0, fuzz.Verdict("refused", "", 200, 0.1))
    torch.add("b.h5", 0, fuzz.Verdict("crash", "", 300, 0.2))
    torch.bad.append({"input": "b.h5"})
    facts = light.replaced(torch, ["b.h5"]).facts()

    assert facts["cases"] == 2
    assert facts["verdicts"] == {"refused": 1, "crash": 1}
    assert facts["most_mib"] == {"a.bag": 200, "b.h5": 300}
    assert facts["bad"] == [{"input": "b.h5"}]


def test_findings_know_their_cases_by_number(tool: Tool) -> None:
    fuzz = tool("fuzz")
    found = fuzz.Findings()
    for number in (0, 1, 2, 7):
        found.add("a.bag", number, fuzz.Verdict("done", ""))

    assert found.numbers == {"a.bag": [[0, 3], [7, 8]]}
    assert [n for n in range(9) if found.has("a.bag", n)] == [0, 1, 2, 7]
    assert not found.has("b.h5", 0)


@pytest.mark.parametrize("kept", [True, False])
def test_results_go_on_with_the_same_program_alone(
    tool: Tool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    out = tmp_path / "results.json"
    monkeypatch.setattr(tool("trials"), "machine", lambda: "a machine")
    tool("trials").Results(out, 0).repeat("render", "kills", 2, lambda _: {"wrong": ""})
    if not kept:
        monkeypatch.setattr(tool("trials"), "program_digest", lambda: "of another")
    rows = tool("trials").Results(out, 0).facts.get("render", {}).get("kills", [])

    assert len(rows) == (2 if kept else 0)


def test_trials_resume_and_a_failed_one_is_a_finding(tool: Tool, tmp_path: Path) -> None:
    trials = tool("trials")
    drawn = list[float]()

    def trial(random: Random) -> dict[str, str]:
        drawn.append(random.random())
        if len(drawn) == 3:
            raise TimeoutError("it never ends")
        return {"wrong": ""}

    trials.Results(tmp_path / "a.json", 0).repeat("render", "kills", 2, trial)
    results = trials.Results(tmp_path / "a.json", 0)
    results.repeat("render", "kills", 4, trial)

    assert len(set(drawn)) == len(results.facts["render"]["kills"]) == 4
    assert [row["wrong"] for row in results.findings] == ["TimeoutError('it never ends')"]


def test_session_that_does_not_play_is_noticed(tool: Tool) -> None:
    trials = tool("trials")
    messages = [pack({"kind": "bench"}), pack({"kind": "chunk"})]
    whole = page_html("session").encode() + b"".join(map(element, messages))

    assert trials.check_session(whole) == 2
    assert trials.check_session(whole[:-12]) == 1

    for bad in (b"", page_html("session").encode()):
        with pytest.raises(ValueError, match="no saved session"):
            trials.check_session(bad)
    with pytest.raises(struct.error):
        trials.check_session(whole.replace(element(messages[0]), element(b"bad")))


def dataset(folder: Path, harm: str = "") -> Path:
    """Store a dataset of three objects, one of whose arrays is harmed by a bit or, where it holds
    text, reversed.
    """
    folder.mkdir()
    samples = samples_of(range(3))
    if harm == "category":
        samples[harm] = samples[harm][::-1]
    elif harm:
        samples[harm].reshape(-1).view(np.uint8)[-1] ^= 1
    store(shard_path(folder, 0), samples, DatasetPlan(load_rig("paper-rig"), 0).provenance, "")
    return folder


@pytest.mark.parametrize(
    "harm", ["", "depth_m", "intensity", "image", "object_depth_m", "scene", "category"]
)
def test_one_bit_in_a_dataset_makes_a_difference(tool: Tool, tmp_path: Path, harm: str) -> None:
    found = tool("trials").differing(dataset(tmp_path / "one"), dataset(tmp_path / "other", harm))
    assert found == ([harm] if harm else [])


def test_finished_part_that_is_made_again_is_noticed(tool: Tool, tmp_path: Path) -> None:
    trials = tool("trials")
    path = dataset(tmp_path / "data") / "shard-000000000.h5"
    before = trials.finished_parts(trials.COMMANDS["dataset build"], tmp_path)

    assert list(before) == [path.name]

    os.utime(path, ns=(0, 0))

    assert trials.finished_parts(trials.COMMANDS["dataset build"], tmp_path) != before
    assert trials.finished_parts(trials.COMMANDS["export"], tmp_path) == {}


def test_processes_of_a_killed_command_that_run_on_are_noticed(
    tool: Tool, monkeypatch: pytest.MonkeyPatch
) -> None:
    kills = tool("kill_commands")
    monkeypatch.setattr(kills, "GRACE_S", 0.1)
    with subprocess.Popen(["/bin/sleep", "60"]) as process:
        assert "1 of its processes" in kills.survivors([process.pid])
        process.kill()
        process.wait()

    assert not kills.survivors([process.pid])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "action"),
    [
        ("done", lambda: None),
        ("crash", os.abort),
        ("crash", lambda: os._exit(3)),
        ("hang", lambda: time.sleep(60)),
        ("memory", lambda: bytearray((1 << 30) + (1 << 20))),
        ("unexpected", Mock(side_effect=AttributeError("nobody foresaw this"))),
        ("unexpected", Mock(side_effect=RecordingError("two\nlines"))),
        ("refused", Mock(side_effect=RecordingError("foreseen"))),
    ],
)
def test_judge_notices_each_kind_of_end(tool: Tool, kind: str, action: Callable[[], None]) -> None:
    verdict = tool("fuzz").judge(action, timeout_s=3.0)

    assert verdict.kind == kind
    assert verdict.details or kind == "done"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".bag", ".bin"])
def test_mutation_is_the_same_for_the_same_seed(
    tool: Tool, noise_bags: dict[str, Path], suffix: str
) -> None:
    module = tool("mutations")
    content = noise_bags["packed"].read_bytes()
    path = Path("a").with_suffix(suffix)
    taken = set[str]()
    for seed in range(20):
        ways, bad = module.mutate(path, content, np.random.default_rng(seed))
        assert (ways, bad) == module.mutate(path, content, np.random.default_rng(seed))
        taken |= set(ways.split("+"))

    assert len(taken) > 4


def test_rows_of_a_growing_log_are_read_once_and_whole(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    rows = list[dict[str, str]]()
    frames = FrameLog(path)
    text = "frame,latency_ms,dropped\n" + "".join(f"{i},{10 + i},{i // 5}\n" for i in range(10))
    for end in (0, 5, 40, 41, 60, len(text) - 1, len(text)):
        path.write_text(text[:end], encoding="utf-8")
        rows += frames.rows()

    assert [row["frame"] for row in rows] == [str(i) for i in range(10)]
    assert frames.rows() == []

    minute = summarize(3, (500.0, 13, 15), rows, watchers=2)

    assert minute.frames == 10
    assert minute.latency_p50_ms == 14.5
    assert minute.dropped == 1.0

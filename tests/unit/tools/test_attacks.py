"""Attacks of tools/robustness: they notice what they look for."""

import os
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from random import Random
from types import ModuleType

import numpy as np
import pytest
from fake_farm import samples_of
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import DatasetPlan
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.view.messages import pack
from nlos_cam.view.session_file import element, page_html

Tool = Callable[[str], ModuleType]


def ended(code: int, said: str) -> subprocess.CompletedProcess[str]:
    return subprocess.CompletedProcess([], code, "", said)


@pytest.mark.parametrize(
    ("code", "said", "wrong"),
    [
        (1, "error: a.npz cannot be written: free some space", ""),
        (1, "Traceback (most recent call last):\nMemoryError", "Traceback"),
        (1, "one\ntwo\nthree\nfour", "4 lines"),
        (-11, "", "-11"),
        (0, "", "a.npz is not whole"),
    ],
)
def test_starved_command_that_ends_badly_is_noticed(
    tool: Tool, tmp_path: Path, code: int, said: str, wrong: str
) -> None:
    starve = tool("starve_commands")
    found = starve.wrong_with(tool("trials").COMMANDS["render"], tmp_path, tmp_path, ended(code, said))
    assert wrong in found
    assert bool(found) == bool(wrong)


def test_starved_command_that_leaves_parts_is_noticed(tool: Tool, tmp_path: Path) -> None:
    starve, render = tool("starve_commands"), tool("trials").COMMANDS["render"]
    (tmp_path / ".a.npz.part").mkdir()
    assert ".a.npz.part" in starve.wrong_with(render, tmp_path, tmp_path, ended(1, "error: full"))
    (tmp_path / ".a.npz.part").rmdir()
    (tmp_path / "a.npz").touch()
    assert "not whole" in starve.wrong_with(render, tmp_path, tmp_path, ended(1, "error: full"))


def test_findings_of_two_groups_are_joined(tool: Tool) -> None:
    fuzz = tool("fuzz")
    light, torch = fuzz.Findings(), fuzz.Findings()
    light.add("a.bag", fuzz.Verdict("refused", "", 200, 0.1))
    torch.add("b.h5", fuzz.Verdict("crash", "", 300, 0.2))
    torch.bad.append({"input": "b.h5"})
    facts = light.replaced(torch, ["b.h5"]).facts()
    assert (facts["cases"], facts["verdicts"]) == (2, {"refused": 1, "crash": 1})
    assert (facts["most_mib"], facts["bad"]) == ({"a.bag": 200, "b.h5": 300}, [{"input": "b.h5"}])


def test_trials_resume_and_a_failed_one_is_a_finding(tool: Tool, tmp_path: Path) -> None:
    trials, drawn = tool("trials"), list[float]()

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
    trials, messages = tool("trials"), [pack({"kind": "bench"}), pack({"kind": "chunk"})]
    whole = page_html("session").encode() + b"".join(map(element, messages))
    assert trials.check_session(whole) == 2
    assert trials.check_session(whole[:-12]) == 1
    for bad in (b"", page_html("session").encode()):
        with pytest.raises(ValueError, match="no saved session"):
            trials.check_session(bad)
    with pytest.raises(struct.error):
        trials.check_session(whole.replace(element(messages[0]), element(b"bad")))


def dataset(folder: Path, harm: str = "") -> Path:
    """Store a dataset of three objects, one of whose arrays is harmed by a bit or, where it holds text, reversed."""
    folder.mkdir()
    samples = samples_of(range(3))
    if harm == "category":
        samples = {**samples, harm: samples[harm][::-1]}
    elif harm:
        values = samples[harm].copy()
        values.reshape(-1).view(np.uint8)[-1] ^= 1
        samples = {**samples, harm: values}
    store(shard_path(folder, 0), samples, DatasetPlan(load_rig("paper-rig"), 0).provenance, "")
    return folder


@pytest.mark.parametrize("harm", ["", "depth_m", "intensity", "image", "object_depth_m", "scene", "category"])
def test_one_bit_in_a_dataset_makes_a_difference(tool: Tool, tmp_path: Path, harm: str) -> None:
    found = tool("trials").differing(dataset(tmp_path / "one"), dataset(tmp_path / "other", harm))
    assert found == ([harm] if harm else [])


def test_finished_part_that_is_made_again_is_noticed(tool: Tool, tmp_path: Path) -> None:
    trials, path = tool("trials"), dataset(tmp_path / "data") / "shard-000000000.h5"
    before = trials.finished_parts(trials.COMMANDS["dataset build"], tmp_path)
    assert list(before) == [path.name]
    os.utime(path, ns=(0, 0))
    assert trials.finished_parts(trials.COMMANDS["dataset build"], tmp_path) != before
    assert trials.finished_parts(trials.COMMANDS["export"], tmp_path) == {}


def test_processes_of_a_killed_command_that_run_on_are_noticed(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    kills = tool("kill_commands")
    monkeypatch.setattr(kills, "GRACE_S", 0.1)
    with subprocess.Popen(["/bin/sleep", "60"]) as process:
        assert "1 of its processes" in kills.survivors([process.pid])
        process.kill()
        process.wait()
    assert not kills.survivors([process.pid])

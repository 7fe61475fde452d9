"""The fuzz: it finds bad endings of each kind, repeats its damage from a seed, and knows every format."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from nlos_cam.errors import RecordingError

Tool = Callable[[str], ModuleType]


def fail(error: BaseException) -> None:
    raise error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "action"),
    [
        ("done", lambda: None),
        ("crash", os.abort),
        ("crash", lambda: os._exit(3)),
        ("hang", lambda: time.sleep(60)),
        ("memory", lambda: bytearray((1 << 30) + (1 << 20))),
        ("unexpected", lambda: fail(AttributeError("nobody foresaw this"))),
        ("unexpected", lambda: fail(RecordingError("two\nlines"))),
        ("refused", lambda: fail(RecordingError("foreseen"))),
    ],
)
def test_judge_notices_each_kind_of_end(tool: Tool, kind: str, action: Callable[[], None]) -> None:
    verdict = tool("fuzz").judge(action, timeout_s=3.0)
    assert verdict.kind == kind
    assert verdict.details or kind == "done"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".bag", ".bin"])
def test_mutation_is_the_same_for_the_same_seed(tool: Tool, noise_bags: dict[str, Path], suffix: str) -> None:
    module, content, path = tool("mutations"), noise_bags["packed"].read_bytes(), Path("a").with_suffix(suffix)
    taken = set[str]()
    for seed in range(20):
        ways, bad = module.mutate(path, content, np.random.default_rng(seed))
        assert (ways, bad) == module.mutate(path, content, np.random.default_rng(seed))
        taken |= set(ways.split("+"))
    assert len(taken) > 4

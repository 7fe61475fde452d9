"""Wrong pictures with a good word: 108 objects, 41 ways to harm a frame, and the verdict on each.

    python tools/studies/wrong_pictures.py [--objects N]     docs/figures/wrong_pictures.json

Every frame runs through the pipeline of `live`, with the default weights, the simulated camera's
noise and a physics check of the same frame. Counted are frames of which the program speaks well
although what it shows is wrong: "object seen" with a silhouette IoU below 0.5, "nothing there" with
an object hidden, a trusted (green) picture with an IoU below 0.75.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import harness
import numpy as np
from nlos_calibration import Rig, load_rig
from nlos_calibration.arrays import Float32

from nlos_cam.camera import World
from nlos_cam.cli.common import tracked
from nlos_cam.dataset import TEST_SEED, DatasetPlan
from nlos_cam.evaluate import Subject, echoes_of, interval, truth_of
from nlos_cam.frames import Frame
from nlos_cam.objects import benchmark_objects, image_from_depth, object_box, unseen_objects
from nlos_cam.reconstruct import (
    Arrival,
    CalibratedRig,
    FrameResult,
    PeriodicPhysicsCheck,
    Pipeline,
    Verdict,
    build_pipeline,
    frame_issues,
    load_networks,
    load_uncertainty,
)
from nlos_cam.render import MultiBounce, SceneFile, SensorModel

FRAMES = 2
"""Frames of each scene: the first is checked by physics, the second is judged with that."""
FROZEN_FRAMES = 7
"""The same of a frozen camera, which is recognised by its repeats."""
SHAPES = "left", "right", "top", "bottom", "disc", "scattered"
SHARES = 0.1, 0.25, 0.4, 0.6
CELL_PIXELS = 8
BAD_IOU = 0.5
GREEN_IOU = 0.75

Change = Callable[[Frame, Frame], Frame]
"""Frame of the object that is hidden, and one of another object, to the frame that arrives."""


@dataclass(frozen=True)
class Outcome:
    """What the program said of one harmed frame, and what was true."""

    group: str
    harm: str
    subject: str
    verdict: str
    trusted: bool
    iou: float


def masked(shape: str, share: float) -> Change:
    """Return a change that takes depth and infrared from a share of the pixels."""

    def change(frame: Frame, _other: Frame) -> Frame:
        row, column = np.indices(frame.depth_m.shape)
        height, width = frame.depth_m.shape
        order = {
            "left": column,
            "right": -column,
            "top": row,
            "bottom": -row,
            "disc": np.hypot(row - height / 2, column - width / 2),
            "scattered": _blocks(height, width),
        }[shape]
        gone = order < np.quantile(order, share)
        return replace(
            frame,
            depth_m=np.where(gone, np.float32(np.nan), frame.depth_m),
            ir=np.where(gone, np.uint8(0), frame.ir),
        )

    return change


def _blocks(height: int, width: int) -> np.ndarray:
    """Return a random value for each block of CELL_PIXELS pixels."""
    cells = np.random.default_rng(5).random((height // CELL_PIXELS, width // CELL_PIXELS))
    return cells.repeat(CELL_PIXELS, 0).repeat(CELL_PIXELS, 1)


def moved(
    turn: Callable[[np.ndarray], np.ndarray], *, depth: bool = True, ir: bool = True
) -> Change:
    """Return a change that moves the pixels of one image or of both."""

    def change(frame: Frame, _other: Frame) -> Frame:
        return replace(
            frame,
            depth_m=np.ascontiguousarray(turn(frame.depth_m)) if depth else frame.depth_m,
            ir=np.ascontiguousarray(turn(frame.ir)) if ir else frame.ir,
        )

    return change


def scaled(depth: float = 1.0, ir: float = 1.0) -> Change:
    """Return a change of the unit of depth, or of the gain."""

    def change(frame: Frame, _other: Frame) -> Frame:
        counts = np.clip(np.rint(frame.ir * ir), 0, 255).astype(np.uint8)
        return replace(frame, depth_m=frame.depth_m * np.float32(depth), ir=counts)

    return change


def lens(zoom: float) -> Change:
    """Return a change to a lens of another focal length, unknown to the program."""

    def turn(image: np.ndarray) -> np.ndarray:
        middle = (np.array(image.shape) - 1) / 2
        rows, columns = (
            np.clip(np.rint((np.arange(size) - at) / zoom + at), 0, size - 1).astype(int)
            for size, at in zip(image.shape, middle, strict=True)
        )
        return image[np.ix_(rows, columns)]

    return moved(turn)


def torn(frame: Frame, other: Frame) -> Frame:
    """Return a frame whose lower half is of another time."""
    half = len(frame.depth_m) // 2
    return replace(
        frame,
        depth_m=np.concatenate([frame.depth_m[:half], other.depth_m[half:]]),
        ir=np.concatenate([frame.ir[:half], other.ir[half:]]),
    )


def blended(frame: Frame, other: Frame) -> Frame:
    """Return the mean of two times."""
    return replace(
        frame,
        depth_m=(frame.depth_m + other.depth_m) / 2,
        ir=((frame.ir.astype(np.uint16) + other.ir) // 2).astype(np.uint8),
    )


def upside_down(image: np.ndarray) -> np.ndarray:
    """Return an image with its rows in the opposite order."""
    return image[::-1]


HARMS: dict[str, Change] = {
    **{f"{shape} {share:.0%} black": masked(shape, share) for shape in SHAPES for share in SHARES},
    "infrared of another object": lambda frame, other: replace(frame, ir=other.ir),
    "infrared upside down": moved(upside_down, depth=False),
    "depth upside down": moved(upside_down, ir=False),
    "infrared left to right": moved(np.fliplr, depth=False),
    "infrared 8 rows off": moved(lambda image: np.roll(image, 8, 0), depth=False),
    "depth 3 % short": scaled(depth=0.97),
    "depth 3 % long": scaled(depth=1.03),
    "infrared halved": scaled(ir=0.5),
    "infrared by 1.5": scaled(ir=1.5),
    "mirrored left to right": moved(np.fliplr),
    "turned by 180 degrees": moved(lambda image: image[::-1, ::-1]),
    "16 columns to the right": moved(lambda image: np.roll(image, 16, 1)),
    "24 rows down": moved(lambda image: np.roll(image, 24, 0)),
    "lens 10 % shorter": lens(0.9),
    "lens 10 % longer": lens(1.1),
    "frozen at another object": lambda _, other: other,
    "torn": torn,
    "mean of two objects": blended,
    "mirrored up to down": moved(upside_down),
}
BY_ACCELEROMETER = "mirrored up to down"
"""A rig is symmetric about y = 0: no image tells this, gravity does."""


def frames_of(world: World, index: int, count: int, step: int) -> list[Frame]:
    """Return frames of one object with different noise."""
    numbers = [index + step * k for k in range(count)]
    return [world.images(number).frame(world.rig.pinhole) for number in numbers]


def judge(pipeline: Pipeline, frames: Sequence[Frame]) -> FrameResult:
    """Return the result of the last of some frames, of consecutive numbers, 1/30 s apart."""
    clock = time.perf_counter
    result = None
    for number, frame in enumerate(frames):
        arrived = replace(frame, frame_number=number + 1, timestamp_s=number / 30)
        arrival = Arrival(arrived, clock(), frame_issues(arrived))
        result = pipeline.process(arrival, clock, clock())
    if result is None:
        raise ValueError("no frames")
    return result


def overlap(shown_m: Float32, truth: Float32, rig: Rig) -> float:
    """Return the silhouette IoU of what is shown with the truth (64, 64) in v."""
    shown = image_from_depth(shown_m, object_box(rig)) > 0
    true = truth > 0
    return float((shown & true).sum() / max((shown | true).sum(), 1))


def measure(group: str, subjects: Sequence[Subject], rig: Rig) -> list[Outcome]:
    """Return the outcome of every harm on every object of a group."""
    truths = truth_of(subjects, object_box(rig))
    network = load_networks()
    uncertainty_model = load_uncertainty()
    bench = CalibratedRig(rig)
    outcomes: list[Outcome] = []
    with tracked(group) as on_progress:
        echoes: list[MultiBounce] = echoes_of(subjects, rig, lambda _done, _total: None)
        world = World(SceneFile(name=group, rig=rig, sensor=SensorModel()), echoes, [None])
        for index, subject in enumerate(subjects):
            on_progress(index, len(subjects))
            other = (index + len(subjects) // 2 + 1) % len(subjects)
            own = frames_of(world, index, FRAMES, len(subjects))
            others = frames_of(world, other, FRAMES, len(subjects))
            for harm, change in [("none", None), *HARMS.items()]:
                frames = own
                if change:
                    frames = [change(a, b) for a, b in zip(own, others, strict=True)]
                if harm.startswith("frozen"):
                    frames = frames[:1] * FROZEN_FRAMES
                checks = PeriodicPhysicsCheck(rig, every=FROZEN_FRAMES + 1)
                pipeline = build_pipeline(
                    bench, network, uncertainty_model=uncertainty_model, checks=checks
                )
                result = judge(pipeline, frames)
                quality = result.reconstruction.quality
                outcomes.append(
                    Outcome(
                        group,
                        harm,
                        subject.name,
                        str(result.verdict),
                        bool(quality and quality.trusted and result.verdict is Verdict.SEEN),
                        overlap(result.depth_m, truths[index], rig),
                    )
                )
    return outcomes


def summarise(outcomes: Sequence[Outcome], unharmed: dict[str, Outcome]) -> dict[str, Any]:
    """Return the shares of some outcomes; `unharmed` holds each object's frame without a harm."""

    def is_bad(outcome: Outcome) -> bool:
        return outcome.verdict == Verdict.SEEN and outcome.iou < BAD_IOU

    tests: dict[str, Callable[[Outcome], bool]] = {
        "seen": lambda o: o.verdict == Verdict.SEEN,
        "seen_wrong": is_bad,
        "seen_wrong_by_the_harm": lambda o: is_bad(o) and unharmed[o.subject].iou >= BAD_IOU,
        "nothing": lambda o: o.verdict == Verdict.NOTHING,
        "green": lambda o: o.trusted,
        "green_wrong": lambda o: o.trusted and o.iou < GREEN_IOU,
    }
    return {name: share(outcomes, test) for name, test in tests.items()}


def share(outcomes: Sequence[Outcome], test: Callable[[Outcome], bool]) -> dict[str, Any]:
    """Return the share of outcomes that pass a test, with a 95 % interval over objects: frames of
    one object with many harms are no independent trials.
    """
    passed: dict[str, list[bool]] = {}
    for each in outcomes:
        passed.setdefault(each.subject, []).append(test(each))
    count = sum(map(sum, passed.values()))
    of_objects = interval(np.array([np.mean(every) for every in passed.values()]))
    # Of no object at all nothing can be resampled: a bound by Wilson's score for as many objects.
    if count in {0, len(outcomes)}:
        bound = harness.wilson(len(passed) if count else 0, len(passed))
        of_objects = replace(of_objects, low=bound["low"], high=bound["high"])
    return {
        "count": count,
        "of": len(outcomes),
        "share": of_objects.value,
        "low": of_objects.low,
        "high": of_objects.high,
    }


def report(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return shares by group, over all harms and for each."""
    facts: dict[str, Any] = {}
    for group in dict.fromkeys(o.group for o in outcomes):
        own = [o for o in outcomes if o.group == group]
        unharmed = {o.subject: o for o in own if o.harm == "none"}
        harmed = [o for o in own if o.harm not in {"none", BY_ACCELEROMETER}]
        facts[group] = {
            "all": summarise(harmed, unharmed),
            "harms": {
                harm: summarise([o for o in own if o.harm == harm], unharmed)
                for harm in ["none", *HARMS]
            },
        }
    return facts


def markdown(facts: dict[str, Any]) -> str:
    """Return a table of the shares, with a row for each group and harm; docs/physics-check.md has some
    of them.
    """
    columns = "seen", "seen_wrong", "seen_wrong_by_the_harm", "nothing", "green_wrong"
    head = ["frames", *(column.replace("_", " ") for column in columns)]
    rows = [
        [f"{group}: {name}", *(f"{100 * shares[column]['share']:.1f} %" for column in columns)]
        for group, found in facts.items()
        for name, shares in [("all harms", found["all"]), *found["harms"].items()]
    ]
    return harness.table(head, rows)


def main() -> None:
    """Measure, print the table, and write the figures."""
    parser = harness.options(__doc__)
    parser.add_argument("--objects", type=int, help="of each group, for a quick look")
    arguments: argparse.Namespace = parser.parse_args()

    rig = load_rig("paper-rig")
    box = DatasetPlan(rig, TEST_SEED).box
    groups = {"kinds of training": benchmark_objects(box), "kinds never seen": unseen_objects(box)}
    outcomes = [
        outcome
        for group, subjects in groups.items()
        for outcome in measure(group, list(subjects)[: arguments.objects], rig)
    ]
    facts = report(outcomes)
    print(markdown(facts))
    if arguments.objects is None:
        harness.write("wrong_pictures", facts)


if __name__ == "__main__":
    main()

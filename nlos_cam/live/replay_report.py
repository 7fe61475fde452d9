"""Report of a replay: result, pictures of some frames, facts of the recording, files, next
commands.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nlos_calibration import Rig

from nlos_cam.camera import Camera
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.live.loop import describe_counts
from nlos_cam.live.statistics import WarningSpan
from nlos_cam.reconstruct import UNEXPLAINED, Verdict
from nlos_cam.report import (
    Banner,
    Bullets,
    Commands,
    Document,
    Facts,
    Section,
    State,
    Table,
    saved_picture,
)

ADVICE = {
    Verdict.SEEN: (
        "The object resembles the training set. Expect blurred outlines and missing thin parts."
    ),
    Verdict.NOTHING: "No hidden surface was found in most frames.",
    Verdict.OUTSIDE: (
        "The shape in most frames is not reliable: the object or the bench is unlike the training"
        " set."
    ),
    Verdict.SATURATED: "Reduce the laser power or the gain, then record again.",
    Verdict.WALL_MOVED: "The lidar or the wall moved since the calibration: calibrate again.",
}
STATES: dict[Verdict, State] = {
    Verdict.SEEN: "good",
    Verdict.NOTHING: "doubtful",
    Verdict.OUTSIDE: "doubtful",
}
CONTENTS = {
    "reconstruction.npz": (
        f"hidden depth and uncertainty of every frame, {OBJECT_PIXELS} x {OBJECT_PIXELS}, m"
    ),
    "difference.npz": f"lidar maps less those of the bare wall, {MAP_ROWS} x {MAP_COLUMNS}",
    "frames.png": "the picture above",
    "report.md": "the text of this page",
    "object": "the hidden surface of each frame, for other programs",
    "replay.webm": "video",
}
SHEET_CAPTION = (
    "One column per frame. Lidar depth is the distance along the optical axis; hidden depth is the"
    " distance of the object from the wall. Uncertainty is the expected absolute error of the"
    " hidden depth."
)


@dataclass(frozen=True)
class ReplayFacts:
    """Facts of a replay that its report shows."""

    camera: Camera
    """After the last frame: its counters are those of the recording."""
    rig: Rig
    numbers: Sequence[int]
    timestamps_s: Sequence[float]
    with_surface: int
    uncertainty_mm: Sequence[float]
    """Median over the surface, by frame with a surface and an uncertainty model."""
    quality: Mapping[str, float]
    """As in `RunReport`."""
    verdicts: Mapping[str, int]
    check_scores: Sequence[float]
    warnings: Sequence[WarningSpan]
    reference_frames: int | None
    """Frames of the bare wall's reference; None without one."""
    interrupted: bool


def replay_document(facts: ReplayFacts, folder: Path, out: Path) -> Document:
    """Return the report on a replay whose other files are in `folder`, which will be renamed to
    `out`.
    """
    seconds = facts.timestamps_s[-1] - facts.timestamps_s[0]
    frames = len(facts.numbers)
    rig = facts.rig
    subtitle = (
        f"{frames} frames, {seconds:.1f} s; rig {rig.name}: {1e3 * rig.lidar.distance_m:.0f} mm to"
        f" the wall, facing {rig.facing_deg:.1f}°"
    )
    notes = ["Interrupted: only the frames up to then are included."] if facts.interrupted else []
    notes += [
        f"warning in {each.frames} frames, from {each.first} to {each.last}: {each.text}"
        for each in facts.warnings
    ]
    return Document(
        f"Replay of {facts.camera.uri}",
        subtitle,
        [
            Section("", [_banner(facts), Bullets("Note", notes)]),
            saved_picture("Some frames", SHEET_CAPTION, folder / "frames.png"),
            Section("Reconstruction", [_verdicts(facts), Facts(_reconstruction(facts))]),
            Section("Recording", [Facts(_recording(facts))]),
            Section("Files", [Facts(_files(folder))]),
            Section("Next commands", [Commands(_next_commands(facts, folder, out))]),
        ],
    )


def _banner(facts: ReplayFacts) -> Banner:
    frames = len(facts.numbers)
    if not facts.verdicts:
        headline = f"Hidden surface in {facts.with_surface} of {frames} frames"
        return Banner(
            "doubtful", headline, "These weights have no uncertainty model, so there is no verdict."
        )
    most = max(facts.verdicts, key=lambda verdict: facts.verdicts[verdict])
    headline = f"{most.capitalize()} in {facts.verdicts[most]} of {frames} frames"
    return Banner(
        STATES.get(Verdict(most), "out-of-range"), headline, ADVICE.get(Verdict(most), "")
    )


def _verdicts(facts: ReplayFacts) -> Table | str:
    frames = len(facts.numbers)
    rows = [
        (verdict, str(count), f"{100 * count / frames:.0f} %")
        for verdict, count in facts.verdicts.items()
    ]
    return Table(("verdict", "frames", "share"), rows) if rows else ""


def _reconstruction(facts: ReplayFacts) -> dict[str, str]:
    found = {"with a hidden surface": f"{facts.with_surface} of {len(facts.numbers)} frames"}
    if len(facts.uncertainty_mm):
        low, middle, high = np.percentile(facts.uncertainty_mm, [5, 50, 95])
        found["uncertainty"] = (
            f"{middle:.0f} mm (median of the surface; 5 to 95 % of frames: {low:.0f} to {high:.0f})"
        )
    if facts.quality:
        found["expected quality"] = (
            f"outline typically {facts.quality['expected_iou']:.0%} right, depth to "
            f"{facts.quality['expected_error_mm']:.0f} mm (medians of the frames with an object)"
        )
    if len(facts.check_scores):
        checked = len(facts.check_scores)
        unexplained = sum(score >= UNEXPLAINED for score in facts.check_scores)
        found["physics check"] = (
            f"score {np.median(facts.check_scores):.2f} (median; 0: the reconstruction explains the"
            f" maps, 1: no better than an empty bench); {unexplained} of {checked} checked frames"
            f" at {UNEXPLAINED:g} or more"
        )
    if facts.reference_frames:
        found["difference maps"] = (
            f"from the bare wall, the mean of {facts.reference_frames} frames"
        )
    return found


def _recording(facts: ReplayFacts) -> dict[str, str]:
    camera = facts.camera
    rig = facts.rig
    return {
        "frame numbers": f"{facts.numbers[0]} to {facts.numbers[-1]}",
        "without all streams": f"{camera.incomplete} frames, skipped",
        "missing": f"{camera.dropped} frames",
        "irregular messages": describe_counts(camera.counts) or "none",
        "rig's checksum": rig.checksum,
    }


def _files(folder: Path) -> dict[str, str]:
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    stills = [name for name in names if name.startswith("still-")]
    found = {
        name: CONTENTS.get(name, "the live view of this replay")
        for name in names
        if name not in stills
    }
    return (
        found
        | ({"still-*.png": f"{len(stills)} frames as pictures"} if stills else {})
        | {"report.md": CONTENTS["report.md"]}
    )


def _next_commands(facts: ReplayFacts, folder: Path, out: Path) -> list[str]:
    bag = shlex.quote(facts.camera.uri.removeprefix("bag:"))
    lines = [f"nlos-cam info {bag}"]
    if not (folder / "object").exists():
        lines.append(
            f"nlos-cam export {shlex.quote(str(out / 'reconstruction.npz'))} --object ply,glb,csv"
        )
    if not (folder / "replay.webm").exists():
        lines.append(f"nlos-cam replay {bag} --stills 6 --video")
    return lines if facts.reference_frames else [*lines, f"nlos-cam replay {bag} --wall wall.toml"]

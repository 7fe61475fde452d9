"""Report of a replay: result, pictures of some frames, facts of the recording, files, next
commands.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nlos_cam.camera import SIMULATED_SERIAL, Camera
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.reconstruct import UNEXPLAINED, CalibratedRig, Verdict, describe_counts
from nlos_cam.replay.results import ReplayResults
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
    Verdict.NOTHING: "No hidden surface was found in these frames.",
    Verdict.OUTSIDE: (
        "The shape in these frames is not reliable: the object or the bench is unlike the training"
        " set."
    ),
    Verdict.SATURATED: "Reduce the laser power or the gain, then record again.",
    Verdict.WALL_MOVED: "The lidar or the wall moved since the calibration: calibrate again.",
}
STATES: dict[Verdict, State] = {
    Verdict.SEEN: "doubtful",
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


def replay_document(
    camera: Camera,
    bench: CalibratedRig,
    results: ReplayResults,
    folder: Path,
    *,
    out: Path,
    options: Sequence[str] = (),
    interrupted: bool = False,
) -> Document:
    """Return the report on a replay whose other files are in `folder`, which will be renamed to
    `out`. `options` are the words of the command line that another replay needs too.

    `camera` has delivered its last frame: its counters are those of the recording.
    """
    rig = bench.rig
    subtitle = (
        f"{len(results.numbers)} frames, {results.duration_s:.1f} s; rig {rig.name}:"
        f" {1e3 * rig.lidar.distance_m:.0f} mm to the wall, facing {rig.facing_deg:.1f}°"
    )
    notes = ["Interrupted: only the frames up to then are included."] if interrupted else []
    if camera.identity.get("serial") == SIMULATED_SERIAL:
        notes.append("A recording of the simulated camera: it says nothing about a real L515.")
    notes += [
        f"warning in {each.frames} frames, from {each.first} to {each.last}: {each.text}"
        for each in results.warnings.spans
    ]
    commands = _next_commands(camera, folder, out, options)
    return Document(
        f"Replay of {camera.uri}",
        subtitle,
        [
            Section("", [_banner(results), Bullets("Note", notes)]),
            saved_picture("Some frames", SHEET_CAPTION, folder / "frames.png"),
            Section("Reconstruction", [_verdicts(results), Facts(_reconstruction(results, bench))]),
            Section("Recording", [Facts(_recording(camera, bench, results))]),
            Section("Files", [Facts(_files(folder))]),
            Section("Next commands", [Commands(commands)]),
        ],
    )


def _banner(results: ReplayResults) -> Banner:
    frames = len(results.numbers)
    verdicts = results.verdicts
    if not verdicts:
        headline = f"Hidden surface in {results.frames_with_surface} of {frames} frames"
        detail = "These weights have no uncertainty model, so there is no verdict."
        return Banner("doubtful", headline, detail)
    most = max(verdicts, key=lambda verdict: verdicts[verdict])
    headline = f"{most.capitalize()} in {verdicts[most]} of {frames} frames"
    verdict = Verdict(most)
    state = STATES.get(verdict, "out-of-range")
    if verdict is Verdict.SEEN and _is_green(results, verdicts[most]):
        state = "good"
    return Banner(state, headline, ADVICE.get(verdict, ""))


def _is_green(results: ReplayResults, seen: int) -> bool:
    """Return True if most frames are green on the live page, which means that their outlines are
    expected to be right; in `seen` of the frames an object is seen.
    """
    trusted = seen * results.quality.summary.get("trusted", 0.0)
    return trusted > len(results.numbers) / 2


def _verdicts(results: ReplayResults) -> Table | str:
    frames = len(results.numbers)
    rows = [
        (verdict, str(count), f"{100 * count / frames:.0f} %")
        for verdict, count in results.verdicts.items()
    ]
    return Table(("verdict", "frames", "share"), rows) if rows else ""


def _reconstruction(results: ReplayResults, bench: CalibratedRig) -> dict[str, str]:
    frames = len(results.numbers)
    facts = {"with a hidden surface": f"{results.frames_with_surface} of {frames} frames"}
    if results.uncertainty_mm:
        low, middle, high = np.percentile(results.uncertainty_mm, [5, 50, 95])
        facts["uncertainty"] = (
            f"{middle:.0f} mm (median of the surface; 5 to 95 % of frames: {low:.0f} to {high:.0f})"
        )
    if quality := results.quality.summary:
        facts["expected quality"] = (
            f"outline typically {quality['expected_iou']:.0%} right, depth to "
            f"{quality['expected_error_mm']:.0f} mm (medians of the frames with an object)"
        )
    if checks := results.checks:
        empty = results.unexplained_empty
        without = f" ({empty:g} without a surface)" if empty != UNEXPLAINED else ""
        middle = np.median([each.score for each in checks])
        facts["physics check"] = (
            f"score {middle:.2f} (median; 0: the reconstruction explains the"
            f" maps, 1: no better than an empty bench); {sum(each.unexplained for each in checks)} of"
            f" {len(checks)} checked frames at {UNEXPLAINED:g} or more{without}"
        )
    if results.weights:
        facts["weights"] = results.weights
    if bench.reference:
        facts["difference maps"] = (
            f"from the bare wall, the mean of {bench.reference.frames} frames"
        )
    return facts


def _recording(camera: Camera, bench: CalibratedRig, results: ReplayResults) -> dict[str, str]:
    return {
        "frame numbers": f"{results.numbers[0]} to {results.numbers[-1]}",
        "without all streams": f"{camera.incomplete} frames, skipped",
        "missing": f"{camera.dropped} frames",
        "irregular messages": describe_counts(camera.counts) or "none",
        "rig's checksum": bench.rig.checksum,
    }


def _files(folder: Path) -> dict[str, str]:
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    stills = [name for name in names if name.startswith("still-")]
    files = {
        name: CONTENTS.get(name, "the live view of this replay")
        for name in names
        if name not in stills
    }
    if stills:
        files["still-*.png"] = f"{len(stills)} frames as pictures"
    files["report.md"] = CONTENTS["report.md"]
    return files


def _next_commands(camera: Camera, folder: Path, out: Path, options: Sequence[str]) -> list[str]:
    bag = shlex.quote(camera.uri.removeprefix("bag:"))
    commands = [f"nlos-cam info {bag}"]
    if not (folder / "object").exists():
        result = shlex.quote(str(out / "reconstruction.npz"))
        commands.append(f"nlos-cam export {result} --object ply,glb,csv")
    if not (folder / "replay.webm").exists():
        words = shlex.join([*options, "--stills", "6", "--video"])
        commands.append(f"nlos-cam replay {bag} {words}")
    return commands

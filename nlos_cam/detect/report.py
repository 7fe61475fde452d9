"""Page of a detection, to publish: verdict, power, significance maps, settings, turns."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path

import numpy as np

from nlos_cam import __version__
from nlos_cam.detect.analysis import POWER, Analysis, Finding
from nlos_cam.detect.levelling import quiet_cells
from nlos_cam.detect.plan import Plan, source_checksum
from nlos_cam.detect.turns import CHANNELS
from nlos_cam.files import atomic_file, program_commit, with_commit
from nlos_cam.report import (
    Banner,
    Bullets,
    Commands,
    Document,
    Facts,
    Picture,
    Section,
    Table,
    figure_of,
    png,
)

UNITS = {"depth": (1e3, "mm"), "infrared": (1.0, "counts"), "confidence": (1.0, "steps")}
"""Factor and unit in which a channel is reported."""
NOT_DETERMINED = "not determined"
"""In place of the smallest effect, where none was found with the stated probability."""
MAX_DRAWN_SETTINGS = 6
DRAWN_PATCH = 3
CAVEATS = (
    (
        "The test says that the readings depend on the object. Whether by three-bounce light, by"
        " stray light past the occluder, or by the hands that move it, only controls can say: the"
        " same protocol with an empty hand (--control), with the gap to the object closed by a"
        " black sheet, and with an object of another brightness."
    ),
    (
        "A negative result holds for effects at least as large as those stated, on this bench, with"
        " these settings."
    ),
    (
        "Levelling subtracts gain and offset of each map: an effect that is the same in all cells"
        " would be subtracted with them."
    ),
)


def write_report(analysis: Analysis, page: Path, *, show_serial: bool = False) -> None:
    """Write the self-contained page; the camera's serial number only with `show_serial`."""
    text = make_document(analysis, show_serial=show_serial).as_html()
    with atomic_file(page) as part:
        part.write_bytes(text.encode(errors="backslashreplace"))


def make_document(analysis: Analysis, *, show_serial: bool = False) -> Document:
    """Return the page's content."""
    plan = analysis.plan
    settings = "one setting" if len(plan.settings) == 1 else f"{len(plan.settings)} settings"
    subtitle = (
        f"{4 * analysis.blocks} of {plan.turns} turns, {plan.frames} frames each, {settings};"
        f" {plan.created[:10]}; nlos-cam {plan.version}"
    )
    parts: list[Section | Picture] = [Section("", [verdict(analysis)])]
    parts.append(Section("Power", [power_text(analysis), _power_table(analysis)]))
    parts += _maps(analysis)
    parts.append(Section("Every test of the family", [_family_table(analysis)]))
    parts.append(Section("What the result does not say", [Bullets("", CAVEATS)]))
    parts.append(Section("Protocol", [PROTOCOL, Facts(facts(analysis, show_serial=show_serial))]))
    parts.append(Section("Settings", [_settings_table(plan)]))
    parts.append(Section("Again", [Commands([command_of(plan), "nlos-cam detect FOLDER"])]))
    title = "Control: nothing was moved in" if plan.control else "Does the lidar see the object?"
    return Document(title, subtitle, parts)


PROTOCOL = (
    "Turns come in blocks of four, out-in-in-out or in-out-out-in, each drawn by a coin before the"
    " first turn. A block's contrast is free of offset and of drift that is linear in time. Gain"
    " and offset of each map are fitted on the cells that see least of the object box, without"
    " knowing the turn's label. The largest significance over all cells, channels, settings and"
    " sizes of patches is compared with that under flipped signs of whole blocks, which are equally"
    " likely without an effect."
)


SIMULATED = " On the simulated camera: this says nothing about a real L515."


def verdict(analysis: Analysis) -> Banner:
    """Return the verdict, what it rests on, and that the camera was simulated where it was."""
    found = _verdict(analysis)
    if not analysis.plan.is_simulated:
        return found
    return replace(found, advice=found.advice + SIMULATED)


def _verdict(analysis: Analysis) -> Banner:
    plan = analysis.plan
    if not analysis.complete:
        return Banner(
            "doubtful",
            "Not finished",
            f"{analysis.blocks} of {plan.blocks} blocks; p = {analysis.p_value:.2g} so far. The"
            " false-alarm rate holds for the whole plan only: the same command goes on with --out"
            " and this folder.",
        )
    rate = f"A bench without any effect is called so in at most {plan.alpha:.2g} of such sessions"
    if analysis.detected:
        best = analysis.findings[0]
        headline = (
            "Something changed although nothing was moved in"
            if plan.control
            else "The readings depend on the object"
        )
        return Banner(
            "doubtful" if plan.control else "good",
            headline,
            f"p = {analysis.p_value:.2g}. {rate}. Clearest: {finding_text(best)}.",
        )
    headline = "Nothing changed, as it should be" if plan.control else "No effect was found"
    return Banner(
        "good" if plan.control else "doubtful",
        headline,
        f"p = {analysis.p_value:.2g}. {power_text(analysis)}",
    )


def finding_text(found: Finding) -> str:
    """Return the place, size and significance of an effect."""
    where = f"row {found.cell[0]}, column {found.cell[1]}"
    patch = "one cell" if found.patch == 1 else f"{found.patch} x {found.patch} cells"
    return (
        f"{found.channel} changes by {amount(found.channel, found.effect, signed=True)} in {patch}"
        f" at {where} ({found.peak:.1f} standard deviations; setting: {found.setting})"
    )


def power_text(analysis: Analysis) -> str:
    """Return the smallest effects that would have been found, or that these are not known."""
    if not any(isfinite(each.smallest) for each in analysis.findings):
        return (
            f"The power was not determined: in {4 * analysis.blocks} turns of"
            f" {analysis.plan.frames} frames no size of an effect was found with a probability of"
            f" {POWER:.0%}. Measure more turns or frames."
        )
    by_channel = [_smallest(analysis, channel) for channel in CHANNELS if _of(analysis, channel)]
    settings = analysis.plan.settings
    under = f' with the setting "{settings[0].name}"' if len(settings) > 1 else ""
    return (
        f"An effect would have been found{under} with a probability of {POWER:.0%} from this size"
        f" on, in the median cell and over the best size of patch: {'; '.join(by_channel)}."
    )


def _smallest(analysis: Analysis, channel: str) -> str:
    found = [each for each in _of(analysis, channel) if isfinite(each.smallest)]
    if not found:
        return f"{channel} {NOT_DETERMINED}"
    cell = min((each.smallest for each in found if each.patch == 1), default=float("inf"))
    patch = min(found, key=lambda each: each.smallest)
    return (
        f"{channel} {amount(channel, cell)} in one cell, {amount(channel, patch.smallest)}"
        f" over {patch.patch} x {patch.patch}"
    )


def _of(analysis: Analysis, channel: str) -> list[Finding]:
    """Return a channel's findings under the first setting: the best of several would promise more
    than any one of them sees.
    """
    first = analysis.plan.settings[0].name
    return [each for each in analysis.findings if each.channel == channel and each.setting == first]


def amount(channel: str, value: float, *, signed: bool = False) -> str:
    """Return a value in the channel's unit for people; words for a power that is not known."""
    if not isfinite(value):
        return NOT_DETERMINED
    factor, unit = UNITS[channel]
    rounded = float(f"{factor * value:.2g}")
    return f"{rounded:{'+' if signed else ''}g} {unit}"  # 300, where .2g alone writes 3e+02


def _power_table(analysis: Analysis) -> Table:
    rows = [
        (
            f"{each.setting}: {each.channel}",
            f"{each.patch} x {each.patch}",
            amount(each.channel, each.smallest),
            amount(each.channel, each.smallest_best),
        )
        for each in sorted(analysis.findings, key=_order(analysis.plan))
    ]
    return Table(("setting and channel", "cells", "median cell", "quietest tenth"), rows)


def _family_table(analysis: Analysis) -> Table:
    rows = [
        (
            f"{each.setting}: {each.channel}",
            f"{each.patch} x {each.patch}",
            f"{each.p_value:.2g}",
            f"{each.peak:.1f}",
            amount(each.channel, each.effect, signed=True),
            f"{each.cell[0]}, {each.cell[1]}",
        )
        for each in analysis.findings
    ]
    # Without a row, what was never tested would read as "no effect".
    tested = {(each.setting, each.channel) for each in analysis.findings}
    rows += [
        (f"{setting.name}: {channel}", "", "not tested: no cell returned in every turn", "", "", "")
        for setting in analysis.plan.settings
        for channel in CHANNELS
        if (setting.name, channel) not in tested
    ]
    head = ("setting and channel", "cells", "p, family-wise", "largest", "change", "row, column")
    return Table(head, rows)


def _order(plan: Plan) -> Callable[[Finding], tuple[int, int, int]]:
    names = [each.name for each in plan.settings]

    def place(found: Finding) -> tuple[int, int, int]:
        return names.index(found.setting), CHANNELS.index(found.channel), found.patch

    return place


def _settings_table(plan: Plan) -> Table:
    rows = [
        (each.name, ", ".join(f"{key} {value:g}" for key, value in each.options.items()) or "-")
        for each in plan.settings
    ]
    return Table(("setting", "options"), rows)


def facts(analysis: Analysis, *, show_serial: bool = False) -> dict[str, str]:
    """Return the session's circumstances by name."""
    plan = analysis.plan
    camera = plan.camera if show_serial and not plan.is_simulated else _public_camera(plan)
    now = f"{with_commit(__version__, program_commit())}, {source_checksum()}"
    measured = f"{plan.version}, {plan.source}"
    found = {
        "camera": camera,
        "serial number": (plan.serial or "not known") if show_serial else "hidden",
        "firmware": plan.firmware or "not known",
        "rig": plan.rig.checksum if plan.rig else "none given: leveled on all cells",
        "cells for levelling": f"{np.count_nonzero(quiet_cells(plan.rig))} of 5120",
        "false-alarm rate": f"{plan.alpha:g} for the whole family",
        "patterns of signs": str(analysis.patterns),
        "seed of the order": str(plan.seed),
        "version, analysis": measured if measured == now else f"{now}; planned by {measured}",
    }
    if analysis.celsius:
        low, high = analysis.celsius
        found["laser driver"] = f"{low:.1f} to {high:.1f} °C"
    return found


def command_of(plan: Plan) -> str:
    """Return the command that measures by this plan, without a serial number or folders."""
    words = ["nlos-cam detect", _public_camera(plan)]
    if plan.rig_option:
        words.append(plan.rig_option)
    elif plan.rig and not plan.is_simulated:  # of a session from before the option was stored
        words.append("--wall wall.toml")
    words.append(f"--turns {plan.turns} --frames {plan.frames} --alpha {plan.alpha:g}")
    words += ["--settings sweep"] if len(plan.settings) > 1 else []
    words += ["--control"] if plan.control else []
    return " ".join([*words, "--out FOLDER"])


def _public_camera(plan: Plan) -> str:
    """Return the camera without a serial number, and without the folders of a simulated scene."""
    kind, _, rest = plan.camera.partition(":")
    return f"{kind}:{Path(rest).name}" if plan.is_simulated and rest else kind


def _maps(analysis: Analysis) -> list[Picture]:
    """Return significance maps: the settings with the most significant findings first."""
    names = list(dict.fromkeys(each.setting for each in analysis.findings))[:MAX_DRAWN_SETTINGS]
    return [
        _map_of(name, [each for each in analysis.findings if each.setting == name])
        for name in names
    ]


def _map_of(setting: str, findings: Sequence[Finding]) -> Picture:
    drawn = [each for each in findings if each.patch == DRAWN_PATCH]
    drawn.sort(key=lambda each: CHANNELS.index(each.channel))
    figure = figure_of(11.0, 3.2)
    axes = np.atleast_1d(figure.subplots(1, len(drawn)))
    for axis, each in zip(axes, drawn, strict=True):
        limit = max(5.0, float(np.nanmax(np.abs(each.significance))))
        image = axis.imshow(each.significance, cmap="RdBu_r", vmin=-limit, vmax=limit)
        axis.set_title(f"{each.channel}: p = {each.p_value:.2g}", fontsize=10)
        axis.set(xlabel="column", ylabel="row")
        figure.colorbar(image, ax=axis, shrink=0.8)
    caption = (
        "Scores of the test, means over 3 x 3 cells; red: larger with the object in. p holds for"
        " the whole family of tests. A score is a mean over its standard deviation, of which the"
        " effect is a part: a strong one saturates it, and several somewhere are usual."
    )
    return Picture(f"Significance, setting: {setting}", caption, png(figure))

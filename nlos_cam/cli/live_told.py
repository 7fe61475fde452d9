"""What `nlos-cam live` tells a person: warnings as they come, and a report at the end."""

from rich.markup import escape

from nlos_cam.cli.common import say
from nlos_cam.live.loop import in_words
from nlos_cam.live.statistics import OUTSIDE_LATENCY, LiveReport


def warn(warning: str, begins: bool) -> None:
    """Tell that a warning begins, or ends."""
    say(f"[yellow]warning:[/] {escape(warning)}" if begins else f"no longer: {escape(warning)}", marked=True)


def told(report: LiveReport) -> str:
    """The report in a few lines."""
    latency = report.latency_ms
    lines = [
        f"{report.frames} frames, {report.fps:.1f} per second, {report.dropped} dropped",
        f"latency  {latency['p50']:.0f} ms median, {latency['p95']:.0f} ms p95, {latency['p99']:.0f} ms p99",
        f"stages   {_stages(report)} (median and p99 in ms)",
    ]
    if report.verdicts:
        lines.append(f"verdicts {', '.join(f'{count} {verdict}' for verdict, count in report.verdicts.items())}")
    if seen := in_words(report.counts):
        lines.append(f"seen     {seen}")
    if report.stalled_s:
        lines.append(f"stalled  {report.stalled_s:.1f} s without a frame")
    lines += [f"warning  {frames} frames: {text}" for text, frames in report.warnings.items()]
    return "\n".join(lines)


def _stages(report: LiveReport) -> str:
    """Those that make up the latency first, and then the others."""
    stages = report.stages_percentiles_ms
    ordered = sorted(stages, key=lambda name: name in OUTSIDE_LATENCY)
    return ", ".join(f"{name} {stages[name]['p50']:.1f} {stages[name]['p99']:.1f}" for name in ordered)

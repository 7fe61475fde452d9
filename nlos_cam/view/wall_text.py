"""The calibration in words, as Markdown: the verdict, what was measured and how surely, and what has changed since."""

from collections.abc import Sequence

from nlos_calibration.board_wall import BoardRecord
from nlos_calibration.uncertainty import INTERVAL_STDS
from nlos_calibration.wall_record import WallRecord

ALL_IS_WELL = "nothing has drifted since the calibration"
NOT_WATCHED = "not watched: the record has no reference of the bare wall; calibrate the wall again"


def calibration_text(record: WallRecord, warnings: Sequence[str] = ()) -> str:
    """The calibration's page; `warnings` are those of now."""
    rows = [f"| {what} | {told} |" for what, told in _rows(record)]
    parts = [
        f"**{record.verdict.upper()}**: {record.advice}",
        _now(warnings, watched=bool(record.reference)),
        "\n".join(["| measured | with its 95 % interval |", "|---|---|", *rows]),
        *([f"Board: {_board(record.board)}"] if record.board else []),
        *(f"Note: {note}" for note in record.warnings),
    ]
    return "\n\n".join(parts)


def _now(warnings: Sequence[str], *, watched: bool) -> str:
    if not warnings:
        return f"**Now**: {ALL_IS_WELL if watched else NOT_WATCHED}"
    return "\n".join(["> [!WARNING]", *(f"> - {warning}" for warning in warnings)])


def _rows(record: WallRecord) -> list[tuple[str, str]]:
    """What was measured, by name; what was not is left out."""
    rows = [
        ("distance", f"{record.distance_m:.4f} m{_interval(record.distance_std_m, 'mm', 1e3)}"),
        ("facing", f"{record.facing_deg:.2f}°{_interval(record.facing_std_deg, '°')}"),
        ("yaw", f"{record.yaw_deg:+z.2f}°{_interval(record.yaw_std_deg, '°')}"),
        ("pitch", f"{record.pitch_deg:+z.2f}°{_interval(record.pitch_std_deg, '°')}"),
    ]
    if record.range_offset_std_m is not None:
        told = f"{1e3 * record.range_offset_m:+z.1f} mm{_interval(record.range_offset_std_m, 'mm', 1e3)}"
        rows.append((f"offset of {record.range_offset_cause}", told))
    if record.occluder is not None:
        rows.append(("occluder", f"{record.occluder.x_m:.3f} m, gap {record.occluder.gap_m:.3f} m"))
    rows.append(("date", f"{record.created.isoformat()}, {record.frames} frames"))
    if record.temperatures_c:
        coldest, warmest = min(record.temperatures_c.values()), max(record.temperatures_c.values())
        rows.append(("temperature", f"{coldest:.1f} to {warmest:.1f} °C" if warmest > coldest else f"{warmest:.1f} °C"))
    return rows


def _interval(std: float | None, unit: str, scale: float = 1.0) -> str:
    """Nothing where no uncertainty is known: records of version 1."""
    if std is None:
        return ""
    gap = "" if unit == "°" else " "
    return f" ± {_plain(INTERVAL_STDS * scale * std)}{gap}{unit}"


def _plain(value: float) -> str:
    """Without a power of ten; what is below a thousandth is rounded up to it."""
    return "0.001" if value < 0.001 else f"{value:.3f}" if value < 0.1 else f"{value:.2f}"


def _board(board: BoardRecord) -> str:
    if board.disagreement_m is None or board.disagreement_deg is None:
        return f"{board.corners} corners; the depth was refused"
    apart = f"{1e3 * board.disagreement_m:+z.2f} mm and {board.disagreement_deg:.2f}° from the depth's plane"
    return f"{apart} ({board.disagreement_sigmas:.1f} sigma); used: {board.used}"

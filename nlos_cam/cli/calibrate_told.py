"""What a person is told of a calibration."""

from nlos_calibration.board_wall import BoardRecord
from nlos_calibration.uncertainty import INTERVAL_STDS
from nlos_calibration.wall_record import OccluderRecord, WallRecord
from rich.markup import escape

from nlos_cam.calibrate.files import WallFiles


def told(record: WallRecord, files: WallFiles) -> str:
    """What was measured, with the half width of each 95 % interval."""
    colour = "green" if record.verdict == "good" else "yellow"
    facing, yaw, pitch = (
        f"{angle} ± {_interval(std):.4f}"
        for angle, std in (
            (f"{record.facing_deg:.2f}", record.facing_std_deg),
            (f"{record.yaw_deg:+z.2f}", record.yaw_std_deg),
            (f"{record.pitch_deg:+z.2f}", record.pitch_std_deg),
        )
    )
    lines = [
        f"distance  {record.distance_m:.4f} m ± {1e3 * _interval(record.distance_std_m):.4f} mm",
        f"facing    {facing} degrees (yaw {yaw}, pitch {pitch})",
    ]
    if record.residual_m is not None:
        share = f"{record.inlier_fraction:.1%} of the depth on the plane"
        lines.append(f"residual  {record.residual_m * 1e3:.2f} mm RMS, {share}")
    if record.occluder is not None:
        lines.append(f"occluder  {_occluder_told(record.occluder)}")
    if record.footprint_share is not None:
        lines.append(f"footprint {record.footprint_share:.0%} of the map's cells are on the wall")
    if record.board is not None:
        lines.append(f"board     {_board_told(record.board)}")
    if record.range_offset_std_m is not None:
        offset, interval = 1e3 * record.range_offset_m, 1e3 * _interval(record.range_offset_std_m)
        lines.append(f"offset    {offset:+.1f} ± {interval:.1f} mm of the lidar's {record.range_offset_cause}")
    lines.append(f"verdict   [bold {colour}]{record.verdict}[/]: {record.advice}")
    lines += [f"note      {warning}" for warning in record.warnings]
    beside = [files.reference.name] if record.reference else []
    return "\n".join([*lines, f"wrote {escape(', '.join([str(files.record), *beside, files.report.name]))}"])


def _interval(std: float | None) -> float:
    return INTERVAL_STDS * (std or 0.0)


def _occluder_told(occluder: OccluderRecord) -> str:
    if occluder.x_std_m is None or occluder.gap_std_m is None:
        return f"{occluder.x_m:.3f} m from the foot, {occluder.gap_m:.3f} m off the wall (entered)"
    x, gap = 1e3 * _interval(occluder.x_std_m), 1e3 * _interval(occluder.gap_std_m)
    return f"{occluder.x_m:.4f} m ± {x:.2f} mm from the foot, {occluder.gap_m:.4f} m ± {gap:.2f} mm off the wall"


def _board_told(board: BoardRecord) -> str:
    found = f"{board.distance_m:.4f} m ± {1e3 * _interval(board.distance_std_m):.2f} mm, {board.facing_deg:.2f} degrees"
    found += f" ± {_interval(board.facing_std_deg):.3f}, by {board.corners} corners"
    if board.disagreement_m is None or board.disagreement_deg is None:
        return found
    apart = f"{1e3 * board.disagreement_m:+z.2f} mm and {board.disagreement_deg:.3f} degrees from the depth's plane"
    return f"{found}; {apart} ({board.disagreement_sigmas:.1f} sigma); used: {board.used}"

"""The report beside a wall's record: one HTML file that says whether the bench is right, and what to move if not."""

from nlos_calibration.measured_wall import MeasuredWall

from nlos_cam import wall_report_text as text
from nlos_cam.wall_bench_picture import bench_picture
from nlos_cam.wall_footprint_picture import footprint_picture
from nlos_cam.wall_pictures import Picture, wall_maps
from nlos_cam.wall_report_html import page, pictured

NO_MAPS = Picture("Maps of the wall", "This record names no reference of the bare wall: there are no maps to draw.")


def report(wall: MeasuredWall, record_file: str) -> str:
    """The report on a wall whose record is called `record_file`, as HTML that needs no other file and no network."""
    record = wall.record
    maps = [NO_MAPS] if wall.reference is None else wall_maps(record, wall.reference)
    under = f"{record.created}, {record.camera}, {record.frames} frames of the bare wall"
    parts = [
        text.verdict(record),
        text.ranges(record),
        pictured(bench_picture(record)),
        text.measures(record),
        text.board(record),
        pictured(footprint_picture(record)),
        *map(pictured, maps),
        text.device(wall),
        text.files(record, record_file),
    ]
    return page(f"The bench as measured: {record_file}", under, parts)

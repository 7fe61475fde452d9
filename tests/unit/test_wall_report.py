import base64
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
from nlos_calibration.wall_record import MeasuredWall

from nlos_cam.calibrate.report import report

Measured = Callable[..., MeasuredWall]
VOID = {"meta", "img", "rect", "path"}
PNG = "data:image/png;base64,"
MAPS = 4
DRAWINGS = 2


class Reader(HTMLParser):
    """What a browser finds: text, pictures, and what it would fetch or run."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.text, self.pictures, self.fetched = "", list[str](), list[str]()
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in {"src", "href", "srcset", "data", "action"} or name.startswith("on"):
                (self.pictures if (value or "").startswith(PNG) else self.fetched).append(value or "")
        if tag in {"script", "link", "iframe", "object", "embed", "base"}:
            self.fetched.append(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def read(wall: MeasuredWall, record_file: str = "wall.toml") -> Reader:
    """The report as read, which must be whole and need nothing else."""
    page = report(wall, record_file)
    found = Reader(page)
    assert found.open == []
    assert found.fetched == []
    assert "url(" not in page
    assert "@import" not in page
    for picture in found.pictures:
        raw = np.frombuffer(base64.b64decode(picture.removeprefix(PNG), validate=True), np.uint8)
        assert cv2.imdecode(raw, cv2.IMREAD_COLOR) is not None
    return found


def test_a_report_is_whole_and_needs_nothing_else(measured: Measured) -> None:
    found = read(measured())
    assert len(found.pictures) == MAPS + DRAWINGS
    assert all(words in found.text for words in ("Good", "inside the paper's ranges", "2026-01-31", "l515:f0246262"))


def test_a_bench_that_is_out_of_range_is_told_what_to_move(measured: Measured) -> None:
    found = read(measured(0.35, 80.0, 0.0))
    assert all(words in found.text for words in ("Out of range", "move the lidar 5 cm closer", "turn the lidar 5 deg"))


def test_every_warning_is_told(measured: Measured) -> None:
    warnings = "ripples of 0.5 mm RMS", "noise > 2 & rising"
    found = read(measured(warnings=warnings))
    assert all(warning in found.text for warning in warnings)


def test_hostile_names_stay_text(measured: Measured) -> None:
    hostile = "<img src=http://evil/x onerror=alert(1)> & \"'"
    wall = measured(serial=hostile, firmware=hostile, reference=hostile, settings={hostile: 1.0})
    changed = wall.record.model_copy(update={"camera": hostile, "advice": hostile, "warnings": (hostile,)})
    found = read(MeasuredWall(changed, wall.reference), f"{hostile}.toml")
    assert found.text.count(hostile) >= 8


def test_a_record_without_a_reference_has_the_drawings_only(measured: Measured) -> None:
    found = read(MeasuredWall(measured().record, None))
    assert len(found.pictures) == DRAWINGS
    assert "names no reference" in found.text


def test_a_wall_by_a_board_alone_is_reported(measured: Measured) -> None:
    wall = measured()
    assert wall.reference is not None
    nothing = np.full_like(wall.reference.depth_m, np.nan)
    depth_less = replace(wall.reference, depth_m=nothing, depth_std_m=nothing, inliers=nothing > 0.0)
    gone = dict.fromkeys(("residual_m", "noise_scale", "inlier_fraction", "ripple_m", "bend_m", "bend_deg"))
    found = read(MeasuredWall(wall.record.model_copy(update=gone), depth_less))
    assert len(found.pictures) == DRAWINGS + 1
    assert "No pixel has depth" in found.text


def test_a_report_of_nothing_but_noise_is_no_larger_than_it_may_be(measured: Measured) -> None:
    wall, noise = measured(width=640), np.random.default_rng(0)
    assert wall.reference is not None
    shape = wall.reference.depth_m.shape
    loud = replace(
        wall.reference,
        depth_m=(wall.reference.depth_m + noise.normal(0.0, 0.001, shape)).astype(np.float32),
        depth_std_m=noise.uniform(0.0, 0.002, shape).astype(np.float32),
        ir=noise.uniform(0.0, 255.0, shape).astype(np.float32),
        saturated=noise.uniform(0.0, 1.0, shape).astype(np.float32),
    )
    assert len(report(MeasuredWall(wall.record, loud), "wall.toml")) < 1_500_000

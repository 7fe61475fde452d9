import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from fake_wall import bare_wall
from measured_walls import BOARD
from nlos_calibration import MeasuredWall, OccluderRecord, WallRecord, wall_facts
from nlos_calibration.wall_record import load_measured
from page_reader import PageReader, read_page

from nlos_cam.calibrate import report
from nlos_cam.calibrate.files import WallFiles, write_record
from nlos_cam.errors import OutputExistsError

Measured = Callable[..., MeasuredWall]


def read(wall: MeasuredWall, record_file: str = "wall.toml") -> PageReader:
    return read_page(report.report_html(wall, record_file))


def recorded(measured: Measured, **fields: object) -> WallRecord:
    return measured().record.model_copy(update=fields)


def test_report_is_self_contained(measured: Measured) -> None:
    found = read(measured(warnings=("ripples of 0.5 mm RMS", "noise > 2 & rising")))

    assert len(found.pictures) == 6

    for words in (
        "Good",
        "2026-01-31",
        "l515:f0246262",
        "ripples of 0.5 mm RMS",
        "noise > 2 & rising",
    ):
        assert words in found.text


@pytest.mark.slow
def test_report_escapes_hostile_names(measured: Measured) -> None:
    hostile = "<img src=http://evil/x onerror=alert(1)> & \"'"
    wall = measured(serial=hostile, firmware=hostile, reference=hostile, settings={hostile: 1.0})
    changed = wall.record.model_copy(
        update={"camera": hostile, "advice": hostile, "warnings": (hostile,)}
    )
    found = read(MeasuredWall(changed, wall.reference), f"{hostile}.toml")

    assert found.text.count(hostile) >= 8


def test_report_shows_maps_only_of_a_reference_with_depth(measured: Measured) -> None:
    wall = measured()

    assert len(read(MeasuredWall(wall.record, None)).pictures) == 2

    nothing = np.full_like(wall.reference.depth_m, np.nan)
    depth_less = replace(
        wall.reference, depth_m=nothing, depth_std_m=nothing, inliers=nothing > 0.0
    )
    gone = dict.fromkeys(
        ("residual_m", "noise_scale", "inlier_fraction", "ripple_m", "bend_m", "bend_deg")
    )

    assert len(read(MeasuredWall(wall.record.model_copy(update=gone), depth_less)).pictures) == 3


@pytest.mark.slow
def test_report_of_noise_stays_small(measured: Measured) -> None:
    wall = measured(width=640)
    noise = np.random.default_rng(0)
    shape = wall.reference.depth_m.shape
    loud = replace(
        wall.reference,
        depth_m=(wall.reference.depth_m + noise.normal(0.0, 0.001, shape)).astype(np.float32),
        depth_std_m=noise.uniform(0.0, 0.002, shape).astype(np.float32),
        ir=noise.uniform(0.0, 255.0, shape).astype(np.float32),
        saturated=noise.uniform(0.0, 1.0, shape).astype(np.float32),
    )

    assert len(report.report_html(MeasuredWall(wall.record, loud), "wall.toml")) < 1_500_000


def test_report_page_may_hold_dollars_and_braces() -> None:
    html = report.page("$title", "{under}", ["<p>$body ${style}</p>"])
    for part in ("<title>$title</title>", "{under}", "<p>$body ${style}</p>"):
        assert part in html


def marker_and_range(value: float) -> tuple[float, float, float]:
    """Return the places of the marker and of both ends of the range from 15 to 30."""
    drawn = report.range_bar("distance", value, (15.0, 30.0), 0.1, "cm", 45.0)
    marker = re.search(r"M ([\d.]+) ", drawn)
    allowed = re.search(r"x='([\d.]+)' y='14' width='([\d.]+)' height='14' class='allowed'", drawn)
    return float(marker[1]), float(allowed[1]), float(allowed[1]) + float(allowed[2])


def test_range_bar_marker_is_where_the_value_is() -> None:
    for value, ends in ((15.0, 1), (30.0, 2)):
        places = marker_and_range(value)
        assert places[0] == pytest.approx(places[ends], abs=0.2)
    at, low, high = marker_and_range(22.5)

    assert at == pytest.approx((low + high) / 2.0, abs=0.2)
    assert marker_and_range(60.0)[0] == marker_and_range(45.0)[0] < 680.0
    assert marker_and_range(-5.0)[0] == marker_and_range(0.0)[0] > 0.0


@pytest.mark.parametrize(
    ("value", "drawn"),
    [(14.85, "outside"), (14.95, "inside"), (30.05, "inside"), (31.0, "outside")],
)
def test_range_bar_shows_whether_the_value_is_inside(value: float, drawn: str) -> None:
    html = report.range_bar("distance", value, (15.0, 30.0), 0.1, "cm", 45.0)

    assert f"{value:.1f} cm" in html
    assert f"class='{drawn}'" in html


@pytest.mark.parametrize("verdict", ["good", "out of range", "doubtful"])
def test_report_banner_holds_verdict_advice_and_warnings(measured: Measured, verdict: str) -> None:
    fields = {
        "verdict": verdict,
        "advice": "move <4 cm> back",
        "warnings": ("ripples & noise", "cold"),
    }
    banner = report.banner(recorded(measured, **fields))

    assert f"class='verdict {verdict.replace(' ', '-')}'" in banner

    for sentence in (verdict, "move <4 cm> back", "ripples & noise", "cold"):
        assert sentence in unescape(banner).lower()


def test_report_bars_are_of_measured_quantities(measured: Measured) -> None:
    record = measured(0.35, 80.0, 0.0).record
    bars = report.ranges(record)

    assert "35.0 cm" in bars
    assert "80.0 degrees" in bars
    assert "gap" not in bars

    wide = OccluderRecord(source="entered", x_m=0.2, gap_m=0.25)

    assert "25.0 cm" in report.ranges(record.model_copy(update={"occluder": wide}))


def test_report_measures_are_the_summarys_rows(measured: Measured) -> None:
    record = recorded(measured, footprint_share=0.875)
    html = unescape(report.measures(record))
    for cell in (cell for row in wall_facts(record) for cell in row):
        assert cell in html

    assert "--tape-m" in html
    assert "--tape-m" not in report.measures(
        record.model_copy(update={"range_offset_std_m": 0.001})
    )


def test_report_compares_the_board_with_the_record(measured: Measured) -> None:
    assert not report.board(measured().record)

    html = unescape(report.board(recorded(measured, board=BOARD)))
    for words in (
        "203.4 ± 1.0 mm",
        "200.",
        "40.10 ± 0.04°",
        "+3.40 mm",
        "0.117°",
        "6.5",
        "at 97 %",
    ):
        assert words in html
    alone = {"used": "board", "disagreement_m": None, "depth_refused": "a <mirror>"}

    assert "a <mirror>" in unescape(
        report.board(recorded(measured, board=BOARD.model_copy(update=alone)))
    )


def test_report_device_has_temperatures_and_settings(measured: Measured) -> None:
    device = {"serial": "f0246262", "firmware": "1.5.8.1", "settings": {"laser_power": 80.0}}
    wall = measured(**device, temperatures_c={"LLD": 41.26})
    html = report.device(
        MeasuredWall(wall.record, replace(wall.reference, celsius_span={"LLD": 1.5}))
    )
    for words in ("f0246262", "1.5.8.1", "laser_power", "80", "41.3 °C", "1.5", "64 x 48"):
        assert words in html

    newer = replace(wall.reference, celsius={"LLD": 52.0}, settings={"laser_power": 60.0})
    html = report.device(MeasuredWall(wall.record, newer))

    assert "52.0 °C" in html
    assert "41.3 °C" not in html

    assert "°C" not in report.device(MeasuredWall(measured().record, None))


@pytest.mark.parametrize(
    ("camera", "record_file", "live"),
    [
        ("l515:f0246262", "wall.toml", "live --camera l515:f0246262 --wall wall.toml"),
        ("sim:bare-wall", "wall.toml", "live --camera sim:SCENE.toml --wall wall.toml"),
        ("bag:my wall.bag", "my wall.toml", "live --camera l515 --wall 'my wall.toml'"),
    ],
)
def test_report_commands_can_be_pasted(
    measured: Measured, camera: str, record_file: str, live: str
) -> None:
    record = measured(reference="wall.npz", reference_sha256="ab" * 32).record.model_copy(
        update={"camera": camera}
    )
    html = unescape(report.usage(record, record_file))

    assert f"nlos-cam {live}\n" in html
    assert all(
        words in html for words in ("render cup --rig", "wall.npz", "ab" * 32, record.rig.checksum)
    )


@pytest.fixture
def files(tmp_path: Path) -> WallFiles:
    return WallFiles.beside(tmp_path / "wall.toml", overwrite=False)


@pytest.mark.slow
def test_wall_files_belong_together(
    files: WallFiles, measured: Measured, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = bare_wall()
    record = write_record(files, measured().record, wall)
    loaded = load_measured(files.record)

    assert loaded.record == record
    np.testing.assert_array_equal(loaded.reference.depth_m, wall.depth_m)
    assert files.report.read_text(encoding="utf-8") == report.report_html(loaded, "wall.toml")

    before = {path.name: path.read_bytes() for path in files.record.parent.iterdir()}

    assert set(before) == {"wall.toml", "wall.npz", "wall.html"}

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nlos_cam.calibrate.files.report_html", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_record(files, record, replace(wall, depth_m=wall.depth_m + np.float32(0.1)))

    assert {path.name: path.read_bytes() for path in files.record.parent.iterdir()} == before


def test_written_wall_without_a_reference_names_none(files: WallFiles, measured: Measured) -> None:
    assert write_record(files, measured().record, None).reference == ""
    assert not files.reference.exists()
    assert load_measured(files.record).reference is None


def test_wall_file_may_not_be_named_as_its_reference_or_report(tmp_path: Path) -> None:
    for name in ("wall.npz", "wall.html"):
        with pytest.raises(OutputExistsError, match=r"wall\.toml"):
            WallFiles.beside(tmp_path / name, overwrite=True)

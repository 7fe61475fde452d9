import csv
import json
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from nlos_cam.camera import FORMATS, open_camera
from nlos_cam.recording import BagReader
from nlos_cam.recording.export import INFO, ExportOptions, ExportResult, export_recording

FRAMES = 20


def exported(bag: Path, out: Path, stop: Event | None = None, **wanted: Any) -> ExportResult:
    return export_recording(BagReader(bag), out, ExportOptions(**wanted), stop=stop or Event())


def samples(bag: Path, stream: str) -> list[Any]:
    return list(BagReader(bag).samples([stream]))


def rows(out: Path, stream: str) -> list[dict[str, str]]:
    with (out / f"{stream}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_export_writes_every_bit_into_png(noise_bag: Path, tmp_path: Path) -> None:
    made = exported(noise_bag, tmp_path / "out")

    assert made.frames == dict.fromkeys(FORMATS, FRAMES) | {"points": 1}

    info = json.loads((tmp_path / "out" / INFO).read_text())

    assert info["device"]["name"] == "Simulated L515"
    assert info["depth_unit_m"] == pytest.approx(0.00025)
    assert (set(info["streams"]), info["capture"]) == (set(FORMATS), None)
    assert info["streams"]["depth"]["intrinsics"]["height"] == 48

    for stream in FORMATS:
        for row, sample in zip(
            rows(tmp_path / "out", stream), samples(noise_bag, stream), strict=True
        ):
            pixels = cv2.imread(str(tmp_path / "out" / row["file"]), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(pixels, sample.pixels)
            assert pixels.dtype == sample.pixels.dtype
            assert int(row["frame_number"]) == sample.number
            assert float(row["timestamp_s"]) == pytest.approx(sample.timestamp_s, abs=1e-6)


def test_export_writes_every_bit_into_npz(noise_bag: Path, tmp_path: Path) -> None:
    exported(noise_bag, tmp_path / "out", format="npz")
    for stream in FORMATS:
        expected = samples(noise_bag, stream)
        with np.load(tmp_path / "out" / f"{stream}.npz") as found:
            np.testing.assert_array_equal(found["pixels"], [sample.pixels for sample in expected])
            np.testing.assert_array_equal(
                found["frame_number"], [sample.number for sample in expected]
            )
            np.testing.assert_array_equal(
                found["timestamp_s"], [sample.timestamp_s for sample in expected]
            )
            assert (found["width"], found["fx"]) == (64, pytest.approx(45.7, abs=0.1))
            assert ("depth_unit_m" in found) == (stream == "depth")

    assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [
        "",
        ".json",
        ".npz",
        ".npz",
        ".npz",
    ]


def test_export_points_are_depth_along_the_rays(noise_bag: Path, tmp_path: Path) -> None:
    assert exported(noise_bag, tmp_path / "out", points=True).frames["points"] == FRAMES

    with open_camera(f"bag:{noise_bag}") as camera:
        frame = next(iter(camera))
    seen = ~np.isnan(frame.depth_m)
    cloud = trimesh.load(tmp_path / "out" / "points" / "000000.ply")
    expected_m = frame.intrinsics.rays()[seen] * frame.depth_m[seen][:, np.newaxis]

    np.testing.assert_allclose(cloud.vertices, expected_m, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, 0], frame.ir[seen])


def test_export_writes_only_chosen_streams_and_frames(noise_bag: Path, tmp_path: Path) -> None:
    made = exported(noise_bag, tmp_path / "out", streams=["infrared"], every=6)

    assert made.frames == {"infrared": 4}
    assert not (tmp_path / "out" / "points").exists()
    assert not (tmp_path / "out" / "depth").exists()
    assert [row["frame_number"] for row in rows(tmp_path / "out", "infrared")] == [
        "0",
        "6",
        "12",
        "18",
    ]


def test_export_replaces_an_earlier_one_and_keeps_other_files(
    noise_bag: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    exported(noise_bag, out)
    (out / "notes.txt").write_text("mine")
    (out / "mine").mkdir()
    exported(noise_bag, out, streams=["infrared"], format="npz")

    assert sorted(path.name for path in out.iterdir()) == [
        "export.json",
        "infrared.npz",
        "mine",
        "notes.txt",
    ]


def test_export_takes_no_name_of_an_earlier_one_for_a_pattern(
    noise_bag: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / INFO).write_text('{"streams": {"*": {}}}')
    (out / "mine.csv").write_text("mine")
    exported(noise_bag, out, streams=["infrared"], format="npz")

    assert (out / "mine.csv").read_text() == "mine"


def test_export_that_is_stopped_keeps_written_frames(noise_bag: Path, tmp_path: Path) -> None:
    stop = Event()
    seen = []

    def after_six() -> None:
        seen.append(1)
        if len(seen) == 6:
            stop.set()

    made = export_recording(
        BagReader(noise_bag),
        tmp_path / "out",
        ExportOptions(format="npz"),
        stop=stop,
        on_frame=after_six,
    )

    assert made.frames == {"depth": 2, "infrared": 2, "confidence": 2, "points": 1}

    with pytest.raises(KeyboardInterrupt):  # what was there stays
        exported(noise_bag, tmp_path / "out", stop, format="npz")
    with np.load(tmp_path / "out" / "depth.npz") as found:
        assert found["pixels"].shape == (2, 48, 64)


def test_export_keeps_the_frames_before_damage(damaged: Path, tmp_path: Path) -> None:
    made = exported(damaged, tmp_path / "out")

    assert "damaged.bag" in made.damage
    assert 0 < made.frames["depth"] < 150
    assert len(rows(tmp_path / "out", "depth")) == made.frames["depth"]


def test_export_of_another_camera_writes_its_streams(real_bag: Path, tmp_path: Path) -> None:
    made = exported(real_bag, tmp_path / "out")

    assert made.frames == {"depth": 2, "color": 1}

    depth = cv2.imread(
        str(tmp_path / "out" / rows(tmp_path / "out", "depth")[0]["file"]), cv2.IMREAD_UNCHANGED
    )
    colour = cv2.imread(str(tmp_path / "out" / rows(tmp_path / "out", "color")[0]["file"]))

    assert depth.dtype == np.uint16
    assert depth.shape == (480, 640)
    assert colour.shape == (480, 640, 3)

    rgb = samples(real_bag, "color")[0].pixels

    np.testing.assert_array_equal(colour[..., ::-1], rgb)

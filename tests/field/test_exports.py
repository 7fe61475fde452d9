"""Someone takes a recording's frames to another program."""

import csv
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from rewritten_bags import LENS, TURNED, Messages, number_of, turned_infrared

from nlos_cam.camera import Sample
from nlos_cam.recording import SAMPLE
from nlos_cam.recording.export import PngSink

Run = Callable[..., Any]
Remake = Callable[..., Path]
FRAMES_END = "/image/data"


def odd_frames(topic: str, time_ns: int, raw: bytes) -> Messages:
    if not topic.endswith(FRAMES_END) or number_of(raw) % 2:
        yield time_ns, raw


def depth_alone(topic: str, time_ns: int, raw: bytes) -> Messages:
    if "Confidence" not in topic and "Infrared" not in topic:
        yield time_ns, raw


def numbers(stream: str) -> list[int]:
    with Path("out", f"{stream}.csv").open(encoding="utf-8") as file:
        return [int(row["frame_number"]) for row in csv.DictReader(file)]


def test_export_counts_frames_not_their_numbers(remake: Remake, run: Run, noise: Path) -> None:
    run("export", remake(odd_frames, source=noise), "--every", 2, "--out", "out")

    assert numbers("depth") == list(range(1, 40, 4))
    assert numbers("infrared") == numbers("depth")
    assert numbers("confidence") == numbers("depth")


def test_export_chooses_whole_sets_beside_gaps(remake: Remake, run: Run, noise: Path) -> None:
    def with_gap(topic: str, time_ns: int, raw: bytes) -> Messages:
        if not ("Infrared" in topic and topic.endswith(FRAMES_END) and number_of(raw) == 3):
            yield time_ns, raw

    run("export", remake(with_gap, source=noise), "--every", 2, "--out", "out")

    assert numbers("infrared") == numbers("depth") == list(range(0, 40, 2))


def test_cloud_needs_depth_alone(remake: Remake, run: Run) -> None:
    run("export", SAMPLE, "--ply", "--out", "whole")
    found = run("export", remake(depth_alone), "--ply", "--out", "out")["frames"]

    assert found == {"depth": 8, "points": 8}

    clouds = [
        np.asarray(trimesh.load(next(Path(folder, "points").iterdir())).vertices)
        for folder in ("whole", "out")
    ]

    np.testing.assert_array_equal(*clouds)


def test_cloud_of_a_frame_without_depth_is_empty(remake: Remake, run: Run) -> None:
    def dark_at_first(topic: str, time_ns: int, raw: bytes) -> Messages:
        if topic.endswith(FRAMES_END) and number_of(raw) == 0:
            pixel_bytes = 2 * 320 * 240
            raw = raw[: -pixel_bytes - 4] + bytes(pixel_bytes) + raw[-4:]
        yield from depth_alone(topic, time_ns, raw)

    found = run("export", remake(dark_at_first), "--ply", "--out", "out")["frames"]

    assert found == {"depth": 8, "points": 8}
    assert b"element vertex 0\n" in Path("out/points/000000.ply").read_bytes()


def test_clouds_pair_streams_by_time(remake: Remake, run: Run, noise: Path) -> None:
    def counted_apart(topic: str, time_ns: int, raw: bytes) -> Messages:
        if topic.endswith(FRAMES_END) and "Infrared" in topic:
            raw = (number_of(raw) + 500).to_bytes(4, "little") + raw[4:]
        yield time_ns, raw

    run("export", noise, "--ply", "--out", "plain")
    run("export", remake(counted_apart, source=noise), "--ply", "--out", "apart")
    plain = {path.name: path.read_bytes() for path in Path("plain/points").iterdir()}

    assert len(plain) == 40
    assert {path.name: path.read_bytes() for path in Path("apart/points").iterdir()} == plain


def test_cloud_without_depth_is_refused(remake: Remake, run: Run) -> None:
    def without_depth(topic: str, time_ns: int, raw: bytes) -> Messages:
        if "Depth" not in topic:
            yield time_ns, raw

    path = remake(without_depth)

    assert "no depth" in run("export", path, "--ply", "--out", "out", code=4).err
    assert not Path("out").exists()


@pytest.mark.parametrize("encoding", ["yuyv", "uyvy"])
def test_yuv_becomes_8_bit_color(encoding: str) -> None:
    # Y = 120, Cb = 90 and Cr = 180 in the range of video, by ITU-R BT.601: 1.164 (Y - 16) is 121.
    rgb = [121 + 1.596 * 52, 121 - 0.391 * -38 - 0.813 * 52, 121 + 2.018 * -38]
    luma = np.full((360, 640), 120, np.uint8)
    chroma = np.where(np.arange(640) % 2, 180, 90) + 0 * luma
    pair = (luma, chroma) if encoding == "yuyv" else (chroma, luma)
    pixels = np.stack(pair, -1).astype(np.uint8).view("<u2")[..., 0]
    sink = PngSink(Path(), "color", encoding)
    sink.add(Sample("color", 0, 0.0, pixels))
    sink.close()
    image = cv2.imread("color/000000.png", cv2.IMREAD_UNCHANGED)

    assert image.shape == (360, 640, 3)
    assert image.dtype == np.uint8
    np.testing.assert_allclose(image[..., ::-1], np.broadcast_to(rgb, image.shape), atol=2)


def test_recorded_yuyv_is_exported_as_color(remake: Remake, run: Run, noise: Path) -> None:
    def as_yuyv(topic: str, time_ns: int, raw: bytes) -> Messages:
        if "Infrared" in topic:  # two bytes a pixel: half as wide
            raw = raw.replace(b"8UC1", b"YUYV", 1)
            raw = raw.replace(struct.pack("<II", 48, 64), struct.pack("<II", 48, 32), 1)
        yield time_ns, raw

    path = remake(as_yuyv, source=noise)
    run("export", path, "--streams", "infrared", "--out", "out")
    image = cv2.imread("out/infrared/000000.png", cv2.IMREAD_UNCHANGED)

    assert image.shape == (48, 32, 3)
    assert image.dtype == np.uint8


def test_export_holds_distortion_and_pose(remake: Remake, run: Run) -> None:
    run("export", remake(turned_infrared), "--out", "out")
    streams = json.loads(Path("out/export.json").read_text())["streams"]
    lenses = {
        "depth": ("none", [0.0] * 5, np.eye(4)),
        "infrared": ("brown_conrady", LENS, TURNED),
        "confidence": ("none", [0.0] * 5, np.eye(4)),
    }
    for name, (model, coefficients, pose) in lenses.items():
        assert streams[name]["distortion"] == {"model": model, "coefficients": coefficients}
        assert streams[name]["pose"]["in_frame_of"] == "depth"
        np.testing.assert_allclose(streams[name]["pose"]["matrix"], pose, atol=1e-9)


def test_surfaces_are_counted_not_their_numbers(run: Run) -> None:
    depth_m = np.full((6, 64, 64), np.nan, np.float32)
    depth_m[:, 20:30, 20:30] = 0.2
    box = {"origin_m": [0.1, 0.1], "pitch_m": [0.002, -0.002], "z_near_m": 0.15, "z_far_m": 0.3}
    numbers = 2 * np.arange(6) + 1
    np.savez("r.npz", depth_m=depth_m, uncertainty_m=depth_m, frame_number=numbers, **box)
    run("export", "r.npz", "--object", "csv", "--every", 2, "--out", "out")

    assert sorted(path.name for path in Path("out").iterdir()) == [
        "000001.csv",
        "000005.csv",
        "000009.csv",
    ]

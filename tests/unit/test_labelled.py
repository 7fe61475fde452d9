"""Labelled recordings to samples: their maps are the frames', their truth is the label's."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.arrays import Float32
from nlos_calibration.errors import CalibrationError
from nlos_calibration.rig import ObjectBox, dump_toml, load_rig

from nlos_cam.camera.recorder import Recording
from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.dataset.labelled import read_labelled, recordings_in, spread
from nlos_cam.errors import RecordingError
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.objects.depth_map import image_from_depth, object_box
from nlos_cam.recording.playback import ReplayCamera
from nlos_cam.recording.sidecar import SidecarFile, WallFile, sidecar_path

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
SLOPE = np.linspace(BOX.z_near_m, BOX.z_far_m, 4096, dtype=np.float32).reshape(64, 64)
KNOWN = {"slope": SLOPE, "half": np.where(np.arange(64) < 32, np.float32(0.2), np.float32(np.nan)) + 0 * SLOPE}
Label = Callable[..., Path]


def known(box: ObjectBox) -> dict[str, Float32]:
    del box
    return KNOWN


@pytest.fixture
def labelled(noise_bag: Path, tmp_path: Path) -> Label:
    """A recording of twenty frames of noise with a sidecar; `others` are arguments of SidecarFile."""

    def make(name: str, label: str | None, **others: Any) -> Path:
        path = tmp_path / f"{name}.bag"
        shutil.copy(noise_bag, path)
        SidecarFile(sidecar_path(path), ReplayCamera(path), label=label, **others)
        return path

    return make


def _maps(world: Any, number: int) -> LidarMaps:
    return maps_from_frame(world.images(number).frame(world.rig.pinhole))


def test_maps_of_a_recording_are_the_maps_of_its_frames(labelled: Label, noise_world: Any) -> None:
    read = read_labelled([labelled("a", "slope")], known=known, frames=4)
    frames = [_maps(noise_world(), number) for number in (2, 7, 12, 17)]
    np.testing.assert_array_equal(read.maps.depth_m, [maps.depth_m for maps in frames])
    np.testing.assert_array_equal(read.maps.intensity, [maps.intensity for maps in frames])


def test_every_sample_has_the_truth_of_its_recordings_label(labelled: Label) -> None:
    read = read_labelled([labelled("a", "slope"), labelled("b", "half")], known=known, frames=3)
    assert read.label == ("slope",) * 3 + ("half",) * 3
    assert read.recording == ("a.bag",) * 3 + ("b.bag",) * 3
    assert read.rig == RIG
    for k, label in enumerate(read.label):
        np.testing.assert_array_equal(read.object_depth_m[k], KNOWN[label])
        np.testing.assert_array_equal(read.maps.image[k], image_from_depth(KNOWN[label], BOX).astype(np.float16))


def test_a_short_recording_gives_all_of_its_frames(labelled: Label) -> None:
    assert len(read_labelled([labelled("a", "slope")], known=known, frames=50).label) == 20


@given(st.integers(0, 1000), st.integers(1, 100))
def test_frames_are_spread_evenly(count: int, wanted: int) -> None:
    chosen = sorted(spread(count, wanted))
    assert len(chosen) == min(count, wanted)
    assert set(chosen) <= set(range(count))
    gaps = np.diff([-chosen[0] - 1, *chosen, 2 * count - chosen[-1]]) if chosen else np.zeros(1)
    assert np.ptp(gaps) <= 2  # mirrored at both ends: neither end is left out


def test_a_wall_record_corrects_the_maps_as_live_does(
    labelled: Label, measured: Callable[..., Any], tmp_path: Path
) -> None:
    record = measured(range_offset_m=0.004).record
    wall = tmp_path / "wall.toml"
    wall.write_text(dump_toml(record), encoding="utf-8")
    paths = [labelled("a", "slope", wall=(RIG, WallFile(path="wall.toml", sha256="")))]
    plain = read_labelled([labelled("b", "slope")], known=known, frames=2)
    corrected = read_labelled(paths, known=known, wall=wall, frames=2)
    assert corrected.rig == record.rig
    np.testing.assert_allclose(corrected.maps.depth_m, plain.maps.depth_m + 0.004, atol=1e-6)
    np.testing.assert_array_equal(corrected.maps.intensity, plain.maps.intensity)


def test_a_wall_of_other_pixels_is_refused(labelled: Label, measured: Callable[..., Any], tmp_path: Path) -> None:
    wall = tmp_path / "wall.toml"
    wall.write_text(dump_toml(measured(width=80).record), encoding="utf-8")
    with pytest.raises(CalibrationError, match="80x60, the camera gives 64x48"):
        read_labelled([labelled("a", "slope")], known=known, wall=wall)


def test_without_a_record_the_bench_is_the_sidecars_if_that_can_hide_something(labelled: Label) -> None:
    own, bare = RIG.model_copy(update={"name": "own"}), load_rig("bare-wall")
    for rig, used in ((own, own), (bare, RIG)):
        path = labelled("a", "slope")
        camera = ReplayCamera(path)
        camera.rig = rig
        SidecarFile(sidecar_path(path), camera, label="slope")
        assert read_labelled([path], known=known, frames=1).rig == used


def test_a_recording_with_a_wall_wants_it(labelled: Label) -> None:
    path = labelled("a", "slope", wall=(RIG, WallFile(path="there/wall.toml", sha256="")))
    with pytest.raises(RecordingError, match=r"captured with --wall there/wall.toml.*give --wall"):
        read_labelled([path], known=known)


def test_recordings_of_two_benches_are_refused(labelled: Label) -> None:
    one, other = labelled("a", "slope"), labelled("b", "slope")
    camera = ReplayCamera(other)
    camera.rig = RIG.model_copy(update={"name": "other"})
    SidecarFile(sidecar_path(other), camera, label="slope")
    with pytest.raises(RecordingError, match=r"a\.bag and .*b\.bag are of two benches"):
        read_labelled([one, other], known=known)


@pytest.mark.parametrize("label", [None, ""])
def test_a_recording_without_a_label_is_refused(labelled: Label, label: str | None) -> None:
    with pytest.raises(RecordingError, match=r"a\.bag has no label: .*--label.*a\.json"):
        read_labelled([labelled("a", label)], known=known)


def test_a_recording_without_a_sidecar_is_refused(noise_bag: Path) -> None:
    with pytest.raises(RecordingError, match="no sidecar"):
        read_labelled([noise_bag], known=known)


def test_an_unknown_label_is_told(labelled: Label) -> None:
    with pytest.raises(RecordingError, match="'mug', which is no test object"):
        read_labelled([labelled("a", "mug")], known=known)


def test_frames_without_a_return_are_left_out_and_nothing_else_is_refused(
    noise_world: Any, hurried_clock: Any, tmp_path: Path
) -> None:
    class Dark(noise_world):
        def images(self, number: int) -> Any:
            seen = super().images(number)
            seen.depth_z16[:] = 0 if number >= self.dark_from else seen.depth_z16
            return seen

    for dark_from, left in ((2, 2), (0, 0)):
        path, world = tmp_path / f"{dark_from}.bag", Dark()
        world.dark_from = dark_from
        with SimulatedCamera("sim:dark", world, clock=hurried_clock(), recording=Recording(path, frames=4)) as camera:
            assert len(list(camera)) >= 1
        SidecarFile(sidecar_path(path), ReplayCamera(path), label="slope")
        if left:
            assert len(read_labelled([path], known=known).label) == left
        else:
            with pytest.raises(RecordingError, match="no frame with a return"):
                read_labelled([path], known=known)


def test_progress_counts_recordings(labelled: Label) -> None:
    seen: list[tuple[int, int]] = []
    paths = [labelled(name, "slope") for name in "ab"]
    read_labelled(paths, known=known, frames=1, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]


def test_a_folder_gives_its_recordings_by_name_and_without_any_it_says_how_to_make_some(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no recordings in .*capture --label"):
        recordings_in(tmp_path)
    for name in ("b.bag", "a.bag", "a.json"):
        (tmp_path / name).touch()
    assert recordings_in(tmp_path) == [tmp_path / "a.bag", tmp_path / "b.bag"]

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up_moments import NOTHING, RIG, bump, full_moment, moment
from measured_walls import exact_wall
from view_streams import messages_in

from nlos_cam.objects import object_box
from nlos_cam.view import unpack
from nlos_cam.view.messages import ERROR_STEP_M, MomentPacker, bench_message, depth_bytes, pack, signed_bytes

BOX = object_box(RIG)


@given(st.dictionaries(st.text(max_size=5).filter(lambda name: name != "arrays"), st.integers()), st.integers(0, 9))
def test_unpacked_message_is_the_packed_one(fields: dict[str, int], rows: int) -> None:
    arrays = {"one": np.arange(rows * 3, dtype=np.uint8).reshape(rows, 3), "two": np.full((2, 2, 3), 7, np.uint8)}
    found, found_arrays = unpack(pack(fields, arrays))
    assert found == fields
    for name, array in arrays.items():
        np.testing.assert_array_equal(found_arrays[name], array)


def test_stream_is_cut_into_whole_messages() -> None:
    stream = [pack({"kind": name}) for name in ("one", "two", "three")]
    joined = b"".join(stream)
    for size in range(len(joined)):
        ends = np.cumsum([len(each) for each in stream])
        assert messages_in(joined[:size]) == stream[: int((ends <= size).sum())]


def test_depth_bytes_keep_depth_to_a_step_and_holes() -> None:
    depth_m = bump(0)
    counts = depth_bytes(depth_m, BOX.z_near_m, BOX.z_far_m)
    assert ((counts == 0) == np.isnan(depth_m)).all()
    step_m = (BOX.z_far_m - BOX.z_near_m) / 254
    found_m = BOX.z_near_m + (counts - 1.0) * step_m
    assert np.nanmax(np.abs(np.where(counts > 0, found_m, np.nan) - depth_m)) <= 0.51 * step_m


def test_signed_bytes_are_symmetric_clipped_and_zero_for_nan() -> None:
    found = signed_bytes(np.array([-9.0, -1.0, 0.0, 1.0, 9.0, np.nan]), 1.0)
    assert found.tolist() == [1, 1, 128, 255, 255, 0]


def test_moment_message_holds_every_layer() -> None:
    fields, arrays = unpack(MomentPacker(RIG).pack(full_moment(3, size=(480, 640))))
    assert {"depth", "truth", "error", "lidar", "infrared", "change", "residual"} == set(arrays)
    assert arrays["lidar"].shape == (160, 214)
    assert fields["frame"] == 3
    assert fields["stages_ms"]["network"] > 0
    error_m = full_moment(3).reconstruction.uncertainty_m
    np.testing.assert_allclose(arrays["error"] * ERROR_STEP_M, error_m, atol=ERROR_STEP_M)


def test_uncertainty_is_sent_where_nothing_was_reconstructed() -> None:
    shown = full_moment(0)
    empty = replace(shown, reconstruction=replace(shown.reconstruction, depth_m=NOTHING))
    _, arrays = unpack(MomentPacker(RIG).pack(empty))
    assert not arrays["depth"].any()
    assert arrays["error"].any()


def test_lidar_pictures_go_only_where_requested() -> None:
    packer = MomentPacker(RIG)
    small, large = (packer.pack(full_moment(0), with_lidar=each) for each in (False, True))
    assert not {"lidar", "infrared", "change", "residual"} & set(unpack(small)[1])
    assert len(small) < len(large)


def test_bare_moment_and_odd_numbers_are_valid_json() -> None:
    shown = moment(0, NOTHING)
    dark = replace(shown, frame=replace(shown.frame, depth_m=np.full_like(shown.frame.depth_m, np.nan)))
    fields, arrays = unpack(MomentPacker(RIG).pack(dark))
    json.dumps(fields, allow_nan=False)
    assert not arrays["lidar"].any()


@pytest.mark.parametrize("measured", [None, exact_wall()])
def test_bench_message_names_every_part(measured: object) -> None:
    fields, arrays = unpack(bench_message(RIG, measured))  # type: ignore[arg-type]
    assert {"wall", "occluder", "lidar", "frustum", "light"} <= set(fields["parts"])
    assert len(fields["parts"]["light"]) == 5, "three bounces between leaving and reaching the lidar"
    assert fields["parts"]["lidar"] == pytest.approx([0.0, 0.0, 0.2])
    assert ("footprint" in fields["parts"]) == (measured is not None)
    assert {"map_depth", "map_error", "map_lidar"} <= set(arrays)

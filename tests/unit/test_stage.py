"""The facts of a scene at an accuracy."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.accuracy import STOPS, Accuracy
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S, gate_bins, occluder_edge
from nlos_cam.render.material import Surface
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts, bins_of

RIG = load_rig("paper-rig")
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
DEPTH = np.full((8, 8), 0.25, np.float32)


def test_a_fact_is_worked_out_once() -> None:
    stage = SceneFacts(Scene(RIG, DEPTH), COARSE)
    for fact in ("depth_m", "patches", "field", "relay", "light"):
        assert getattr(stage, fact) is getattr(stage, fact)


@pytest.mark.parametrize(("cells", "stride", "blocks"), [(8, 2, 4), (8, 1, 8), (7, 2, 7), (8, 4, 2)])
def test_a_stride_takes_blocks_where_the_grid_divides_by_it(cells: int, stride: int, blocks: int) -> None:
    scene = Scene(RIG, DEPTH[:cells, :cells], Surface(np.linspace(0, 1, cells**2).reshape(cells, cells)))
    stage = SceneFacts(scene, replace(COARSE, object_stride=stride))
    assert stage.depth_m.shape == stage.albedo.shape == (blocks, blocks)
    assert stage.patches is not None
    assert len(stage.patches.beta) == blocks**2
    assert stage.albedo.mean() == pytest.approx(0.5)


def test_nothing_hidden_has_no_patches_no_light_and_no_sight() -> None:
    for depth in (None, np.full((8, 8), np.nan, np.float32)):
        stage = SceneFacts(Scene(RIG, depth), COARSE)
        assert stage.patches is stage.light is stage.sight is None
        assert stage.more_bounces == 0


def test_an_object_beyond_the_gate_has_no_patches() -> None:
    device = RIG.device.model_copy(update={"gate_s": 0.4999 / SPEED_OF_LIGHT_M_PER_S})
    assert SceneFacts(Scene(RIG.model_copy(update={"device": device}), DEPTH), COARSE).patches is None
    assert SceneFacts(Scene(RIG, DEPTH), COARSE).patches is not None


@pytest.mark.parametrize("bin_m", [0.01, 0.037, 0.1])
def test_bins_hold_the_longest_path_or_end_with_the_gate(bin_m: float) -> None:
    stage = SceneFacts(Scene(RIG, DEPTH), COARSE)
    patches, beams, relay = stage.patches, stage.beams(), stage.relay
    assert patches is not None
    foot = beams.foot_m[beams.on_wall]
    cells = np.stack([relay.x_m, relay.y_m, np.zeros_like(relay.x_m)], 1)
    d2 = np.linalg.norm(foot[:, None] - patches.point_m, axis=-1)
    d3 = (np.linalg.norm(patches.point_m[:, None] - cells, axis=-1) + relay.length_m).max(1)
    longest = (beams.length_m[beams.on_wall, None] + d2 + d3).max()
    device = RIG.device.model_copy(update={"bin_m": bin_m})
    assert bins_of(beams, patches, relay, device) * bin_m > longest
    short = device.model_copy(update={"gate_s": 1.0 / SPEED_OF_LIGHT_M_PER_S})
    assert bins_of(beams, patches, relay, short) == gate_bins(short)


def test_a_job_has_the_beams_that_light_the_wall() -> None:
    stage = SceneFacts(Scene(RIG, DEPTH), COARSE)
    beams = stage.beams()
    assert stage.patches is not None
    job = stage.job(beams, stage.patches, stage.relay, occluder_edge(RIG), stage.field)
    assert len(job.foot_m) == len(job.length_m) == len(job.map_foot_m) == beams.on_wall.sum()
    some = job.some(np.array([3, 1]))
    np.testing.assert_array_equal(some.foot_m, job.foot_m[[3, 1]])
    np.testing.assert_array_equal(some.cos_incidence, job.cos_incidence[[3, 1]])
    assert some.map_foot_m is job.map_foot_m


def test_coarse_stops_look_at_fewer_patches_as_bright_on_the_whole() -> None:
    scene = Scene(RIG, DEPTH)
    few, many = (SceneFacts(scene, STOPS[stop]).light for stop in ("draft", "standard"))
    assert few is not None
    assert many is not None
    assert len(few.energy) == len(many.energy) // 4
    assert few.taken.sum() == pytest.approx(many.taken.sum(), rel=0.05)

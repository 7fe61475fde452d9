import dataclasses
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from made_up_moments import NOTHING, RIG, SHEET, full_moment, moment
from measured_walls import exact_wall
from nlos_calibration.wall_record import MeasuredWall

from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.drawing import Drawing, new_recording
from nlos_cam.view.viewer import Moment

SIZE = 480, 640
BENCH = {f"bench/{name}" for name in ("box", "light", "lidar", "lidar/body", "lidar/view", "occluder", "wall")}
FIGURES = {"latency", "drops", "physics/score"}
LIDAR = {"lidar/depth", "lidar/infrared", "lidar/confidence"}
PLAIN = BENCH | FIGURES | LIDAR | {"bench/hidden", "reconstruction", "verdict"}
FULL = PLAIN | {"truth", "uncertainty", "temperature", "physics/residual"}
POSE = {f"bench/measured/{name}" for name in ("footprint", "distance", "distance/end", "axis", "axis/end", "frame")}
REFERENCE = {"bench/measured/points", "wall/residual", "wall/noise", "wall/saturated"}


def drawn(moments: list[Moment], *, measured: MeasuredWall | None = None, rig: Any = RIG, **options: bool) -> list[int]:
    """The bytes that each moment takes; the first, with bench and layout."""
    recording = new_recording()
    stream = recording.binary_stream()
    drawing = Drawing(recording, rig, moments[0], measured)
    sizes = []
    for each in moments:
        drawing.draw(each, **({"with_lidar": False} | options))
        sizes.append(len(stream.read() or b""))
    recording.disconnect()
    return sizes


def ignore(*things: object) -> None:
    del things


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """The paths and things that are logged, in their order; the layout, which goes another way, is left out."""
    noted: list[tuple[str, Any]] = []
    log = rr.RecordingStream.log

    def note(self: rr.RecordingStream, path: str, *things: Any, **options: bool) -> None:
        noted.extend((path, thing) for thing in things)
        log(self, path, *things, **options)

    monkeypatch.setattr(rr.RecordingStream, "log", note)
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", ignore)
    return noted


def counts(logged: list[tuple[str, Any]]) -> Counter[str]:
    return Counter(path for path, _ in logged)


def test_layout_and_bench_are_sent_once() -> None:
    first, second, third = drawn([moment(number) for number in range(3)])
    assert first > second > 0
    assert third == pytest.approx(second, rel=0.2)


def test_all_that_a_moment_holds_is_drawn_and_of_a_bare_one_what_there_is(logged: list[tuple[str, Any]]) -> None:
    drawn([full_moment(0)], with_lidar=True)
    assert set(counts(logged)) == FULL
    del logged[:]
    drawn([moment(0)], with_lidar=True)
    assert set(counts(logged)) == PLAIN


def test_what_is_large_goes_out_when_asked_for_and_only_then(logged: list[tuple[str, Any]]) -> None:
    drawn([full_moment(0), full_moment(1)], with_surface=False)
    assert not (LIDAR | {"bench/hidden", "physics/residual"}) & set(counts(logged))
    assert counts(logged)["reconstruction"] > 0


def test_no_surface_clears_the_one_before(logged: list[tuple[str, Any]]) -> None:
    drawn([moment(0, SHEET), moment(1, NOTHING), moment(2, SHEET)])
    assert [type(thing) for path, thing in logged if path == "bench/hidden"] == [rr.Mesh3D, rr.Clear, rr.Mesh3D]


def test_a_rig_without_an_occluder_is_drawn(logged: list[tuple[str, Any]]) -> None:
    drawn([moment(0)], rig=RIG.model_copy(update={"occluder": None}))
    assert set(counts(logged)) == PLAIN - LIDAR - {"bench/occluder"}


def test_an_odd_frame_size_is_drawn() -> None:
    assert drawn([full_moment(0, size=(241, 321))], with_lidar=True)[0]


def test_a_verdict_is_sent_again_only_when_it_is_another(logged: list[tuple[str, Any]]) -> None:
    verdicts = [Verdict.SEEN, Verdict.SEEN, Verdict.OUTSIDE, Verdict.OUTSIDE, Verdict.SEEN]
    drawn([full_moment(number, verdict) for number, verdict in enumerate(verdicts)])
    assert counts(logged)["verdict"] == 3


@pytest.mark.parametrize("verdict", list(Verdict))
def test_only_what_may_be_believed_is_drawn_plainly(verdict: Verdict, logged: list[tuple[str, Any]]) -> None:
    drawn([full_moment(0, verdict)])
    picture, scale = (
        next(thing for path, thing in logged if path == "reconstruction" and isinstance(thing, kind))
        for kind in (rr.Image, rr.Transform3D)
    )
    pixels, factor = len(picture.buffer.as_arrow_array()[0]) // 3, scale.scale.as_arrow_array().to_pylist()[0][0]
    assert pixels == (64**2 if verdict is Verdict.SEEN else 512**2)
    assert pixels**0.5 * factor == 64, "it takes as much room whatever is written on it"


def test_all_pictures_of_a_saved_path_are_of_one_kind(logged: list[tuple[str, Any]]) -> None:
    recording = new_recording()
    drawing = Drawing(recording, RIG, full_moment(0), saved=True)
    for number, verdict in enumerate(Verdict):
        drawing.draw(full_moment(number, verdict), with_lidar=True)
    recording.disconnect()
    kinds: dict[str, set[str]] = {}
    for path, thing in logged:
        if isinstance(thing, rr.EncodedImage):
            kinds.setdefault(path, set()).add(thing.media_type.as_arrow_array().to_pylist()[0])
    assert {len(found) for found in kinds.values()} == {1}
    assert kinds["reconstruction"] == {"image/png"}


def test_a_doubted_surface_is_pale_in_3d(logged: list[tuple[str, Any]]) -> None:
    drawn([full_moment(0), full_moment(0, Verdict.OUTSIDE)])
    meshes = [thing for path, thing in logged if path == "bench/hidden"]
    rgb = [
        np.array(mesh.vertex_colors.as_arrow_array().to_pylist(), np.uint32).view(np.uint8).reshape(-1, 4)
        for mesh in meshes
    ]
    seen, doubted = (np.ptp(colours[:, 1:].astype(int), axis=1).mean() for colours in rgb)
    assert doubted < 0.5 * seen


def test_a_physics_check_is_drawn_once_however_many_frames_it_stands_for(logged: list[tuple[str, Any]]) -> None:
    drawn([full_moment(number) for number in (28, 29, 30, 31)], with_lidar=True)
    assert counts(logged)["physics/residual"] == 2
    assert sum(path == "physics/score" and isinstance(thing, rr.Scalars) for path, thing in logged) == 2


def differing(number: int, *warnings: str) -> Moment:
    return dataclasses.replace(full_moment(number), warnings=warnings)


def test_without_a_measured_wall_nothing_of_one_is_sent(logged: list[tuple[str, Any]]) -> None:
    drawn([differing(0, "it has drifted")], with_lidar=True)
    assert set(counts(logged)) == FULL


def test_a_measured_wall_is_drawn_once_and_its_difference_with_the_lidars_pictures(
    logged: list[tuple[str, Any]],
) -> None:
    drawn([differing(number) for number in range(3)], with_lidar=True, measured=exact_wall())
    number = counts(logged)
    assert set(number) == FULL | POSE | REFERENCE | {"calibration", "lidar/difference"}
    assert {path for path in POSE | REFERENCE if number[path] != 1} == set()
    assert number["lidar/difference"] == 3


def test_a_wall_without_a_reference_shows_pose_and_text(logged: list[tuple[str, Any]]) -> None:
    drawn([moment(0)], with_lidar=True, measured=exact_wall(reference=None))
    assert set(counts(logged)) == PLAIN | POSE | {"calibration"}


def test_the_text_is_sent_again_only_when_it_says_something_else(logged: list[tuple[str, Any]]) -> None:
    moments = [differing(0), differing(1), differing(2, "drifted"), differing(3, "drifted"), differing(4)]
    drawn(moments, measured=exact_wall())
    assert counts(logged)["calibration"] == 3


def test_a_saved_drawing_can_be_read_back_by_time_and_by_frame(
    tmp_path: Path, chunks_of: Callable[[Path], list[Any]]
) -> None:
    recording = new_recording()
    recording.save(tmp_path / "view.rrd")
    drawing = Drawing(recording, RIG, full_moment(7), saved=True)
    for number in (7, 9, 12):
        drawing.draw(full_moment(number), with_lidar=True)
    recording.disconnect()
    rows: Counter[str] = Counter()
    for chunk in chunks_of(tmp_path / "view.rrd"):
        if not chunk.is_static:
            assert chunk.timeline_names == ["time", "frame"]
            rows[chunk.entity_path] += chunk.num_rows
    assert rows["/reconstruction"] >= 3
    assert {rows[f"/{path}"] for path in (*LIDAR, "uncertainty", "truth", "drops", "bench/hidden")} == {3}
    assert (tmp_path / "view.rrd").stat().st_size > 10_000

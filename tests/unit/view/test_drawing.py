import dataclasses
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from made_up_moments import NOTHING, RIG, SHEET, full_moment, moment
from measured_walls import exact_wall
from nlos_calibration.rig import load_rig
from nlos_calibration.wall_record import MeasuredWall

from nlos_cam.errors import SceneError
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.drawing import Drawing, Plots, _light_path, bench_parts, new_recording
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


Logged = list[tuple[str, Any]]


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> Logged:
    """Paths and things in the order in which they are logged, without the layout."""
    noted: Logged = []
    log = rr.RecordingStream.log

    def note(self: rr.RecordingStream, path: str, *things: Any, **options: bool) -> None:
        noted.extend((path, thing) for thing in things)
        log(self, path, *things, **options)

    monkeypatch.setattr(rr.RecordingStream, "log", note)
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", lambda *_: None)
    return noted


def counts(logged: Logged) -> Counter[str]:
    return Counter(path for path, _ in logged)


def test_drawing_sends_layout_and_bench_once() -> None:
    first, second, third = drawn([moment(number) for number in range(3)])
    assert first > second > 0
    assert third == pytest.approx(second, rel=0.2)


@pytest.mark.parametrize(("each", "paths"), [(full_moment(0), FULL), (moment(0), PLAIN)])
def test_drawing_logs_all_that_a_moment_holds(logged: Logged, each: Moment, paths: set[str]) -> None:
    drawn([dataclasses.replace(each, warnings=("it has drifted",))], with_lidar=True)
    assert set(counts(logged)) == paths


def test_drawing_logs_large_data_only_when_asked(logged: Logged) -> None:
    drawn([full_moment(0), full_moment(1)], with_surface=False)
    assert not (LIDAR | {"bench/hidden", "physics/residual"}) & set(counts(logged))
    assert counts(logged)["reconstruction"] > 0


def test_drawing_clears_the_surface_when_nothing_is_hidden(logged: Logged) -> None:
    drawn([moment(0, SHEET), moment(1, NOTHING), moment(2, SHEET)])
    assert [type(thing) for path, thing in logged if path == "bench/hidden"] == [rr.Mesh3D, rr.Clear, rr.Mesh3D]


def test_drawing_takes_rigs_without_occluder_and_odd_sizes(logged: Logged) -> None:
    drawn([moment(0)], rig=RIG.model_copy(update={"occluder": None}))
    assert set(counts(logged)) == PLAIN - LIDAR - {"bench/occluder"}
    assert drawn([full_moment(0, size=(241, 321))], with_lidar=True)[0]


def test_drawing_sends_a_verdict_only_when_it_changes(logged: Logged) -> None:
    verdicts = [Verdict.SEEN, Verdict.SEEN, Verdict.OUTSIDE, Verdict.OUTSIDE, Verdict.SEEN]
    drawn([full_moment(number, verdict) for number, verdict in enumerate(verdicts)])
    assert counts(logged)["verdict"] == 3


@pytest.mark.parametrize("verdict", list(Verdict))
def test_drawing_marks_a_reconstruction_not_to_be_trusted(verdict: Verdict, logged: Logged) -> None:
    drawn([full_moment(0, verdict)])
    picture, scale = (
        next(thing for path, thing in logged if path == "reconstruction" and isinstance(thing, kind))
        for kind in (rr.Image, rr.Transform3D)
    )
    pixels, factor = len(picture.buffer.as_arrow_array()[0]) // 3, scale.scale.as_arrow_array().to_pylist()[0][0]
    assert pixels == (64**2 if verdict is Verdict.SEEN else 512**2)
    assert pixels**0.5 * factor == 64, "it is drawn at the same size with or without a note"


def test_saved_drawing_keeps_one_media_type_per_path(logged: Logged) -> None:
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


def test_drawing_fades_a_doubted_surface_in_3d(logged: Logged) -> None:
    drawn([full_moment(0), full_moment(0, Verdict.OUTSIDE)])
    meshes = [thing.vertex_colors.as_arrow_array().to_pylist() for path, thing in logged if path == "bench/hidden"]
    rgb = [np.array(colors, np.uint32).view(np.uint8).reshape(-1, 4) for colors in meshes]
    seen, doubted = (np.ptp(colors[:, 1:].astype(int), axis=1).mean() for colors in rgb)
    assert doubted < 0.5 * seen


def test_drawing_sends_each_physics_check_once(logged: Logged) -> None:
    drawn([full_moment(number) for number in (28, 29, 30, 31)], with_lidar=True)
    assert counts(logged)["physics/residual"] == 2
    assert sum(path == "physics/score" and isinstance(thing, rr.Scalars) for path, thing in logged) == 2


def differing(number: int, *warnings: str) -> Moment:
    return dataclasses.replace(full_moment(number), warnings=warnings)


@pytest.mark.parametrize("measured", [False, True])
def test_drawing_fills_every_view_of_the_layout(
    logged: Logged, monkeypatch: pytest.MonkeyPatch, measured: bool
) -> None:
    """No view of the page stays empty: each shows a path that is logged."""
    sent: list[Any] = []
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", lambda _, blueprint: sent.append(blueprint))
    drawn([full_moment(0)], with_lidar=True, measured=exact_wall() if measured else None)

    def origins(part: Any) -> set[str]:
        if isinstance(part, rrb.View):
            return {str(part.origin).strip("/")}
        return set().union(*(origins(each) for each in part.contents if not isinstance(each, str)))

    shown = origins(sent[0].root_container)
    assert len(shown) >= 13
    assert shown <= set(counts(logged)) | {"bench"}


def test_drawing_sends_a_measured_wall_once(logged: Logged) -> None:
    drawn([moment(0)], with_lidar=True, measured=exact_wall(reference=None))
    assert set(counts(logged)) == PLAIN | POSE | {"calibration"}
    logged.clear()
    drawn([differing(number) for number in range(3)], with_lidar=True, measured=exact_wall())
    number = counts(logged)
    assert set(number) == FULL | POSE | REFERENCE | {"calibration", "lidar/difference"}
    assert {path for path in POSE | REFERENCE if number[path] != 1} == set()
    assert number["lidar/difference"] == 3


def test_drawing_sends_the_wall_text_only_when_it_changes(logged: Logged) -> None:
    moments = [differing(0), differing(1), differing(2, "drifted"), differing(3, "drifted"), differing(4)]
    drawn(moments, measured=exact_wall())
    assert counts(logged)["calibration"] == 3


def test_saved_drawing_can_be_read_by_time_and_frame(tmp_path: Path, chunks_of: Callable[[Path], list[Any]]) -> None:
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


BOX = RIG.object_box
PARTS = dict(bench_parts(RIG))


def corners(path: str) -> np.ndarray:
    return np.array(PARTS[path].vertex_positions.as_arrow_array().to_pylist())


def test_bench_parts_hold_everything_on_the_bench() -> None:
    assert set(PARTS) == BENCH
    assert set(dict(bench_parts(RIG.model_copy(update={"occluder": None})))) == BENCH - {"bench/occluder"}
    with pytest.raises(SceneError, match="object_box"):
        dict(bench_parts(load_rig("bare-wall")))


def test_bench_parts_stand_where_the_rig_says() -> None:
    assert (corners("bench/wall")[:, 2] == 0.0).all()
    np.testing.assert_allclose(corners("bench/occluder")[:, 0], RIG.occluder.x_m, rtol=1e-6)
    assert corners("bench/occluder")[:, 2].min() == pytest.approx(RIG.occluder.z_min_m)


def test_light_path_leads_by_the_wall_to_the_object_and_back() -> None:
    assert BOX is not None
    path = _light_path(RIG, BOX)
    eye = RIG.wall_from_lidar[:3, 3]
    np.testing.assert_array_equal(path[[0, 4]], [eye, eye])
    assert (path[[1, 3], 2] == 0.0).all()
    x, y, z = path[2]
    assert BOX.x_min_m < x < BOX.x_max_m
    assert BOX.y_min_m < y < BOX.y_max_m
    assert BOX.z_near_m <= z <= BOX.z_far_m


class Log:
    """Names and values of the plots, by path."""

    def __init__(self) -> None:
        self.styles: dict[str, list[str]] = {}
        self.values: dict[str, list[list[float]]] = {}

    def __call__(self, path: str, thing: Any, *, static: bool = False) -> None:
        if isinstance(thing, rr.SeriesLines):
            assert static
            self.styles[path] = thing.names.as_arrow_array().to_pylist()
        else:
            self.values.setdefault(path, []).append(thing.scalars.as_arrow_array().to_pylist())


def plotted(*moments: Moment) -> Log:
    log = Log()
    plots = Plots(log, moments[0])
    for each in moments:
        plots.draw(each)
    return log


def test_plots_have_a_line_for_each_working_stage_in_ms() -> None:
    log = plotted(full_moment(0))
    assert log.styles["latency"] == ["total, ms", "maps, ms", "bench, ms", "network, ms"]
    assert log.values["latency"] == [pytest.approx([20.0, 2.0, 0.1, 9.0])]


def test_plots_have_as_many_values_as_names() -> None:
    other = dataclasses.replace(full_moment(3), celsius={"other": 1.0})
    log = plotted(moment(0), full_moment(1), moment(2), other)
    for path, values in log.values.items():
        assert {len(figures) for figures in values} == {len(log.styles[path])}, path
    assert log.styles["temperature"] == ["ldd temperature", "mc temperature"]
    assert "temperature" not in plotted(moment(0)).styles


def test_plots_draw_drops_of_each_moment_and_a_check_once() -> None:
    log = plotted(*map(full_moment, range(28, 62)))
    assert [value for (value,) in log.values["drops"]] == [number // 50 for number in range(28, 62)]
    assert len(log.values["physics/score"]) == 3

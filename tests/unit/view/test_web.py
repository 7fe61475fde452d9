import base64
import errno
import io
import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock, call

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up_moments import NO_MAPS, NOTHING, RIG, bump, full_moment, moment, with_result
from measured_walls import exact_wall
from view_streams import ask, messages, messages_of, saved_moments

from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import object_box
from nlos_cam.reconstruct.network import Quality, Uncertainty
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view import Moment, PlaybackViewer, RecordedView, WebViewer
from nlos_cam.view.assessment import RGB, assess, expected_error_m, expected_overlap
from nlos_cam.view.messages import (
    ERROR_STEP_M,
    MomentPacker,
    bench_message,
    depth_bytes,
    pack,
    signed_bytes,
    unpack,
)
from nlos_cam.view.session_file import FALL_S, MAX_BYTES, Chunks, SessionFile
from nlos_cam.view.viewer import Viewers


@pytest.fixture
def viewer() -> Iterator[WebViewer]:
    with WebViewer(RIG) as viewer:
        yield viewer
    with pytest.raises(ConnectionRefusedError):
        ask(viewer.address or "", "/")


def frames(viewer: WebViewer | PlaybackViewer) -> Iterator[dict[str, Any]]:
    """Yield the messages that a browser receives."""
    with closing(ask(viewer.address or "", "/stream")) as answer:
        yield from messages(answer)


def test_browsers_receive_bench_status_and_the_newest_moment(viewer: WebViewer) -> None:
    viewer.show(full_moment(7))
    for _ in range(3):  # the page is opened again, while no new moment comes
        found = {}
        for each in frames(viewer):
            found[each["kind"]] = each
            if len(found) == 4:
                break
        assert (set(found), found["moment"]["frame"]) == ({"hello", "bench", "status", "moment"}, 7)
        assert found["bench"]["rig"] == RIG.name


def test_run_has_a_name_by_which_a_page_knows_it_again(viewer: WebViewer) -> None:
    first, again = (next(frames(viewer))["run"] for _ in range(2))
    with WebViewer(RIG) as another:
        assert next(frames(another))["run"] != first
    assert first == again


def test_measured_bench_is_sent_again_and_leaving_ends_streams() -> None:
    with WebViewer() as viewer:
        received = frames(viewer)
        assert next(each for each in received if each["kind"] == "status")["state"] == "running"
        viewer.begin(RIG)
        assert "calibration" not in next(each for each in received if each["kind"] == "bench")
        viewer.begin(RIG, exact_wall())
        measured = next(each for each in received if each["kind"] == "bench")
        assert measured["calibration"][0][0] == "verdict"
        assert "wall_residual" in measured["arrays"]
    assert list(received)[-1]["state"] == "ended"


def test_nothing_is_packed_without_browser(
    viewer: WebViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MomentPacker, "pack", lambda *_, **__: pytest.fail("packed"))
    for number in range(1000):
        viewer.show(moment(number))

    assert threading.active_count() <= 4


def test_slow_browser_skips_to_the_newest_moment() -> None:
    asked = Event()
    let = Event()
    taken = list[bytes]()

    def slow_browser(content: bytes) -> None:
        if b"moment" in content:
            asked.set()
            assert let.wait(60.0)
        taken.append(content)

    with WebViewer(RIG) as viewer:
        thread = threading.Thread(target=viewer._stream, args=(slow_browser,))
        thread.start()
        viewer.show(full_moment(0))
        assert asked.wait(60.0)
        for number in range(1, 500):
            viewer.show(moment(number))
        assert any(each.get("frame") == 499 for each in frames(viewer)), (
            "another browser is not kept waiting"
        )
        let.set()
    thread.join(60.0)

    assert sum(b"moment" in content for content in taken) < 10


def test_page_controls_with_the_token_of_the_address() -> None:
    controls = Mock(
        **{"status.return_value": {"state": "stalled", "camera": "sim"}, "run.return_value": "done"}
    )
    with WebViewer(RIG, controls=controls) as viewer:
        address, _, token = (viewer.address or "").partition("#")
        assert (
            next(each for each in frames(viewer) if each["kind"] == "status")["state"] == "stalled"
        )
        for sent, status in ((token, 200), ("", 403)):
            body = '{"command": "average", "frames": 4}'
            with closing(
                ask(address, "/command", method="POST", body=body, X_Token=sent)
            ) as answer:
                assert answer.status == status

    assert controls.run.call_args_list == [call("average", {"frames": 4})]


def test_page_is_whole_and_names_no_other_address(viewer: WebViewer) -> None:
    with closing(ask(viewer.address or "", "/")) as answer:
        page = answer.read().decode()

    assert "class Bench" in page
    assert "class Pictures" in page
    assert "src=" not in page
    assert "http" not in page.replace("http-equiv", "")


def test_playback_keeps_every_moment_for_every_browser() -> None:
    with PlaybackViewer(RIG) as viewer:
        for number in range(70):
            viewer.show(full_moment(number))
        viewer.finish()
        for _ in range(2):
            times_s: list[float] = []
            for each in frames(viewer):
                times_s += each.get("times_s", [])
                if len(times_s) == 70:
                    break
            assert times_s == pytest.approx([number / 30 for number in range(70)], abs=1e-3)


def test_playback_sends_its_status_while_chunks_come() -> None:
    controls: Any = SimpleNamespace(
        status=lambda: {"state": "playback"}, run=lambda *_: "", file=lambda _: None
    )
    with PlaybackViewer(RIG, controls=controls) as viewer:
        for number in range(70):
            viewer.show(full_moment(number))
        kinds = [each["kind"] for each in islice(frames(viewer), 4)]

    assert kinds[:3] == ["hello", "bench", "chunk"]
    assert kinds[3] == "status"


def test_page_of_another_run_is_sent_to_the_session(saved: Path) -> None:
    with RecordedView(saved) as viewer, closing(ask(viewer.address or "", "/stream")) as answer:
        (hello,) = messages(answer)

    assert (hello["kind"], hello["mode"]) == ("hello", "session")


def test_session_is_served_in_an_origin_of_its_own(saved: Path) -> None:
    with RecordedView(saved) as viewer, closing(ask(viewer.address or "", "/")) as answer:
        policy = answer.headers["Content-Security-Policy"]
        page = answer.read()
    with WebViewer(RIG) as live, closing(ask(live.address or "", "/")) as answer:
        live_policy = answer.headers["Content-Security-Policy"]

    assert "sandbox allow-scripts" in policy
    assert "allow-same-origin" not in policy
    assert "sandbox" not in live_policy
    assert len(messages_of(page)) == len(messages_of(saved.read_bytes()))


def test_view_of_a_recording_names_the_full_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    class FullDisk(io.BytesIO):
        def write(self, _: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", FullDisk)
    monkeypatch.setattr("tempfile.gettempdir", lambda: "/elsewhere")
    with PlaybackViewer(RIG) as viewer:
        viewer.show(full_moment(1))
        with pytest.raises(DiskFullError, match=r"/elsewhere .*TMPDIR"):
            viewer.finish()


@pytest.mark.parametrize(
    ("content", "advice"),
    [(None, "cannot be read"), (b"something else", "--save-view")],
)
def test_recorded_view_refuses_other_files(
    tmp_path: Path, content: bytes | None, advice: str
) -> None:
    if content is not None:
        (tmp_path / "other.html").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"other\.html.*{advice}"):
        RecordedView(tmp_path / "other.html")


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    with SessionFile(tmp_path / "view.html", RIG, keeps_all=True) as session:
        for number in range(90):
            session.show(full_moment(number))
    assert session.kept == 30
    return tmp_path / "view.html"


def test_session_keeps_ten_moments_a_second_in_one_page(saved: Path) -> None:
    assert [each["frame"] for each in saved_moments(saved)] == list(range(0, 90, 3))

    page = saved.read_text()

    assert 'data-mode="session"' in page
    assert "src=" not in page

    kinds = [unpack(message)[0]["kind"] for message in messages_of(page.encode())]

    assert kinds == ["bench", "chunk", "chunk", "chunk"]


def test_earlier_session_stays_until_the_first_moment(saved: Path) -> None:
    before = saved.read_bytes()
    with SessionFile(saved, RIG):
        pass
    assert saved.read_bytes() == before

    with SessionFile(saved, RIG) as session:
        session.show(full_moment(7))
    assert [each["frame"] for each in saved_moments(saved)] == [7]


@pytest.mark.parametrize("share", [0.85, 0.9, 0.99])
def test_cut_session_lacks_only_its_end(saved: Path, tmp_path: Path, share: float) -> None:
    content = saved.read_bytes()
    (tmp_path / "cut.html").write_bytes(content[: int(share * len(content))])
    frames = [each["frame"] for each in saved_moments(tmp_path / "cut.html")]

    assert frames == list(range(0, 90, 3))[: len(frames)]
    assert len(frames) % 10 == 0


def test_full_session_ends_before_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.session_file.MAX_BYTES", 1)
    with SessionFile(tmp_path / "view.html", RIG, keeps_all=True) as session:
        for number in range(0, 300, 3):
            session.show(moment(number))

    assert session.full
    assert session.kept < 40 < MAX_BYTES


def test_session_that_cannot_be_written_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FileNotFoundError), SessionFile(tmp_path / "none" / "view.html", RIG):
        pytest.fail("it is an error at once")
    monkeypatch.setattr(base64, "b64encode", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError), SessionFile(tmp_path / "view.html", RIG) as session:
        session.show(moment(0))


def test_full_session_has_a_problem_that_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.view.session_file.MAX_BYTES", 1)
    with SessionFile(tmp_path / "view.html", RIG, keeps_all=True) as session:
        assert session.problem == ""
        for number in range(0, 300, 3):
            session.show(moment(number))

    assert "view.html is full" in session.problem


def test_session_that_the_disk_ends_has_a_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(base64, "b64encode", Mock(side_effect=OSError(28, "No space left")))
    entered = ExitStack()
    session = entered.enter_context(SessionFile(tmp_path / "view.html", RIG))
    session.show(moment(0))
    session._thread.join()
    session.show(moment(30))
    with pytest.raises(OSError, match="No space"):
        entered.close()

    assert "view.html ended early (No space left)" in session.problem
    assert str(tmp_path) not in session.problem
    assert session.left_out == 0


def test_session_goes_on_where_the_time_falls_back(tmp_path: Path) -> None:
    with SessionFile(tmp_path / "view.html", RIG, keeps_all=True) as session:
        for number in (*range(100, 130), *range(30)):
            session.show(full_moment(number))
    found = saved_moments(tmp_path / "view.html")

    assert [each["frame"] for each in found] == [*range(100, 130, 3), *range(0, 30, 3)]


def test_times_of_chunks_never_fall() -> None:
    chunks = Chunks(MomentPacker())
    made = [chunks.add(full_moment(number)) for number in (*range(600, 640), *range(40))]
    made.append(chunks.rest())
    times_s = [each for chunk in made if chunk for each in unpack(chunk)[0]["times_s"]]

    assert len(times_s) == 80
    assert times_s == sorted(times_s)
    assert times_s[-1] == pytest.approx(39 / 30 + FALL_S + 39 / 30, abs=1e-3)


def test_scales_wait_for_the_first_frame_with_depth() -> None:
    far_m = np.linspace(-0.3, 0.3, 64 * 80, dtype=np.float32).reshape(64, 80)
    difference = LidarMaps(far_m, far_m, np.isfinite(far_m))
    full = with_result(full_moment(0), difference=difference)
    depth_m = np.full_like(full.result.frame.depth_m, np.nan)
    blind = with_result(full, frame=replace(full.result.frame, depth_m=depth_m), difference=NO_MAPS)
    packer = MomentPacker()
    before, first, later = (unpack(packer.pack(each))[0] for each in (blind, full, full_moment(1)))
    expected = unpack(MomentPacker().pack(full))[0]

    assert before["lidar_span_m"] == [0.0, 1.0]
    for name in ("lidar_span_m", "change_span_m"):
        assert first[name] == later[name] == expected[name] != before[name]


def test_viewers_show_every_moment_and_begin_all_or_none() -> None:
    some = [MagicMock(address=address) for address in (None, "http://one", "http://two")]
    shown = moment(7)
    with Viewers(some) as viewers:
        viewers.show(shown)
        assert viewers.address == "http://one"
    for each in some:
        assert [name for name, *_ in each.mock_calls] == ["__enter__", "show", "__exit__"]
        each.show.assert_called_once_with(shown)
    some[2].__enter__.side_effect = OSError("no room")
    with pytest.raises(OSError, match="no room"), Viewers(some[1:]):
        pass

    assert [name for name, *_ in some[1].mock_calls[3:]] == ["__enter__", "__exit__"]


BOX = object_box(RIG)


@given(
    st.dictionaries(st.text(max_size=5).filter(lambda name: name != "arrays"), st.integers()),
    st.integers(0, 9),
)
def test_unpacked_message_is_the_packed_one(fields: dict[str, int], rows: int) -> None:
    arrays = {
        "one": np.arange(rows * 3, dtype=np.uint8).reshape(rows, 3),
        "two": np.full((2, 2, 3), 7, np.uint8),
    }
    found, found_arrays = unpack(pack(fields, arrays))

    assert found == fields

    for name, array in arrays.items():
        np.testing.assert_array_equal(found_arrays[name], array)


def test_bytes_keep_depth_to_a_step_and_differences_symmetric() -> None:
    depth_m = bump(0)
    counts = depth_bytes(depth_m, BOX.z_near_m, BOX.z_far_m)

    assert ((counts == 0) == np.isnan(depth_m)).all()

    step_m = (BOX.z_far_m - BOX.z_near_m) / 254
    found_m = BOX.z_near_m + (counts - 1.0) * step_m

    assert np.nanmax(np.abs(np.where(counts > 0, found_m, np.nan) - depth_m)) <= 0.51 * step_m
    assert signed_bytes(np.array([-9.0, -1.0, 0.0, 1.0, 9.0, np.nan]), 1.0).tolist() == [
        1,
        1,
        128,
        255,
        255,
        0,
    ]


def test_moment_message_holds_layers_and_requested_pictures() -> None:
    shown = full_moment(3, size=(480, 640))
    fields, arrays = unpack(MomentPacker().pack(shown))

    assert {"depth", "truth", "error", "lidar", "infrared", "change", "residual"} == set(arrays)
    assert arrays["lidar"].shape == (160, 214)
    assert fields["frame"] == 3
    assert fields["stages_ms"]["network"] > 0
    np.testing.assert_allclose(
        arrays["error"] * ERROR_STEP_M, shown.result.uncertainty_m, atol=ERROR_STEP_M
    )

    _, small = unpack(MomentPacker().pack(shown, with_lidar=False))

    assert {*arrays} - {*small} == {"lidar", "infrared", "change", "residual"}


def test_moment_without_surface_sends_uncertainty_in_valid_json() -> None:
    shown = full_moment(0)
    reconstruction = replace(shown.result.reconstruction, depth_m=NOTHING)
    empty = with_result(shown, reconstruction=reconstruction)
    _, arrays = unpack(MomentPacker().pack(empty))

    assert not arrays["depth"].any()
    assert arrays["error"].any()

    shown = moment(0, NOTHING)
    frame = shown.result.frame
    dark = with_result(shown, frame=replace(frame, depth_m=np.full_like(frame.depth_m, np.nan)))
    fields, arrays = unpack(MomentPacker().pack(dark))
    json.dumps(fields, allow_nan=False)

    assert not arrays["lidar"].any()


@pytest.mark.parametrize("none", [np.nan, np.inf, -9999.0])
def test_moment_message_leaves_out_a_temperature_that_is_none(none: float) -> None:
    shown = replace(full_moment(0), celsius={"ldd_temperature": none, "mc_temperature": 35.0})
    fields, _ = unpack(MomentPacker().pack(shown))

    assert fields["celsius"] == {"mc": 35.0}


@pytest.mark.parametrize("measured", [None, exact_wall()])
def test_bench_message_names_every_part(measured: object) -> None:
    fields, arrays = unpack(bench_message(RIG, measured))  # type: ignore[arg-type]

    assert {"wall", "occluder", "lidar", "frustum", "light"} <= set(fields["parts"])
    assert len(fields["parts"]["light"]) == 5, (
        "three bounces between leaving and reaching the lidar"
    )
    assert fields["parts"]["lidar"] == pytest.approx([0.0, 0.0, 0.2])
    assert ("footprint" in fields["parts"]) == (measured is not None)
    assert {"map_depth", "map_error"} <= set(arrays)


def with_uncertainty(
    surface: np.ndarray, error_m: float = 0.017, quality: Quality | None = None
) -> Moment:
    shown = full_moment(0)
    spread_m = np.full((64, 64), error_m, np.float32)
    uncertainty = Uncertainty(0.0, 0.0, spread_m, surface.astype(np.float32), quality)
    reconstruction = replace(
        shown.result.reconstruction, uncertainty=uncertainty, uncertainty_m=spread_m
    )
    return with_result(shown, reconstruction=reconstruction)


def test_expected_overlap_is_exact_for_certain_pixels() -> None:
    mask = np.isfinite(bump(0))
    half = mask & (np.arange(64) < np.argwhere(mask)[:, 1].mean())
    for surface, overlap in ((mask, 1.0), (half, half.sum() / mask.sum()), (~mask, 0.0)):
        assert expected_overlap(with_uncertainty(surface).result.reconstruction) == pytest.approx(
            overlap
        )

    assert expected_overlap(full_moment(0).result.reconstruction) is None
    assert expected_overlap(moment(0, NOTHING).result.reconstruction) is None
    assert expected_error_m(moment(0).result.reconstruction) is None


def test_detected_object_is_graded_by_the_models_numbers() -> None:
    told = assess(with_uncertainty(0.71 * np.isfinite(bump(0))))

    assert "71%" in told.detail
    assert "17 mm" in told.detail
    assert told.trusted


@pytest.mark.parametrize("trusted", [True, False])
@pytest.mark.parametrize("verdict", [Verdict.SEEN, Verdict.OUTSIDE])
def test_only_a_trusted_quality_of_a_detected_object_is_green(
    trusted: bool, verdict: Verdict
) -> None:
    predicted = Quality((0.58, 0.71, 0.82), 0.6, 0.017, trusted=trusted)
    shown = with_result(with_uncertainty(np.ones((64, 64)), quality=predicted), verdict=verdict)
    told = assess(shown)

    assert (told.tone == "good") == (trusted and verdict is Verdict.SEEN)

    if verdict is Verdict.SEEN:
        assert told.detail == "outline typically 71% right (58% to 82%), depth to 17 mm"


@pytest.mark.parametrize("verdict", [*Verdict, None])
def test_only_a_detected_shape_is_trusted_and_none_is_green(
    verdict: Verdict | None,
) -> None:
    told = assess(with_result(full_moment(0), verdict=verdict))

    assert told.trusted == (verdict in {Verdict.SEEN, None})

    red, green, blue = told.rgb

    assert green < max(red, blue)
    assert told.headline
    assert set(RGB.values()) >= {told.rgb}

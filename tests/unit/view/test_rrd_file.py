from collections import Counter
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from made_up_moments import RIG, full_moment, moment
from measured_walls import exact_wall

from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.drawing import Drawing
from nlos_cam.view.rrd_file import QUEUE_MOMENTS, RrdFile

Chunks = Callable[[Path], list[Any]]


def rows(chunks: list[Any]) -> Counter[str]:
    counted: Counter[str] = Counter()
    for chunk in chunks:
        counted[chunk.entity_path] += chunk.num_rows
    return counted


def frames_of(chunks: list[Any], path: str) -> list[int]:
    """Frame numbers at which an entity changes."""
    found = [chunk.to_record_batch() for chunk in chunks if chunk.entity_path == path and not chunk.is_static]
    return sorted(number for batch in found for number in batch.column("frame").to_pylist())


def test_saved_view_keeps_ten_moments_a_second(tmp_path: Path, chunks_of: Chunks) -> None:
    path = tmp_path / "view.rrd"
    with RrdFile(path, RIG, keeps_all=True) as view:
        for number in range(60):
            view.show(full_moment(number))
    assert (view.kept, view.left_out, view.full) == (20, 0, False)
    chunks = chunks_of(path)
    assert frames_of(chunks, "/drops") == list(range(0, 60, 3))
    assert frames_of(chunks, "/bench/hidden") == list(range(0, 60, 6))
    assert frames_of(chunks, "/lidar/depth") == list(range(0, 60, 15))
    counted = rows(chunks)
    assert counted["/bench/wall"] == 1
    assert counted["/physics/residual"] == 2


def test_saved_view_holds_a_measured_wall_and_every_verdict(tmp_path: Path, chunks_of: Chunks) -> None:
    path = tmp_path / "view.rrd"
    with RrdFile(path, RIG, exact_wall(), keeps_all=True) as view:
        for number, verdict in enumerate(Verdict):
            view.show(full_moment(3 * number, verdict))
    counted = rows(chunks_of(path))
    assert counted["/verdict"] == len(Verdict)
    assert counted["/bench/measured/footprint"] == counted["/calibration"] == 1


def test_saved_view_never_keeps_a_live_run_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    began, let, draw = Event(), Event(), Drawing.draw

    def wait(drawing: Drawing, *arguments: Any, **options: Any) -> None:
        began.set()
        assert let.wait(60.0)
        draw(drawing, *arguments, **options)

    monkeypatch.setattr(Drawing, "draw", wait)
    with RrdFile(tmp_path / "view.rrd", RIG) as view:
        view.show(moment(0))
        assert began.wait(60.0)
        for number in range(1, 100):
            view.show(moment(3 * number))
        assert view.left_out == 99 - QUEUE_MOMENTS
        let.set()
    assert view.kept == 1 + QUEUE_MOMENTS


def test_saved_view_ends_at_its_largest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.rrd_file.MAX_BYTES", 50_000)
    monkeypatch.setattr("nlos_cam.view.rrd_file.BATCH_S", 0.001)
    with RrdFile(tmp_path / "view.rrd", RIG, keeps_all=True) as view:
        for number in range(0, 600, 3):
            view.show(full_moment(number))
    assert view.full
    assert view.kept < 200


def test_saved_view_raises_errors_of_its_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("drawing failed")

    monkeypatch.setattr(Drawing, "draw", fail)
    view = RrdFile(tmp_path / "a.rrd", RIG, keeps_all=True)
    view.__enter__()
    for number in range(0, 60, 3):
        view.show(moment(number))
    with pytest.raises(ZeroDivisionError, match="drawing failed"):
        view.__exit__()


def test_saved_view_refuses_a_path_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"), RrdFile(tmp_path / "none" / "view.rrd", RIG):
        pass


def test_saved_view_without_moments_is_a_valid_file(tmp_path: Path) -> None:
    with RrdFile(tmp_path / "view.rrd", RIG) as view:
        pass
    assert view.kept == 0
    assert (tmp_path / "view.rrd").read_bytes().startswith(b"RRF2")

"""Soak: rows of the frame log are read once and whole, and a minute's line states them."""

from pathlib import Path

from soak import FrameLog, summarize


def test_rows_of_a_growing_log_are_read_once_and_whole(tmp_path: Path) -> None:
    path, rows = tmp_path / "frames.csv", list[dict[str, str]]()
    frames = FrameLog(path)
    text = "frame,latency_ms,dropped\n" + "".join(f"{i},{10 + i},{i // 5}\n" for i in range(10))
    for end in (0, 5, 40, 41, 60, len(text) - 1, len(text)):
        path.write_text(text[:end], encoding="utf-8")
        rows += frames.rows()
    assert [row["frame"] for row in rows] == [str(i) for i in range(10)]
    assert frames.rows() == []
    minute = summarize(3, (500.0, 13, 15), rows, watchers=2)
    assert (minute.frames, minute.latency_p50_ms, minute.dropped) == (10, 14.5, 1.0)

import base64
from pathlib import Path

import pytest
from made_up_moments import RIG, full_moment, moment
from view_streams import messages_of, saved_moments

from nlos_cam.view.messages import unpack
from nlos_cam.view.session_file import MAX_BYTES, SessionFile


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
    fields = [unpack(message)[0]["kind"] for message in messages_of(saved.read_bytes())]
    assert fields == ["bench", "chunk", "chunk", "chunk"]


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


def test_session_that_cannot_be_written_is_an_error_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), SessionFile(tmp_path / "none" / "view.html", RIG):
        pass


def test_error_of_the_writer_is_raised_on_leaving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base64, "b64encode", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError), SessionFile(tmp_path / "view.html", RIG) as session:
        session.show(moment(0))

"""Document: one content, a self-contained page and Markdown; names from recordings stay text."""

from pathlib import Path

from page_reader import read_page

from nlos_cam.report import (
    Banner,
    Bullets,
    Commands,
    Document,
    Facts,
    Picture,
    Section,
    Table,
    figure_of,
    png,
)
from nlos_cam.report.document import write_document

HOSTILE = "<img src=http://evil/x onerror=alert(1)> & \"'$body"
PICTURE = Picture("picture", "caption", png(figure_of(1.0, 1.0)), "some.png")


def document(word: str) -> Document:
    banner = Banner("good", word, word)
    table = Table((word, "b"), [(word, "1 mm")])
    blocks = [
        banner,
        word,
        table,
        Facts({word: word}),
        Bullets(word, [word]),
        Commands([word, word]),
    ]
    return Document(
        word, word, [Section("", [word]), Section(word, blocks), PICTURE, Picture(word, word)]
    )


def test_page_and_markdown_hold_the_same_words(tmp_path: Path) -> None:
    write_document(document("salt"), tmp_path / "report.html")
    page = read_page((tmp_path / "report.html").read_text(encoding="utf-8"))
    text = (tmp_path / "report.md").read_text(encoding="utf-8")

    assert (
        page.text.count("salt") - text.count("salt") == 1
    )  # the page's title, too, is the document's
    assert len(page.pictures) == 1
    assert "![picture](some.png)" in text
    assert "| --- | --- |\n| salt | 1 mm |" in text


def test_names_with_markup_stay_text() -> None:
    page = read_page(document(HOSTILE).as_html())
    assert page.text.count(HOSTILE) == read_page(document("salt").as_html()).text.count("salt")


def test_bullets_without_items_are_left_out() -> None:
    empty = Document("a", "b", [Section("", [Bullets("notes", [])])])

    assert "notes" not in empty.as_html()
    assert empty.as_markdown() == "# a\n\nb\n"

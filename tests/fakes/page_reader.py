"""Reader of a report's page as a browser reads it, for tests."""

import base64
from html.parser import HTMLParser

import cv2
import numpy as np

VOID = {"meta", "img", "rect", "path"}
PNG = "data:image/png;base64,"


class PageReader(HTMLParser):
    """Reader of a page as a browser: its text, its pictures, and everything it would fetch or
    run.
    """

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.text = ""
        self.pictures = list[str]()
        self.fetched = list[str]()
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in {"src", "href", "srcset", "data", "action"} or name.startswith("on"):
                (self.pictures if (value or "").startswith(PNG) else self.fetched).append(
                    value or ""
                )
        if tag in {"script", "link", "iframe", "object", "embed", "base"}:
            self.fetched.append(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def decoded(picture: bytes) -> np.ndarray:
    """Return a picture's pixels (height, width, 3), red first."""
    return cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def read_page(page: str) -> PageReader:
    """Read a page, which must be well-formed and need no other file and no network."""
    found = PageReader(page)
    assert found.open == []
    assert found.fetched == []
    assert "url(" not in page
    assert "@import" not in page
    for picture in found.pictures:
        assert decoded(base64.b64decode(picture.removeprefix(PNG), validate=True)).size
    return found

from collections.abc import Iterator
from typing import Any

import pytest
from browser_page import needs_browser
from screenshots import CHROMIUM, FLAGS


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A Chromium that all tests share: it takes seconds to start."""
    needs_browser()
    from playwright.sync_api import sync_playwright

    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS) as browser,
    ):
        yield browser


@pytest.fixture
def browser(chromium: Any) -> Iterator[Any]:
    """The shared Chromium; pages that a test leaves open are closed: they would watch the next
    test's view as well.
    """
    yield chromium
    for context in chromium.contexts:
        context.close()

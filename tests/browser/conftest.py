from collections.abc import Iterator
from typing import Any

import pytest
from browser_page import needs_browser
from screenshots import CHROMIUM, SOFTWARE_GL


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A Chromium that all tests share: it takes seconds to start."""
    needs_browser()
    from playwright.sync_api import sync_playwright

    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL) as browser,
    ):
        yield browser

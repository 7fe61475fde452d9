import errno
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import usb.core
from fake_bench import Bench, fake_device


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.fixture
def device() -> Callable[..., SimpleNamespace]:
    return fake_device


@pytest.fixture
def access_denied() -> usb.core.USBError:
    return usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)

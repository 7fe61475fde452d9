import errno
from collections.abc import Callable
from types import SimpleNamespace

import pytest
import usb.core
from fake_bench import fake_device


@pytest.fixture
def device() -> Callable[..., SimpleNamespace]:
    return fake_device


@pytest.fixture
def access_denied() -> usb.core.USBError:
    return usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)

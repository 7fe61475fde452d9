"""Networks through torch.compile: the same noise, dropout and figures within rounding, in less time."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import torch

from nlos_models.errors import TrainingError

Network = TypeVar("Network", bound=Callable[..., Any])


def compiled(network: Network) -> Network:
    """The network, or part of one, compiled at its first call; that raises TrainingError where it cannot be.

    Random numbers are drawn as without it, so that a run may be gone on with either way.
    """
    from torch._dynamo.exc import BackendCompilerFailed  # pyright: ignore[reportPrivateUsage]  named nowhere else

    quick = torch.compile(network, options={"fallback_random": True})

    @wraps(network)
    def call(*inputs: Any) -> Any:
        try:
            return quick(*inputs)
        except BackendCompilerFailed as error:
            raise TrainingError(
                f"--compile does not work here ({_reason(error)}): install a C++ compiler (g++), or do without"
            ) from error

    return cast("Network", call)


def _reason(error: BaseException) -> str:
    """The first line of what went wrong below it."""
    inner = getattr(error, "inner_exception", error)
    return str(inner).strip().splitlines()[0]

"""Networks through torch.compile: the same noise, dropout and figures within rounding, in less time."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import torch

from nlos_models.errors import TrainingError

Network = TypeVar("Network", bound=Callable[..., Any])
COMPILERS = ("torch._dynamo", "torch._inductor")


def compiled(network: Network) -> Network:
    """The network, or part of one; it is compiled as it is first run, its gradients as they are first asked for.

    Random numbers are drawn as without it, so that a run may be gone on with either way.
    """
    return cast("Network", torch.compile(network, options={"fallback_random": True}))


@contextmanager
def compiling() -> Generator[None]:
    """Around a step forwards and back: raises TrainingError where a network cannot be compiled."""
    try:
        yield
    except RuntimeError as error:
        if not type(error).__module__.startswith(COMPILERS):
            raise
        reason = str(getattr(error, "inner_exception", error)).strip().splitlines()[0]
        raise TrainingError(
            f"--compile does not work here ({reason}): install a C++ compiler (g++), or do without"
        ) from error

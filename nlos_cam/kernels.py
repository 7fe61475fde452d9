"""Compiled functions that only compiled functions call.

numba compiles two further functions beside each, which convert the arguments of calls from Python and from C. Without
them the first run on a machine compiles less; such a function cannot be called from Python.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np

Kernel = TypeVar("Kernel", bound=Callable[..., Any])
int64: Any = np.int64
"""Cast of indices and constants to one type: a callee is compiled for each type that it is called with."""


def inner(**options: Any) -> Callable[[Kernel], Kernel]:
    """Return a decorator that compiles such a function on its first use, and caches it; options as for `numba.njit`."""
    compile_function: Any = numba.njit
    return compile_function(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)

"""The one place of numba's flags, so that every kernel is compiled alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def kernel(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a kernel on first use and keep it on disk.

    `cache=True`: numba's cache watches the kernel's own file only, so a kernel may call kernels of its own file alone
    (a test enforces it). `error_model="numpy"`: a division by zero gives inf, as in the equations, and costs no branch.
    Never `fastmath`: the laws are compared to the last bits, and NaN must stay visible.
    """
    return cast("Callable[Parameters, Result]", numba.njit(cache=True, error_model="numpy", fastmath=False)(function))

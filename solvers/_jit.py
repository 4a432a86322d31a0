"""The one place of numba's flags, so that every kernel is compiled alike."""

from __future__ import annotations

import os
import types
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt
from llvmlite import ir  # type: ignore[import-untyped]
from numba.extending import intrinsic, overload

# Threads of OpenMP that wait for each other by spinning take the cores from one another as soon as other processes
# are at work: a sweep of a millisecond then takes tens of them. Read when the first thread starts.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

prange = numba.prange
"""The range of a loop whose passes may run on any thread, in a `parallel_kernel`; elsewhere it is `range`."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def kernel(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a kernel on first use and keep it on disk.

    `cache=True`: numba's cache watches the kernel's own file only, so a kernel may call kernels of its own file alone
    (a test enforces it). `error_model="numpy"`: a division by zero gives inf, as in the equations, and costs no branch.
    Never `fastmath`: the laws are compared to the last bits, and NaN must stay visible.
    """
    return cast("Callable[Parameters, Result]", numba.njit(cache=True, error_model="numpy", fastmath=False)(function))


def parallel_kernel(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile as `kernel` does, and let the loops over `prange` run on several threads.

    The passes of such a loop must write to places of their own (gather, never scatter), and sums must be formed over a
    fixed number of chunks: then the result is the same, bit for bit, for any number of threads.
    """
    compiled = numba.njit(cache=True, error_model="numpy", fastmath=False, parallel=True)(function)
    return cast("Callable[Parameters, Result]", compiled)


def alone(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a `parallel_kernel` once more, for one thread: on a small problem threads wait more than they work."""
    plain = getattr(function, "py_func", function)
    # Under a name of its own, and a qualified name, by which numba finds a kernel's files in its cache: otherwise the
    # one of the two that is compiled first would stand for both.
    copy = types.FunctionType(plain.__code__, plain.__globals__, f"{plain.__name__}_alone")
    copy.__module__, copy.__qualname__ = plain.__module__, copy.__name__
    return kernel(copy)


def prefetch(array: npt.NDArray[Any], place: int | np.unsignedinteger[Any]) -> None:
    """Tell the processor, within a kernel, that an entry of an array is read soon; no result depends on it.

    Where a loop jumps through memory in an order known ahead, what is asked for some passes before its turn is there
    when it comes. A place beyond the end does no harm. Outside compiled code nothing happens.

    Args:
        array: contiguous, of any shape.
        place: of the entry, counted as if the array were flat.
    """


def _code_of_prefetch(_typing: Any, array: Any, place: Any) -> tuple[Any, Callable[..., Any]]:
    """Signature and code of `prefetch`, as numba asks for them."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        offset = context.cast(builder, arguments[1], signature.args[1], numba.types.intp)
        pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        hint = builder.module.declare_intrinsic(
            "llvm.prefetch", (pointer,), ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        )
        # For a read, into all caches, of data.
        entry = builder.bitcast(builder.gep(start, [offset]), pointer)
        builder.call(hint, [entry, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return numba.types.void(array, place), code


_hint: Any = intrinsic(_code_of_prefetch)
# A kernel that calls `prefetch` gets the hint.
overload(prefetch)(lambda array, place: lambda array, place: _hint(array, place))

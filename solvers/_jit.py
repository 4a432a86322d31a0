"""The one place of numba: its flags, so that every kernel is compiled alike, and what it has no words for."""

from __future__ import annotations

import os
import types
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt
from llvmlite import ir  # type: ignore[import-untyped]
from numba.extending import intrinsic, overload

# Threads of OpenMP that wait for each other by spinning take the cores from one another as soon as other processes
# are at work: a sweep of a millisecond then takes tens of them. Those that sleep at once take as long to wake up as
# many a loop lasts, and an impact has hundreds. So they spin a little, then sleep. Read when the first thread starts.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

prange = numba.prange
"""The range of a loop whose passes may run on any thread, in a `parallel_kernel`; elsewhere it is `range`."""

# Kernels carry this file's checksum in their names, by which numba finds them in its cache.
EDITION = f"{zlib.crc32(Path(__file__).read_bytes()):08x}"

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Floats = npt.NDArray[np.float64]
Place = int | np.unsignedinteger[Any]

# Vectors of numbers, and lanes of one vector, then of another, that make up a third.
_FOUR, _TWO = ir.VectorType(ir.DoubleType(), 4), ir.VectorType(ir.DoubleType(), 2)
_INDEX = ir.IntType(32)
_FIRST, _IN_TURN, _ALL_BUT_LAST = (
    ir.Constant(ir.VectorType(_INDEX, 4), lanes) for lanes in ([0, 0, 0, 0], [0, 1, 2, 3], [0, 1, 2, 7])
)
_AXES = (np.uint64(0), np.uint64(1), np.uint64(2))
_MASS = np.uint64(3)


def kernel(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a kernel on first use and keep it on disk.

    `cache=True`: numba's cache watches the kernel's own file only, so a kernel may call kernels of its own file alone
    (a test enforces it), and what stands in this one, which is watched by its checksum.
    `error_model="numpy"`: a division by zero gives inf, as in the equations, and costs no branch.
    Never `fastmath`: the laws are compared to the last bits, and NaN must stay visible.
    """
    function.__qualname__ += f"-{EDITION}"
    return cast("Callable[Parameters, Result]", numba.njit(cache=True, error_model="numpy", fastmath=False)(function))


def parallel_kernel(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile as `kernel` does, and let the loops over `prange` run on several threads.

    The passes of such a loop must write to places of their own (gather, never scatter), and sums must be formed over a
    fixed number of chunks: then the result is the same, bit for bit, for any number of threads.
    """
    function.__qualname__ += f"-{EDITION}"
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


def prefetch(array: npt.NDArray[Any], place: Place) -> None:
    """Tell the processor, within a kernel, that an entry of an array is read soon; no result depends on it.

    Where a loop jumps through memory in an order known ahead, what is asked for some passes before its turn is there
    when it comes. A place beyond the end does no harm. Outside compiled code nothing happens.

    Args:
        array: contiguous, of any shape.
        place: of the entry, counted as if the array were flat.
    """


def along(normal: Floats, row: Place, V: Floats, a: Place, b: Place) -> float:
    """Relative velocity n · (v_b - v_a) in a kernel, by vector registers.

    A body is a row of four numbers, which such a register holds; numba's compiler takes them one by one. Rows are read
    fastest from arrays that begin with a line of the cache (`buffers.on_lines`).

    Args:
        normal: flat, in groups of three.
        row: place of the first of the three numbers of n.
        V: flat; four numbers a body: velocity, and one that has no part in this.
        a: place of the first number of body a.
        b: place of the first number of body b.
    """
    x, y, z = (normal[row + axis] * (V[b + axis] - V[a + axis]) for axis in _AXES)
    return float(x + y + z)


def move(normal: Floats, row: Place, kick: float, V: Floats, a: Place, b: Place) -> None:
    """Add what an impulse along n does to the velocities of two bodies, which differ, in a kernel; see `along`.

    Args:
        normal: flat, in groups of three.
        row: place of the first of the three numbers of n.
        kick: impulse [N s], against n on body a, along n on body b.
        V: flat; velocity and inverse mass [1/kg] of each body.
        a: place of the first number of body a.
        b: place of the first number of body b.
    """
    for axis in _AXES:
        n = normal[row + axis]
        V[a + axis] -= kick * V[a + _MASS] * n
        V[b + axis] += kick * V[b + _MASS] * n


def _pointer(context: Any, builder: Any, array: tuple[Any, Any], place: tuple[Any, Any]) -> Any:
    """Pointer to a place in a flat array; both are given as type and value."""
    start = context.make_array(array[0])(context, builder, array[1]).data
    return builder.gep(start, [context.cast(builder, place[1], place[0], numba.types.intp)])


def _code_of_prefetch(_typing: Any, array: Any, place: Any) -> tuple[Any, Callable[..., Any]]:
    """Signature and code of `prefetch`, as numba asks for them."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        entry, place = zip(signature.args, arguments, strict=True)
        pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        hint = builder.module.declare_intrinsic(
            "llvm.prefetch", (pointer,), ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        )
        # For a read, into all caches, of data.
        address = builder.bitcast(_pointer(context, builder, entry, place), pointer)
        builder.call(hint, [address, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return numba.types.void(array, place), code


def _body(context: Any, builder: Any, array: tuple[Any, Any], place: tuple[Any, Any]) -> Any:
    """Pointer to the four numbers of a body."""
    return builder.bitcast(_pointer(context, builder, array, place), _FOUR.as_pointer())


def _normal(context: Any, builder: Any, array: tuple[Any, Any], place: tuple[Any, Any]) -> Any:
    """Three numbers, then 0; what lies behind them is not touched, as there the array may end."""
    start = _pointer(context, builder, array, place)
    two = builder.load(builder.bitcast(start, _TWO.as_pointer()), align=8)
    third = builder.load(builder.gep(start, [_INDEX(2)]))
    padded = builder.shuffle_vector(two, ir.Constant(_TWO, [0.0, 0.0]), _IN_TURN)
    return builder.insert_element(padded, third, _INDEX(2))


def _code_of_along(_typing: Any, normal: Any, row: Any, V: Any, a: Any, b: Any) -> tuple[Any, Callable[..., Any]]:
    """Signature and code of `along`, as numba asks for them."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given = list(zip(signature.args, arguments, strict=True))
        n = _normal(context, builder, given[0], given[1])
        v_a, v_b = (builder.load(_body(context, builder, given[2], given[side]), align=8) for side in (3, 4))
        product = builder.fmul(n, builder.fsub(v_b, v_a))
        x, y, z = (builder.extract_element(product, _INDEX(axis)) for axis in range(3))
        return builder.fadd(builder.fadd(x, y), z)

    return numba.types.float64(normal, row, V, a, b), code


def _code_of_move(
    _typing: Any, normal: Any, row: Any, kick: Any, V: Any, a: Any, b: Any
) -> tuple[Any, Callable[..., Any]]:
    """Signature and code of `move`, as numba asks for them."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given = list(zip(signature.args, arguments, strict=True))
        n = _normal(context, builder, given[0], given[1])
        bodies = [_body(context, builder, given[3], given[side]) for side in (4, 5)]
        before = [builder.load(body, align=8) for body in bodies]
        empty = ir.Constant(_FOUR, ir.Undefined)
        for body, v, change in zip(bodies, before, (builder.fsub, builder.fadd), strict=True):
            part = builder.fmul(arguments[2], builder.extract_element(v, _INDEX(3)))
            parts = builder.shuffle_vector(builder.insert_element(empty, part, _INDEX(0)), empty, _FIRST)
            after = change(v, builder.fmul(parts, n))
            # Not even a kick that is no number reaches the mass.
            builder.store(builder.shuffle_vector(after, v, _ALL_BUT_LAST), body, align=8)
        return context.get_dummy_value()

    return numba.types.void(normal, row, kick, V, a, b), code


_hint: Any = intrinsic(_code_of_prefetch)
_along: Any = intrinsic(_code_of_along)
_move: Any = intrinsic(_code_of_move)
# A kernel that calls `prefetch` gets the hint, one that calls `along` or `move` gets the vectors.
overload(prefetch)(lambda array, place: lambda array, place: _hint(array, place))
overload(along)(lambda normal, row, V, a, b: lambda normal, row, V, a, b: _along(normal, row, V, a, b))
overload(move)(lambda normal, row, kick, V, a, b: lambda normal, row, kick, V, a, b: _move(normal, row, kick, V, a, b))

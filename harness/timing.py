"""Time and memory of one solve; never an error: what is timed is not looked at, what is looked at is not timed.

    warm     solves of the same problem again and again, after one that compiled and built what the problem keeps
    fresh    the first solve of a problem whose matrices (W and its like) are not built yet; kernels are compiled
    cold     the first solve in a process that has solved nothing: compiled kernels are read from the cache
    memory   growth of the resident memory of the process during a fresh solve, beyond the problem itself

A time is CPU time of the process, all threads together: where a machine is shared, wall time measures the others. Wall
time is kept beside it. A calibration kernel of fixed work runs before and after; where it slows down, so did all else.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from harness.checked import checked_solve
from solvers import ImpactProblem, ImpactSolution, Solver
from solvers._jit import kernel
from solvers.solution import Floats

# A sample is as many solves as take this long, so that the clock's own error and call (0.3 µs) do not show [s].
SAMPLE_S = 0.005
MOST_SOLVES = 200
# Samples of one task. A solve that takes longer than LONG_S is timed once: its own length averages the machine.
SAMPLES = 3
LONG_S = 0.2
# The calibration kernel may be this much slower than its best time of the whole run before a timing is flagged: quiet
# repeats of it differ by a few percent, a neighbor on the same core or memory channel costs more than a fifth.
NOISE_RATIO = 1.2
# 16 MiB of float64: beyond the second-level cache, so that memory traffic of neighbors is felt.
CALIBRATION_SIZE = 2**21
CALIBRATION_STEPS = 2**17
KIBIBYTE = 1024

T = TypeVar("T")


@dataclass(frozen=True)
class Timing:
    """Times of one solver on one problem."""

    cpu_s: tuple[float, ...]
    """CPU time of one solve [s], one entry a sample."""
    wall_s: tuple[float, ...]
    """Wall time of one solve [s], one entry a sample."""
    solves: int
    """Solves in each sample."""
    fresh_s: float
    """CPU time of the solve that also builds what the problem keeps [s]."""
    memory_bytes: float
    """Growth of resident memory during that solve; NaN where the system does not tell."""
    calibration_s: tuple[float, float]
    """CPU time of the calibration kernel before and after [s]."""
    solution: ImpactSolution


def time_solver(solver: Solver, problem: ImpactProblem, *, samples: int = SAMPLES) -> Timing:
    """Time a solver on one problem, warm and fresh.

    Args:
        solver: the law with its settings.
        problem: the impact.
        samples: how many; one where a solve takes longer than `LONG_S`.

    Raises:
        UnsupportedProblem: the law does not apply.
        InvalidSolution: the answer breaks the contract.
    """
    # Compiles; its problem is thrown away with all that it built.
    checked_solve(solver, unbuilt(problem))
    before = calibrate()
    fresh_problem = unbuilt(problem)
    with _quiet():
        memory_bytes, fresh_s, solution = _fresh(solver, fresh_problem)
        solves, taken = 1, [_sample(solver, fresh_problem, 1)]
        warm_s = taken[0][0]
        if warm_s <= LONG_S:
            solves = int(np.clip(np.ceil(SAMPLE_S / max(warm_s, 1e-9)), 1, MOST_SOLVES))
            taken = [_sample(solver, fresh_problem, solves) for _ in range(samples)]
    return Timing(
        cpu_s=tuple(cpu for cpu, _ in taken),
        wall_s=tuple(wall for _, wall in taken),
        solves=solves,
        fresh_s=fresh_s,
        memory_bytes=memory_bytes,
        calibration_s=(before, calibrate()),
        solution=solution,
    )


def time_first_solves(solver: Solver, problem: ImpactProblem) -> tuple[float, float]:
    """CPU time of the first and of the second solve [s]; cold and warm where this process has solved nothing yet.

    Both solve a problem whose matrices are not built, so that the difference is the kernels alone.
    """
    times = []
    for _ in range(2):
        fresh = unbuilt(problem)
        _, cpu_s, _ = _clocked(lambda fresh=fresh: checked_solve(solver, fresh))  # type: ignore[misc]
        times.append(cpu_s)
    return times[0], times[1]


def unbuilt(problem: ImpactProblem) -> ImpactProblem:
    """Return the same problem without the matrices that it builds when they are first asked for."""
    return ImpactProblem(
        problem.inverse_mass, problem.J, problem.v_pre, problem.restitution, problem.friction, problem.D,
        problem.stiffness, problem.tangential_restitution,
    )  # fmt: skip


def calibrate() -> float:
    """CPU time of the calibration kernel [s], the best of three: what this machine does now."""
    field = _calibration_field()
    return min(_clocked(lambda: _gather(field, CALIBRATION_STEPS))[1] for _ in range(3))


@functools.lru_cache(maxsize=1)
def _calibration_field() -> Floats:
    """Memory of the calibration kernel; its first touch is the system's work, and compiling is nobody's."""
    field = np.ones(CALIBRATION_SIZE)
    _gather(field, 1)
    return field


def is_noisy(calibration_s: float, best_s: float) -> bool:
    """Tell whether the machine was disturbed: the kernel took more than `NOISE_RATIO` times its best time."""
    return calibration_s > NOISE_RATIO * best_s


def _sample(solver: Solver, problem: ImpactProblem, solves: int) -> tuple[float, float]:
    """CPU and wall time of one solve [s], over so many in a row."""

    def repeat() -> None:
        for _ in range(solves):
            solver.solve(problem)

    wall_s, cpu_s, _ = _clocked(repeat)
    return cpu_s / solves, wall_s / solves


def _fresh(solver: Solver, problem: ImpactProblem) -> tuple[float, float, ImpactSolution]:
    """Growth of memory [bytes], CPU time [s] and answer of the first solve of a problem."""
    # What every law reads is built first: it belongs to the problem.
    _ = problem.u_pre, problem.JM, problem.JT, problem.MJT
    # Memory that earlier solves have freed would be taken again without growth: give it back first (glibc).
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    held = _resident_bytes("VmRSS")
    with suppress(OSError):
        # Starts the peak anew (Linux); see proc(5).
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    _, cpu_s, solution = _clocked(lambda: checked_solve(solver, problem))
    return _resident_bytes("VmHWM") - held, cpu_s, solution


def _clocked(call: Callable[[], T]) -> tuple[float, float, T]:
    """Wall time, CPU time [s] and result of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return time.perf_counter() - wall, time.process_time() - cpu, result


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the garbage collector out of the times."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _resident_bytes(field: str) -> float:
    """Resident memory now (VmRSS) or at its peak (VmHWM) [bytes]; NaN where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return float("nan")
    return next((float(line.split()[1]) * KIBIBYTE for line in lines if line.startswith(field + ":")), float("nan"))


@kernel
def _gather(field: Floats, steps: int) -> float:
    """Read entries in a scattered order and multiply: fixed arithmetic and memory traffic."""
    mask = field.size - 1
    i = 0
    total = 0.0
    for _ in range(steps):
        # Every entry once in a period (Knuth 1998, 3.2.1, Theorem A: full period modulo a power of two).
        i = (i * 1664525 + 1013904223) & mask
        total = total * 0.5 + field[i]
    return total

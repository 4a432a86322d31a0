"""Tasks in child processes with hard limits: whatever a solver does, the run goes on and has a row for it.

Workers are kept between tasks (a start costs more than most tasks) and forked from a server process that has the
libraries loaded and runs no task. A worker that dies or is killed is replaced; its task alone is lost, with a reason.

    time     the parent kills the worker at the limit; the system's alarm kills it even where the parent is gone
    memory   RLIMIT_DATA of the worker: what it holds when the task starts, plus the limit

Linux and macOS; the memory limit works on Linux only (macOS does not enforce it).
"""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import resource
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pebble

from harness.hard_cases import measure_hard_case
from harness.measure import measure_impact, measure_sweep
from harness.measurement import InvalidSolution, Kind, Measurement, Outcome, Task
from harness.selection import build_scenario, choose_solver
from harness.store import Ending, PlannedTask
from solvers import UnsupportedProblem

MEBIBYTE = 2**20
# How often progress is shown and finished tasks are stored [s].
POLL_S = 0.1
# The alarm is the second line of defense: it must not fire before the parent's own kill has had its chance.
ALARM_GRACE_S = 10.0
# A worker is replaced after so many tasks, so that what solvers leak does not add up.
TASKS_PER_WORKER = 200
# A pool that broke (a worker was killed between two tasks) is made anew; this often without any progress is a fault.
MOST_RESTARTS = 3
# Signals that also end a compiled library (OSQP among them) that goes on without the memory that it was refused.
MEMORY_SIGNALS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT)
# Exit code by which a worker says that the memory limit was reached; no signal and no shell uses it.
OUT_OF_MEMORY_EXIT = 77
# One thread a worker: --jobs says how many cores are used, and sums do not depend on how many there are.
SINGLE_THREADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
PRELOADED = ["harness.isolation"]


class IsolationError(RuntimeError):
    """Child processes cannot be started or kept alive; the text says what was seen."""


@dataclass(frozen=True)
class Limits:
    """What one task may use."""

    timeout_s: float = 120.0
    """Wall-clock time [s]; it includes compiling kernels on a first run."""
    memory_mb: float = 4096.0
    """Memory that the task may allocate [MiB]."""


def run_isolated(
    tasks: Sequence[PlannedTask],
    *,
    jobs: int,
    limits: Limits,
    on_end: Callable[[PlannedTask, Ending], None],
    on_poll: Callable[[Sequence[PlannedTask]], None],
    measure: Callable[[Task], Measurement] | None = None,
) -> None:
    """Run tasks in child processes, `jobs` at a time.

    Args:
        tasks: what to run, in the order in which they start.
        jobs: number of worker processes, ≥ 1.
        limits: of each task.
        on_end: called in this process as soon as a task has ended.
        on_poll: called a few times a second with the tasks in hand.
        measure: what a worker does with a task, a function of some module; None: `measure_task`.

    Raises:
        IsolationError: workers keep dying without any task in hand.
    """
    waiting = deque(tasks)
    restarts = 0
    while waiting:
        before = len(waiting)
        with _pool(jobs) as pool:
            _drain(pool, waiting, jobs, limits, on_end, on_poll, measure or measure_task)
        restarts = 0 if len(waiting) < before else restarts + 1
        if waiting and restarts >= MOST_RESTARTS:
            raise IsolationError(
                f"the worker processes died {restarts} times before they took a task; {len(waiting)} tasks are open. "
                "Is memory short? Fewer --jobs may help"
            )


def measure_task(task: Task) -> Measurement:
    """Make the task's solver and scene and measure.

    Raises:
        Exception: whatever the solver raises.
    """
    choice = choose_solver(task.solver)
    if task.kind is Kind.SWEEP:
        return measure_sweep(choice.solver, task.scenario, task.parameters, seed=task.seed)
    scenario = build_scenario(task.scenario, task.parameters)
    if task.kind is Kind.HARD_CASE:
        return measure_hard_case(choice.solver, scenario)
    return measure_impact(choice.solver, scenario, name=choice.name, seed=task.seed)


def _drain(
    pool: Any,
    waiting: deque[PlannedTask],
    jobs: int,
    limits: Limits,
    on_end: Callable[[PlannedTask, Ending], None],
    on_poll: Callable[[Sequence[PlannedTask]], None],
    measure: Callable[[Task], Measurement],
) -> None:
    """Feed one pool until all is done or the pool broke; what it broke on goes back to `waiting`."""
    given: dict[Future[Ending], PlannedTask] = {}
    started: dict[Future[Ending], float] = {}
    while waiting or given:
        # One task more than workers, so that none waits for the parent, and an interrupt has little to undo.
        while waiting and len(given) <= jobs:
            try:
                future = pool.schedule(_run_task, args=[waiting[0].task, limits, measure], timeout=limits.timeout_s)
            except RuntimeError:
                waiting.extendleft(reversed(given.values()))
                return
            given[future] = waiting.popleft()
        done, _ = wait(given, timeout=POLL_S, return_when=FIRST_COMPLETED)
        for future in given:
            if future.running():
                started.setdefault(future, time.monotonic())
        for future in sorted(done, key=lambda future: given[future].number):
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                continue
            wall_s = time.monotonic() - started.get(future, time.monotonic())
            ending = future.result() if error is None else _ending_of_death(error, wall_s, limits)
            on_end(given.pop(future), ending)
        on_poll([planned for future, planned in given.items() if future.running()])
        if any(isinstance(future.exception(), BrokenProcessPool) for future in given if future.done()):
            waiting.extendleft(reversed(given.values()))
            return


def _ending_of_death(error: BaseException, wall_s: float, limits: Limits) -> Ending:
    """Say how a worker ended that gave no answer."""
    if isinstance(error, TimeoutError):
        return Ending(Outcome.TIMED_OUT, f"killed at the time limit of {limits.timeout_s:g} s", limits.timeout_s)
    if not isinstance(error, pebble.ProcessExpired):
        # The answer did not get through: it could not be sent from process to process.
        return Ending(Outcome.RAISED, f"{type(error).__name__}: {error}", wall_s)
    code = error.exitcode
    if code == OUT_OF_MEMORY_EXIT:
        return Ending(Outcome.OUT_OF_MEMORY, f"the memory limit of {limits.memory_mb:g} MiB was reached", wall_s)
    if code == -signal.SIGALRM:
        return Ending(Outcome.TIMED_OUT, f"killed by the alarm after {limits.timeout_s:g} s", wall_s)
    if code is not None and code < 0:
        reason = f"the process was killed by {_signal_name(-code)}"
        if -code in MEMORY_SIGNALS:
            reason += f" (so may end, too, what does not check its allocations, at a limit of {limits.memory_mb:g} MiB)"
        return Ending(Outcome.CRASHED, reason, wall_s)
    return Ending(Outcome.CRASHED, f"the process ended by itself with exit code {code}", wall_s)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


@contextmanager
def _pool(jobs: int) -> Iterator[Any]:
    """A pool of workers; leaving it kills them, whatever they do."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    pool: Any = pebble.ProcessPool(jobs, max_tasks=TASKS_PER_WORKER, initializer=_start_worker, context=context)
    try:
        # The server takes its environment over at its first start, which the first task brings about.
        try:
            with _environment(dict.fromkeys(SINGLE_THREADED, "1")):
                pool.schedule(_nothing).result()
        except (BrokenProcessPool, pebble.ProcessExpired, RuntimeError) as error:
            raise IsolationError(f"worker processes cannot be started: {error}") from error
        yield pool
    finally:
        pool.stop()
        pool.join()


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables that the user has not set, for a while."""
    added = {key: value for key, value in values.items() if key not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for key in added:
            os.environ.pop(key, None)


def _nothing() -> None:
    """The task that starts the workers."""


def _start_worker() -> None:
    """Prepare a new worker."""
    # The default action ends a process inside a compiled kernel too, where Python's handlers do not run.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    _die_with_parent()
    # Under "fork" and "forkserver" numba's threads take a named semaphore, which a worker that is killed leaves behind.
    multiprocessing.set_start_method("spawn", force=True)
    # What a solver prints would tear the progress display; `replay` shows it.
    sink = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(sink, descriptor)
    os.close(sink)


def _die_with_parent() -> None:
    """End this process when the run's process is gone, in the middle of a compiled kernel too.

    The run holds the other end of a pipe. When that closes, the system sends SIGIO, which ends a process by default.
    (The fork server is no help: it lives as long as any worker does.) Where pipes give no signal, the alarm remains.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    with suppress(OSError):
        fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
        flags = fcntl.fcntl(parent.sentinel, fcntl.F_GETFL)
        fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, flags | os.O_ASYNC)


def _run_task(task: Task, limits: Limits, measure: Callable[[Task], Measurement]) -> Ending:
    """Run one task in this worker; the isolation boundary: here and nowhere else every exception is caught."""
    signal.setitimer(signal.ITIMER_REAL, limits.timeout_s + ALARM_GRACE_S)
    _limit_memory(limits.memory_mb)
    _reset_peak_memory()
    begin = time.perf_counter()
    measurement, outcome, reason = None, Outcome.MEASURED, ""
    try:
        measurement = measure(task)
    except UnsupportedProblem as error:
        outcome, reason = Outcome.REFUSED, str(error)
    except InvalidSolution as error:
        outcome, reason = Outcome.INVALID, str(error)
    except MemoryError:
        # Memory that was refused once is short from now on: the next task gets a new process.
        os._exit(OUT_OF_MEMORY_EXIT)
    except BaseException as error:  # sys.exit and KeyboardInterrupt of a solver too
        outcome, reason = Outcome.RAISED, _last_line(error)
    wall_s = time.perf_counter() - begin
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return Ending(outcome, reason, wall_s, _peak_memory_mb(), measurement)


def _last_line(error: BaseException) -> str:
    """An exception in one line, with the place that raised it; file names without folders."""
    text = " ".join(traceback.format_exception_only(error)[-1].split())
    frames = traceback.extract_tb(error.__traceback__)
    return f"{text} ({Path(frames[-1].filename).name}:{frames[-1].lineno} in {frames[-1].name})" if frames else text


def _limit_memory(memory_mb: float) -> None:
    """Let this process allocate so much more than it holds now."""
    held = _proc_status_kb("VmData") * 1024
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = held + int(memory_mb * MEBIBYTE)
    resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))


def _reset_peak_memory() -> None:
    """Start the peak of resident memory anew: a worker has run other tasks before."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _peak_memory_mb() -> float:
    """Largest resident memory of this process since `_reset_peak_memory` [MiB]; since its start outside Linux."""
    peak_kb = _proc_status_kb("VmHWM")
    if peak_kb:
        return peak_kb / 1024
    unit = 1024 if sys.platform != "darwin" else 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MEBIBYTE


def _proc_status_kb(field: str) -> int:
    """One line of /proc/self/status [KiB]; 0 where the system has none."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith(field + ":")), 0)

"""How far a run is: a bar on a terminal, lines elsewhere; both on standard error, so that results can be piped."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from harness.run import FAILURES, Progress, describe
from harness.simulation import State

# Where there is no terminal (a log file, CI) a line this often shows that the run is alive [s].
PLAIN_PROGRESS_S = 5.0


@contextmanager
def progress_display() -> Iterator[Callable[[Progress], None]]:
    """Show the progress of the tasks of a run until the block ends."""
    console = Console(stderr=True)
    if not sys.stderr.isatty():
        yield _PlainProgress(console)
        return
    columns = (
        BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[failures]}"),
        TextColumn("{task.description}", markup=False),
    )  # fmt: skip
    with ProgressBar(*columns, console=console) as bar:
        yield _BarProgress(bar)


@contextmanager
def step_display() -> Iterator[Callable[[State], None]]:
    """Show the progress of a simulation until the block ends: steps a second, contacts, energy, time left."""
    console = Console(stderr=True)
    if not sys.stderr.isatty():
        yield _PlainSteps(console)
        return
    columns = (
        BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
    )  # fmt: skip
    with ProgressBar(*columns, console=console) as bar:
        row = bar.add_task("starting", total=None)
        rate = _Rate()

        def show(state: State) -> None:
            if not bar.finished and bar.tasks[row].total is None:
                # What an earlier call made is done already and says nothing of the time left.
                bar.reset(row, total=state.steps, completed=state.report.step)
            bar.update(row, completed=state.report.step, description=_step_words(state, rate(state.report.step)))

        yield show


class _Rate:
    """Steps a second since the first call."""

    def __init__(self) -> None:
        self._first = -1
        self._begin = 0.0

    def __call__(self, step: int) -> float:
        now = time.monotonic()
        if self._first < 0:
            self._first, self._begin = step, now
        return (step - self._first) / (now - self._begin) if now > self._begin else 0.0


class _PlainSteps:
    """Progress of a simulation as a line every few seconds."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._rate = _Rate()
        self._last = time.monotonic()

    def __call__(self, state: State) -> None:
        rate = self._rate(state.report.step)
        now = time.monotonic()
        if now - self._last < PLAIN_PROGRESS_S:
            return
        self._last = now
        left = f", {(state.steps - state.report.step) / rate:.0f} s left" if rate > 0 else ""
        self._console.print(
            f"{state.report.step}/{state.steps} steps, {_step_words(state, rate)}{left}",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip


def _step_words(state: State, rate: float) -> str:
    """What a step came to, in a few words."""
    report = state.report
    measures = "".join(f", {name} {value:.3g}" for name, value in state.measures.items())
    return (
        f"{rate:.3g} steps/s, {report.contacts} contacts, {report.iterations} iterations, "
        f"energy {report.energy.kinetic + report.energy.potential:.4g} {state.energy_unit}{measures}"
    )


class _BarProgress:
    """Progress as a bar with the tasks in hand."""

    def __init__(self, bar: ProgressBar) -> None:
        self._bar = bar
        self._row: TaskID = bar.add_task("starting", total=None, failures="")

    def __call__(self, progress: Progress) -> None:
        self._bar.update(self._row, total=progress.total, completed=progress.done)
        self._bar.update(self._row, failures=f"{progress.failures} failed" if progress.failures else "")
        if progress.in_hand:
            self._bar.update(self._row, description=", ".join(progress.in_hand))


class _PlainProgress:
    """Progress as lines: every failure, and one line every few seconds."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last = time.monotonic()

    def __call__(self, progress: Progress) -> None:
        if progress.ended and progress.ending and progress.ending.outcome in FAILURES:
            self._say(f"{describe(progress.ended)}: {progress.ending.outcome.value}: {progress.ending.reason}")
        now = time.monotonic()
        if now - self._last >= PLAIN_PROGRESS_S and progress.in_hand:
            self._last = now
            self._say(
                f"{progress.done}/{progress.total} done, {progress.failures} failed, {progress.elapsed_s:.0f} s; "
                f"in hand: {', '.join(progress.in_hand)}"
            )

    def _say(self, line: str) -> None:
        # As it is: no markup, no colors, no breaks at the width of a terminal that is none.
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

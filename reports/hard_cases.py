"""The hard cases: a table of every solver on every scene that laws break on, ruled from the rows of a store.

Printed in the terminal, and written as Markdown and CSV. Everything comes from the store, so that the same store gives
the same bytes; a case that was not measured shows as not done, never as passed.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from harness.hard_cases import MARGIN, Conduct, Ruling, rule
from harness.measurement import Kind
from harness.results import Frames, Results, ScoreRow, TaskRow
from reports.files import prepare, write_whole
from reports.markdown import markdown_table
from reports.spreadsheet import csv_text
from reports.wording import number, one_line
from scenarios.tiers import HARD_CASES

MARK = {
    Conduct.PASSED: "✓",
    Conduct.REFUSED: "r",
    Conduct.STALLED: "…",
    Conduct.WRONG: "✗",
    Conduct.TIMED_OUT: "t",
    Conduct.CRASHED: "c",
    Conduct.OPEN: "–",
}
NATURAL_MARK = "∞"
"""Mark of a stall that is the problem's nature."""
LEGEND = (
    "✓ passed  r refused, with a reason  … stalled at its bound and said so  ∞ the same, and by the certificate it is "
    "the problem's nature  ✗ wrong  t timed out  c crashed  – not done"
)
FAULTY = (Conduct.WRONG, Conduct.TIMED_OUT, Conduct.CRASHED)
"""What nobody should do, and what the terminal names one by one."""
SHOWN_FAULTS = 12
_STYLE = {
    Conduct.PASSED: "green",
    Conduct.WRONG: "bold red",
    Conduct.TIMED_OUT: "bold red",
    Conduct.CRASHED: "bold red",
    Conduct.STALLED: "yellow",
}


@dataclass(frozen=True)
class Case:
    """One hard scene with all who were tried on it."""

    chapter: str
    """What is hard about it, a key of `HARD_CASES`."""
    label: str
    margin: float
    """Interior margin of the certificate; NaN where it is not known."""
    interior: bool | None
    """Whether one motion opens all contacts; None where that was not decided."""
    tasks: Mapping[str, TaskRow]
    """Solver → its task."""
    rulings: Mapping[str, Ruling]
    """Solver → what it came to."""


@dataclass(frozen=True)
class HardTable:
    """The table solver × case."""

    solvers: tuple[str, ...]
    cases: tuple[Case, ...]
    missing: int
    """Hard cases that no solver of the store was planned on."""

    def counts(self, solver: str) -> Counter[Conduct]:
        """How many cases of a solver came to what."""
        return Counter(case.rulings[solver].conduct for case in self.cases if solver in case.rulings)

    def faults(self) -> tuple[tuple[str, Case], ...]:
        """Every (solver, case) that is wrong, timed out or crashed, by solver."""
        return tuple(
            (solver, case)
            for solver in self.solvers
            for case in self.cases
            if solver in case.rulings and case.rulings[solver].conduct in FAULTY
        )


def hard_table(store: Frames) -> HardTable:
    """Rule every task of a hard case in a store.

    Args:
        store: anything with `frame(name)` for "tasks", "scores" and "series".

    Returns:
        The table; without cases where the store has none.

    Raises:
        ResultsError: a row of the store cannot be read.
    """
    results = Results(store, kinds=(Kind.HARD_CASE,))
    rows: dict[str, list[ScoreRow]] = {}
    for score in results.scores:
        rows.setdefault(score.task.task, []).append(score)
    cases = []
    planned = 0
    for chapter, instances in HARD_CASES.items():
        for family, parameters in instances:
            planned += 1
            tasks = [task for task in results.tasks if _is_of(task, family, parameters)]
            if tasks:
                cases.append(_case(chapter, tasks, rows))
    solvers = sorted({solver for case in cases for solver in case.tasks})
    return HardTable(tuple(solvers), tuple(cases), planned - len(cases))


def _is_of(task: TaskRow, family: str, parameters: Mapping[str, object]) -> bool:
    return task.kind == Kind.HARD_CASE.value and task.scenario == family and dict(task.parameters) == dict(parameters)


def _case(chapter: str, tasks: Sequence[TaskRow], rows: Mapping[str, Sequence[ScoreRow]]) -> Case:
    """One scene's line of the table."""
    rulings = {task.solver: rule(task, rows.get(task.task, ())) for task in tasks}
    # Every solver that was measured has the same certificate: it is the scene's.
    margins = [row for task in tasks for row in rows.get(task.task, ()) if row.metric == MARGIN]
    margin = margins[0].value if margins else math.nan
    interior = margins[0].detail.get("interior") if margins else None
    return Case(chapter, tasks[0].label, margin, interior, {task.solver: task for task in tasks}, rulings)


def render_terminal(table: HardTable, console: Console) -> None:
    """Print the table, what the marks mean, and every fault; it says the same without color.

    Args:
        table: from `hard_table`.
        console: where to print.
    """
    if not table.cases:
        return
    grid = Table(
        title="Hard cases: what each solver came to", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    grid.add_column("scene", overflow="fold")
    grid.add_column("margin", no_wrap=True)
    for solver in table.solvers:
        # Upright names: the marks are one letter wide.
        grid.add_column("\n".join(solver.split("-")), no_wrap=True, justify="center")
    chapter = ""
    for case in table.cases:
        if case.chapter != chapter:
            chapter = case.chapter
            grid.add_row(Text(chapter, style="bold"), "", *("" for _ in table.solvers))
        grid.add_row(
            Text(f"  {case.label}"), _margin(case), *(_marked(case.rulings.get(name)) for name in table.solvers)
        )
    console.print(grid)
    console.print(Text(LEGEND, style="dim"))
    faults = [_sentence(solver, case) for solver, case in table.faults()]
    more = [f"… and {len(faults) - SHOWN_FAULTS} more in hard_cases.md"] if len(faults) > SHOWN_FAULTS else []
    console.print(Text(f"\nWrong, timed out or crashed: {len(faults)}", style="bold"))
    for line in [*faults[:SHOWN_FAULTS], *more]:
        console.print(Padding(Text(line), (0, 0, 0, 2)))


def write_hard_cases(store: Frames, folder: str | os.PathLike[str]) -> list[Path]:
    """Write the table of a store's hard cases.

    Args:
        store: anything with `frame(name)` for "tasks", "scores" and "series".
        folder: where to; made where it is missing.

    Returns:
        hard_cases.md and hard_cases.csv; nothing where the store has no hard case.

    Raises:
        ResultsError: a row of the store cannot be read, or the folder cannot be written to.
    """
    table = hard_table(store)
    if not table.cases:
        return []
    path = prepare(folder)
    texts = {"hard_cases.md": hard_cases_markdown(table), "hard_cases.csv": hard_cases_csv(table)}
    return [write_whole(path / name, text.encode("utf-8")) for name, text in texts.items()]


def hard_cases_markdown(table: HardTable) -> str:
    """The table as a Markdown page: marks, counts, and every ruling that is not a pass with its reason."""
    lines = ["# Hard cases", "", *_incomplete(table), LEGEND, ""]
    lines += [
        "`margin` is the certificate: the largest t with J c ≥ t for one motion |c| ≤ 1. Where it is 0, no motion",
        "opens all contacts, and an elastic iteration may go on for ever.",
        "",
    ]
    chapter = ""
    for case in table.cases:
        if case.chapter != chapter:
            chapter = case.chapter
            lines += [f"## {chapter[0].upper()}{chapter[1:]}", "", *_chapter(table, chapter), ""]
    heading = ("solver", *(conduct.value for conduct in Conduct))
    counted = ((s, *(str(table.counts(s)[conduct]) for conduct in Conduct)) for s in table.solvers)
    lines += ["## Counts", "", *markdown_table(heading, counted), "", "## Reasons", ""]
    lines += [*markdown_table(("solver", "scene", "came to", "why", "task"), _reasons(table)), ""]
    return "\n".join(lines)


def hard_cases_csv(table: HardTable) -> str:
    """One line for each solver and case."""
    rows: list[Sequence[object]] = [(
        "chapter", "scene", "solver", "conduct", "natural", "reason", "status", "iterations", "visits", "margin",
        "interior", "task",
    )]  # fmt: skip
    for case in table.cases:
        for solver in table.solvers:
            if solver not in case.rulings:
                continue
            ruling, task = case.rulings[solver], case.tasks[solver]
            rows.append((
                case.chapter, case.label, solver, ruling.conduct.value, ruling.natural, one_line(ruling.reason),
                task.status, task.iterations, task.visits, case.margin, case.interior, task.task,
            ))  # fmt: skip
    return csv_text(rows)


def _incomplete(table: HardTable) -> list[str]:
    """A warning where cases or tasks are missing."""
    undone = sum(table.counts(solver)[Conduct.OPEN] for solver in table.solvers)
    if not undone and not table.missing:
        return []
    return [f"> **Incomplete:** {undone} planned tasks are not done, {table.missing} hard cases were not planned.", ""]


def _chapter(table: HardTable, chapter: str) -> list[str]:
    """The lines of one chapter's table."""
    body = (
        (case.label, _margin(case), *(_mark(case.rulings.get(solver)) for solver in table.solvers))
        for case in table.cases
        if case.chapter == chapter
    )
    return markdown_table(("scene", "margin", *table.solvers), body)


def _reasons(table: HardTable) -> list[Sequence[str]]:
    """All that is not a pass, faults first."""
    order = list(Conduct)
    found = [
        (order.index(ruling.conduct) if ruling.conduct not in FAULTY else -1, solver, case, ruling)
        for solver in table.solvers
        for case in table.cases
        if (ruling := case.rulings.get(solver)) and ruling.conduct not in (Conduct.PASSED, Conduct.OPEN)
    ]
    found.sort(key=lambda entry: entry[0])
    return [
        (solver, case.label, ruling.conduct.value, ruling.reason, case.tasks[solver].task)
        for _, solver, case, ruling in found
    ]


def _sentence(solver: str, case: Case) -> str:
    """One fault in words."""
    ruling = case.rulings[solver]
    return (
        f"{solver} on {case.label}: {ruling.conduct.value}: {one_line(ruling.reason)} [task {case.tasks[solver].task}]"
    )


def _mark(ruling: Ruling | None) -> str:
    if ruling is None:
        return MARK[Conduct.OPEN]
    return NATURAL_MARK if ruling.natural else MARK[ruling.conduct]


def _marked(ruling: Ruling | None) -> Text:
    """A mark in its color."""
    style = "dim" if ruling is None else _STYLE.get(ruling.conduct, "dim")
    return Text(_mark(ruling), style=style)


def _margin(case: Case) -> str:
    """The certificate, short."""
    return number(case.margin) if case.interior is not False else "0"

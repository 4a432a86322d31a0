"""The scorecard as text: printed in the terminal, and written as Markdown, LaTeX and CSV.

Everything is made from the rows of a store and from nothing else, so that the same store gives the same bytes. Every
number that is shown names the row that it comes from (`scores.score` in the store, column `score` of rows.csv).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from harness.claims import PAPER
from harness.measurement import DESIDERATA, Verdict
from harness.results import Cell, Frames
from reports.files import prepare, write_whole
from reports.latex import scorecard_latex, table_1_latex
from reports.markdown import departures_markdown, scorecard_markdown, table_1_markdown
from reports.scorecard import DISTURBANCE, REFERENCES, ReportError, Scorecard, failures, scorecard
from reports.spreadsheet import rows_csv, scorecard_csv
from reports.wording import (
    cell_name,
    cell_text,
    claim_counts,
    count_text,
    coverage_text,
    disputed,
    failed_count,
    loss_sentence,
    number,
    row_sentence,
    spread_text,
    work_text,
)

__all__ = ["ReportError", "Scorecard", "render_terminal", "scorecard", "write_tables"]

SHOWN_FAILURES = 12
"""Failures that the terminal lists; all of them are in scorecard.md."""

_STYLE = {
    Verdict.PASS: "green",
    Verdict.FAIL: "bold red",
    Verdict.SHOWN: "",
    Verdict.NOT_APPLICABLE: "dim",
    None: "dim",
}


def render_terminal(card: Scorecard, console: Console) -> None:
    """Print the scorecard; it fits 120 columns and says the same without color.

    Args:
        card: from `scorecard`.
        console: where to print.
    """
    if not card.complete:
        console.print(Text(f"INCOMPLETE: {card.open} planned tasks are not done", style="bold yellow"))
    for title, columns in (
        ("Multi-impact scorecard: worst scene of each solver", _terminal_desiderata(card)),
        ("Errors (rms), robustness, work (iterations: median / largest)", _terminal_beyond(card)),
    ):
        for table in _tables(title, card, columns, console.width):
            console.print(table)
    console.print(Text("✓ pass  ✗ fail  · shown, not gated  n/a nothing to measure  – not measured; the number is the "
                       "worst row's", style="dim"))  # fmt: skip
    _print_list(console, "Measured / planned, where they differ", _coverage_lines(card))
    lines = _failure_lines(card)
    more = [f"… and {len(lines) - SHOWN_FAILURES} more in scorecard.md"] if len(lines) > SHOWN_FAILURES else []
    _print_list(console, "What falls short", [*lines[:SHOWN_FAILURES], *more])
    disputed_claims = [f"{f.evidence.verdict.value}: {f.claim.statement}" for f in disputed(card.findings)]
    _print_list(console, f"Claims of {PAPER}: {claim_counts(card.findings)}", disputed_claims or ["none is disputed"])


def _print_list(console: Console, heading: str, lines: Sequence[str]) -> None:
    """A heading with indented lines; nothing where there are none."""
    if not lines:
        return
    console.print(Text(f"\n{heading}", style="bold"))
    for line in lines:
        console.print(_indented(line))


def write_tables(store: Frames, folder: str | os.PathLike[str]) -> list[Path]:
    """Write all tables of a store.

    Args:
        store: anything with `frame(name)` for "tasks", "scores", "series" and "runs".
        folder: where to; made where it is missing.

    Returns:
        The files: scorecard (md, tex, csv), rows.csv, table1 (md, tex), departures.md.

    Raises:
        ReportError: the store has nothing to report, or the folder cannot be written to.
    """
    card = scorecard(store)
    path = prepare(folder)
    texts = {
        "scorecard.md": scorecard_markdown(card),
        "scorecard.tex": scorecard_latex(card),
        "scorecard.csv": scorecard_csv(card),
        "rows.csv": rows_csv(card),
        "table1.md": table_1_markdown(card),
        "table1.tex": table_1_latex(card),
        "departures.md": departures_markdown(card),
    }
    return [write_whole(path / name, text.encode("utf-8")) for name, text in texts.items()]


def _terminal_desiderata(card: Scorecard) -> Mapping[str, list[Text]]:
    """The six desiderata and the gates beyond them: heading → one entry a solver."""
    columns = {name: [_marked(solver.cells[name]) for solver in card.cards] for name in DESIDERATA}
    columns["invar."] = [_marked(solver.invariance) for solver in card.cards]
    columns["scale"] = [_marked(solver.scale) for solver in card.cards]
    return columns


def _marked(cell: Cell) -> Text:
    """A cell in its color."""
    return Text(cell_text(cell), style=_STYLE[cell.verdict])


def _terminal_beyond(card: Scorecard) -> Mapping[str, list[Text]]:
    """Errors, robustness, work and coverage: heading → one entry a solver."""
    columns = {
        f"to {name.split()[0]}": [Text(spread_text(solver.validation.get(name))) for solver in card.cards]
        for name in REFERENCES
    }
    columns["own eqs."] = [_marked(solver.verification) for solver in card.cards]
    columns[f"moved by {number(DISTURBANCE)}"] = [
        Text(number(solver.robustness.value) if solver.robustness else "–") for solver in card.cards
    ]
    columns["stopping"] = [_marked(solver.termination) for solver in card.cards]
    work = [work_text(solver) for solver in card.cards]
    columns["iterations"] = [Text(iterations) for iterations, _ in work]
    columns["visits"] = [Text(count_text(s.work.visits) if s.work else "–") for s in card.cards]
    columns["measured"] = [Text(f"{s.coverage.measured}/{s.coverage.planned}") for s in card.cards]
    return columns


def _tables(title: str, card: Scorecard, columns: Mapping[str, list[Text]], width: int) -> list[Table]:
    """One table, or several below one another where the console is too narrow: a number is never cut."""
    names = [solver.solver for solver in card.cards]
    # A space before every column and one at the end of the line.
    first = max(map(len, ["solver", *names])) + 3
    groups: list[list[str]] = []
    used = width + 1
    for heading, entries in columns.items():
        needed = max(len(heading), *(len(entry.plain) for entry in entries)) + 2
        if used + needed > width:
            groups.append([])
            used = first
        groups[-1].append(heading)
        used += needed
    tables = []
    for group in groups:
        table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for heading in ("solver", *group):
            table.add_column(heading, no_wrap=True)
        for k, name in enumerate(names):
            table.add_row(name, *(columns[heading][k] for heading in group))
        tables.append(table)
    return tables


def _coverage_lines(card: Scorecard) -> list[str]:
    """Solvers of which not every planned task was measured."""
    return [
        f"{solver.solver}: {coverage_text(solver)}"
        for solver in card.cards
        if solver.coverage.measured != solver.coverage.planned
    ]


def _indented(text: str) -> Padding:
    """A line that stays indented where it is wrapped."""
    return Padding(Text(text), (0, 0, 0, 2))


def _failure_lines(card: Scorecard) -> list[str]:
    """One line for each failed cell, then one for each lost task."""
    lines = []
    for solver, cell in failures(card):
        if cell.failed and cell.worst is not None:
            lines.append(f"{solver.solver} {cell_name(cell)}: {row_sentence(cell.worst)}{failed_count(cell)}")
    for solver in card.cards:
        lines += [f"{solver.solver} lost {loss_sentence(task)}" for task in solver.coverage.lost]
    return lines

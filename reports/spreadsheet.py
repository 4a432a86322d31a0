"""The scorecard and all of its rows as comma-separated values."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence

from harness.results import ScoreRow
from reports.scorecard import DISTURBANCE, Scorecard, SolverCard, all_cells


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Comma-separated text, the first row the heading; numbers in full precision, NaN and None empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        writer.writerow([_plain(entry) for entry in row])
    return text.getvalue()


def _plain(entry: object) -> object:
    """An entry as it is written: floats in full, NaN and None as nothing."""
    if entry is None or (isinstance(entry, float) and math.isnan(entry)):
        return ""
    return repr(float(entry)) if isinstance(entry, float) else entry


CARD_COLUMNS = (
    "solver", "name", "statistic", "value", "verdict", "tolerance", "margin", "metric", "scene", "reference", "score",
    "count",
)  # fmt: skip
"""Columns of scorecard.csv: one number a row."""


def scorecard_csv(card: Scorecard) -> str:
    """The scorecard in tidy form: one number a row."""
    rows: list[Sequence[object]] = []
    for solver in card.cards:
        for cell in all_cells(solver):
            verdict = cell.verdict.value if cell.verdict else "not measured"
            count = cell.passed + cell.failed
            rows.append(_tidy(solver.solver, cell.name, "worst", cell.worst, verdict, count))
            rows += [
                (solver.solver, cell.name, kind, n, "", None, None, "", "", "", None, count + len(cell.lost))
                for kind, n in (("failed", cell.failed), ("lost", len(cell.lost)))
            ]
        if solver.robustness is not None:
            row = solver.robustness.row
            rows.append((
                solver.solver, "robustness", f"largest response to {DISTURBANCE:.0e}", solver.robustness.value,
                row.verdict.value, None, None, row.metric, row.task.label, "", row.score, None,
            ))  # fmt: skip
        rows += _tidy_spreads(solver)
        rows += _tidy_counts(solver)
    return csv_text([CARD_COLUMNS, *rows])


def _tidy(
    solver: str, name: str, statistic: str, row: ScoreRow | None, verdict: str, count: int | None
) -> Sequence[object]:
    """One worst row in tidy form."""
    if row is None:
        return (solver, name, statistic, None, verdict, None, None, "", "", "", None, count)
    return (
        solver, name, statistic, row.value, verdict, row.tolerance, row.margin, row.metric, row.task.label,
        row.reference, row.score, count,
    )  # fmt: skip


def _tidy_spreads(card: SolverCard) -> list[Sequence[object]]:
    """The validation errors of one solver in tidy form."""
    rows: list[Sequence[object]] = []
    for name, spread in card.validation.items():
        for statistic, value in (("rms", spread.rms), ("median", spread.median)):
            rows.append((
                card.solver, "validation", statistic, value, "", None, None, "", "", name, None, spread.count
            ))  # fmt: skip
        rows.append(_tidy(card.solver, "validation", "worst", spread.worst, spread.worst.verdict.value, spread.count))
    return rows


def _tidy_counts(card: SolverCard) -> list[Sequence[object]]:
    """Work and coverage of one solver in tidy form."""
    counts: list[tuple[str, str, float | int]] = []
    if card.work is not None:
        counts += [
            ("work", "median iterations", card.work.median_iterations),
            ("work", "largest iterations", card.work.largest_iterations),
            ("work", "contact visits", card.work.visits),
            ("work", "not converged", len(card.work.unconverged)),
        ]
    coverage = card.coverage
    counts += [
        ("coverage", "planned", coverage.planned),
        ("coverage", "measured", coverage.measured),
        ("coverage", "refused", coverage.refused),
        ("coverage", "lost", len(coverage.lost)),
        ("coverage", "open", coverage.open),
    ]
    return [(card.solver, name, what, n, "", None, None, "", "", "", None, None) for name, what, n in counts]


ROW_COLUMNS = (
    "score", "task", "kind", "solver", "scene", "outcome", "name", "metric", "value", "tolerance", "verdict", "margin",
    "reference", "status", "iterations", "visits", "detail",
)  # fmt: skip
"""Columns of rows.csv: every score, and every task without one."""


def rows_csv(card: Scorecard) -> str:
    """Every row of the store; a task without scores (refused, lost, open) is a row with its reason."""
    rows: list[tuple[object, ...]] = []
    scored: dict[str, list[ScoreRow]] = {}
    for score in card.results.scores:
        scored.setdefault(score.task.task, []).append(score)
    for task in card.results.tasks:
        outcome = task.outcome.value if task.outcome else "planned"
        head = (task.task, task.kind, task.solver, task.label, outcome)
        tail = (task.status, task.iterations, task.visits)
        if task.task not in scored:
            reason = json.dumps({"reason": task.reason}, ensure_ascii=False)
            rows.append((None, *head, "", "", None, None, "", None, "", *tail, reason))
        for row in scored.get(task.task, []):
            detail = json.dumps(dict(row.detail), sort_keys=True, ensure_ascii=False)
            rows.append((
                row.score, *head, row.name, row.metric, row.value, row.tolerance, row.verdict.value, row.margin,
                row.reference, *tail, detail,
            ))  # fmt: skip
    return csv_text([ROW_COLUMNS, *rows])

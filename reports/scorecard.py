"""The scorecard: every solver's cells, errors and coverage, added up from the rows of a store; nothing is drawn here.

A cell shows the worst row of its solver and desideratum. A crash, a time-out or an invalid answer fails the cells that
its task should have filled; a refusal and a task that is not done show in the coverage.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.claims import Finding, check_claims
from harness.measurement import DESIDERATA, Kind, Outcome, Verdict
from harness.results import Cell, Coverage, Frames, Results, ResultsError, ScoreRow, TaskRow

FIRST = ("qce", "gr", "lcp-pgs")
"""Solvers that stand for the rows of the paper's Table 1 come first, the others in alphabetical order."""

REFERENCES = ("Hertz", "ideal exchange")
"""References that validation errors are shown against, each in a column of its own."""

DISTURBANCE = 1e-8
"""Size of the disturbance whose largest response is shown, relative to the impact velocity."""


class ReportError(ResultsError):
    """A report cannot be made; the text says why and what to do."""


@dataclass(frozen=True)
class Spread:
    """Validation errors of one solver against one reference, over its scenes."""

    reference: str
    rms: float
    """Root mean square over the scenes, dimensionless (relative to the pre-impact velocity)."""
    median: float
    count: int
    unmeasured: int
    """Scenes with this reference for which the solver has no answer."""
    within: int
    """Scenes whose error is below the reference's own uncertainty: not distinguishable from none."""
    worst: ScoreRow


@dataclass(frozen=True)
class Response:
    """Largest response of a solver to a small disturbance."""

    value: float
    """Relative to the impact velocity."""
    row: ScoreRow


@dataclass(frozen=True)
class Work:
    """Iterations and contact visits of a solver over the single impacts that it solved."""

    scenes: int
    median_iterations: float
    largest_iterations: int
    visits: int
    """Contact visits of all scenes together: what a computation costs on any machine."""
    unconverged: tuple[TaskRow, ...]
    """Scenes on which the solver itself says that it did not converge."""


@dataclass(frozen=True)
class SolverCard:
    """All that is shown of one solver."""

    solver: str
    cells: Mapping[str, Cell]
    """Desideratum → cell."""
    invariance: Cell
    scale: Cell
    termination: Cell
    claim: Cell
    """What the solver claims against what the harness recomputes."""
    robustness: Response | None
    validation: Mapping[str, Spread]
    """Reference → spread; only references that were measured."""
    verification: Cell
    """Residuals of the law's own equations, and distances to its own closed forms."""
    work: Work | None
    coverage: Coverage


@dataclass(frozen=True)
class Scorecard:
    """The measured card, with where it comes from and what the rows say of the paper's claims."""

    cards: tuple[SolverCard, ...]
    findings: tuple[Finding, ...]
    results: Results
    run: Mapping[str, Any]
    """The store's latest run: version, started, environment, settings, command; empty where it says nothing."""
    runs: int
    """Number of runs that the store was made by."""

    @property
    def open(self) -> int:
        """Tasks that are planned and not done."""
        return sum(card.coverage.open for card in self.cards)

    @property
    def complete(self) -> bool:
        """True where every planned task is done."""
        return self.open == 0


def scorecard(store: Frames) -> Scorecard:
    """Add up a store's rows.

    Args:
        store: anything with `frame(name)` for "tasks", "scores", "series" and "runs".

    Returns:
        The scorecard; incomplete where planned tasks are not done.

    Raises:
        ReportError: the store has no task that is done, or rows that cannot be read.
    """
    try:
        results = Results(store)
        findings = check_claims(results)
    except ResultsError as error:
        raise ReportError(str(error)) from error
    if not results.tasks:
        raise ReportError("the store is empty: no task was planned in it; measure first with `impactbench run`")
    if not any(task.done for task in results.tasks):
        raise ReportError(
            f"the store has {len(results.tasks)} planned tasks and none is done; go on with `impactbench run`"
        )
    run, runs = _latest_run(store)
    names = sorted(results.solvers, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name))
    return Scorecard(tuple(_card(results, name) for name in names), findings, results, run, runs)


def failures(card: Scorecard) -> tuple[tuple[SolverCard, Cell], ...]:
    """Every failed cell, desiderata first, then the gates beyond them."""
    return tuple((solver, cell) for solver in card.cards for cell in all_cells(solver) if cell.verdict is Verdict.FAIL)


def all_cells(card: SolverCard) -> tuple[Cell, ...]:
    """A solver's cells in the order in which they are shown."""
    six = (card.cells[name] for name in DESIDERATA)
    return (*six, card.invariance, card.scale, card.termination, card.claim, card.verification)


def _card(results: Results, solver: str) -> SolverCard:
    """Everything about one solver."""
    errors = results.scores_of(solver, "error")
    return SolverCard(
        solver=solver,
        cells={name: results.cell(solver, name) for name in DESIDERATA},
        invariance=results.cell(solver, "invariance"),
        scale=results.cell(solver, "scale"),
        termination=results.cell(solver, "termination"),
        claim=results.cell(solver, "claim"),
        robustness=_response(results.scores_of(solver, "robustness")),
        validation=_validation(results, solver, errors),
        verification=results.cell(solver, "error", metric="verification"),
        work=_work(results.tasks_of(solver, kind=Kind.IMPACT)),
        coverage=results.coverage(solver),
    )


def _response(rows: Sequence[ScoreRow]) -> Response | None:
    """The largest response to a disturbance of size DISTURBANCE over all scenes."""
    found = [
        Response(float(value), row)
        for row in rows
        for size, value in row.detail.items()
        if row.metric == "largest response" and _is_size(size) and isinstance(value, (int, float))
    ]
    found += [Response(row.value, row) for row in rows if _is_size(row.metric.rpartition(", size ")[2])]
    return max(found, key=lambda response: response.value) if found else None


def _is_size(text: str) -> bool:
    """True for the text of the number DISTURBANCE."""
    try:
        return math.isclose(float(text), DISTURBANCE, rel_tol=1e-9)
    except ValueError:
        return False


def _validation(results: Results, solver: str, errors: Sequence[ScoreRow]) -> Mapping[str, Spread]:
    """Spread of the errors against each reference; scenes that others measured and this one did not are counted."""
    spreads = {}
    scenes = _referenced_scenes(results)
    for reference in sorted({row.reference for row in errors if row.metric.startswith("validation")}):
        rows = [
            row
            for row in errors
            if row.metric.startswith("validation") and row.reference == reference and not math.isnan(row.value)
        ]
        if not rows:
            continue
        values = np.array([row.value for row in rows])
        unmeasured = scenes[reference] - {row.task.label for row in rows}
        spreads[reference] = Spread(
            reference,
            float(np.sqrt(np.mean(values**2))),
            float(np.median(values)),
            len(rows),
            len(unmeasured & {task.label for task in results.tasks_of(solver)}),
            sum(row.detail.get("distinguishable") is False for row in rows),
            max(rows, key=lambda row: row.value),
        )
    return spreads


def _referenced_scenes(results: Results) -> Mapping[str, set[str]]:
    """Reference → scenes on which any solver was measured against it."""
    scenes: dict[str, set[str]] = {}
    for row in results.scores:
        if row.name == "error" and row.metric.startswith("validation"):
            scenes.setdefault(row.reference, set()).add(row.task.label)
    return scenes


def _work(tasks: Sequence[TaskRow]) -> Work | None:
    """Iterations and visits over the measured single impacts."""
    measured = [task for task in tasks if task.outcome is Outcome.MEASURED and task.iterations is not None]
    if not measured:
        return None
    iterations = [task.iterations or 0 for task in measured]
    return Work(
        len(measured),
        float(np.median(iterations)),
        max(iterations),
        sum(task.visits or 0 for task in measured),
        tuple(task for task in measured if task.status and task.status != "converged"),
    )


def _latest_run(store: Frames) -> tuple[Mapping[str, Any], int]:
    """The last row of the table of runs as a plain mapping, and the number of rows."""
    records = store.frame("runs").to_dict("records")
    return (records[-1] if records else {}), len(records)

"""What a store measured, read once: rows joined with their tasks, and the cells that they add up to.

Claims and reports both work on this and on nothing else; nothing here solves, and nothing here draws.
A cell is one solver under one name (a desideratum, or "invariance", "robustness", …) over all its scenes:
it fails where any gated row fails or any task that should have filled it was lost, and it shows its worst row.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pandas as pd

from harness.measurement import DESIDERATA, Kind, Outcome, Verdict
from solvers.solution import Floats

NEEDED = {
    "tasks": ("task", "kind", "solver", "scenario", "parameters", "label", "state", "outcome"),
    "scores": ("score", "task", "name", "metric", "value", "tolerance", "verdict", "margin"),
    "series": ("series", "task", "name", "columns"),
}
"""Columns without which a report cannot be made; all others may be missing or empty."""

LOST = (Outcome.RAISED, Outcome.INVALID, Outcome.CRASHED, Outcome.TIMED_OUT, Outcome.OUT_OF_MEMORY)
"""Outcomes that count as a failure: the task was planned, the law did not refuse it, and it has no scores."""

SWEEP_JUDGES = {"wave": ("WAV",), "disturbance": ("robustness",)}
"""What a sweep fills, hence what its loss fails."""

IMPACT_JUDGES = (*DESIDERATA, "invariance", "scale", "termination", "claim")
"""What a single impact fills, hence what its loss fails: the six desiderata and the gates beyond them."""


class ResultsError(Exception):
    """The store lacks what was asked of it; the text says what, and what to run."""


class Frames(Protocol):
    """A store as claims and reports see it."""

    def frame(self, name: str) -> Any:
        """Return the table "tasks", "scores", "series" or "runs" as a pandas DataFrame."""
        ...


@dataclass(frozen=True)
class TaskRow:
    """One planned task and how it ended."""

    task: str
    kind: str
    solver: str
    scenario: str
    label: str
    parameters: Mapping[str, Any]
    tags: frozenset[str]
    done: bool
    outcome: Outcome | None
    """None while the task is planned only."""
    reason: str
    status: str
    """The solver's own status label; empty where nothing was solved."""
    iterations: int | None
    visits: int | None


@dataclass(frozen=True)
class ScoreRow:
    """One number of one task."""

    score: int
    """Identity of the row in the store; reports link to it."""
    task: TaskRow
    name: str
    metric: str
    value: float
    tolerance: float
    verdict: Verdict
    margin: float
    reference: str
    detail: Mapping[str, Any]

    @property
    def gated(self) -> bool:
        """True where a tolerance decides."""
        return self.verdict in (Verdict.PASS, Verdict.FAIL)

    @property
    def link(self) -> str:
        """How reports name the row."""
        return f"score {self.score}"


@dataclass(frozen=True)
class SeriesRow:
    """Columns of numbers of one task, for figures and for claims about curves."""

    series: int
    task: TaskRow
    name: str
    columns: Mapping[str, Any]

    @property
    def link(self) -> str:
        """How reports name the row."""
        return f"series {self.series}"


@dataclass(frozen=True)
class Cell:
    """One solver under one name: the verdict, the worst row, and what stands behind it."""

    solver: str
    name: str
    verdict: Verdict | None
    """None: nothing was measured."""
    worst: ScoreRow | None
    """The gated row with the smallest margin; among rows without a gate the largest value. None: no row."""
    passed: int
    failed: int
    lost: tuple[TaskRow, ...]
    """Tasks that should have filled this cell and ended without scores."""


@dataclass(frozen=True)
class Coverage:
    """How many of a solver's planned tasks came to what."""

    planned: int
    measured: int
    refused: int
    lost: tuple[TaskRow, ...]
    open: int
    """Planned and not done: the card is incomplete."""


class Results:
    """All rows of one store, in its order: tasks as planned, then their rows.

    Args:
        store: where the frames come from.
        kinds: which tasks; hard cases have a table of their own (`harness.hard_cases`) and must not spoil the card.

    Raises:
        ResultsError: a frame lacks a needed column, or a cell of it cannot be read.
    """

    def __init__(self, store: Frames, *, kinds: Collection[Kind] = (Kind.IMPACT, Kind.SWEEP)) -> None:
        tasks = [_task(record) for record in _records(store, "tasks")]
        by_id = {task.task: task for task in tasks}
        chosen = {kind.value for kind in kinds}
        self.tasks: tuple[TaskRow, ...] = tuple(task for task in tasks if task.kind in chosen)
        scores = (_score(record, by_id) for record in _records(store, "scores"))
        self.scores: tuple[ScoreRow, ...] = tuple(row for row in scores if row.task.kind in chosen)
        self._series: tuple[SeriesRow, ...] = tuple(
            SeriesRow(
                int(record["series"]),
                _owner(record, by_id),
                str(record["name"]),
                _json(record["columns"], f"columns of series {record['series']}"),
            )
            for record in _records(store, "series")
        )

    @property
    def solvers(self) -> tuple[str, ...]:
        """Every solver with a planned task, in alphabetical order."""
        return tuple(sorted({task.solver for task in self.tasks}))

    def tasks_of(self, solver: str, *, kind: Kind | None = None) -> tuple[TaskRow, ...]:
        """All tasks of one solver, of one kind if given."""
        return tuple(task for task in self.tasks if task.solver == solver and (kind is None or task.kind == kind.value))

    def scores_of(self, solver: str, name: str | None = None) -> tuple[ScoreRow, ...]:
        """All rows of one solver, under one name if given."""
        return tuple(
            score for score in self.scores if score.task.solver == solver and (name is None or score.name == name)
        )

    def series(self, name: str, solver: str | None = None) -> tuple[SeriesRow, ...]:
        """All series of one name, of one solver if given."""
        return tuple(row for row in self._series if row.name == name and (solver is None or row.task.solver == solver))

    def coverage(self, solver: str) -> Coverage:
        """Count what became of a solver's planned tasks."""
        tasks = self.tasks_of(solver)
        return Coverage(
            planned=len(tasks),
            measured=sum(task.outcome is Outcome.MEASURED for task in tasks),
            refused=sum(task.outcome is Outcome.REFUSED for task in tasks),
            lost=tuple(task for task in tasks if task.outcome in LOST),
            open=sum(not task.done for task in tasks),
        )

    def cell(self, solver: str, name: str, *, metric: str = "") -> Cell:
        """Add up one solver's rows under one name, of metrics that begin with `metric` only.

        Any failed gated row fails the cell, and so does any lost task: a law that crashes on a scene has not
        passed it. A refusal does not; it shows in the coverage.
        """
        rows = [row for row in self.scores_of(solver, name) if row.metric.startswith(metric)]
        gated = [row for row in rows if row.gated]
        lost = tuple(task for task in self.tasks_of(solver) if task.outcome in LOST and name in _judged(task))
        failed = sum(row.verdict is Verdict.FAIL for row in gated)
        verdict: Verdict | None
        if failed or lost:
            verdict = Verdict.FAIL
        elif gated:
            verdict = Verdict.PASS
        elif any(row.verdict is Verdict.SHOWN for row in rows):
            verdict = Verdict.SHOWN
        else:
            verdict = Verdict.NOT_APPLICABLE if rows else None
        return Cell(solver, name, verdict, worst_row(rows), len(gated) - failed, failed, lost)


def worst_row(rows: Sequence[ScoreRow]) -> ScoreRow | None:
    """The gated row with the smallest margin, failures first; without gates the largest value; None without rows.

    A NaN margin is the worst there is: it says that a number could not be had. Ties go to the earlier row.
    """
    gated = [row for row in rows if row.gated]
    if gated:
        return min(
            gated,
            key=lambda row: (
                row.verdict is not Verdict.FAIL,
                -math.inf if math.isnan(row.margin) else row.margin,
            ),
        )
    shown = [row for row in rows if row.verdict is Verdict.SHOWN]
    if shown:
        return min(shown, key=lambda row: -math.inf if math.isnan(row.value) else -abs(row.value))
    return None


def _judged(task: TaskRow) -> tuple[str, ...]:
    """Names that a task should have filled."""
    if task.kind == Kind.SWEEP.value and task.scenario in SWEEP_JUDGES:
        return SWEEP_JUDGES[task.scenario]
    return IMPACT_JUDGES


def _records(store: Frames, name: str) -> list[Mapping[str, Any]]:
    """One frame as records in the store's order (planned order), with its needed columns checked."""
    frame = store.frame(name)
    absent = [column for column in NEEDED[name] if column not in frame.columns]
    if absent:
        raise ResultsError(f"the store's table {name!r} lacks the columns {', '.join(absent)}")
    records: list[Mapping[str, Any]] = frame.to_dict("records")
    return records


def _task(record: Mapping[str, Any]) -> TaskRow:
    """One record of the table of tasks."""
    label = str(record["task"])
    outcome = _text(record["outcome"])
    try:
        ended = Outcome(outcome) if outcome else None
    except ValueError:
        raise ResultsError(f"task {label} has the unknown outcome {outcome!r}") from None
    return TaskRow(
        task=str(record["task"]),
        kind=_text(record["kind"]),
        solver=_text(record["solver"]),
        scenario=_text(record["scenario"]),
        label=_text(record["label"]) or _text(record["scenario"]),
        parameters=_json(record["parameters"], f"parameters of task {label}"),
        tags=frozenset(_list(record.get("tags"), f"tags of task {label}")),
        done=_text(record["state"]) == "done",
        outcome=ended,
        reason=_text(record.get("reason")),
        status=_text(record.get("status")),
        iterations=_integer(record.get("iterations")),
        visits=_integer(record.get("visits")),
    )


def _score(record: Mapping[str, Any], by_id: Mapping[str, TaskRow]) -> ScoreRow:
    """One record of the table of scores."""
    verdict = _text(record["verdict"])
    try:
        said = Verdict(verdict)
    except ValueError:
        raise ResultsError(f"score {record['score']} has the unknown verdict {verdict!r}") from None
    return ScoreRow(
        score=int(record["score"]),
        task=_owner(record, by_id),
        name=_text(record["name"]),
        metric=_text(record["metric"]),
        value=_number(record["value"]),
        tolerance=_number(record["tolerance"]),
        verdict=said,
        margin=_number(record["margin"]),
        reference=_text(record.get("reference")),
        detail=_json(record.get("detail"), f"detail of score {record['score']}"),
    )


def _owner(record: Mapping[str, Any], by_id: Mapping[str, TaskRow]) -> TaskRow:
    """The task of a score or series."""
    task = by_id.get(str(record["task"]))
    if task is None:
        raise ResultsError(f"a row belongs to task {record['task']}, which the store does not have")
    return task


def _missing(value: object) -> bool:
    """True for what a database hands back for NULL."""
    return value is None or bool(pd.api.types.is_scalar(value) and pd.isna(value))


def _text(value: object) -> str:
    """A text column; NULL is the empty text."""
    return "" if _missing(value) else str(value)


def _number(value: Any) -> float:
    """A real column; NULL is NaN."""
    return math.nan if _missing(value) else float(value)


def _integer(value: Any) -> int | None:
    """An integer column; NULL is None."""
    return None if _missing(value) else int(value)


def _json(value: Any, what: str) -> Mapping[str, Any]:
    """A JSON object column; NULL is the empty object."""
    if _missing(value) or value == "":
        return {}
    if isinstance(value, Mapping):
        return value
    try:
        parsed = json.loads(value)
    except (TypeError, ValueError) as error:
        raise ResultsError(f"{what}: not JSON ({error})") from None
    if not isinstance(parsed, dict):
        raise ResultsError(f"{what}: not a JSON object")
    return parsed


def _list(value: Any, what: str) -> list[str]:
    """A JSON array column; NULL is the empty list."""
    if _missing(value) or (isinstance(value, str) and value == ""):
        return []
    if isinstance(value, (list, tuple, set, frozenset)):
        return [str(item) for item in value]
    try:
        parsed = json.loads(value)
    except (TypeError, ValueError) as error:
        raise ResultsError(f"{what}: not JSON ({error})") from None
    return [str(item) for item in parsed]


@dataclass(frozen=True)
class ThreeBallSweep:
    """Outcome of the three-ball chain (va, 0, -1) over va, beside its references; velocities in units of v₀."""

    link: str
    va: Floats
    """Pre-impact velocity of ball A, rising, shape (k,)."""
    v_post: Floats
    """Post-impact velocities of A, B, C, shape (k, 3); the references alike. NaN where there is none."""
    ideal: Floats
    hertz: Floats
    lcp: Floats


@dataclass(frozen=True)
class Cradle:
    """Newton's cradle: the first `moving` of `balls` equal balls strike the rest at speed 1."""

    link: str
    balls: int
    moving: int
    v_post: Floats
    """Post-impact velocities, shape (balls,); the references alike. NaN where there is none."""
    ideal: Floats
    hertz: Floats


@dataclass(frozen=True)
class DisturbedCradle:
    """Newton's cradle with one ball moving, its contacts' velocities disturbed by random numbers of one size."""

    link: str
    balls: int
    size: float
    """Size of the disturbance of u_pre, relative to the impact velocity."""
    v_post: Floats
    """Post-impact velocities, shape (draws, balls)."""
    undisturbed: Floats
    """The same law without disturbance, shape (balls,)."""
    hertz: Floats
    """Hertz contact without disturbance, shape (balls,); NaN where there is none."""

    @property
    def response(self) -> float:
        """Largest change of any ball's velocity in any draw, in units of the impact velocity."""
        return float(np.abs(self.v_post - self.undisturbed).max(initial=0.0))


def three_ball_sweep(results: Results, solver: str) -> ThreeBallSweep | None:
    """The solver's latest sweep over va; None where it has none.

    Raises:
        ResultsError: the series has other columns or lengths than it should.
    """
    rows = results.series("three-ball sweep", solver)
    if not rows:
        return None
    row = rows[-1]
    va = _column(row, "va", (-1,))
    order = np.argsort(va, kind="stable")
    shape = (va.size, 3)
    v_post, ideal, hertz, lcp = (_column(row, name, shape)[order] for name in ("v_post", "ideal", "hertz", "lcp"))
    return ThreeBallSweep(row.link, va[order], v_post, ideal, hertz, lcp)


def cradles(results: Results, solver: str) -> tuple[Cradle, ...]:
    """The solver's latest cradles; empty where it has none.

    Raises:
        ResultsError: the series has other columns or lengths than it should.
    """
    rows = results.series("cradles", solver)
    if not rows:
        return ()
    row = rows[-1]
    balls = np.atleast_1d(_column(row, "balls", None)).astype(int)
    moving = np.atleast_1d(_column(row, "moving", None)).astype(int)
    listed = np.ndim(row.columns["balls"]) == 1
    found = []
    for k, (n, moved) in enumerate(zip(balls, moving, strict=True)):
        v_post, ideal, hertz = (
            _values(row, name, _item(row, name, k) if listed else row.columns.get(name), (n,))
            for name in ("v_post", "ideal", "hertz")
        )
        found.append(Cradle(row.link, int(n), int(moved), v_post, ideal, hertz))
    return tuple(found)


def disturbed_cradles(results: Results, solver: str) -> tuple[DisturbedCradle, ...]:
    """The solver's disturbed cradles, by number of balls and size; empty where it has none.

    Raises:
        ResultsError: a series has other columns or lengths than it should.
    """
    found: dict[tuple[int, float], DisturbedCradle] = {}
    for row in results.series("disturbed cradle", solver):
        listed = np.ndim(row.columns.get("balls", 0)) == 1
        for k, n in enumerate(np.atleast_1d(_column(row, "balls", None)).astype(int)):
            size, v_post, undisturbed, hertz = (
                _item(row, name, k) if listed else row.columns.get(name)
                for name in ("size", "v_post", "undisturbed", "hertz")
            )
            cradle = DisturbedCradle(
                row.link,
                int(n),
                float(_values(row, "size", size, ())),
                _values(row, "v_post", v_post, (-1, n)),
                _values(row, "undisturbed", undisturbed, (n,)),
                _values(row, "hertz", hertz, (n,)),
            )
            found[cradle.balls, cradle.size] = cradle
    return tuple(found[key] for key in sorted(found))


def _item(row: SeriesRow, name: str, k: int) -> Any:
    """Entry k of a column; None where the column is absent."""
    column = row.columns.get(name)
    if column is None:
        return None
    if k >= len(column):
        raise ResultsError(f"{row.link} ({row.name}): column {name!r} has {len(column)} entries, {k + 1} needed")
    return column[k]


def _column(row: SeriesRow, name: str, shape: tuple[int, ...] | None) -> Floats:
    """One column of a series as an array of a shape."""
    if shape is None and name not in row.columns:
        raise ResultsError(f"{row.link} ({row.name}) lacks the column {name!r}")
    return _values(row, name, row.columns.get(name), shape)


def _values(row: SeriesRow, name: str, values: Any, shape: tuple[int, ...] | None) -> Floats:
    """Numbers as an array of a shape, NaN for each null; all NaN where there are none."""
    if values is None and shape is not None and -1 not in shape:
        return np.full(shape, np.nan)
    try:
        array = np.array(values, dtype=np.float64)
        return array if shape is None else array.reshape(shape)
    except (TypeError, ValueError) as error:
        raise ResultsError(f"{row.link} ({row.name}): column {name!r} is not as it should be: {error}") from None

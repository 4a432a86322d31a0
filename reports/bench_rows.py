"""What a bench measured, read once from the store: points of the sweeps, scaling, first solves, noise of the machine.

Nothing here solves, times or draws. A point that gave no answer keeps its outcome and has infinite costs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from harness.measurement import Outcome
from harness.results import Frames
from harness.statistics import PowerLaw, Repeats, cost_to_reach, fit_power_law, summarize
from harness.timing import is_noisy
from harness.work_precision import COLD, ERRORS, RUNS, SCALING, TIMES, VERIFICATION, WARM
from reports.scorecard import ReportError
from solvers.solution import Floats, Status

# Errors that the table of costs asks for.
TARGETS = tuple(10.0**-k for k in range(2, 13, 2))
# A law is as far from the truth as it is: the table of validation errors asks where it gets to.
VALIDATION_TARGETS = (0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 0.01, 1e-4)
# Error at which solvers are compared in the profiles: beyond what graphics needs, within what all methods can do.
COMPARED_AT = 1e-6
# Below so many contacts a time is mostly that of the call, which would flatten the exponent.
FIT_FROM = 100
# The reference that a validation error is shown against, where a scene has several.
PREFERRED = "validation: Hertz"


@dataclass(frozen=True)
class Timed:
    """Repeats of one solver at one setting on one scene."""

    repeats: Repeats
    """CPU time of one solve [s]."""
    rounds: Mapping[int, float]
    """Round → median of its samples [s]: rounds of two solvers lie side by side in time."""
    wall_s: float
    """Median wall time of one solve [s]."""
    fresh_s: float
    """Median CPU time of a solve that builds its matrices too [s]."""
    memory_bytes: float
    """Largest growth of memory of a round."""
    noisy: int
    """Rounds in which the calibration kernel was slow."""


@dataclass(frozen=True)
class Point:
    """One solver at one setting on one scene, or one size of a scaling sweep."""

    law: str
    specification: str
    setting: str
    """Name and value of the dial; empty where the solver has none."""
    scene: str
    """Label of the scene."""
    family: str
    """Scene without its size: what a scaling curve runs over."""
    contacts: int
    tags: frozenset[str]
    outcome: Outcome | None
    """None while it is planned only."""
    reason: str
    status: str
    iterations: int | None
    visits: int | None
    errors: Mapping[str, float] = field(default_factory=dict)
    """Metric → value; those that do not apply are missing."""
    uncertainties: Mapping[str, float] = field(default_factory=dict)
    """Validation metric → uncertainty of its reference."""
    timed: Timed | None = None
    rows: tuple[int, ...] = ()
    """Tasks in the store that this comes from."""

    @property
    def converged(self) -> bool:
        """True where the solver's own stopping test passed."""
        return self.status == Status.CONVERGED.label

    @property
    def median_s(self) -> float:
        """Median CPU time [s]; infinite without one."""
        return self.timed.repeats.median if self.timed else math.inf

    @property
    def work(self) -> float:
        """Contact visits; infinite where nothing was solved. A solve without any counts as one."""
        return math.inf if self.visits is None or not self.errors else float(max(self.visits, 1))

    def error(self, metric: str) -> float:
        """One error; NaN where it was not measured."""
        return self.errors.get(metric, math.nan)


@dataclass(frozen=True)
class FirstSolve:
    """First and second solve in a fresh process."""

    law: str
    first: Repeats
    second: Repeats


@dataclass(frozen=True)
class WarmSteps:
    """Steps of a layer at rest, from zero and from the impulse of the step before."""

    law: str
    scene: str
    steps: int
    cold: Repeats
    """CPU time of all steps from zero [s]."""
    warm: Repeats
    """CPU time of all steps from the last impulse [s]."""
    cold_visits: int
    warm_visits: int
    difference: float
    """Largest |v_warm - v_cold| over the speed with which the layer came down."""
    statuses: tuple[str, ...]


def holds_bench(store: Frames) -> bool:
    """Tell whether a store has the rows of a bench."""
    return bool(store.frame("tasks")["scenario"].isin(RUNS).any())


class Bench:
    """All rows of a bench.

    Args:
        store: anything with `frame(name)` for "tasks", "scores", "series" and "runs".

    Raises:
        ReportError: the store has no bench in it.
    """

    def __init__(self, store: Frames) -> None:
        tasks = store.frame("tasks")
        self._tasks = [row for row in tasks.itertuples() if row.scenario in RUNS]
        if not self._tasks:
            raise ReportError("the store holds no bench; measure one first: impactbench bench")
        self._series = {
            int(row.task): row.columns for row in store.frame("series").itertuples() if row.name in (TIMES, COLD, WARM)
        }
        self._scores: dict[int, list[Any]] = {}
        for row in store.frame("scores").itertuples():
            self._scores.setdefault(int(row.task), []).append(row)
        runs = store.frame("runs")
        self.environment: Mapping[str, Any] = runs["environment"].iloc[-1] if len(runs) else {}
        self.open = sum(row.state != "done" for row in self._tasks)
        """Planned tasks that are not done: the report is incomplete."""

    @cached_property
    def calibrations(self) -> Floats:
        """CPU times of the calibration kernel [s], in the order of the tasks; empty without timings."""
        found = [time for columns in self._series.values() for time in columns.get("calibration_s", ())]
        return np.array(found, dtype=np.float64)

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """Points of the work-precision sweeps, in planned order."""
        timed = self._timed(TIMES)
        return tuple(self._point(row, timed) for row in self._tasks if row.scenario == ERRORS)

    @cached_property
    def scaling(self) -> tuple[Point, ...]:
        """Points of the scaling sweeps, one a law, family and size."""
        timed = self._timed(SCALING)
        firsts: dict[tuple[str, str], Any] = {}
        for row in self._tasks:
            if row.scenario == SCALING:
                key = (row.solver, row.label)
                # A round that was lost is what the point came to, whatever the others did.
                if key not in firsts or _outcome(row) not in (Outcome.MEASURED, None):
                    firsts[key] = row
        return tuple(self._point(row, timed) for row in firsts.values())

    @cached_property
    def first_solves(self) -> tuple[FirstSolve, ...]:
        """Cold and warm, one a law."""
        found: dict[str, list[Mapping[str, float]]] = {}
        for row in self._tasks:
            if row.scenario == COLD and int(row.task) in self._series:
                found.setdefault(row.parameters["law"], []).append(self._series[int(row.task)])
        return tuple(
            FirstSolve(
                law,
                summarize([c["first_s"] for c in rounds]),
                summarize([c["second_s"] for c in rounds]),
            )
            for law, rounds in found.items()
        )

    @cached_property
    def warm_steps(self) -> tuple[WarmSteps, ...]:
        """Cold and warm start over a sequence of impacts, one a law."""
        found: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
        for row in self._tasks:
            if row.scenario == WARM and int(row.task) in self._series:
                found.setdefault((row.parameters["law"], row.label), []).append(self._series[int(row.task)])
        return tuple(
            WarmSteps(
                law, scene, len(rounds[0]["cold_s"]),
                summarize([sum(c["cold_s"]) for c in rounds]), summarize([sum(c["warm_s"]) for c in rounds]),
                sum(rounds[0]["cold_visits"]), sum(rounds[0]["warm_visits"]),
                max(c["difference"] for c in rounds), tuple(rounds[0]["statuses"]),
            )
            for (law, scene), rounds in found.items()
        )  # fmt: skip

    def lost(self) -> list[tuple[str, str, str, str]]:
        """Run, solver, scene and reason of all that ended without an answer, each once."""
        found = {
            (row.solver, row.label): (row.scenario, row.solver, row.label, f"{row.outcome}: {row.reason}")
            for row in reversed(self._tasks)
            if _outcome(row) not in (Outcome.MEASURED, None)
        }
        return list(reversed(found.values()))

    def _timed(self, run: str) -> dict[tuple[str, str], Timed]:
        """Rounds put together, for every solver and scene that has at least one."""
        rounds: dict[tuple[str, str], dict[int, Mapping[str, Any]]] = {}
        for row in self._tasks:
            if row.scenario == run and int(row.task) in self._series:
                key = (row.solver, row.label)
                rounds.setdefault(key, {})[int(row.parameters["round"])] = self._series[int(row.task)]
        return {key: _together(found, self._best_calibration) for key, found in rounds.items()}

    @cached_property
    def _best_calibration(self) -> float:
        return float(self.calibrations.min()) if self.calibrations.size else math.inf

    def _point(self, row: Any, timed: Mapping[tuple[str, str], Timed]) -> Point:
        parameters = row.parameters
        scores = [score for score in self._scores.get(int(row.task), ()) if not math.isnan(score.value)]
        value = parameters["value"]
        return Point(
            law=parameters["law"],
            specification=row.solver,
            setting="" if value is None else f"{parameters['field']} {value:g}",
            scene=row.label,
            family=_family(parameters),
            contacts=int(parameters["contacts"]),
            tags=frozenset(row.tags),
            outcome=_outcome(row),
            reason=_text(row.reason),
            status=_text(row.status),
            iterations=None if _missing(row.iterations) else int(row.iterations),
            visits=None if _missing(row.visits) else int(row.visits),
            errors={score.metric: float(score.value) for score in scores},
            uncertainties={s.metric: float(s.detail["uncertainty"]) for s in scores if "uncertainty" in s.detail},
            timed=timed.get((row.solver, row.label)),
            rows=(int(row.task),),
        )


def laws(points: Iterable[Point]) -> list[str]:
    """Laws of some points, in planned order."""
    return list(dict.fromkeys(point.law for point in points))


def scenes(points: Iterable[Point]) -> list[str]:
    """Labels of the scenes of some points, in planned order."""
    return list(dict.fromkeys(point.scene for point in points))


def sweep(points: Iterable[Point], law: str, scene: str) -> list[Point]:
    """The settings of one law on one scene, from coarse to fine."""
    return [point for point in points if point.law == law and point.scene == scene]


def validation_metric(points: Iterable[Point]) -> str:
    """The reference that the errors of some points are shown against; empty where there is none."""
    found = {metric for point in points for metric in point.errors if metric.startswith("validation: ")}
    return PREFERRED if PREFERRED in found else min(found, default="")


def is_own_reference(law: str, metric: str) -> bool:
    """True where a reference was computed by the law itself: its error would say nothing."""
    return law.partition(":")[0] == "hertz" and metric == PREFERRED


def reach(points: Sequence[Point], metric: str, targets: Sequence[float], *, visits: bool) -> Floats:
    """CPU time [s], or contact visits, at which one law first reaches each error on one scene; ∞ = not reached."""
    errors = [point.error(metric) for point in points]
    costs = [point.work if visits else point.median_s for point in points]
    return cost_to_reach(errors, costs, targets)


def cost_matrix(bench: Bench, *, target: float = COMPARED_AT, visits: bool) -> tuple[list[str], list[str], Floats]:
    """Cost of every law to reach one verification error on every scene.

    Returns:
        Scenes, laws, and costs of shape (scenes, laws), infinite where a law fails. A law that has no verification
        error anywhere is left out: there is nothing to reach.
    """
    points = bench.points
    names = [law for law in laws(points) if any(VERIFICATION in p.errors for p in points if p.law == law)]
    where = scenes(points)
    costs = [
        [float(reach(sweep(points, law, scene), VERIFICATION, [target], visits=visits)[0]) for law in names]
        for scene in where
    ]
    return where, names, np.array(costs, dtype=np.float64).reshape(len(where), len(names))


def exponent(points: Iterable[Point]) -> PowerLaw | None:
    """Fitted growth of the median time over contacts, of converged solves from `FIT_FROM` contacts on; None of one."""
    fitted = [p for p in points if p.contacts >= FIT_FROM and p.converged and math.isfinite(p.median_s)]
    if len({p.contacts for p in fitted}) < 2:
        return None
    return fit_power_law([p.contacts for p in fitted], [p.median_s for p in fitted])


def _together(rounds: Mapping[int, Mapping[str, Any]], best_s: float) -> Timed:
    """All rounds of one solver at one setting on one scene."""
    columns = [rounds[k] for k in sorted(rounds)]
    return Timed(
        repeats=summarize([time for c in columns for time in c["cpu_s"]]),
        rounds={k: float(np.median(rounds[k]["cpu_s"])) for k in sorted(rounds)},
        wall_s=float(np.median([time for c in columns for time in c["wall_s"]])),
        fresh_s=float(np.median([c["fresh_s"] for c in columns])),
        memory_bytes=max(float(c["memory_bytes"]) for c in columns),
        noisy=sum(is_noisy(max(c["calibration_s"]), best_s) for c in columns),
    )


def _family(parameters: Mapping[str, Any]) -> str:
    """Name and parameters without the size: "sphere-pack, hot"."""
    kept = [str(value) for key, value in parameters["parameters"].items() if key == "start"]
    if parameters["scene"] == "sphere-pack" and not kept:
        kept = ["kick"]
    return ", ".join([str(parameters["scene"]), *kept])


def _outcome(row: Any) -> Outcome | None:
    """How a task ended; None while it is planned only."""
    return None if _missing(row.outcome) else Outcome(row.outcome)


def _text(value: Any) -> str:
    return "" if _missing(value) else str(value)


def _missing(value: Any) -> bool:
    return bool(pd.isna(value))

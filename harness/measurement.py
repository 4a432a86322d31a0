"""The nouns of the harness: a task that is planned, the scores that it gave, and how it ended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum


class Verdict(Enum):
    """What a score says."""

    PASS = "pass"
    FAIL = "fail"
    NOT_APPLICABLE = "n/a"
    """The scene has nothing to measure here (value NaN)."""
    SHOWN = "shown"
    """Measured and printed, but no tolerance gates it."""


class Outcome(Enum):
    """How a task ended. Everything but MEASURED is a row with a reason, and counts in every aggregate."""

    MEASURED = "measured"
    REFUSED = "refused"
    """The solver raised `UnsupportedProblem`."""
    RAISED = "raised"
    """The solver raised any other exception."""
    INVALID = "invalid"
    """The answer broke the contract: wrong shape, wrong type, NaN."""
    CRASHED = "crashed"
    """The child process died."""
    TIMED_OUT = "timed out"
    """The child process was killed at the time limit."""
    OUT_OF_MEMORY = "out of memory"
    """The memory limit was reached."""


@dataclass(frozen=True)
class Score:
    """One number of one task; dimensionless, with what it is gated by."""

    name: str
    """What is judged: one of DESIDERATA, or "invariance", "robustness", "termination", "scale", "claim", "error"."""

    metric: str
    """Which number of it: "energy gained", "worst symmetry residual", …"""

    value: float
    """The number; NaN where it does not apply."""

    verdict: Verdict

    tolerance: float = math.nan
    """The bound that gates `value`; NaN where none does."""

    margin: float = math.nan
    """Distance to the bound, positive = pass. Upper bound: log10(tolerance / value), decades. Lower: value - bound."""

    reference: str = ""
    """Name of the reference that an error is measured against; empty where there is none."""

    detail: Mapping[str, object] = field(default_factory=dict)
    """JSON-able particulars: which symmetry, which contact, which disturbance."""


DESIDERATA = ("WAV", "BRK", "SYM", "KIN", "MOM", "ONE")


@dataclass(frozen=True)
class Series:
    """Numbers for a figure, stored so that no report has to solve anything again."""

    name: str
    """What they are: "solution", "three-ball sweep", "cradles", "disturbed cradle"."""

    columns: Mapping[str, object]
    """JSON-able columns, name → list (of lists)."""


@dataclass(frozen=True)
class Measurement:
    """All that one task measured."""

    status: str
    """The solver's status label on the scene itself ("converged", …)."""

    iterations: int
    visits: int
    scores: tuple[Score, ...]
    series: tuple[Series, ...] = ()


class Kind(Enum):
    """What a task does."""

    IMPACT = "impact"
    """All scores of one solver on one scenario."""
    SWEEP = "sweep"
    """One solver over a family of scenes: the wave effect on chains, the disturbed cradle."""
    HARD_CASE = "hard case"
    """One solve of one scene on which laws break, and what it came to."""
    SIMULATION = "simulation"
    """A moving scene: the whole run, or the impact of one of its steps."""


@dataclass(frozen=True)
class Task:
    """One planned piece of work; equal tasks are the same work."""

    kind: Kind
    solver: str
    """Solver specification as the user gives it: "qce", "qce:tolerance=1e-8", "my_law.py:MyLaw"."""
    scenario: str
    """Name in `CATALOG`, or in `SWEEPS` for a sweep."""
    parameters: Mapping[str, object]
    """The family's parameters, JSON-able."""
    seed: int


class InvalidSolution(Exception):
    """A solver's answer breaks the contract; the text says how."""


def upper_bound(
    name: str,
    metric: str,
    value: float,
    tolerance: float,
    reference: str = "",
    detail: Mapping[str, object] | None = None,
) -> Score:
    """Score a residual that passes when value ≤ tolerance; a NaN value fails."""
    verdict = Verdict.PASS if value <= tolerance else Verdict.FAIL
    if value > 0:
        margin = math.log10(tolerance / value) if math.isfinite(value) else -math.inf
    else:
        margin = math.inf if value <= 0 else math.nan
    return Score(name, metric, value, verdict, tolerance, margin, reference, detail or {})


def lower_bound(
    name: str,
    metric: str,
    value: float,
    tolerance: float,
    reference: str = "",
    detail: Mapping[str, object] | None = None,
) -> Score:
    """Score a number that passes when value ≥ tolerance; a NaN value fails."""
    verdict = Verdict.PASS if value >= tolerance else Verdict.FAIL
    return Score(name, metric, value, verdict, tolerance, value - tolerance, reference, detail or {})


def shown(
    name: str, metric: str, value: float, reference: str = "", detail: Mapping[str, object] | None = None
) -> Score:
    """Score that is printed without a gate."""
    return Score(name, metric, value, Verdict.SHOWN, reference=reference, detail=detail or {})


def not_applicable(name: str, metric: str, reason: str) -> Score:
    """Score of something that the scene does not have."""
    return Score(name, metric, math.nan, Verdict.NOT_APPLICABLE, detail={"reason": reason})

"""A store made by hand: the frames that claims and reports read, filled row by row."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from harness.measurement import DESIDERATA
from solvers.solution import Floats

TASK_COLUMNS = (
    "task", "run", "kind", "solver", "settings", "scenario", "parameters", "label", "tags", "seed", "state", "outcome",
    "reason", "status", "iterations", "visits", "wall_s", "peak_memory_mb",
)  # fmt: skip
SCORE_COLUMNS = (
    "score", "task", "name", "metric", "value", "tolerance", "verdict", "margin", "reference", "detail",
)  # fmt: skip
SERIES_COLUMNS = ("series", "task", "name", "columns")
RUN_COLUMNS = ("run", "started", "finished", "version", "environment", "settings", "command")


class HandmadeStore:
    """Frames with the store's columns; every method adds one row and returns its number."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[Any, ...]]] = {"tasks": [], "scores": [], "series": [], "runs": []}
        environment = {"commit": "0123abc", "python": "3.11", "numpy": "2.0", "cpu": "a_cpu & more", "cores": 2}
        settings = {"seed": 7, "timeout_s": 60.0}
        run = (1, "2026-01-02T03:04:05+00:00", None, "0.1.0", environment, settings, "impactbench scorecard")
        self.rows["runs"].append(run)

    def frame(self, name: str) -> pd.DataFrame:
        """One table as the store returns it."""
        columns = {"tasks": TASK_COLUMNS, "scores": SCORE_COLUMNS, "series": SERIES_COLUMNS, "runs": RUN_COLUMNS}
        return pd.DataFrame(self.rows[name], columns=list(columns[name]))

    def task(
        self, solver: str, scenario: str, *, kind: str = "impact", outcome: str | None = "measured", reason: str = "",
        status: str | None = "converged", iterations: int | None = 3, parameters: Mapping[str, Any] | None = None,
    ) -> int:  # fmt: skip
        """A task that is done, or planned only where the outcome is None."""
        number = len(self.rows["tasks"]) + 1
        measured = outcome == "measured"
        self.rows["tasks"].append((
            number, 1, kind, solver, {}, scenario, dict(parameters or {}), f"{scenario}()", [], 0,
            "planned" if outcome is None else "done", outcome, reason, status if measured else None,
            iterations if measured else None, 10 if measured else None, 0.1, 50.0,
        ))  # fmt: skip
        return number

    def score(
        self, task: int, name: str, value: float, *, metric: str = "residual", tolerance: float = 1e-9,
        verdict: str | None = None, reference: str = "", detail: Mapping[str, Any] | None = None,
    ) -> int:  # fmt: skip
        """A gated upper bound; any verdict can be forced."""
        number = 100 * task + len([row for row in self.rows["scores"] if row[1] == task])
        said = verdict or ("pass" if value <= tolerance else "fail")
        gated = said in ("pass", "fail")
        margin = (
            math.log10(tolerance / value) if gated and value > 0 else math.inf if gated and value == 0 else math.nan
        )
        self.rows["scores"].append((
            number, task, name, metric, value, tolerance if gated else math.nan, said, margin, reference,
            dict(detail or {}),
        ))  # fmt: skip
        return number

    def series(self, task: int, name: str, columns: Mapping[str, Any]) -> int:
        """A series of one task."""
        number = 100 * task + len([row for row in self.rows["series"] if row[1] == task])
        self.rows["series"].append((number, task, name, dict(columns)))
        return number

    def all_six(self, solver: str, *, failing: Sequence[str] = (), value: float = 1e-15) -> int:
        """A scene on which a solver passes all desiderata but some."""
        task = self.task(solver, "pool-break")
        for name in DESIDERATA:
            self.score(task, name, 0.5 if name in failing else value)
        return task


def qce_law(va: Floats) -> Floats:
    """QCE's three balls (va, 0, -1): v_C = va / (2 - va), the others from momentum and energy (Zhang 2015)."""
    v_c = va / (2.0 - va)
    total = va - 1.0 - v_c
    squares = va**2 + 1.0 - v_c**2
    difference = np.sqrt(np.maximum(2.0 * squares - total**2, 0.0))
    return np.column_stack([(total - difference) / 2.0, (total + difference) / 2.0, v_c])


def lcp_law(va: Floats) -> Floats:
    """Elastic Newton LCP of the three balls (va, 0, -1)."""
    return np.column_stack([-(va + 2.0) / 3.0, 2.0 * (va - 1.0) / 3.0, (2.0 * va + 1.0) / 3.0])


def gr_law(va: Floats) -> Floats:
    """Generalized reflections: the LCP's outcome but at va = 0, where the balls exchange their velocities."""
    v = lcp_law(va)
    v[va == 0.0] = (-1.0, 0.0, 0.0)
    return v


def ideal_law(va: Floats) -> Floats:
    """Ideal exchange of the three balls (va, 0, -1)."""
    return np.column_stack([-np.ones_like(va), np.zeros_like(va), va])


VA = np.linspace(0.0, 1.0, 21)


def add_sweep(store: HandmadeStore, solver: str, v_post: Floats, *, hertz: Floats | None = None) -> int:
    """A three-ball sweep over VA of one solver; Hertz as given, else the ideal exchange."""
    task = store.task(solver, "wave", kind="sweep")
    ideal = ideal_law(VA)
    columns = {
        "va": VA.tolist(),
        "v_post": v_post.tolist(),
        "ideal": ideal.tolist(),
        "hertz": (ideal if hertz is None else hertz).tolist(),
        "lcp": lcp_law(VA).tolist(),
    }
    store.series(task, "three-ball sweep", columns)
    cases = [(n, k) for n in (3, 5) for k in range(1, n)]
    exchange = [[0.0] * (n - k) + [1.0] * k for n, k in cases]
    columns = {
        "balls": [n for n, _ in cases],
        "moving": [k for _, k in cases],
        "v_post": exchange,
        "ideal": exchange,
        "hertz": [[v + 0.01 for v in row] for row in exchange],
    }
    store.series(task, "cradles", columns)
    return task


def add_disturbed(store: HandmadeStore, solver: str, *, jump: Mapping[int, float]) -> int:
    """Disturbed cradles of a solver that moves by the disturbance, and in one draw by `jump[balls]`."""
    task = store.task(solver, "disturbance", kind="sweep")
    for balls, leap in jump.items():
        still = [0.0] * (balls - 1) + [1.0]
        for size in (1e-8, 1e-2):
            draws = [[v + size * sign for v in still] for sign in (-1.0, 1.0)] + [[v - leap for v in still]]
            columns = {"balls": balls, "size": size, "v_post": draws, "undisturbed": still, "hertz": still}
            store.series(task, "disturbed cradle", columns)
    return task

"""Cold and warm start over a sequence of impacts: what the last step's impulse saves in the next one.

A layer that comes down, and then rests under gravity, as a moving scene with a fixed step meets it:

    v_pre of step k + 1 = ½ v_post of step k + g Δt        same contacts, restitution 0, no friction

Half of the velocity is taken away because frictionless spheres in a frozen geometry would slide ever faster.
Every solver gets the same problems: they come from the inelastic LCP solved to `SEQUENCE_TOLERANCE` by one method.
Step 0 has no predecessor and is not counted.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.checked import checked_solve
from scenarios import CATALOG
from solvers import ImpactProblem, ImpactSolution, Solver
from solvers.lcp_gradient import AcceleratedProjectedGradient
from solvers.solution import Floats

STEPS = 10
"""Steps after the first one."""
# Speed that gravity gives in a step, of that with which the layer comes down: g Δt = 0.05 v₀.
FALL = 0.05
# Share of the velocity that a step leaves to the next.
KEPT = 0.5
# Tight enough that what a step leaves behind is far below what gravity adds.
SEQUENCE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class WarmStart:
    """One solver over the sequence, from zero and from the last step's impulse; one entry a step."""

    cold_s: tuple[float, ...]
    """CPU time from zero [s]."""
    warm_s: tuple[float, ...]
    """CPU time from the last impulse [s]."""
    cold_visits: tuple[int, ...]
    warm_visits: tuple[int, ...]
    difference: float
    """Largest |v_warm - v_cold| over the speed with which the layer comes down."""
    statuses: tuple[str, ...]
    """Labels of all statuses that occurred, sorted."""


def takes_start(solver: Solver) -> bool:
    """Tell whether a solver can start from an earlier impulse: its `solve` has a parameter `start`."""
    return "start" in inspect.signature(solver.solve).parameters


def resting_layer(spheres: int, *, seed: int = 0) -> Iterator[ImpactProblem]:
    """Yield the impacts of the sequence, `STEPS` + 1 of them.

    Args:
        spheres: of the layer, ≥ 100.
        seed: of the layer.
    """
    scene = CATALOG["sphere-pack"](spheres=spheres, seed=seed, restitution=0.0)
    problem = scene.problem
    method = AcceleratedProjectedGradient(tolerance=SEQUENCE_TOLERANCE)
    fall = np.zeros(problem.n)
    fall[2::3] = -FALL
    for _ in range(STEPS):
        yield problem
        problem = problem.replace(v_pre=KEPT * method.solve(problem).v_post + fall)
    yield problem


def measure_warm_start(solver: Solver, spheres: int, *, seed: int = 0) -> WarmStart:
    """Solve every step of the sequence from zero and from what the same solver found a step before.

    Args:
        solver: one whose `solve` takes a start (`takes_start`).
        spheres: of the layer, ≥ 100.
        seed: of the layer.

    Raises:
        InvalidSolution: an answer breaks the contract.
        UnsupportedProblem: the law does not apply.
    """
    start: Floats | None = None
    cold_s, warm_s, cold_visits, warm_visits, differences = [], [], [], [], []
    statuses = set()
    for problem in resting_layer(spheres, seed=seed):
        # Compiles at the first step, and builds what the problem keeps: both solves below find it there.
        checked_solve(solver, problem)
        cold_time, cold = _timed(solver, problem)
        if start is not None:
            warm_time, warm = _timed(Started(solver, start), problem)
            cold_s.append(cold_time)
            warm_s.append(warm_time)
            cold_visits.append(int(cold.visits))
            warm_visits.append(int(warm.visits))
            differences.append(float(np.abs(warm.v_post - cold.v_post).max()))
            statuses |= {cold.status.label, warm.status.label}
        start = cold.impulse
    return WarmStart(
        tuple(cold_s), tuple(warm_s), tuple(cold_visits), tuple(warm_visits), max(differences),
        tuple(sorted(statuses)),
    )  # fmt: skip


@dataclass(frozen=True)
class Started:
    """A solver with its start."""

    solver: Any
    start: Floats
    """First guess of the normal impulse [N s], shape (m,)."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve from the start."""
        solution: ImpactSolution = self.solver.solve(problem, start=self.start)
        return solution


def _timed(solver: Solver, problem: ImpactProblem) -> tuple[float, ImpactSolution]:
    """CPU time [s] and answer of one solve."""
    begin = time.process_time()
    solution = checked_solve(solver, problem)
    return time.process_time() - begin, solution

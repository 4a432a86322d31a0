"""What a solver claims, checked: the shape of its answer, the velocity that goes with its impulse, its status.

The library judges, never the solver: `checked_solve` is the only way in which the harness calls one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from harness.measurement import InvalidSolution, Score, not_applicable, shown, upper_bound
from solvers import ImpactProblem, ImpactSolution, Solver, Status
from solvers.solution import Floats

Solve: TypeAlias = Callable[[ImpactProblem], ImpactSolution]

# v_post and its recomputation sum the same few products in another order. The bound is relative to the sum of their
# absolute values, so that a light body between heavy ones is not blamed for the rounding of large canceling impulses.
CLAIM_TOLERANCE = 1e-12
# The looser one of the two bounds that `desiderata.one` puts on an answer; who says "converged" must meet it.
HONESTY_TOLERANCE = 1e-9
# Between 0, "the stopping test passed", and 1, "it did not".
TERMINATION_TOLERANCE = 0.5


def ratio(part: float, whole: float) -> float:
    """Return part / whole; 0 where there is no part, infinity where a part stands against nothing."""
    if part == 0.0:
        return 0.0
    return part / whole if whole > 0.0 else math.inf


def checked_solve(solver: Solver, problem: ImpactProblem) -> ImpactSolution:
    """Solve one impact and check that the answer keeps the contract of `solvers.Solver`.

    Args:
        solver: any object with `solve`.
        problem: the impact, m contacts and n velocities.

    Raises:
        InvalidSolution: the answer has the wrong type or shape, or is not finite; the text says which.
        UnsupportedProblem: the law does not apply. Any other exception of the solver passes through as well.
    """
    solution = solver.solve(problem)
    if not isinstance(solution, ImpactSolution):
        raise InvalidSolution(f"solve must return an ImpactSolution, not {type(solution).__name__}")
    _check_array("v_post", solution.v_post, problem.n)
    if solution.impulse is not None:
        _check_array("impulse", solution.impulse, problem.m)
    if solution.friction_impulse is not None:
        _check_array("friction_impulse", solution.friction_impulse, 2 * problem.m)
    if not isinstance(solution.status, Status):
        raise InvalidSolution(f"status must be a Status, not {solution.status!r}")
    _check_count("iterations", solution.iterations)
    _check_count("visits", solution.visits)
    return solution


class Tally:
    """A solver that is checked at every solve, and the count of what its solves cost and came to."""

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self.solves = 0
        self.iterations = 0
        self.visits = 0
        self.unfinished: Counter[str] = Counter()
        """Status label → number of solves that ended with it; "converged" is not counted."""

    def __call__(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve, check and count; raises as `checked_solve` does."""
        solution = checked_solve(self.solver, problem)
        self.solves += 1
        self.iterations += int(solution.iterations)
        self.visits += int(solution.visits)
        if solution.status is not Status.CONVERGED:
            self.unfinished[solution.status.label] += 1
        return solution


def _check_array(field: str, value: object, size: int) -> None:
    """Check one array of an answer: real numbers, one dimension of the right length, all finite."""
    if not isinstance(value, np.ndarray):
        raise InvalidSolution(f"{field} must be a NumPy array, not {type(value).__name__}")
    array: npt.NDArray[np.generic] = value
    if array.dtype.kind not in "fiu":
        raise InvalidSolution(f"{field} must hold real numbers, not {array.dtype}")
    if array.shape != (size,):
        raise InvalidSolution(f"{field} must have shape ({size},), not {array.shape}")
    bad = np.flatnonzero(~np.isfinite(np.asarray(array, dtype=np.float64)))
    if bad.size:
        raise InvalidSolution(f"{field} must be finite: entry {bad[0]} is {array[bad[0]]}")


def _check_count(field: str, value: object) -> None:
    """Check one count of an answer: an integer, zero or more."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise InvalidSolution(f"{field} must be an integer, not {value!r}")
    if value < 0:
        raise InvalidSolution(f"{field} must be ≥ 0, not {value}")


def remaining_approach(problem: ImpactProblem, v_post: Floats) -> float:
    """Fastest approach that is left, max(0, -min u_post), over the largest |u_pre|; dimensionless."""
    return ratio(max(0.0, -float((problem.J @ v_post).min(initial=0.0))), problem.speed)


def unanswered_approach(problem: ImpactProblem, v_post: Floats) -> float:
    """As `remaining_approach`, less what Newton's law leaves: a contact that separated at u may approach at c_r u."""
    left = problem.J @ v_post + problem.restitution * np.maximum(problem.u_pre, 0.0)
    return ratio(max(0.0, -float(left.min(initial=0.0))), problem.speed)


def pulling_impulse(impulse: Floats) -> float:
    """Strongest pull, max(0, -min impulse), over the largest |impulse|; dimensionless."""
    return ratio(max(0.0, -float(impulse.min(initial=0.0))), float(np.abs(impulse).max(initial=0.0)))


def friction_excess(problem: ImpactProblem, solution: ImpactSolution) -> float:
    """Largest |friction impulse| - μ impulse over all directions and contacts, over the largest |impulse|."""
    if solution.impulse is None or solution.friction_impulse is None:
        return 0.0
    bound = np.repeat(problem.friction * solution.impulse, 2)
    excess = float((np.abs(solution.friction_impulse) - bound).max(initial=0.0))
    return ratio(excess, float(np.abs(solution.impulse).max(initial=0.0)))


def velocity_mismatch(problem: ImpactProblem, solution: ImpactSolution) -> float:
    """Distance between the claimed velocity and v_pre + M⁻¹(Jᵀ impulse + Dᵀ friction_impulse), dimensionless.

    Returns:
        The largest difference over the largest sum of the absolute values of what is added up; NaN without an impulse.
    """
    if solution.impulse is None:
        return math.nan
    summands = np.abs(problem.v_pre) + abs(problem.JM).T @ np.abs(solution.impulse)
    if solution.friction_impulse is not None:
        summands = summands + abs(problem.DM).T @ np.abs(solution.friction_impulse)
    difference = solution.v_post - problem.v_after(solution.impulse, solution.friction_impulse)
    return ratio(float(np.abs(difference).max(initial=0.0)), float(summands.max(initial=0.0)))


def claim(problem: ImpactProblem, solution: ImpactSolution) -> tuple[Score, ...]:
    """Score what the solver claims against what the harness recomputes.

    Returns:
        "velocity from impulse", and "converged but not feasible": the worst of unanswered approach, pulling impulse
        and friction outside its cone, where the solver says that it converged.
    """
    if solution.impulse is None:
        velocity = not_applicable("claim", "velocity from impulse", "the solver gives no impulse")
    else:
        mismatch = velocity_mismatch(problem, solution)
        velocity = upper_bound("claim", "velocity from impulse", mismatch, CLAIM_TOLERANCE)
    metric = "converged but not feasible"
    if solution.status is not Status.CONVERGED:
        return velocity, not_applicable("claim", metric, f"the solver does not claim to: {solution.status}")
    parts = {
        "unanswered approach": unanswered_approach(problem, solution.v_post),
        "pulling impulse": 0.0 if solution.impulse is None else pulling_impulse(solution.impulse),
        "friction outside its cone": friction_excess(problem, solution),
    }
    return velocity, upper_bound("claim", metric, max(parts.values()), HONESTY_TOLERANCE, detail=parts)


def termination(solution: ImpactSolution, *, tags: frozenset[str]) -> tuple[Score, ...]:
    """Score how the computation ended: its own stopping test passed (0) or not (1), iterations, contact visits.

    On "jammed" scenes the first is shown without a gate: by Gordan's alternative no elastic iteration need end there.
    """
    missed = 0.0 if solution.status is Status.CONVERGED else 1.0
    detail = {"status": solution.status.label, "happened": solution.status.happened}
    if "jammed" in tags:
        ended = shown("termination", "stopping test missed", missed, detail=detail)
    else:
        ended = upper_bound("termination", "stopping test missed", missed, TERMINATION_TOLERANCE, detail=detail)
    return (
        ended,
        shown("termination", "iterations", float(solution.iterations)),
        shown("termination", "contact visits", float(solution.visits)),
    )

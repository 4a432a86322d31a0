"""Pairwise propagation: each violated contact is resolved as if it were alone.

    λ_i += -(1 + c_r) u_i / W_ii     for every contact with u_i < -tol

`gauss-seidel` goes through the contacts in order and uses each new velocity at once: the result depends on the order,
and symmetry is lost. `jacobi` takes all violated contacts from the old velocity: symmetric, but bodies that share
contacts gain energy. They are the scorecard's negative controls. Sources: Smith 2012, Section 3; Zhang 2015, Section 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.boxed_lcp import MAX_VISITS
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem

Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class GaussSeidel:
    """One violated contact at a time, in order; one iteration is one pass over the contacts."""

    tolerance: float = 1e-10
    """A contact is violated when u < -tolerance times the largest |u_pre|; dimensionless."""

    max_iterations: int = 20_000
    """Bound on passes."""

    max_visits: int = MAX_VISITS
    """Bound on contact visits."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; any restitution per contact, no friction."""
        return _propagate(problem, _gauss_seidel, self.tolerance, self.max_iterations, self.max_visits)


@dataclass(frozen=True)
class Jacobi:
    """All violated contacts from the same velocity; one iteration is one pass over the contacts."""

    tolerance: float = 1e-10
    """A contact is violated when u < -tolerance times the largest |u_pre|; dimensionless."""

    max_iterations: int = 20_000
    """Bound on passes."""

    max_visits: int = MAX_VISITS
    """Bound on contact visits."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; any restitution per contact, no friction."""
        return _propagate(problem, _jacobi, self.tolerance, self.max_iterations, self.max_visits)


def _propagate(
    problem: ImpactProblem, passes: object, tolerance: float, max_iterations: int, max_visits: int
) -> ImpactSolution:
    """Run one of the two kernels and judge what it reached.

    The velocity is the one that was carried along: between bodies that are squeezed from both sides the impulses grow
    without bound, and the difference of their sums loses digits that the velocity itself keeps.
    """
    if problem.has_friction:
        raise UnsupportedProblem("pairwise propagation has no friction: friction must be 0")
    J, JM = problem.J, problem.JM
    # The last pass finds nothing, or is followed by none: it is counted beside those that strike.
    max_passes = max(min(max_iterations, max_visits // max(problem.m, 1) - 1), 0)
    impulse, v, iterations, finite = passes(  # type: ignore[operator]
        J.indptr, J.indices, J.data, JM.indptr, JM.indices, JM.data, problem.W_diagonal, problem.restitution,
        problem.v_pre, tolerance * problem.speed, max_passes,
    )  # fmt: skip
    u_min = float((J @ v).min(initial=0.0))
    if not finite:
        status = Status.NOT_FINITE
    elif u_min < -tolerance * problem.speed:
        status = Status.ITERATION_LIMIT
    else:
        status = Status.CONVERGED
    residual = max(0.0, -u_min) / (problem.speed or 1.0)
    return ImpactSolution(impulse, v, status, iterations, problem.m * (iterations + 1), residual)


@kernel
def _gauss_seidel(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats,
    W_diagonal: Floats, e: Floats, v_pre: Floats, threshold: float, max_iterations: int,
) -> tuple[Floats, Floats, int, bool]:  # fmt: skip
    """Passes in contact order; returns impulse, velocity, passes, whether all stayed finite."""
    m = W_diagonal.size
    impulse = np.zeros(m)
    v = v_pre.copy()
    for iteration in range(max_iterations):
        hit = False
        for i in range(m):
            u = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                u += J[q] * v[J_index[q]]
            if u < -threshold:
                hit = True
                p = -(1.0 + e[i]) * u / W_diagonal[i]
                impulse[i] += p
                for q in range(JM_start[i], JM_start[i + 1]):
                    v[JM_index[q]] += p * JM[q]
        if not hit:
            return impulse, v, iteration, True
    return impulse, v, max_iterations, True


@kernel
def _jacobi(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats,
    W_diagonal: Floats, e: Floats, v_pre: Floats, threshold: float, max_iterations: int,
) -> tuple[Floats, Floats, int, bool]:  # fmt: skip
    """Passes from the old velocity; stops at the last finite state; returns as `_gauss_seidel`."""
    m = W_diagonal.size
    impulse = np.zeros(m)
    v = v_pre.copy()
    p = np.zeros(m)
    for iteration in range(max_iterations):
        hit = False
        for i in range(m):
            u = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                u += J[q] * v[J_index[q]]
            p[i] = 0.0
            if u < -threshold:
                hit = True
                p[i] = -(1.0 + e[i]) * u / W_diagonal[i]
        if not hit:
            return impulse, v, iteration, True
        for i in range(m):
            # Energy gained at every pass may grow without bound: stop before it overflows.
            if not p[i] < 1e100 * (1.0 + threshold):
                return impulse, v, iteration, False
        for i in range(m):
            impulse[i] += p[i]
            for q in range(JM_start[i], JM_start[i + 1]):
                v[JM_index[q]] += p[i] * JM[q]
    return impulse, v, max_iterations, True

"""Quadratic contact energy (QCE): every contact's impulse grows with its own approach, until its energy is returned.

    F = max(-u, 0),  P(s) = s F,   0 = e_i(s) = ∫ u_i ds   defines the end s_i of contact i,   λ_i = F_i s_i

All active contacts load together in one clock s. Contact i ends when the work done over it is back at zero; its
neighbors then go on without it. When none is active the velocities are updated and the iteration starts again with
what still approaches. Work over each contact is zero, hence the kinetic energy is conserved to rounding.

Source: Zhang et al. 2015, "Quadratic Contact Energy Model for Multi-impact Simulation", Algorithm 1, with these
corrections: lines 20-23 need F_i S_k as the current impulse, F_k / 2 and F_i in the updates and a minus in that of A;
line 33 tests the relative velocities. The equation is kept as e + v t + ½ w t² about the last update instead of
A P² + B P + C, and w is summed anew after every end: by subtraction it cancels and up to 18 % of the energy is lost.
"The larger root" (Section 3.3) is wrong for w < 0; the first upward zero crossing is right for either sign.

Two implementations give the same answer: `qce_heap` for small problems, `qce_stream` for large ones.

paper → here: S → end, J q̇ → u, A → w/2, B → v, C → e (all three divided by F_i, about the last update).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from solvers import qce_stream, recovery
from solvers._jit import kernel
from solvers.problem import ImpactProblem
from solvers.qce_heap import solve_by_heap
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem
from solvers.sphere_rows import sphere_rows

Ints = npt.NDArray[np.int32]
Indices = npt.NDArray[np.uint32]

# Up to here the heap is as fast (sphere packs: equal near 300 contacts, the stream twice as fast at 800; measured).
SMALL = 200
# An evaluation of `qce_stream` costs the square of a contact's neighbors, the heap's only their number.
MOST_CONTACTS_OF_A_BODY = 32


@dataclass(frozen=True)
class QuadraticContactEnergy:
    """QCE as published: every contact that approaches loads (Zhang 2015)."""

    tolerance: float = 1e-10
    """A contact approaches when u < -tolerance times the largest |u_pre|; dimensionless."""

    max_iterations: int = 10_000
    """Bound on outer iterations (compression phases)."""

    recover_after: int = 0
    """Outer iterations after which what still approaches is resolved inelastically; 0 = never (the published law)."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; restitution and friction must be 1 and 0 (see `QceLcp` for others)."""
        require_elastic(problem, "qce")
        if self.recover_after:
            return recovery.resolve(
                problem, replace(self, recover_after=0, max_iterations=self.recover_after).solve(problem)
            )
        return solve_elastic(problem, defer=0.0, tolerance=self.tolerance, max_iterations=self.max_iterations)


@dataclass(frozen=True)
class DeferredContactEnergy:
    """QCE in which contacts that hardly approach wait for the next outer iteration.

    The published law jumps by up to 0.3 of the impact velocity under a disturbance of 1e-8 (four or more balls in a
    cradle), against Section 5.5 of Zhang 2015. Waiting removes the jump.
    """

    defer: float = 0.1
    """Contacts with F_i < defer · max F wait for the next outer iteration; 0 is the published law. Dimensionless."""

    tolerance: float = 1e-10
    """A contact approaches when u < -tolerance times the largest |u_pre|; dimensionless."""

    max_iterations: int = 10_000
    """Bound on outer iterations (compression phases)."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; restitution and friction must be 1 and 0."""
        require_elastic(problem, "qce-defer")
        return solve_elastic(problem, defer=self.defer, tolerance=self.tolerance, max_iterations=self.max_iterations)


def require_elastic(problem: ImpactProblem, law: str) -> None:
    """Refuse a problem that is not elastic and frictionless.

    Raises:
        UnsupportedProblem: restitution differs from 1 or friction from 0.
    """
    if (problem.restitution != 1.0).any():
        raise UnsupportedProblem(f"{law} is an elastic law: restitution must be 1 (qce-lcp takes any)")
    if problem.has_friction:
        raise UnsupportedProblem(f"{law} has no friction: friction must be 0 (qce-lcp takes any)")


def solve_elastic(problem: ImpactProblem, *, defer: float, tolerance: float, max_iterations: int) -> ImpactSolution:
    """Run QCE's outer iteration on a problem, whatever its restitution and friction say.

    Args:
        problem: bodies, contacts, velocities.
        defer: contacts with F_i < defer · max F wait for the next outer iteration; dimensionless.
        tolerance: a contact approaches when u < -tolerance times the largest |u_pre|; dimensionless.
        max_iterations: bound on outer iterations.
    """
    speed = problem.speed
    threshold = speed * tolerance
    impulse, iterations, visits, stalled = _outer_iterations(problem, threshold, defer, max_iterations)
    J, JM = problem.J, problem.JM
    v, u_min = _outcome(
        J.indptr, J.indices.view(np.uint32), J.data, JM.indptr, JM.indices.view(np.uint32), JM.data,
        problem.v_pre, impulse,
    )  # fmt: skip
    if not np.isfinite(v).all():
        status = Status.NOT_FINITE
    elif stalled:
        status = Status.STALLED
    elif iterations >= max_iterations and u_min < -threshold:
        status = Status.ITERATION_LIMIT
    else:
        status = Status.CONVERGED
    return ImpactSolution(impulse, v, status, iterations, visits, max(-u_min, 0.0) / (speed or 1.0))


def _outer_iterations(
    problem: ImpactProblem, threshold: float, defer: float, max_iterations: int
) -> tuple[Floats, int, int, bool]:
    """Choose between heap and stream, which give the same; impulse, outer iterations, contact visits, stalled."""
    if problem.m >= SMALL and np.diff(problem.MJT.indptr).max(initial=0) <= MOST_CONTACTS_OF_A_BODY:
        rows = sphere_rows(problem)
        if rows is None:
            streamed = qce_stream.solve_sparse(problem, threshold=threshold, defer=defer, max_iterations=max_iterations)
        else:
            streamed = qce_stream.solve_spheres(rows, threshold=threshold, defer=defer, max_iterations=max_iterations)
        impulse, iterations, visits, flag = streamed
        if flag != qce_stream.RESTLESS:
            if rows is not None:
                impulse = rows.in_problem_order(impulse)
            return impulse, iterations, visits, flag == qce_stream.STALLED
    return solve_by_heap(problem, threshold=threshold, defer=defer, max_iterations=max_iterations)


@kernel
def _outcome(
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    v_pre: Floats, impulse: Floats,
) -> tuple[Floats, float]:  # fmt: skip
    """Velocity after an impulse, and the smallest u, at most 0; in a kernel, as sparse products cost 30 µs a call."""
    v = v_pre.copy()
    for i in range(impulse.size):
        if impulse[i] != 0.0:
            for q in range(JM_start[i], JM_start[i + 1]):
                v[JM_index[q]] += JM[q] * impulse[i]
    u_min = 0.0
    for i in range(impulse.size):
        u = 0.0
        for q in range(J_start[i], J_start[i + 1]):
            u += J[q] * v[J_index[q]]
        u_min = min(u_min, u)
    return v, u_min

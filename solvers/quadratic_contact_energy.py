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
from typing import NamedTuple, TypedDict

import numpy as np
import numpy.typing as npt

from solvers import qce_stream, recovery
from solvers._jit import kernel
from solvers.problem import ImpactProblem
from solvers.qce_heap import MAX_VISITS, solve_by_heap
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem
from solvers.sphere_rows import SphereRows, sphere_rows

Ints = npt.NDArray[np.int32]
Indices = npt.NDArray[np.uint32]

# Up to here the heap is as fast: equal on a rack of 136 contacts, where packing takes half of the stream's time; a
# sphere pack of 299 takes the stream a third of the heap's time (measured).
SMALL = 100
# The stream holds the couplings of all pairs of a body's active contacts, the square of their number.
MOST_CONTACTS_OF_A_BODY = 32


@dataclass(frozen=True)
class QuadraticContactEnergy:
    """QCE as published: every contact that approaches loads (Zhang 2015)."""

    tolerance: float = 1e-10
    """A contact approaches when u < -tolerance times the largest |u_pre|; dimensionless."""

    max_iterations: int = 10_000
    """Bound on outer iterations (compression phases)."""

    max_visits: int = MAX_VISITS
    """Bound on contact visits; the default is about a minute on one thread."""

    recover_after: int = 0
    """Outer iterations after which what still approaches is resolved inelastically; 0 = never (the published law)."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; restitution and friction must be 1 and 0 (see `QceLcp` for others)."""
        require_elastic(problem, "qce")
        if self.recover_after:
            return recovery.resolve(
                problem, replace(self, recover_after=0, max_iterations=self.recover_after).solve(problem)
            )
        return solve_elastic(
            problem,
            defer=0.0,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            max_visits=self.max_visits,
        )


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

    max_visits: int = MAX_VISITS
    """Bound on contact visits; the default is about a minute on one thread."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; restitution and friction must be 1 and 0."""
        require_elastic(problem, "qce-defer")
        return solve_elastic(
            problem,
            defer=self.defer,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            max_visits=self.max_visits,
        )


def require_elastic(problem: ImpactProblem, law: str) -> None:
    """Refuse a problem that is not elastic and frictionless.

    Raises:
        UnsupportedProblem: restitution differs from 1 or friction from 0.
    """
    if (problem.restitution != 1.0).any():
        raise UnsupportedProblem(f"{law} is an elastic law: restitution must be 1 (qce-lcp takes any)")
    if problem.has_friction:
        raise UnsupportedProblem(f"{law} has no friction: friction must be 0 (qce-lcp takes any)")


def solve_elastic(
    problem: ImpactProblem,
    *,
    defer: float,
    tolerance: float,
    max_iterations: int,
    max_visits: int = MAX_VISITS,
) -> ImpactSolution:
    """Run QCE's outer iteration on a problem, whatever its restitution and friction say.

    Args:
        problem: bodies, contacts, velocities.
        defer: contacts with F_i < defer · max F wait for the next outer iteration; dimensionless.
        tolerance: a contact approaches when u < -tolerance times the largest |u_pre|; dimensionless.
        max_iterations: bound on outer iterations.
        max_visits: bound on contact visits.
    """
    speed = problem.speed
    threshold = speed * tolerance
    settings = _Settings(threshold=threshold, defer=defer, max_iterations=max_iterations, max_visits=max_visits)
    reached = None
    if problem.m >= SMALL and _most_contacts(problem.JM.indices, problem.n) <= MOST_CONTACTS_OF_A_BODY:
        rows = sphere_rows(problem)
        reached = _stream_sparse(problem, settings) if rows is None else _stream_spheres(problem, rows, settings)
    if reached is None:
        impulse, iterations, visits, stalled = solve_by_heap(problem, **settings)
        reached = _Reached(impulse, *_outcome_of(problem, impulse), iterations, visits, stalled)
    if not np.isfinite(reached.v).all():
        status = Status.NOT_FINITE
    elif reached.stalled:
        status = Status.STALLED
    elif reached.approach > threshold and (reached.iterations >= max_iterations or reached.visits >= max_visits):
        status = Status.ITERATION_LIMIT
    else:
        status = Status.CONVERGED
    residual = reached.approach / (speed or 1.0)
    return ImpactSolution(reached.impulse, reached.v, status, reached.iterations, reached.visits, residual)


class _Settings(TypedDict):
    """What heap and stream are told."""

    threshold: float
    defer: float
    max_iterations: int
    max_visits: int


class _Reached(NamedTuple):
    """What heap and stream come to; `approach` is the largest -u afterwards [m/s], at least 0."""

    impulse: Floats
    v: Floats
    approach: float
    iterations: int
    visits: int
    stalled: bool


def _stream_spheres(problem: ImpactProblem, rows: SphereRows, settings: _Settings) -> _Reached | None:
    """Stream packed contacts; None where no fixed point was found."""
    impulse, iterations, visits, flag = qce_stream.solve_spheres(rows, **settings)
    if flag == qce_stream.RESTLESS:
        return None
    v = rows.velocity_in_problem_order(rows.V, problem.n)
    approach = qce_stream.largest_approach(rows)
    return _Reached(rows.in_problem_order(impulse), v, approach, iterations, visits, flag == qce_stream.STALLED)


def _stream_sparse(problem: ImpactProblem, settings: _Settings) -> _Reached | None:
    """Stream sparse matrices; None where no fixed point was found."""
    impulse, iterations, visits, flag = qce_stream.solve_sparse(problem, **settings)
    if flag == qce_stream.RESTLESS:
        return None
    return _Reached(impulse, *_outcome_of(problem, impulse), iterations, visits, flag == qce_stream.STALLED)


def _outcome_of(problem: ImpactProblem, impulse: Floats) -> tuple[Floats, float]:
    """Velocity after an impulse, and the largest approach velocity then, at least 0."""
    J, JM = problem.J, problem.JM
    return _outcome(
        J.indptr, J.indices.view(np.uint32), J.data, JM.indptr, JM.indices.view(np.uint32), JM.data,
        problem.v_pre, impulse,
    )  # fmt: skip


@kernel
def _most_contacts(JM_index: Ints, n: int) -> int:
    """Most contacts that change one velocity."""
    count = np.zeros(n, np.int32)
    for d in JM_index:
        count[d] += 1
    most = 0
    for d in range(n):
        most = max(most, count[d])
    return most


@kernel
def _outcome(
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    v_pre: Floats, impulse: Floats,
) -> tuple[Floats, float]:  # fmt: skip
    """Velocity after an impulse, and the largest -u, at least 0; in a kernel, as sparse products cost 30 µs a call."""
    v = v_pre.copy()
    for i in range(impulse.size):
        if impulse[i] != 0.0:
            for q in range(JM_start[i], JM_start[i + 1]):
                v[JM_index[q]] += JM[q] * impulse[i]
    approach = 0.0
    for i in range(impulse.size):
        u = 0.0
        for q in range(J_start[i], J_start[i + 1]):
            u += J[q] * v[J_index[q]]
        approach = max(approach, -u)
    return v, approach

"""Generalized reflections (GR): reflect all violated contacts together, again and again.

    V = {i : u_i < -tol},   λ_V solves the inelastic LCP on V alone,   v += 2 M⁻¹ J_Vᵀ λ_V,   until V is empty

Each reflection doubles the inelastic impulse, hence keeps the kinetic energy. Restitution (GRR) is the mean
(1 - c_r) inelastic LCP + c_r GR with one c_r for all contacts; friction is one maximum-dissipation solve afterwards
with the normal impulses held. Source: Smith 2012, "Reflections on simultaneous impact"; termination: Vouga 2017. The
original has no bound on iterations; this one has and says when it is reached. The inner LCP must be solved more
tightly than the tolerance on u: on packs the result is off by 10 % otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from solvers import boxed_lcp, recovery
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem


@dataclass(frozen=True)
class GeneralizedReflections:
    """Generalized reflections with one restitution (Smith 2012); one iteration is one reflection."""

    tolerance: float = 1e-10
    """A contact is violated when u < -tolerance times the largest |u_pre|; dimensionless."""

    inner_tolerance: float = 1e-13
    """Natural-map residual of the inelastic LCP on the violated contacts, relative to the largest |u_pre|."""

    max_iterations: int = 5_000
    """Bound on reflections; a light ball under a mass of 10⁶ takes 3,141."""

    max_inner_sweeps: int = 20_000
    """Bound on the sweeps of one inelastic LCP, and of the friction solve."""

    recover_after: int = 0
    """Reflections after which what still approaches is resolved inelastically; 0 = never (the published law)."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact.

        Raises:
            UnsupportedProblem: the contacts have different restitution.
        """
        restitution = one_restitution(problem, "generalized reflections take")
        if self.recover_after:
            return recovery.resolve(
                problem, replace(self, recover_after=0, max_iterations=self.recover_after).solve(problem)
            )
        impulse, status, iterations, visits = np.zeros(problem.m), Status.CONVERGED, 0, 0
        if restitution > 0.0:
            impulse, status, iterations, visits = self._reflect(problem)
        if restitution < 1.0:
            plastic = boxed_lcp.project(
                problem, np.zeros(problem.m), tolerance=self.inner_tolerance, max_sweeps=self.max_inner_sweeps
            )
            impulse = (1.0 - restitution) * plastic.impulse + restitution * impulse
            iterations += 1
            visits += plastic.visits
            status = _worse(status, plastic.residual, self.tolerance)
        friction_impulse = None
        if problem.has_friction:
            friction = boxed_lcp.dissipate(problem, impulse, tolerance=self.tolerance, max_sweeps=self.max_inner_sweeps)
            friction_impulse = friction.friction_impulse
            visits += friction.visits
            status = _worse(status, friction.residual, self.tolerance)
        v_post = problem.v_after(impulse, friction_impulse)
        if not np.isfinite(v_post).all():
            status = Status.NOT_FINITE
        u_min = float((problem.J @ v_post).min(initial=0.0))
        residual = max(-u_min, 0.0) / (problem.speed or 1.0)
        if problem.has_friction:
            # The friction solve moves the normal velocities, and the law has no second look at them.
            status = _worse(status, residual, self.tolerance)
        return ImpactSolution(impulse, v_post, status, iterations, visits, residual, friction_impulse)

    def _reflect(self, problem: ImpactProblem) -> tuple[Floats, Status, int, int]:
        """Reflect until no contact is violated; impulse, status, reflections, contact visits."""
        impulse = np.zeros(problem.m)
        rest = np.zeros(problem.m)
        v = problem.v_pre.copy()
        status = Status.CONVERGED
        visits = 0
        for iteration in range(self.max_iterations + 1):
            violated = np.flatnonzero(problem.J @ v < -self.tolerance * problem.speed).astype(np.int32)
            visits += problem.m
            if violated.size == 0:
                return impulse, status, iteration, visits
            if iteration == self.max_iterations:
                break
            inner = boxed_lcp.project(
                problem,
                rest,
                rows=violated,
                v_start=v,
                tolerance=self.inner_tolerance,
                max_sweeps=self.max_inner_sweeps,
            )
            visits += inner.visits
            # Twice the change: the reflection of v about the face of the inelastic outcome.
            v = 2.0 * inner.v - v
            impulse += 2.0 * inner.impulse
            if inner.residual > self.tolerance:
                # An inner LCP that is not solved to the tolerance on u spoils everything after it.
                status = Status.STALLED
        return impulse, Status.ITERATION_LIMIT, self.max_iterations, visits


def one_restitution(problem: ImpactProblem, law: str) -> float:
    """Return the one restitution of all contacts; 1 without contacts.

    Raises:
        UnsupportedProblem: there is more than one.
    """
    if problem.m == 0:
        return 1.0
    if problem.restitution.min() != problem.restitution.max():
        raise UnsupportedProblem(f"{law} one restitution for all contacts")
    return float(problem.restitution[0])


def _worse(status: Status, residual: float, tolerance: float) -> Status:
    return Status.STALLED if status is Status.CONVERGED and residual > tolerance else status

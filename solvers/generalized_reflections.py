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

from solvers import boxed_lcp, cone_projection, recovery
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

    max_visits: int = boxed_lcp.MAX_VISITS
    """Bound on contact visits: of the reflections together, of the inelastic LCP, and of the friction solve."""

    recover_after: int = 0
    """Reflections after which what still approaches is resolved inelastically; 0 = never (the published law)."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact.

        Raises:
            UnsupportedProblem: the contacts have different restitution, or bodies have too many of them.
        """
        restitution = one_restitution(problem, "generalized reflections take")
        if self.recover_after:
            return recovery.resolve(
                problem, replace(self, recover_after=0, max_iterations=self.recover_after).solve(problem)
            )
        solution = self._reflect(problem) if restitution == 1.0 else self._mean(problem, restitution)
        return self._with_friction(problem, solution) if problem.has_friction else solution

    def _reflect(self, problem: ImpactProblem) -> ImpactSolution:
        """Reflect until no contact is violated: the elastic law."""
        speed = problem.speed or 1.0
        impulse, v, iterations, left, visits, inner_residual = cone_projection.reflect(
            problem,
            threshold=self.tolerance * problem.speed,
            tolerance=self.inner_tolerance * speed,
            max_iterations=self.max_iterations,
            max_sweeps=self.max_inner_sweeps,
            max_visits=self.max_visits,
        )
        if not np.isfinite(v).all():
            status = Status.NOT_FINITE
        elif left:
            status = Status.ITERATION_LIMIT
        elif inner_residual > self.tolerance * speed:
            # An inner LCP that is not solved to the tolerance on u spoils everything after it.
            status = Status.STALLED
        else:
            status = Status.CONVERGED
        return ImpactSolution(impulse, v, status, iterations, visits, _approach(problem, v))

    def _mean(self, problem: ImpactProblem, restitution: float) -> ImpactSolution:
        """Mean of the inelastic LCP and the reflections (GRR); without restitution there are none."""
        reflected = ImpactSolution(np.zeros(problem.m), problem.v_pre, Status.CONVERGED, 0, 0)
        if restitution > 0.0:
            reflected = self._reflect(problem)
        plastic = boxed_lcp.project(
            problem,
            np.zeros(problem.m),
            tolerance=self.inner_tolerance,
            max_sweeps=self.max_inner_sweeps,
            max_visits=self.max_visits,
        )
        status = _worse(reflected.status, plastic.residual, self.tolerance)
        if status is Status.STALLED and (plastic.sweeps >= self.max_inner_sweeps or plastic.visits >= self.max_visits):
            status = Status.ITERATION_LIMIT
        assert reflected.impulse is not None
        v = (1.0 - restitution) * plastic.v + restitution * reflected.v_post
        return ImpactSolution(
            (1.0 - restitution) * plastic.impulse + restitution * reflected.impulse,
            v,
            status,
            reflected.iterations + 1,
            reflected.visits + plastic.visits,
            _approach(problem, v),
        )

    def _with_friction(self, problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
        """Add the friction impulse of maximum dissipation at these normal impulses."""
        assert solution.impulse is not None
        friction = boxed_lcp.dissipate(
            problem,
            solution.impulse,
            v_start=solution.v_post,
            tolerance=self.tolerance,
            max_sweeps=self.max_inner_sweeps,
            max_visits=self.max_visits,
        )
        residual = _approach(problem, friction.v)
        return ImpactSolution(
            solution.impulse,
            friction.v,
            # The friction solve moves the normal velocities, and the law has no second look at them.
            _worse(solution.status, max(friction.residual, residual), self.tolerance),
            solution.iterations,
            solution.visits + friction.visits,
            residual,
            friction.friction_impulse,
        )


def _approach(problem: ImpactProblem, v: Floats) -> float:
    """Fastest approach that is left, over the largest |u_pre|."""
    return max(0.0, -float((problem.J @ v).min(initial=0.0))) / (problem.speed or 1.0)


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

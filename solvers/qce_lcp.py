"""QCE with restitution and friction: the LCP that must reach a share of QCE's outcome, and the blend of impulses.

    0 <= λ  complementary to  W λ + u_pre - c_r J v_c >= 0        v_c: QCE's velocity           (`qce-lcp`, Eq. 19)
    λ = (1 - c_r) λ_l + c_r λ_c                                   λ_l: inelastic LCP, λ_c: QCE  (`qce-blend`)

c_r = 0 is the inelastic LCP, c_r = 1 is QCE. The appendix of Zhang 2015 says that the blend solves Eq. 19; it does
not in general, as complementarity fails where QCE pushes at a contact that the inelastic LCP lets separate. Hence two
laws. Friction: Eq. 21, alternating with the boxed LCP of the pyramid.

Eq. 19 cannot raise the kinetic energy (one c_r, no friction): v is the projection of v_pre, in the mass norm, on
c_r v_c + C with the cone C = {J v ≥ 0}. Let Π be the projection of v_pre - c_r v_c on C. As v_c - v_pre = M⁻¹Jᵀλ_c
pairs non-negatively with C, |Π|² = <v_pre - c_r v_c, Π> ≤ (1 - c_r) <v_c, Π> ≤ (1 - c_r) |v_pre| |Π|, hence
|v| ≤ |Π| + c_r |v_c| ≤ |v_pre|.

Source: Zhang 2015, Section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from solvers import boxed_lcp
from solvers.generalized_reflections import one_restitution
from solvers.newton_lcp import lcp_solution
from solvers.problem import ImpactProblem
from solvers.quadratic_contact_energy import solve_elastic
from solvers.solution import Floats, ImpactSolution, Status


@dataclass(frozen=True)
class QceLcp:
    """LCP with QCE's outcome as its prediction (Zhang 2015, Eq. 19 and 21); restitution per contact, friction."""

    tolerance: float = 1e-12
    """Natural-map residual of the LCP at which to stop, relative to the largest |u_pre|."""

    qce_tolerance: float = 1e-10
    """A contact approaches in the QCE step when u < -qce_tolerance times the largest |u_pre|."""

    max_iterations: int = 10_000
    """Bound on QCE's outer iterations."""

    max_sweeps: int = 20_000
    """Bound on the sweeps of the LCP."""

    max_visits: int = boxed_lcp.MAX_VISITS
    """Bound on the contact visits of the QCE step, and on the row visits of the LCP."""

    def solve(
        self, problem: ImpactProblem, *, start: Floats | None = None, friction_start: Floats | None = None
    ) -> ImpactSolution:
        """Solve one multi-impact with any restitution and friction per contact.

        Args:
            problem: the impact.
            start: first guess of the normal impulse [N s], shape (m,), for the LCP; a pull counts as 0.
            friction_start: first guess of the friction impulse [N s], shape (2m,); cut to its bounds.

        Raises:
            ProblemError: a guess has another shape or is not finite.
            UnsupportedProblem: bodies have too many contacts for the frictionless LCP.
        """
        target = np.zeros(problem.m)
        elastic = None
        if problem.restitution.any():
            elastic = solve_elastic(
                problem,
                defer=0.0,
                tolerance=self.qce_tolerance,
                max_iterations=self.max_iterations,
                max_visits=self.max_visits,
            )
            if not problem.has_friction and (problem.restitution == 1.0).all():
                return elastic
            target = problem.restitution * (problem.J @ elastic.v_post)
        if problem.has_friction:
            result = boxed_lcp.sweep(
                problem,
                target,
                tolerance=self.tolerance,
                max_sweeps=self.max_sweeps,
                max_visits=self.max_visits,
                start=start,
                friction_start=friction_start,
            )
        else:
            result = boxed_lcp.project(
                problem,
                target,
                tolerance=self.tolerance,
                max_sweeps=self.max_sweeps,
                max_visits=self.max_visits,
                start=start,
            )
        return _joined(lcp_solution(result, self.tolerance), elastic)


@dataclass(frozen=True)
class QceBlend:
    """Mean of the inelastic LCP's and QCE's impulses (Zhang 2015, appendix); one restitution, friction."""

    tolerance: float = 1e-12
    """Natural-map residual of the inelastic LCP and change of the friction impulse, relative to the largest |u_pre|."""

    qce_tolerance: float = 1e-10
    """A contact approaches in the QCE step when u < -qce_tolerance times the largest |u_pre|."""

    max_iterations: int = 10_000
    """Bound on QCE's outer iterations."""

    max_sweeps: int = 20_000
    """Bound on the sweeps of the LCPs together."""

    max_visits: int = boxed_lcp.MAX_VISITS
    """Bound on the contact visits of the QCE step, and on the row visits of the LCPs together."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact.

        Raises:
            UnsupportedProblem: the contacts have different restitution.
        """
        restitution = one_restitution(problem, "the blend takes")
        elastic = None
        elastic_impulse = np.zeros(problem.m)
        if restitution > 0.0:
            elastic = solve_elastic(
                problem,
                defer=0.0,
                tolerance=self.qce_tolerance,
                max_iterations=self.max_iterations,
                max_visits=self.max_visits,
            )
            assert elastic.impulse is not None
            elastic_impulse = elastic.impulse
            if restitution == 1.0 and not problem.has_friction:
                return elastic
        return _joined(self._alternate(problem, restitution, elastic_impulse), elastic)

    def _alternate(self, problem: ImpactProblem, restitution: float, elastic_impulse: Floats) -> ImpactSolution:
        """Normal impulses at given friction, friction at given normal impulses (Eq. 21), until neither changes."""
        rest = np.zeros(problem.m)
        friction_impulse = None
        v_start = problem.v_pre
        sweeps = visits = 0
        while True:
            plastic = boxed_lcp.project(
                problem,
                rest,
                v_start=v_start,
                tolerance=self.tolerance,
                max_sweeps=self.max_sweeps,
                max_visits=self.max_visits,
            )
            impulse = (1.0 - restitution) * plastic.impulse + restitution * elastic_impulse
            sweeps += plastic.sweeps
            visits += plastic.visits
            residual = plastic.residual
            if not problem.has_friction:
                break
            friction = boxed_lcp.dissipate(
                problem, impulse, tolerance=self.tolerance, max_sweeps=self.max_sweeps, max_visits=self.max_visits
            )
            friction_impulse = friction.friction_impulse
            sweeps += friction.sweeps
            visits += friction.visits
            v_before, v_start = v_start, problem.v_after(rest, friction_impulse)
            change = float(np.abs(problem.J @ (v_start - v_before)).max(initial=0.0)) / (problem.speed or 1.0)
            residual = max(residual, friction.residual, change)
            if change <= self.tolerance or sweeps >= self.max_sweeps or visits >= self.max_visits:
                break
        v = problem.v_after(impulse, friction_impulse)
        result = boxed_lcp.LcpResult(impulse, friction_impulse, v, sweeps, visits, residual)
        solution = lcp_solution(result, self.tolerance)
        if solution.status is Status.CONVERGED and problem.has_friction:
            # Friction moves the normal velocities of QCE's share, which nothing pushes back.
            u_min = float((problem.J @ solution.v_post).min(initial=0.0))
            if u_min < -self.qce_tolerance * problem.speed:
                return replace(solution, status=Status.STALLED)
        return solution


def _joined(solution: ImpactSolution, elastic: ImpactSolution | None) -> ImpactSolution:
    """Add the QCE step's work, and its status where it did not converge: the LCP's target is then not QCE's."""
    if elastic is None:
        return solution
    status = elastic.status if elastic.status is not Status.CONVERGED else solution.status
    return ImpactSolution(
        solution.impulse,
        solution.v_post,
        status,
        elastic.iterations + solution.iterations,
        elastic.visits + solution.visits,
        solution.residual,
        solution.friction_impulse,
    )

"""Contact LCPs, without and with friction: the numerical core that several laws share.

    0 <= λ    complementary to  J v - target >= 0          normal rows
    |λ_f| <= μ λ, opposing      D v + β₀ D v_pre           friction pyramid (boxed LCP), two rows a contact
    v = v_start + M⁻¹ (Jᵀ λ + Dᵀ λ_f)

`sweep` is projected Gauss-Seidel, alternating one sweep over the normals with one over the tangents (Zhang 2015, Eq.
20-21; Stewart 1996, Tonge 2012; β₀: Walton 1993), after proximal Newton steps where there is friction and the problem
is small enough (see `projected_gauss_seidel`). `dissipate` solves the tangents alone, the normal impulses held (maximum
dissipation). `project` solves the frictionless problem to rounding. This file is their contract; the work is done in
`projected_gauss_seidel` and `cone_projection`.

Residual: the natural map max |min(J v - target, diag(W) λ)| over the problem's largest |u_pre|, dimensionless.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solvers import cone_projection, projected_gauss_seidel
from solvers.problem import ImpactProblem, ProblemError
from solvers.solution import Floats

# About 20 s where a row visit takes 20 ns (`tests/benchmarks/test_bench_solvers.py` prints it), a minute or so in CSR.
MAX_VISITS = 1_000_000_000


@dataclass(frozen=True)
class LcpResult:
    """An LCP's solution and what it cost."""

    impulse: Floats
    """λ [N s], shape (m,), ≥ 0."""
    friction_impulse: Floats | None
    """λ_f [N s], shape (2m,); None without friction."""
    v: Floats
    """Velocity after both [m/s, rad/s], shape (n,)."""
    sweeps: int
    visits: int
    residual: float
    """Natural map, relative to the problem's largest |u_pre|."""


def sweep(
    problem: ImpactProblem,
    target: Floats,
    *,
    tolerance: float,
    max_sweeps: int,
    max_visits: int = MAX_VISITS,
    start: Floats | None = None,
    friction_start: Floats | None = None,
) -> LcpResult:
    """Solve the LCP by projected Gauss-Seidel, with friction where the problem has it (Zhang 2015, Eq. 21).

    Args:
        problem: bodies, contacts, friction.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        tolerance: natural-map residual at which to stop, dimensionless.
        max_sweeps: bound on sweeps (over normals and tangents).
        max_visits: bound on row visits; the sweep in progress is finished.
        start: first guess of λ, see `first_guess`.
        friction_start: first guess of λ_f, see `first_friction_guess`.

    Raises:
        ProblemError: a guess has another shape or is not finite.
    """
    scale = problem.speed or 1.0
    guess = first_guess(problem, start)
    impulse, friction_impulse, v, sweeps, visits, residual = projected_gauss_seidel.sweep(
        problem,
        target,
        guess,
        first_friction_guess(problem, friction_start, guess),
        tolerance=tolerance * scale,
        max_sweeps=max_sweeps,
        max_visits=max_visits,
    )
    return LcpResult(impulse, friction_impulse if problem.has_friction else None, v, sweeps, visits, residual / scale)


def dissipate(
    problem: ImpactProblem,
    impulse: Floats,
    *,
    v_start: Floats | None = None,
    tolerance: float,
    max_sweeps: int,
    max_visits: int = MAX_VISITS,
) -> LcpResult:
    """Find the friction impulse of maximum dissipation for given normal impulses (Smith 2012).

    Args:
        problem: bodies, contacts, friction.
        impulse: normal impulses λ [N s], shape (m,).
        v_start: velocity with these [m/s, rad/s], shape (n,); computed from them if None.
        tolerance: natural-map residual at which to stop, dimensionless.
        max_sweeps: bound on sweeps over the tangents.
        max_visits: bound on row visits; the sweep in progress is finished.
    """
    scale = problem.speed or 1.0
    friction_impulse, v, sweeps, visits, residual = projected_gauss_seidel.dissipate(
        problem,
        impulse,
        problem.v_after(impulse) if v_start is None else v_start,
        tolerance=tolerance * scale,
        max_sweeps=max_sweeps,
        max_visits=max_visits,
    )
    return LcpResult(impulse, friction_impulse, v, sweeps, visits, residual / scale)


def project(
    problem: ImpactProblem,
    target: Floats,
    *,
    v_start: Floats | None = None,
    tolerance: float,
    max_sweeps: int,
    max_visits: int = MAX_VISITS,
    start: Floats | None = None,
) -> LcpResult:
    """Solve the frictionless LCP to rounding: v is the projection of v_start on {J v ≥ target} in the mass norm.

    Args:
        problem: bodies and contacts; friction is not read.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        v_start: velocity before [m/s], shape (n,); the problem's v_pre if None.
        tolerance: natural-map residual at which to stop, dimensionless.
        max_sweeps: bound on sweeps; a conjugate-gradient step counts as one.
        max_visits: bound on contact visits.
        start: first guess of λ, see `first_guess`.

    Raises:
        ProblemError: the guess has another shape or is not finite.
        UnsupportedProblem: bodies have too many contacts.
    """
    scale = problem.speed or 1.0
    impulse, v, sweeps, visits, residual = cone_projection.project(
        problem,
        target,
        problem.v_pre if v_start is None else v_start,
        first_guess(problem, start),
        tolerance=tolerance * scale,
        max_sweeps=max_sweeps,
        max_visits=max_visits,
    )
    return LcpResult(impulse, None, v, sweeps, visits, residual / scale)


def first_guess(problem: ImpactProblem, start: Floats | None) -> Floats:
    """Check a first guess of the normal impulse [N s], shape (m,); a pull counts as 0, None is 0 everywhere.

    Raises:
        ProblemError: it has another shape or is not finite.
    """
    if start is None:
        return np.zeros(problem.m)
    return np.maximum(_checked("start", start, "m", problem.m), 0.0)


def first_friction_guess(problem: ImpactProblem, friction_start: Floats | None, impulse: Floats) -> Floats:
    """Check a first guess of the friction impulse [N s], shape (2m,); what exceeds μ impulse is cut to it.

    Raises:
        ProblemError: it has another shape or is not finite.
    """
    if friction_start is None:
        return np.zeros(2 * problem.m)
    bound = np.repeat(problem.friction * impulse, 2)
    return np.clip(_checked("friction_start", friction_start, "2m", 2 * problem.m), -bound, bound)


def _checked(field: str, guess: Floats, shape: str, size: int) -> Floats:
    """Check shape and finiteness of a guess."""
    array = np.asarray(guess, dtype=np.float64)
    if array.shape != (size,):
        raise ProblemError(f"{field} must have shape ({shape},) = ({size},), not {array.shape}")
    if not np.isfinite(array).all():
        raise ProblemError(f"{field} must be finite")
    return array

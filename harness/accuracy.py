"""Two kinds of error, never mixed.

    validation     ‖v⁺ - v_ref‖∞ / max|v⁻|    how far a law is from a named truth (ideal exchange, Hertz, experiment)
    verification   the law's own equations    how well a solver solves what it says that it solves

A validation error is shown, never gated: a law may be far from the truth and still be solved exactly. Every score
names its reference; an error within the reference's own uncertainty is "not distinguishable" from none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from harness.checked import checked_solve, ratio
from harness.desiderata import ENERGY_TOLERANCE, energy_change
from harness.measurement import Score, not_applicable, shown, upper_bound
from scenarios.scenario import Quantity, Reference
from solvers import SOLVERS, ImpactProblem, ImpactSolution, ProblemError, Solver
from solvers.solution import Floats

# Closed forms hold to rounding, solvers stop at 1e-10 of the approach or before.
VERIFICATION_TOLERANCE = 1e-9
# Iteration counts are whole numbers: half of one is the largest error that still rounds to the right count.
COUNT_TOLERANCE = 0.5
# A solver that stops at 1e-10 or before leaves a natural-map residual of the same size.
RESIDUAL_TOLERANCE = 1e-9
# Settings of the integrators, adaptive and of fixed step, and by how much they are changed to see what they are worth.
COARSER = {"tolerance": 100.0, "steps_per_contact": 0.5}


def velocity_error(problem: ImpactProblem, v_post: Floats, reference: Reference) -> float:
    """Largest |v⁺ - v_ref| over the largest |v⁻|, dimensionless."""
    scale = float(np.abs(problem.v_pre).max(initial=0.0))
    return ratio(float(np.abs(v_post - reference.value).max(initial=0.0)), scale)


def _detail(problem: ImpactProblem, reference: Reference, error: float) -> dict[str, object]:
    """What a reader needs beside an error: the reference's kind and source, its uncertainty, and what that implies."""
    scale = float(np.abs(problem.v_pre).max(initial=0.0))
    uncertainty = ratio(reference.uncertainty, scale)
    return {
        "kind": reference.kind.value,
        "source": reference.source,
        "uncertainty": uncertainty,
        "distinguishable": bool(error > uncertainty),
    }


def validation(problem: ImpactProblem, v_post: Floats, references: tuple[Reference, ...]) -> tuple[Score, ...]:
    """Validation errors: against every reference that is truth for every law."""
    scores = []
    for reference in references:
        if reference.laws or reference.quantity is not Quantity.VELOCITY:
            continue
        error = velocity_error(problem, v_post, reference)
        metric = f"validation: {reference.name}"
        scores.append(shown("error", metric, error, reference.name, _detail(problem, reference, error)))
    return tuple(scores)


def verification(
    problem: ImpactProblem, solution: ImpactSolution, references: tuple[Reference, ...], *, name: str
) -> tuple[Score, ...]:
    """Verification errors: against the closed forms of this very law, `name` in the registry.

    A closed form that is known to some digits only widens the bound by its uncertainty.
    """
    scores = []
    for reference in references:
        if name not in reference.laws:
            continue
        metric = f"verification: {reference.name}"
        if reference.quantity is Quantity.ITERATIONS:
            count = float(reference.value[0])
            error = ratio(abs(solution.iterations - count), count)
            bound = ratio(COUNT_TOLERANCE + reference.uncertainty, count)
            detail: dict[str, object] = {"iterations": int(solution.iterations), "expected": count}
            scores.append(upper_bound("error", metric, error, bound, reference.name, detail))
        else:
            error = velocity_error(problem, solution.v_post, reference)
            detail = _detail(problem, reference, error)
            bound = VERIFICATION_TOLERANCE + ratio(reference.uncertainty, float(np.abs(problem.v_pre).max(initial=0.0)))
            scores.append(upper_bound("error", metric, error, bound, reference.name, detail))
    return tuple(scores)


def natural_map(problem: ImpactProblem, solution: ImpactSolution, target: Floats) -> float:
    """Residual of 0 ≤ λ ⊥ J v⁺ - target ≥ 0, dimensionless; NaN without an impulse.

    ‖λ - max(0, λ - (J v⁺ - target) / diag W)‖∞ is written as a velocity, diag(W) λ against J v⁺ - target, and taken
    over the largest |u⁻|. v⁺ is recomputed from the impulses, friction included.

    Args:
        problem: the impact.
        solution: the solver's answer.
        target: least normal relative velocity after the impact [m/s], shape (m,).
    """
    if solution.impulse is None:
        return np.nan
    excess = problem.J @ problem.v_after(solution.impulse, solution.friction_impulse) - target
    residual = np.minimum(problem.W_diagonal * solution.impulse, excess)
    return ratio(float(np.abs(residual).max(initial=0.0)), problem.speed)


def tangent_map(problem: ImpactProblem, solution: ImpactSolution) -> float:
    """Residual of the friction rows, |λ_f| ≤ μ λ opposing D v⁺ + β₀ D v⁻, as a velocity over the largest |u⁻|."""
    if solution.impulse is None or solution.friction_impulse is None or problem.D is None:
        return 0.0
    diagonal = np.asarray(problem.DM.multiply(problem.D).sum(axis=1), dtype=np.float64).reshape(-1)
    bound = np.repeat(problem.friction * np.maximum(solution.impulse, 0.0), 2)
    slip = problem.D @ problem.v_after(solution.impulse, solution.friction_impulse) - problem.slip_target
    step = solution.friction_impulse * diagonal - slip
    projected = np.clip(step, -bound * diagonal, bound * diagonal)
    residual = (solution.friction_impulse * diagonal - projected)[diagonal > 0]
    return ratio(float(np.abs(residual).max(initial=0.0)), problem.speed)


def _natural_map_score(problem: ImpactProblem, solution: ImpactSolution, target: Floats, reference: str) -> Score:
    """Natural map of the normals and the tangents together."""
    parts = {"normals": natural_map(problem, solution, target), "tangents": tangent_map(problem, solution)}
    metric = "verification: natural map"
    return upper_bound("error", metric, max(parts.values()), RESIDUAL_TOLERANCE, reference, parts)


def newton_lcp(solver: Solver, problem: ImpactProblem, solution: ImpactSolution) -> Score:
    """Residual of 0 ≤ λ ⊥ u⁺ + c_r u⁻ ≥ 0."""
    return _natural_map_score(problem, solution, -problem.restitution * problem.u_pre, "Newton LCP")


def qce_lcp(solver: Solver, problem: ImpactProblem, solution: ImpactSolution) -> Score:
    """Residual of 0 ≤ λ ⊥ u⁺ - c_r J q̇_c⁺ ≥ 0 (Zhang 2015, Eq. 19), with QCE's q̇_c⁺ computed anew."""
    elastic = SOLVERS["qce"]().solve(problem.replace(restitution=1.0, friction=0.0))
    return _natural_map_score(problem, solution, problem.restitution * (problem.J @ elastic.v_post), "Eq. 19")


def energy(solver: Solver, problem: ImpactProblem, solution: ImpactSolution) -> Score:
    """Residual of K⁺ = K⁻, which an elastic law builds upon; only where the impact is elastic and frictionless."""
    metric, reference = "verification: energy", "conservation of energy"
    if (problem.restitution != 1.0).any() or problem.has_friction:
        return not_applicable("error", metric, "the impact is not elastic and frictionless")
    if (problem.v_pre[problem.inverse_mass.diagonal() == 0] != 0).any():
        return not_applicable("error", metric, "an immovable body moves: it may do work")
    try:
        change = abs(energy_change(problem, solution.v_post))
    except ProblemError as error:
        return not_applicable("error", metric, str(error))
    return upper_bound("error", metric, change, ENERGY_TOLERANCE, reference)


def self_convergence(solver: Solver, problem: ImpactProblem, solution: ImpactSolution) -> Score:
    """Change of v⁺ over the largest |v⁻| when the solver itself is run more coarsely: an error estimate.

    The coarser run is the less accurate one, so the estimate is of its error; the solver's own is smaller.
    """
    other = checked_solve(coarser(solver), problem)
    scale = float(np.abs(problem.v_pre).max(initial=0.0))
    change = ratio(float(np.abs(other.v_post - solution.v_post).max(initial=0.0)), scale)
    return shown("error", "verification: self-convergence", change, "itself, run more coarsely", dict(COARSER))


def coarser(solver: Solver) -> Solver:
    """The same solver with the settings in COARSER multiplied, those of them that it has."""
    settings = {field.name: getattr(solver, field.name) for field in dataclasses.fields(solver)}  # type: ignore[arg-type]
    for name, factor in COARSER.items():
        if name in settings:
            settings[name] *= factor
    return type(solver)(**settings)


OWN_EQUATIONS: dict[str, Callable[[Solver, ImpactProblem, ImpactSolution], Score]] = {
    "ehi": self_convergence,
    "gauss-seidel": energy,
    "gr": energy,
    "hertz": self_convergence,
    "jacobi": energy,
    "lcp-apgd": newton_lcp,
    "lcp-clarabel": newton_lcp,
    "lcp-nnls": newton_lcp,
    "lcp-osqp": newton_lcp,
    "lcp-pgs": newton_lcp,
    "lcp-spg": newton_lcp,
    "lzb": self_convergence,
    "qce": energy,
    "qce-defer": energy,
    "qce-lcp": qce_lcp,
}
"""Solver name → residual of the equations that it says it solves. The blend (`qce-blend`) is a formula: none."""

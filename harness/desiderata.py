"""The six desiderata for multi-impact laws as numbers (Smith et al. 2012, Table 1 of Zhang 2015).

    WAV  impacts propagate as waves         locality: |∂u_i⁺/∂u_j⁻|, j ≠ i;  skill: 1 - RMS(law) / RMS(Newton LCP)
    BRK  touching contacts may break away   min u_i⁺ / u_i⁺(ideal) over contacts with u_i⁻ = 0 that should separate
    SYM  symmetry is kept                   ‖S v⁺(v⁻) - v⁺(S v⁻)‖ / ‖v⁻‖, also for renumberings of contacts and bodies
    KIN  kinetic energy is kept             max(0, K⁺ - K⁻) / K⁻, and max(0, K⁻ - K⁺) / K⁻ for elastic impacts
    MOM  momentum is kept                   |c · M (v⁺ - v⁻)| for every invariant c
    ONE  one-sided contacts                 max(0, -min λ) / max |λ|,  max(0, -min u⁺) / max |u⁻|

Every score is a pure function of arrays and problems; 0 is perfect (1 for BRK and skill), NaN says "does not apply".
"""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from harness.checked import HONESTY_TOLERANCE, pulling_impulse, ratio, remaining_approach
from harness.measurement import Score, lower_bound, not_applicable, shown, upper_bound
from scenarios.scenario import Invariant, Reference
from solvers import ImpactProblem, ImpactSolution, ProblemError, Status
from solvers.solution import Floats

# A law that is local up to its solver's tolerance (1e-12 … 1e-10) shows slopes below 1e-7 at the step of the
# difference quotient; a wave shows slopes of order 0.1.
LOCALITY_TOLERANCE = 1e-6
# The Newton LCP itself has skill 0 up to its solver's tolerance: a law must be better by more than that.
SKILL_TOLERANCE = 1e-6
# Half of the ideal separation: Zhang 2015 asks for "break-away" and gives no number.
BREAK_TOLERANCE = 0.5
# Share of the largest approach above which a contact counts as separating in racks and packs.
SEPARATING = 0.05
# Rounding of a hundred iterations, amplified by the conditioning of the law; a broken symmetry shows 1e-3 or more.
SYMMETRY_TOLERANCE = 1e-9
# Rounding of the kinetic energy; the paper's own implementation lost 2.43e-4.
ENERGY_TOLERANCE = 1e-9
# Momentum is a plain sum: nothing but its rounding may remain.
MOMENTUM_TOLERANCE = 1e-12
# The sign of an impulse is a matter of a comparison, not of a computation.
PULL_TOLERANCE = 1e-12
# Solvers stop at a relative 1e-10 of the approach; ten times that is left to rounding.
APPROACH_TOLERANCE = HONESTY_TOLERANCE
# A relative velocity below this share of the largest one is rounding, not motion.
AT_REST = 1e-12


def mismatch(v: Floats, expected: Floats, v_pre: Floats) -> float:
    """Distance ‖v - expected‖₂ / ‖v_pre‖₂ of two velocities, shape (n,); dimensionless."""
    return ratio(float(np.linalg.norm(v - expected)), float(np.linalg.norm(v_pre)))


def wav_locality(slope: float, *, detail: dict[str, object] | None = None) -> Score:
    """WAV (a): the largest |∂u_i⁺/∂u_j⁻|, j ≠ i, on chains. A law without it sends no wave."""
    return lower_bound("WAV", "locality on chains", slope, LOCALITY_TOLERANCE, detail=detail)


def root_mean_square(outcomes: list[Floats], expected: list[Floats]) -> float:
    """Root mean square over cases of the Euclidean distance between two lists of velocities [m/s]."""
    squares = [float(np.sum((v - w) ** 2)) for v, w in zip(outcomes, expected, strict=True)]
    return math.sqrt(sum(squares) / len(squares))


def skill(outcomes: list[Floats], newton: list[Floats], expected: list[Floats]) -> float:
    """Return 1 - RMS(outcomes) / RMS(newton), both about `expected`: 1 is perfect, 0 no better than the Newton LCP."""
    return 1.0 - root_mean_square(outcomes, expected) / root_mean_square(newton, expected)


def wav_skill(value: float, *, sweep: str, reference: str, detail: dict[str, object] | None = None) -> Score:
    """WAV (b): skill over one sweep of chains against one named reference."""
    return lower_bound("WAV", f"skill, {sweep}", value, SKILL_TOLERANCE, reference, detail)


def brk_chain(problem: ImpactProblem, v_post: Floats, ideal: Reference) -> Score:
    """BRK on a chain: contacts with u⁻ = 0 that carry an impulse and separate in the ideal outcome.

    Args:
        problem: the chain.
        v_post: the law's outcome [m/s], shape (n,).
        ideal: the ideal exchange of velocities.

    Returns:
        The worst u⁺ over the ideal u⁺; not applicable where no such contact exists.
    """
    metric = "worst separation of touching contacts"
    at_rest = AT_REST * problem.speed
    u_ideal = problem.J @ ideal.value
    impulse = np.atleast_1d(spsolve(sp.csc_array(problem.W), u_ideal - problem.u_pre)) if problem.m else np.zeros(0)
    breaking = (np.abs(problem.u_pre) <= at_rest) & (u_ideal > at_rest) & (impulse * problem.W_diagonal > at_rest)
    contacts = np.flatnonzero(breaking)
    if contacts.size == 0:
        return not_applicable("BRK", metric, "no contact at rest separates in the ideal outcome")
    shares = (problem.J @ v_post)[contacts] / u_ideal[contacts]
    worst = int(np.argmin(shares))
    detail = {"contact": int(contacts[worst]), "contacts": int(contacts.size)}
    return lower_bound("BRK", metric, float(shares[worst]), BREAK_TOLERANCE, ideal.name, detail)


def brk_share(problem: ImpactProblem, v_post: Floats, compliant: Reference) -> Score:
    """BRK in racks and packs: share of the contacts that separate in the compliant outcome and separate here too."""
    metric = "share of separating contacts"
    threshold = SEPARATING * problem.speed
    separating = problem.J @ compliant.value > threshold
    count = int(separating.sum())
    if count == 0:
        return not_applicable("BRK", metric, f"no contact separates in the outcome of {compliant.name}")
    found = int((problem.J @ v_post > threshold)[separating].sum())
    return shown("BRK", metric, found / count, compliant.name, {"contacts": count})


def sym(metric: str, residuals: dict[str, float]) -> Score:
    """SYM: the worst of some symmetry residuals, each with the name of the map that it belongs to."""
    worst = max(residuals, key=lambda name: residuals[name])
    return upper_bound("SYM", metric, residuals[worst], SYMMETRY_TOLERANCE, detail={"worst": worst, **residuals})


def energy_change(problem: ImpactProblem, v_post: Floats) -> float:
    """Return (K⁺ - K⁻) / K⁻, dimensionless; 0 where nothing moves and nothing changes.

    Raises:
        ProblemError: a block of the inverse mass is too large to be inverted.
    """
    before = problem.kinetic_energy(problem.v_pre)
    change = problem.kinetic_energy(v_post) - before
    return math.copysign(ratio(abs(change), before), change)


def kin(problem: ImpactProblem, v_post: Floats) -> tuple[Score, ...]:
    """KIN: energy gained, energy lost (gated for elastic frictionless impacts only), and the paper's e = |ΔK| / K⁻."""
    immovable = problem.inverse_mass.diagonal() == 0
    if (problem.v_pre[immovable] != 0).any():
        return (not_applicable("KIN", "energy gained", "an immovable body moves: it may do work without end"),)
    try:
        change = energy_change(problem, v_post)
    except ProblemError as error:
        return (not_applicable("KIN", "energy gained", str(error)),)
    elastic = bool((problem.restitution == 1.0).all()) and not problem.has_friction
    lost = max(0.0, -change)
    return (
        upper_bound("KIN", "energy gained", max(0.0, change), ENERGY_TOLERANCE),
        upper_bound("KIN", "energy lost", lost, ENERGY_TOLERANCE) if elastic else shown("KIN", "energy lost", lost),
        shown("KIN", "energy error e", abs(change)),
    )


def mom(problem: ImpactProblem, v_post: Floats, invariants: tuple[Invariant, ...]) -> Score:
    """MOM: the worst relative drift of the scene's momenta c · M v.

    The drift is relative to Σ |c_i (M v)_i|, the larger one of before and after: a total of zero divides nothing.
    """
    metric = "worst momentum drift"
    if not invariants:
        return not_applicable("MOM", metric, "the scene conserves no momentum: all its bodies lean on immovable ones")
    try:
        before, after = problem.mass @ problem.v_pre, problem.mass @ v_post
    except ProblemError as error:
        return not_applicable("MOM", metric, str(error))
    drifts = {}
    for invariant in invariants:
        scale = max(float(np.abs(invariant.direction * p).sum()) for p in (before, after))
        drifts[invariant.name] = ratio(abs(float(invariant.direction @ (after - before))), scale)
    worst = max(drifts, key=lambda name: drifts[name])
    return upper_bound("MOM", metric, drifts[worst], MOMENTUM_TOLERANCE, detail={"worst": worst})


def one(problem: ImpactProblem, solution: ImpactSolution, *, tags: frozenset[str]) -> tuple[Score, ...]:
    """ONE: contacts push and never pull, and none approaches after the impact.

    On "jammed" scenes an iteration that honestly says it did not end is not judged by what still approaches: no
    elastic one need end there (Gordan's alternative); its termination score carries it.
    """
    if solution.impulse is None:
        pull = not_applicable("ONE", "pulling impulse", "the solver gives no impulse")
    else:
        pull = upper_bound("ONE", "pulling impulse", pulling_impulse(solution.impulse), PULL_TOLERANCE)
    left = remaining_approach(problem, solution.v_post)
    metric = "remaining approach"
    if "jammed" in tags and solution.status is not Status.CONVERGED and left > APPROACH_TOLERANCE:
        reason = f"no elastic iteration need end on a jammed scene; the solver says: {solution.status}"
        return pull, not_applicable("ONE", metric, reason)
    return pull, upper_bound("ONE", metric, left, APPROACH_TOLERANCE)

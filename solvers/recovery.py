"""Recovery: what an elastic iteration left approaching at its bound is resolved inelastically, once.

    v = Π v_e,   Π the projection in the mass norm on the cone C = {v : J v >= 0}
    0 <= Δλ  complementary to  J v_e + W Δλ >= 0,   v = v_e + M⁻¹ Jᵀ Δλ,   λ = λ_e + Δλ      v_e, λ_e: the iterate

Contacts that squeeze a body from both sides leave no motion that opens them all, and an elastic iteration may go on
for ever (Gordan's alternative; Vouga 2017 on termination). A simulation needs an answer all the same: some iterations
of the law, then the one inelastic LCP (target 0) on the velocity that they reached.

It ends with u >= 0, as v lies in C. It cannot raise the kinetic energy: C is a convex cone with its apex at 0, so that
<v_e - v, v> = 0 in the mass norm, and |v|² = <v_e, v> <= |v_e| |v|, hence |v| <= |v_e|. An LCP that is cut off cannot
either: the change of energy is q(Δλ) = Δλᵀ J v_e + ½ Δλᵀ W Δλ, the very function that Gauss-Seidel and conjugate
gradients lower from q(0) = 0 at each step. Impulses stay >= 0 and momentum is kept, as Δλ >= 0 is an impulse of the
same contacts. Friction impulses stay within their bounds, as the normal impulses only grow.

The energy that the inelastic part takes is lost, so this is a policy and no law: off unless it is asked for (setting
`recover_after` of `qce` and `gr`), and the status still says that the elastic law did not end.
"""

from __future__ import annotations

import numpy as np

from solvers import boxed_lcp
from solvers.problem import ImpactProblem
from solvers.solution import ImpactSolution, Status

# Natural-map residual of the inelastic LCP, relative to the largest |u_pre|: that of the laws' own inelastic LCPs.
TOLERANCE = 1e-12
# Sweeps of the inelastic LCP: the bound of the laws' own.
MAX_SWEEPS = 20_000

RECOVERABLE = (Status.ITERATION_LIMIT, Status.STALLED)
"""What an iteration that can be recovered says; a converged one needs nothing, any other has no usable iterate."""


def resolve(
    problem: ImpactProblem,
    solution: ImpactSolution,
    *,
    tolerance: float = TOLERANCE,
    max_sweeps: int = MAX_SWEEPS,
) -> ImpactSolution:
    """Resolve inelastically what a solution left approaching; a solution that converged is returned as it is.

    Args:
        problem: the impact that was solved.
        solution: what a law reached; its normal and friction impulses are kept and only added to.
        tolerance: natural-map residual of the inelastic LCP at which to stop, relative to the largest |u_pre|.
        max_sweeps: bound on its sweeps.

    Returns:
        The sum of both. The status stays that of the law, which did not end; `residual` is the approach that is left,
        relative to the largest |u_pre|; `iterations` counts the inelastic LCP as one more.
    """
    if solution.status not in RECOVERABLE or not np.isfinite(solution.v_post).all():
        return solution
    rest = boxed_lcp.project(
        problem, np.zeros(problem.m), v_start=solution.v_post, tolerance=tolerance, max_sweeps=max_sweeps
    )
    impulse = None if solution.impulse is None else solution.impulse + rest.impulse
    u_min = float((problem.J @ rest.v).min(initial=0.0))
    return ImpactSolution(
        impulse,
        rest.v,
        solution.status,
        solution.iterations + 1,
        solution.visits + rest.visits,
        max(0.0, -u_min) / (problem.speed or 1.0),
        solution.friction_impulse,
    )

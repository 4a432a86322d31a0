"""Hertz: compliant contacts, all at once in time, with the gaps that open remembered. The model reference.

    M dv/dt = Jᵀ F,    F_i = k_i max(δ_i, 0)^η,    dδ_i/dt = -u_i = -(J v)_i,    δ(0) = 0,    η = 3/2

Contacts touch at the start; the geometry is frozen. A contact that opens (δ < 0) must close its gap before it presses
again. The impact is over when nothing presses and no gap closes. The outcome does not depend on stiffness, mass or
speed scales, only on ratios: in units of the largest approach they cancel (see `solvers.compression`).
η = 3/2 is Hertz 1882 for smooth convex bodies, η = 1 a linear spring.

This is an impact model and not the truth: another η gives another outcome (three balls, one moving: the last leaves
with 0.994549 for η = 3/2 and with 0.980032 for η = 1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from solvers.compression import Compliance, integrate_with_gaps
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, UnsupportedProblem

# Factor by which the tolerance is loosened for the uncertainty of a reference: two decades show the trend of the
# error clearly, and the looser run is still far from the range in which nothing converges.
LOOSER = 100.0
# Rounding that no comparison of two runs shows, relative to the largest velocity.
ROUNDING = 1e-14


@dataclass(frozen=True)
class Hertz(Compliance):
    """Compliant contacts with memory of gaps; elastic and without friction."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; restitution and friction must be 1 and 0.

        Raises:
            UnsupportedProblem: restitution differs from 1 or friction from 0.
        """
        if (problem.restitution != 1.0).any():
            raise UnsupportedProblem("hertz is an elastic law: restitution must be 1 (lzb takes any above its bound)")
        if problem.has_friction:
            raise UnsupportedProblem("hertz has no friction: friction must be 0")
        return integrate_with_gaps(problem, self)


def hertz_reference(problem: ImpactProblem, *, exponent: float = 1.5) -> tuple[Floats, float]:
    """Velocity after the impact with its uncertainty, by two runs of different fineness.

    Args:
        problem: the impact.
        exponent: η of the contact force, ≥ 1.

    Returns:
        Velocity [m/s, rad/s], shape (n,), of the finer run, and the largest difference of any entry from the coarser
        one (tolerance 100 times as large; half as many leapfrog steps), at least rounding.

    Raises:
        UnsupportedProblem: the law does not apply.
    """
    fine = Hertz(exponent=exponent)
    if problem.m <= fine.adaptive_contacts:
        coarse = replace(fine, tolerance=LOOSER * fine.tolerance)
    else:
        coarse = replace(fine, steps_per_contact=0.5 * fine.steps_per_contact)
    v = fine.solve(problem).v_post
    difference = float(np.abs(v - coarse.solve(problem).v_post).max(initial=0.0))
    return v, max(difference, ROUNDING * float(np.abs(problem.v_pre).max(initial=0.0)))

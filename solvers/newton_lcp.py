"""Newton LCP: all contacts at once, each with Newton's restitution law.

    0 <= λ  complementary to  W λ + (1 + c_r) u_pre >= 0

The law that most engines solve. u_post = -c_r u_pre wherever a contact pushes, whatever the other contacts do: no
wave, no break-away. A contact that separates before the impact may approach afterwards (u_post ≥ -c_r u_pre).
Sources: Zhang 2015, Section 2; Smith 2012, "Reflections on simultaneous impact"; friction: Stewart 1996, Tonge 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solvers import boxed_lcp
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status


@dataclass(frozen=True)
class NewtonLcp:
    """Simultaneous impacts as an LCP by projected Gauss-Seidel, with friction; one iteration is one sweep.

    With friction, small problems begin with proximal Newton steps, as sweeps may creep; their iterations count as
    sweeps, and sweeps take what they leave.
    """

    tolerance: float = 1e-11
    """Natural-map residual at which to stop, relative to the largest |u_pre|."""

    max_iterations: int = 20_000
    """Bound on sweeps over all contacts."""

    max_visits: int = boxed_lcp.MAX_VISITS
    """Bound on row visits; the sweep in progress is finished."""

    def solve(
        self, problem: ImpactProblem, *, start: Floats | None = None, friction_start: Floats | None = None
    ) -> ImpactSolution:
        """Solve one multi-impact with any restitution and friction per contact.

        Args:
            problem: the impact.
            start: first guess of the normal impulse [N s], shape (m,); a pull counts as 0.
            friction_start: first guess of the friction impulse [N s], shape (2m,); cut to its bounds.

        Raises:
            ProblemError: a guess has another shape or is not finite.
        """
        result = boxed_lcp.sweep(
            problem,
            -problem.restitution * problem.u_pre,
            tolerance=self.tolerance,
            max_sweeps=self.max_iterations,
            max_visits=self.max_visits,
            start=start,
            friction_start=friction_start,
        )
        return lcp_solution(result, self.tolerance)


def lcp_solution(result: boxed_lcp.LcpResult, tolerance: float) -> ImpactSolution:
    """Turn an LCP's result into a solution; its status is what its residual says."""
    if not np.isfinite(result.v).all():
        status = Status.NOT_FINITE
    else:
        status = Status.CONVERGED if result.residual <= tolerance else Status.ITERATION_LIMIT
    return ImpactSolution(
        result.impulse,
        result.v,
        status,
        result.sweeps,
        result.visits,
        result.residual,
        result.friction_impulse,
    )

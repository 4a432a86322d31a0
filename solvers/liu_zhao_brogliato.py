"""LZB: the impulses of all contacts grow together, in ratios given by stored energy and stiffness.

    dP_j/dP_i = (k_j/k_i)^(1/(η+1)) (E_j/E_i)^(η/(η+1)),    dE_i = -u_i dP_i (compression), -u_i dP_i/e_i² (expansion)

A contact without stored energy that approaches starts with a rate ∝ |u|^η. A contact ends when its energy is used up;
if it approaches again it presses at once, as no gap is known. The impact is over when no energy is stored and nothing
approaches. Source: Liu, Zhao and Brogliato 2008, "Frictionless multiple impacts in multibody systems"; Zhang 2015,
Eq. 6, states the law with an approximation that is not used here. Restitution is energetic (Stronge 1990): of the
work of compression, the part e² comes back (bi-stiffness).

How it is integrated. Write E = k δ^(η+1)/(η+1), which defines a compression δ. Then

    k^(1/(η+1)) E^(η/(η+1)) = (η+1)^(-η/(η+1)) k δ^η,    dE = k δ^η dδ

so the law says dP_i = k_i δ_i^η dt in a common clock t, and dδ_i = -u_i dt (-u_i dt/e_i² in expansion): the compliant
contact of `hertz`, but without memory of gaps. Only stiffness ratios matter, as t may be scaled at will. The impulse is
no good as a clock: E^(η/(η+1)) has no unique solution from E = 0. In t the start is regular, and F ∝ |u|^η follows.

The other reading of bi-stiffness, dδ = -u dt with the force scaled by e² in expansion, distributes differently in
expansion and is not this law. With e = 0.7, three balls, one moving, this one gives (0.11040, 0.15840, 0.73119).
"""

from __future__ import annotations

from dataclasses import dataclass

from solvers.compression import Compliance, integrate_without_gaps
from solvers.problem import ImpactProblem
from solvers.solution import ImpactSolution, UnsupportedProblem

# Below this restitution the energy runs out so fast in expansion (1/e² = 1e6) that the part of a compression which
# counts as none (1e-12) grows to 1e-6 of a contact. A pair at this bound rebounds with e to a relative 2e-9.
SMALLEST_RESTITUTION = 1e-3


@dataclass(frozen=True)
class LiuZhaoBrogliato(Compliance):
    """Energy-based distribution of impulses, energetic restitution per contact, no friction."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact; friction must be 0.

        Raises:
            UnsupportedProblem: friction differs from 0, or a restitution is below `SMALLEST_RESTITUTION`.
        """
        if problem.has_friction:
            raise UnsupportedProblem("lzb has no friction here: friction must be 0")
        if problem.restitution.min(initial=1.0) < SMALLEST_RESTITUTION:
            raise UnsupportedProblem(
                f"lzb stores energy and gives e² of it back: restitution must be at least {SMALLEST_RESTITUTION:g}"
            )
        return integrate_without_gaps(problem, self)

"""Impact laws: each turns an `ImpactProblem` into an `ImpactSolution`."""

from __future__ import annotations

from solvers.problem import ImpactProblem, ProblemError
from solvers.quadratic_contact_energy import DeferredContactEnergy, QuadraticContactEnergy
from solvers.solution import ImpactSolution, Solver, Status, UnsupportedProblem

SOLVERS: dict[str, type[Solver]] = {
    "qce": QuadraticContactEnergy,
    "qce-defer": DeferredContactEnergy,
}
"""Name → law. Adding one is one file and one line here."""

__all__ = [
    "SOLVERS", "ImpactProblem", "ImpactSolution", "ProblemError", "Solver", "Status", "UnsupportedProblem",
]  # fmt: skip

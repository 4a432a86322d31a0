"""Impact laws: each turns an `ImpactProblem` into an `ImpactSolution`."""

from __future__ import annotations

from solvers.explicit_hertz import ExplicitHertz
from solvers.generalized_reflections import GeneralizedReflections
from solvers.hertz import Hertz
from solvers.lcp_qp import NewtonLcpNnls
from solvers.liu_zhao_brogliato import LiuZhaoBrogliato
from solvers.newton_lcp import NewtonLcp
from solvers.pairwise import GaussSeidel, Jacobi
from solvers.problem import ImpactProblem, ProblemError
from solvers.qce_lcp import QceBlend, QceLcp
from solvers.quadratic_contact_energy import DeferredContactEnergy, QuadraticContactEnergy
from solvers.solution import ImpactSolution, Solver, Status, UnsupportedProblem

SOLVERS: dict[str, type[Solver]] = {
    "ehi": ExplicitHertz,
    "gauss-seidel": GaussSeidel,
    "gr": GeneralizedReflections,
    "hertz": Hertz,
    "jacobi": Jacobi,
    "lcp-nnls": NewtonLcpNnls,
    "lcp-pgs": NewtonLcp,
    "lzb": LiuZhaoBrogliato,
    "qce": QuadraticContactEnergy,
    "qce-blend": QceBlend,
    "qce-defer": DeferredContactEnergy,
    "qce-lcp": QceLcp,
}
"""Name → law. Adding one is one file and one line here."""

__all__ = [
    "SOLVERS", "ImpactProblem", "ImpactSolution", "ProblemError", "Solver", "Status", "UnsupportedProblem",
]  # fmt: skip

"""Impact laws: each turns an `ImpactProblem` into an `ImpactSolution`."""

from __future__ import annotations

from solvers.explicit_hertz import ExplicitHertz
from solvers.generalized_reflections import GeneralizedReflections
from solvers.hertz import Hertz
from solvers.lcp_gradient import AcceleratedProjectedGradient, SpectralProjectedGradient
from solvers.lcp_qp import NewtonLcpClarabel, NewtonLcpNnls, NewtonLcpOsqp
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
    "lcp-apgd": AcceleratedProjectedGradient,
    "lcp-clarabel": NewtonLcpClarabel,
    "lcp-nnls": NewtonLcpNnls,
    "lcp-osqp": NewtonLcpOsqp,
    "lcp-pgs": NewtonLcp,
    "lcp-spg": SpectralProjectedGradient,
    "lzb": LiuZhaoBrogliato,
    "qce": QuadraticContactEnergy,
    "qce-blend": QceBlend,
    "qce-defer": DeferredContactEnergy,
    "qce-lcp": QceLcp,
}
"""Name → law. Adding one is one file and one line here."""

PEERS = frozenset({"lcp-apgd", "lcp-clarabel", "lcp-osqp", "lcp-spg"})
"""More methods for the law of `lcp-pgs` and `lcp-nnls`: the bench compares them, the scorecard judges the law once."""

__all__ = [
    "PEERS", "SOLVERS", "ImpactProblem", "ImpactSolution", "ProblemError", "Solver", "Status", "UnsupportedProblem",
]  # fmt: skip

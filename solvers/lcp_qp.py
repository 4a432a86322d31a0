"""The Newton LCP solved exactly as a quadratic program: the accuracy peer of projected Gauss-Seidel.

    min ½ |x|²  subject to  A x >= (-(1 + c_r) u_pre),   A = J L,  M⁻¹ = L Lᵀ,  v_post = v_pre + L x

Least distance programming: one nonnegative least-squares problem min |E z - f|, E = [Aᵀ; -bᵀ], f = (0, …, 0, 1),
whose residual gives x and λ = z / (1 + bᵀz). Unlike the dual form it needs no right-hand side in the range of A, so
that restitution may differ from contact to contact. Source: Lawson and Hanson 1974, "Solving least squares problems",
chapter 23. Impulses are not unique where W is singular; velocities are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize

from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem


@dataclass(frozen=True)
class NewtonLcpNnls:
    """Newton LCP by nonnegative least squares: an active set, exact up to rounding; small problems, no friction."""

    tolerance: float = 1e-10
    """Natural-map residual above which the answer is called stalled, relative to the largest |u_pre|."""

    max_contacts: int = 600
    """Larger problems are refused: the dense active set costs O(m³)."""

    max_iterations_per_contact: int = 30
    """Bound on active-set changes, per contact."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact.

        Raises:
            UnsupportedProblem: friction, or too many contacts.
        """
        if problem.has_friction:
            raise UnsupportedProblem("the quadratic program has no friction: friction must be 0")
        if problem.m > self.max_contacts:
            raise UnsupportedProblem(
                f"{problem.m} contacts: dense nonnegative least squares takes at most max_contacts = "
                f"{self.max_contacts}"
            )
        if problem.m == 0:
            return ImpactSolution(np.zeros(0), problem.v_pre.copy(), Status.CONVERGED, 0, 0, 0.0)
        scale = 1.0 / np.sqrt(problem.W_diagonal)
        A = _unit_rows(problem)
        b = (1.0 + problem.restitution) * problem.u_pre * scale
        size = float(np.abs(b).max()) or 1.0
        z, converged = _least_distance(A, b / size, maxiter=self.max_iterations_per_contact * problem.m)
        impulse = z * size * scale
        u = problem.u_pre + problem.J @ (problem.JM.T @ impulse)
        natural = np.minimum(u + problem.restitution * problem.u_pre, problem.W_diagonal * impulse)
        residual = float(np.abs(natural).max()) / (problem.speed or 1.0)
        status = Status.STALLED if residual > self.tolerance else Status.CONVERGED
        if not converged:
            status = Status.ITERATION_LIMIT
        pushing = int(np.count_nonzero(impulse))
        # An active set changes one contact at a time: at least one product with all rows for every pushing one.
        return ImpactSolution(impulse, problem.v_after(impulse), status, pushing, problem.m * max(pushing, 1), residual)


def _unit_rows(problem: ImpactProblem) -> Floats:
    """Return A with A Aᵀ = W scaled to a unit diagonal, shape (m, n) or (m, m)."""
    diagonal = problem.inverse_mass.diagonal()
    if problem.inverse_mass.nnz == np.count_nonzero(diagonal):
        A = problem.J.toarray() * np.sqrt(diagonal)
    else:
        eigenvalues, vectors = scipy.linalg.eigh(
            problem.W.toarray() / np.sqrt(np.outer(problem.W_diagonal, problem.W_diagonal))
        )
        A = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    rows: Floats = A / np.linalg.norm(A, axis=1)[:, None]
    return rows


def _least_distance(A: Floats, b: Floats, *, maxiter: int) -> tuple[Floats, bool]:
    """Multipliers z ≥ 0 of min ½|x|² subject to A x ≥ -b, shape (m,); False where the bound was reached."""
    E = np.vstack([A.T, -b])
    f = np.zeros(E.shape[0])
    f[-1] = 1.0
    try:
        z, _ = scipy.optimize.nnls(E, f, maxiter=maxiter)
    except RuntimeError:
        return np.zeros(b.size), False
    remainder = 1.0 + float(b @ z)
    if not remainder > 0:
        return np.zeros(b.size), False
    z = z / remainder
    return _polished(A, b, z), True


def _polished(A: Floats, b: Floats, z: Floats) -> Floats:
    """Solve anew on the active set alone: the division by 1 + bᵀz costs digits where |x| is large."""
    active = np.flatnonzero(z > 0)
    if active.size == 0:
        return z
    x = np.linalg.lstsq(A[active], -b[active], rcond=None)[0]
    better = z.copy()
    better[active] = np.linalg.lstsq(A[active].T, x, rcond=None)[0]
    if better.min() < 0:
        return z
    return better if _natural_map(A, b, better) < _natural_map(A, b, z) else z


def _natural_map(A: Floats, b: Floats, z: Floats) -> float:
    return float(np.abs(np.minimum(A @ (A.T @ z) + b, z)).max())

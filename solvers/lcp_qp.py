"""The Newton LCP as a quadratic program: accuracy peers of projected Gauss-Seidel, by other people's methods.

    min ½ |x|²  subject to  A x >= (-(1 + c_r) u_pre),   A = J L,  M⁻¹ = L Lᵀ,  v_post = v_pre + L x

Least distance programming: one nonnegative least-squares problem min |E z - f|, E = [Aᵀ; -bᵀ], f = (0, …, 0, 1),
whose residual gives x and λ = z / (1 + bᵀz). Unlike the dual form it needs no right-hand side in the range of A, so
that restitution may differ from contact to contact. Source: Lawson and Hanson 1974, "Solving least squares problems",
chapter 23. Impulses are not unique where W is singular; velocities are.

`lcp-osqp` (Stellato 2020, operator splitting with polishing) and `lcp-clarabel` (Goulart and Chen 2024, interior
point) get the same program sparse, with a unit diagonal of W and velocities near one; where M⁻¹ is not diagonal, its
dual min ½ zᵀ W z + bᵀ z, z ≥ 0. Their flags are not read: an interior point method at a tolerance of 1e-6 leaves a
natural map of 1e-4, and polishing may fail silently. The residual is measured here and decides the status.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.sparse as sp

from solvers.lcp_gradient import judged
from solvers.problem import ImpactProblem, Matrix
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem

# Natural map of a nonnegative least-squares problem with unit rows that counts as solved; rounding leaves 1e-15 of it.
MINIMAL = 1e-12


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
        z, ended = _least_distance(A, b / size, maxiter=self.max_iterations_per_contact * problem.m)
        impulse = z * size * scale
        pushing = int(np.count_nonzero(impulse))
        missed = Status.STALLED if ended else Status.ITERATION_LIMIT
        # An active set changes one contact at a time: at least one product with all rows for every pushing one.
        return judged(problem, impulse, self.tolerance, pushing, problem.m * max(pushing, 1), missed=missed)


@dataclass(frozen=True)
class NewtonLcpOsqp:
    """Newton LCP by OSQP: operator splitting, then one polish on the contacts that it found pushing; no friction."""

    tolerance: float = 1e-10
    """Natural-map residual up to which the answer counts as converged, relative to the largest |u_pre|."""

    solver_tolerance: float = 1e-9
    """OSQP's own absolute and relative tolerance; dimensionless."""

    max_iterations: int = 20_000
    """Bound on OSQP's iterations."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact with any restitution per contact.

        Raises:
            UnsupportedProblem: friction, or the package osqp is not installed.
        """
        return _by_package(problem, "osqp", self._minimize, self.tolerance, self.max_iterations)

    def _minimize(self, osqp: ModuleType, P: Matrix, q: Floats, A: Matrix, b: Floats) -> tuple[Floats, Floats, int]:
        """Minimize ½ xᵀPx + qᵀx subject to A x ≥ -b; x, multipliers ≥ 0, iterations."""
        method = osqp.OSQP()
        method.setup(
            sp.csc_matrix(sp.triu(P)), q, sp.csc_matrix(A), -b, np.full(b.size, np.inf),
            verbose=False, eps_abs=self.solver_tolerance, eps_rel=self.solver_tolerance,
            max_iter=self.max_iterations,
        )  # fmt: skip
        result = method.solve(raise_error=False)
        iterations = int(result.info.iter)
        # Polishing without an active constraint would write to the terminal, and has nothing to do.
        if iterations < self.max_iterations and (A @ result.x + b < -result.y).any():
            method.update_settings(polishing=True, max_iter=self.max_iterations - iterations)
            result = method.solve(raise_error=False)
            iterations += int(result.info.iter)
        return np.asarray(result.x, np.float64), -np.asarray(result.y, np.float64), iterations


@dataclass(frozen=True)
class NewtonLcpClarabel:
    """Newton LCP by Clarabel's interior point method; no friction."""

    tolerance: float = 1e-8
    """Natural-map residual up to which the answer counts as converged, relative to the largest |u_pre|."""

    solver_tolerance: float = 1e-11
    """Clarabel's own tolerance on gap and feasibility; dimensionless."""

    max_iterations: int = 200
    """Bound on interior point iterations, each with one factorization."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact with any restitution per contact.

        Raises:
            UnsupportedProblem: friction, or the package clarabel is not installed.
        """
        return _by_package(problem, "clarabel", self._minimize, self.tolerance, self.max_iterations)

    def _minimize(self, clarabel: ModuleType, P: Matrix, q: Floats, A: Matrix, b: Floats) -> tuple[Floats, Floats, int]:
        """Minimize ½ xᵀPx + qᵀx subject to A x ≥ -b; x, multipliers ≥ 0, iterations."""
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_iter = self.max_iterations
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = self.solver_tolerance
        # One thread: factorizations in parallel would not give the same bits each time.
        settings.max_threads = 1
        method = clarabel.DefaultSolver(
            sp.csc_matrix(sp.triu(P)), q, sp.csc_matrix(-A), b, [clarabel.NonnegativeConeT(b.size)], settings
        )
        result = method.solve()
        return np.asarray(result.x, np.float64), np.asarray(result.z, np.float64), int(result.iterations)


def _by_package(
    problem: ImpactProblem,
    package: str,
    minimize: Callable[[ModuleType, Matrix, Floats, Matrix, Floats], tuple[Floats, Floats, int]],
    tolerance: float,
    max_iterations: int,
) -> ImpactSolution:
    """Scale a problem, hand it to a package's method, and judge the impulse that comes back.

    Args:
        problem: the impact.
        package: name of the package.
        minimize: of the package's module, P (k, k), q (k,), A (l, k) and b (l,): x (k,) that minimizes ½ xᵀPx + qᵀx
            subject to A x ≥ -b, its multipliers ≥ 0 (l,), and iterations.
        tolerance: natural-map residual up to which the answer counts as converged.
        max_iterations: bound of the method.

    Raises:
        UnsupportedProblem: friction, or the package is not installed.
    """
    if problem.has_friction:
        raise UnsupportedProblem("the quadratic program has no friction: friction must be 0")
    try:
        module = importlib.import_module(package)
    except ImportError:
        raise UnsupportedProblem(f"the package {package} is not installed: pip install {package}") from None
    scale = 1.0 / np.sqrt(problem.W_diagonal)
    b = (1.0 + problem.restitution) * problem.u_pre * scale
    size = float(-b.min(initial=0.0))
    if size == 0.0:
        return judged(problem, np.zeros(problem.m), tolerance, 0, 0, missed=Status.STALLED)
    diagonal = problem.inverse_mass.diagonal()
    if problem.inverse_mass.nnz == np.count_nonzero(diagonal):
        A = sp.diags_array(scale) @ problem.J @ sp.diags_array(np.sqrt(diagonal))
        _, z, iterations = minimize(module, sp.eye_array(problem.n), np.zeros(problem.n), A, b / size)
    else:
        W = sp.diags_array(scale) @ problem.W @ sp.diags_array(scale)
        z, _, iterations = minimize(module, W, b / size, sp.eye_array(problem.m), np.zeros(problem.m))
    impulse = np.maximum(np.nan_to_num(z, posinf=0.0, neginf=0.0), 0.0) * size * scale
    missed = Status.ITERATION_LIMIT if iterations >= max_iterations else Status.STALLED
    return judged(problem, impulse, tolerance, iterations, problem.m * iterations, missed=missed)


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
    """Multipliers of min ½|x|² subject to A x ≥ -b.

    Args:
        A: rows of unit length, shape (m, k), any k with A Aᵀ = W.
        b: right-hand side, shape (m,), near one in size.
        maxiter: bound on changes of the active set.

    Returns:
        z ≥ 0, shape (m,), and False where the bound ended it. z = 0 where nothing satisfies the constraints.

    `scipy.optimize.nnls` may return what is no minimum, and a residual below the least one (1.17.1: two boxes of balls
    that push on all walls). What it returns is therefore checked, and the slower `lsq_linear` asked where it fails.
    """
    E = np.vstack([A.T, -b])
    f = np.zeros(E.shape[0])
    f[-1] = 1.0
    try:
        z, _ = scipy.optimize.nnls(E, f, maxiter=maxiter)
    except RuntimeError:
        return np.zeros(b.size), False
    if np.abs(np.minimum(E.T @ (E @ z - f), z)).max() > MINIMAL:
        z = np.maximum(scipy.optimize.lsq_linear(E, f, (0.0, np.inf), method="bvls", max_iter=maxiter).x, 0.0)
    remainder = 1.0 + float(b @ z)
    if not remainder > 0:
        return np.zeros(b.size), True
    z = z / remainder
    return _polished(A, b, z), True


def _polished(A: Floats, b: Floats, z: Floats) -> Floats:
    """Solve anew on the active set alone, shapes as in `_least_distance`: 1 + bᵀz costs digits where |x| is large."""
    active = np.flatnonzero(z > 0)
    if active.size == 0:
        return z
    x = np.linalg.lstsq(A[active], -b[active], rcond=None)[0]
    better = z.copy()
    better[active] = np.linalg.lstsq(A[active].T, x, rcond=None)[0]
    if better.min() < 0:
        return z
    # Large impulses cancel in the residual: below this it does not tell one from the other (mass ratio 10¹²: 10⁻⁴).
    rounding = np.finfo(np.float64).eps * float((np.abs(A) @ (np.abs(A.T) @ better)).max())
    return better if _natural_map(A, b, better) < max(_natural_map(A, b, z), rounding) else z


def _natural_map(A: Floats, b: Floats, z: Floats) -> float:
    """Residual of 0 ≤ z ⊥ A Aᵀ z + b ≥ 0, whose W = A Aᵀ has a unit diagonal."""
    return float(np.abs(np.minimum(A @ (A.T @ z) + b, z)).max())

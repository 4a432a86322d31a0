"""Contact LCPs, without and with friction: the numerical core that several laws share.

    0 <= λ    complementary to  J v - target >= 0          normal rows
    |λ_f| <= μ λ, opposing      D v                        friction pyramid (boxed LCP), two rows a contact
    v = v_start + M⁻¹ (Jᵀ λ + Dᵀ λ_f)

`sweep` is projected Gauss-Seidel, alternating one sweep over the normals with one over the tangents (Zhang 2015,
Eq. 20-21; Stewart 1996, Tonge 2012). `dissipate` solves the tangents alone, the normal impulses held (maximum
dissipation). `project` solves the frictionless problem to rounding: projected Gauss-Seidel finds the contacts that
push, conjugate gradients on those alone remove the slow modes that Gauss-Seidel leaves. All are matrix-free: a visit
touches the velocities of one contact, never a row of W.

Residual: the natural map max |min(J v - target, diag(W) λ)| over the problem's largest |u_pre|, dimensionless.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.problem import ImpactProblem, Matrix
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]

# Gauss-Seidel sweeps between two conjugate-gradient runs: enough to change the set of pushing contacts.
SWEEPS_PER_FACE = 6
# The velocity is carried along incrementally and computed anew so often: rounding grows as √visits in between.
REFRESH = 64


@dataclass(frozen=True)
class LcpResult:
    """An LCP's solution and what it cost."""

    impulse: Floats
    """λ [N s], shape (m,), ≥ 0."""
    friction_impulse: Floats | None
    """λ_f [N s], shape (2m,); None without friction."""
    v: Floats
    """Velocity after both [m/s, rad/s], shape (n,)."""
    sweeps: int
    visits: int
    residual: float
    """Natural map, relative to the problem's largest |u_pre|."""


def sweep(
    problem: ImpactProblem, target: Floats, *, tolerance: float, max_sweeps: int, start: Floats | None = None
) -> LcpResult:
    """Solve the LCP by projected Gauss-Seidel, with friction where the problem has it (Zhang 2015, Eq. 21).

    Args:
        problem: bodies, contacts, friction.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        tolerance: natural-map residual at which to stop, dimensionless.
        max_sweeps: bound on sweeps (over normals and tangents).
        start: first guess of λ, shape (m,).
    """
    impulse = np.zeros(problem.m) if start is None else np.maximum(start, 0.0)
    friction_impulse = np.zeros(2 * problem.m)
    J, JM = problem.J, problem.JM
    D, DM = _tangents(problem)
    v, sweeps, visits, residual = _sweep(
        J.indptr, J.indices, J.data, JM.indptr, JM.indices, JM.data, problem.W_diagonal,
        D.indptr, D.indices, D.data, DM.indptr, DM.indices, DM.data, problem.friction,
        problem.v_pre, target, impulse, friction_impulse, tolerance * _scale(problem), max_sweeps,
    )  # fmt: skip
    friction = friction_impulse if problem.has_friction else None
    return LcpResult(impulse, friction, v, sweeps, visits, residual / _scale(problem))


def dissipate(problem: ImpactProblem, impulse: Floats, *, tolerance: float, max_sweeps: int) -> LcpResult:
    """Find the friction impulse of maximum dissipation for given normal impulses, shape (m,) (Smith 2012)."""
    friction_impulse = np.zeros(2 * problem.m)
    D, DM = _tangents(problem)
    v, sweeps, visits, residual = _dissipate(
        D.indptr, D.indices, D.data, DM.indptr, DM.indices, DM.data, problem.friction,
        problem.v_after(impulse), impulse, friction_impulse, tolerance * _scale(problem), max_sweeps,
    )  # fmt: skip
    return LcpResult(impulse, friction_impulse, v, sweeps, visits, residual / _scale(problem))


def project(
    problem: ImpactProblem,
    target: Floats,
    *,
    rows: Ints | None = None,
    v_start: Floats | None = None,
    tolerance: float,
    max_sweeps: int,
) -> LcpResult:
    """Solve the frictionless LCP to rounding: v is the projection of v_start on {J v ≥ target} in the mass norm.

    Args:
        problem: bodies and contacts; friction is not read.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        rows: the contacts that take part, ascending; all if None.
        v_start: velocity before [m/s], shape (n,); the problem's v_pre if None.
        tolerance: natural-map residual at which to stop, dimensionless.
        max_sweeps: bound on sweeps; a conjugate-gradient step counts as one.
    """
    J, JM = problem.J, problem.JM
    impulse, v, sweeps, visits, residual = _project(
        J.indptr, J.indices, J.data, JM.indptr, JM.indices, JM.data, problem.W_diagonal,
        np.arange(problem.m, dtype=np.int32) if rows is None else rows,
        problem.v_pre.copy() if v_start is None else v_start.copy(),
        target, tolerance * _scale(problem), max_sweeps,
    )  # fmt: skip
    return LcpResult(impulse, None, v, sweeps, visits, residual / _scale(problem))


def _scale(problem: ImpactProblem) -> float:
    return problem.speed if problem.speed > 0 else 1.0


def _tangents(problem: ImpactProblem) -> tuple[Matrix, Matrix]:
    """D and D M⁻¹; the empty D M⁻¹ stands for both without friction."""
    return (problem.DM if problem.D is None else problem.D), problem.DM


@kernel
def _row(start: Ints, index: Ints, value: Floats, i: int, v: Floats) -> float:
    """Row i of a CSR matrix times v."""
    total = 0.0
    for q in range(start[i], start[i + 1]):
        total += value[q] * v[index[q]]
    return total


@kernel
def _add_row(start: Ints, index: Ints, value: Floats, i: int, factor: float, v: Floats) -> None:
    """Add a multiple of row i of a CSR matrix to v."""
    for q in range(start[i], start[i + 1]):
        v[index[q]] += factor * value[q]


@kernel
def _tangent_sweep(
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats,
    diagonal: Floats, mu: Floats, impulse: Floats, friction_impulse: Floats, v: Floats,
) -> float:  # fmt: skip
    """One projected sweep over the tangents, |λ_f| ≤ μ λ; returns the largest velocity change that it made."""
    change = 0.0
    for i in range(mu.size):
        if mu[i] == 0.0:
            continue
        bound = mu[i] * impulse[i]
        for row in range(2 * i, 2 * i + 2):
            if diagonal[row] <= 0.0:
                continue
            wanted = friction_impulse[row] - _row(D_start, D_index, D, row, v) / diagonal[row]
            step = min(max(wanted, -bound), bound) - friction_impulse[row]
            if step != 0.0:
                friction_impulse[row] += step
                _add_row(DM_start, DM_index, DM, row, step, v)
                change = max(change, abs(step) * diagonal[row])
    return change


@kernel
def _tangent_residual(
    D_start: Ints, D_index: Ints, D: Floats,
    diagonal: Floats, mu: Floats, impulse: Floats, friction_impulse: Floats, v: Floats,
) -> float:  # fmt: skip
    """Natural map of the boxed LCP [m/s]."""
    residual = 0.0
    for i in range(mu.size):
        if mu[i] == 0.0:
            continue
        bound = mu[i] * impulse[i]
        for row in range(2 * i, 2 * i + 2):
            if diagonal[row] <= 0.0:
                continue
            wanted = friction_impulse[row] - _row(D_start, D_index, D, row, v) / diagonal[row]
            step = min(max(wanted, -bound), bound) - friction_impulse[row]
            residual = max(residual, abs(step) * diagonal[row])
    return residual


@kernel
def _tangent_diagonal(
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats, n: int
) -> Floats:
    """Diagonal of D M⁻¹ Dᵀ; zero for the unused direction of a planar contact."""
    rows = D_start.size - 1
    diagonal = np.zeros(rows)
    column = np.zeros(n)
    for row in range(rows):
        _add_row(D_start, D_index, D, row, 1.0, column)
        diagonal[row] = _row(DM_start, DM_index, DM, row, column)
        for q in range(D_start[row], D_start[row + 1]):
            column[D_index[q]] = 0.0
    return diagonal


@kernel
def _sweep(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats, W_diagonal: Floats,
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats, mu: Floats,
    v_pre: Floats, target: Floats, impulse: Floats, friction_impulse: Floats, tolerance: float, max_sweeps: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """Projected Gauss-Seidel from given impulses (changed in place); returns v, sweeps, visits, residual [m/s]."""
    m = target.size
    diagonal = _tangent_diagonal(D_start, D_index, D, DM_start, DM_index, DM, v_pre.size)
    frictional = 0
    for i in range(m):
        if mu[i] > 0.0:
            frictional += 1
    sweeps = 0
    visits = 0
    residual = np.inf
    v = v_pre.copy()
    while True:
        if sweeps % REFRESH == 0:
            # The velocity anew: increments would collect rounding.
            v[:] = v_pre
            for i in range(m):
                _add_row(JM_start, JM_index, JM, i, impulse[i], v)
                if mu[i] > 0.0:
                    _add_row(DM_start, DM_index, DM, 2 * i, friction_impulse[2 * i], v)
                    _add_row(DM_start, DM_index, DM, 2 * i + 1, friction_impulse[2 * i + 1], v)
        change = 0.0
        for i in range(m):
            excess = _row(J_start, J_index, J, i, v) - target[i]
            step = max(-excess / W_diagonal[i], -impulse[i])
            if step != 0.0:
                impulse[i] += step
                _add_row(JM_start, JM_index, JM, i, step, v)
                change = max(change, abs(step) * W_diagonal[i])
        if frictional:
            slip = _tangent_sweep(
                D_start, D_index, D, DM_start, DM_index, DM, diagonal, mu, impulse, friction_impulse, v
            )
            change = max(change, slip)
        sweeps += 1
        visits += m + 2 * frictional
        if change <= tolerance or sweeps >= max_sweeps:
            # The changes of a sweep are only an estimate: measure the residual itself, on a fresh velocity.
            v[:] = v_pre
            for i in range(m):
                _add_row(JM_start, JM_index, JM, i, impulse[i], v)
                if mu[i] > 0.0:
                    _add_row(DM_start, DM_index, DM, 2 * i, friction_impulse[2 * i], v)
                    _add_row(DM_start, DM_index, DM, 2 * i + 1, friction_impulse[2 * i + 1], v)
            residual = 0.0
            for i in range(m):
                excess = _row(J_start, J_index, J, i, v) - target[i]
                residual = max(residual, abs(min(excess, impulse[i] * W_diagonal[i])))
            if frictional:
                slip = _tangent_residual(D_start, D_index, D, diagonal, mu, impulse, friction_impulse, v)
                residual = max(residual, slip)
            visits += m + 2 * frictional
            if residual <= tolerance or sweeps >= max_sweeps:
                return v, sweeps, visits, residual


@kernel
def _dissipate(
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats, mu: Floats,
    v_start: Floats, impulse: Floats, friction_impulse: Floats, tolerance: float, max_sweeps: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """Sweeps over the tangents alone (λ_f changed in place); returns v, sweeps, visits, residual [m/s]."""
    diagonal = _tangent_diagonal(D_start, D_index, D, DM_start, DM_index, DM, v_start.size)
    v = v_start.copy()
    sweeps = 0
    residual = np.inf
    while residual > tolerance and sweeps < max_sweeps:
        _tangent_sweep(D_start, D_index, D, DM_start, DM_index, DM, diagonal, mu, impulse, friction_impulse, v)
        residual = _tangent_residual(D_start, D_index, D, diagonal, mu, impulse, friction_impulse, v)
        sweeps += 1
    return v, sweeps, 4 * sweeps * mu.size, residual


@kernel
def _project(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats, W_diagonal: Floats,
    rows: Ints, v_start: Floats, target: Floats, tolerance: float, max_sweeps: int,
) -> tuple[Floats, Floats, int, int, float]:  # fmt: skip
    """Gauss-Seidel and conjugate gradients in turn; returns λ, v, sweeps, visits, residual [m/s]."""
    m = target.size
    n = v_start.size
    impulse = np.zeros(m)
    best = np.zeros(m)
    best_residual = np.inf
    r = np.zeros(m)
    z = np.zeros(m)
    p = np.zeros(m)
    Wp = np.zeros(m)
    free = np.zeros(m, np.bool_)
    v = v_start.copy()
    dv = np.zeros(n)
    sweeps = 0
    visits = 0
    idle = 0
    while True:
        # Gauss-Seidel: contacts that start or stop pushing.
        for _ in range(SWEEPS_PER_FACE):
            change = 0.0
            for q in range(rows.size):
                i = rows[q]
                excess = _row(J_start, J_index, J, i, v) - target[i]
                step = max(-excess / W_diagonal[i], -impulse[i])
                if step != 0.0:
                    impulse[i] += step
                    _add_row(JM_start, JM_index, JM, i, step, v)
                    change = max(change, abs(step) * W_diagonal[i])
            sweeps += 1
            visits += rows.size
            if change <= 0.1 * tolerance:
                break
        # Velocity and residual anew.
        v[:] = v_start
        for q in range(rows.size):
            _add_row(JM_start, JM_index, JM, rows[q], impulse[rows[q]], v)
        residual = 0.0
        pushing = 0
        for q in range(rows.size):
            i = rows[q]
            excess = _row(J_start, J_index, J, i, v) - target[i]
            residual = max(residual, abs(min(excess, impulse[i] * W_diagonal[i])))
            free[i] = impulse[i] > 0.0
            r[i] = -excess if free[i] else 0.0
            pushing += free[i]
        visits += rows.size
        if residual < best_residual:
            idle = 0
            best_residual = residual
            best[:] = impulse
        else:
            idle += 1
        if residual <= tolerance or sweeps >= max_sweeps or idle >= max_sweeps // 20 + 20:
            break
        # Conjugate gradients on the pushing contacts, preconditioned by the diagonal, until one would pull.
        rz = 0.0
        for q in range(rows.size):
            i = rows[q]
            z[i] = r[i] / W_diagonal[i] if free[i] else 0.0
            p[i] = z[i]
            rz += r[i] * z[i]
        rz_start = rz
        for _ in range(2 * pushing + 10):
            if not rz > 1e-30 * rz_start or sweeps >= max_sweeps:
                break
            dv[:] = 0.0
            for q in range(rows.size):
                i = rows[q]
                if free[i]:
                    _add_row(JM_start, JM_index, JM, i, p[i], dv)
            pWp = 0.0
            longest = np.inf
            for q in range(rows.size):
                i = rows[q]
                if free[i]:
                    Wp[i] = _row(J_start, J_index, J, i, dv)
                    pWp += p[i] * Wp[i]
                    if p[i] < 0.0:
                        longest = min(longest, -impulse[i] / p[i])
            sweeps += 1
            visits += 2 * pushing
            if not pWp > 0.0:
                break
            length = rz / pWp
            blocked = length >= longest
            length = min(length, longest)
            largest = 0.0
            for q in range(rows.size):
                i = rows[q]
                if free[i]:
                    impulse[i] = max(impulse[i] + length * p[i], 0.0)
                    r[i] -= length * Wp[i]
                    largest = max(largest, abs(r[i]))
            if blocked or largest <= 0.1 * tolerance:
                break
            rz_new = 0.0
            for q in range(rows.size):
                i = rows[q]
                if free[i]:
                    z[i] = r[i] / W_diagonal[i]
                    rz_new += r[i] * z[i]
            beta = rz_new / rz
            rz = rz_new
            for q in range(rows.size):
                i = rows[q]
                if free[i]:
                    p[i] = z[i] + beta * p[i]
        v[:] = v_start
        for q in range(rows.size):
            _add_row(JM_start, JM_index, JM, rows[q], impulse[rows[q]], v)
    v[:] = v_start
    for q in range(rows.size):
        _add_row(JM_start, JM_index, JM, rows[q], best[rows[q]], v)
    return best, v, sweeps, visits, best_residual

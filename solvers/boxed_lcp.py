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
# Unsigned where an entry is itself an index: a signed one costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]

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
        J.indptr, _unsigned(J), J.data, JM.indptr, _unsigned(JM), JM.data, problem.W_diagonal,
        D.indptr, _unsigned(D), D.data, DM.indptr, _unsigned(DM), DM.data, problem.friction,
        problem.v_pre, target, impulse, friction_impulse, tolerance * _scale(problem), max_sweeps,
    )  # fmt: skip
    friction = friction_impulse if problem.has_friction else None
    return LcpResult(impulse, friction, v, sweeps, visits, residual / _scale(problem))


def dissipate(problem: ImpactProblem, impulse: Floats, *, tolerance: float, max_sweeps: int) -> LcpResult:
    """Find the friction impulse of maximum dissipation for given normal impulses, shape (m,) (Smith 2012)."""
    friction_impulse = np.zeros(2 * problem.m)
    D, DM = _tangents(problem)
    v, sweeps, visits, residual = _dissipate(
        D.indptr, _unsigned(D), D.data, DM.indptr, _unsigned(DM), DM.data, problem.friction,
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
    v = problem.v_pre.copy() if v_start is None else v_start.copy()
    limit = tolerance * _scale(problem)
    if rows is None:
        impulse, sweeps, visits, residual = _project(
            J.indptr, _unsigned(J), J.data, JM.indptr, _unsigned(JM), JM.data, problem.W_diagonal,
            v, target, limit, max_sweeps,
        )  # fmt: skip
        return LcpResult(impulse, None, v, sweeps, visits, residual / _scale(problem))
    # The rows by themselves, with the velocities that they touch: sweeps over a few contacts of a large problem would
    # spend their time on the velocities of all others, and on cache misses between them.
    start, index, value, M_start, M_index, M_value, columns = _part(
        rows, J.indptr, _unsigned(J), J.data, JM.indptr, _unsigned(JM), JM.data, problem.n
    )
    v_part = v[columns]
    impulse_part, sweeps, visits, residual = _project(
        start, index, value, M_start, M_index, M_value, problem.W_diagonal[rows],
        v_part, target[rows], limit, max_sweeps,
    )  # fmt: skip
    v[columns] = v_part
    impulse = np.zeros(problem.m)
    impulse[rows] = impulse_part
    return LcpResult(impulse, None, v, sweeps, visits, residual / _scale(problem))


def _scale(problem: ImpactProblem) -> float:
    return problem.speed if problem.speed > 0 else 1.0


def _unsigned(matrix: Matrix) -> Indices:
    """Column indices of a CSR matrix as the kernels read them; no copy."""
    indices: Indices = matrix.indices.view(np.uint32)
    return indices


def _tangents(problem: ImpactProblem) -> tuple[Matrix, Matrix]:
    """D and D M⁻¹; the empty D M⁻¹ stands for both without friction."""
    return (problem.DM if problem.D is None else problem.D), problem.DM


@kernel
def _row(start: Ints, index: Indices, value: Floats, i: int, v: Floats) -> float:
    """Row i of a CSR matrix times v."""
    total = 0.0
    for q in range(start[i], start[i + 1]):
        total += value[q] * v[index[q]]
    return total


@kernel
def _add_row(start: Ints, index: Indices, value: Floats, i: int, factor: float, v: Floats) -> None:
    """Add a multiple of row i of a CSR matrix to v."""
    for q in range(start[i], start[i + 1]):
        v[index[q]] += factor * value[q]


@kernel
def _normal_sweep(
    rows: Ints, J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    W_diagonal: Floats, target: Floats, impulse: Floats, v: Floats,
) -> float:  # fmt: skip
    """One projected sweep over the normals of some contacts; returns the largest velocity change that it made.

    Without branches, also where the step is zero: half of the contacts push, at random, and a mispredicted branch
    costs as much as the row.
    """
    change = 0.0
    for position in range(rows.size):
        i = rows[position]
        u = 0.0
        for q in range(J_start[i], J_start[i + 1]):
            u += J[q] * v[J_index[q]]
        step = -(u - target[i]) / W_diagonal[i]
        step = step if step > -impulse[i] else -impulse[i]
        impulse[i] += step
        for q in range(JM_start[i], JM_start[i + 1]):
            v[JM_index[q]] += step * JM[q]
        jump = abs(step) * W_diagonal[i]
        change = jump if jump > change else change
    return change


@kernel
def _push(rows: Ints, JM_start: Ints, JM_index: Indices, JM: Floats, impulse: Floats, v: Floats) -> None:
    """Add M⁻¹ Jᵀ impulse of some contacts to v."""
    for position in range(rows.size):
        i = rows[position]
        if impulse[i] != 0.0:
            for q in range(JM_start[i], JM_start[i + 1]):
                v[JM_index[q]] += impulse[i] * JM[q]


@kernel
def _excess(rows: Ints, J_start: Ints, J_index: Indices, J: Floats, target: Floats, v: Floats, excess: Floats) -> None:
    """J v - target at some contacts."""
    for position in range(rows.size):
        i = rows[position]
        u = 0.0
        for q in range(J_start[i], J_start[i + 1]):
            u += J[q] * v[J_index[q]]
        excess[i] = u - target[i]


@kernel
def _tangent_sweep(
    D_start: Ints, D_index: Indices, D: Floats, DM_start: Ints, DM_index: Indices, DM: Floats,
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
    D_start: Ints, D_index: Indices, D: Floats,
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
    D_start: Ints, D_index: Indices, D: Floats, DM_start: Ints, DM_index: Indices, DM: Floats, n: int
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
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats, W_diagonal: Floats,
    D_start: Ints, D_index: Indices, D: Floats, DM_start: Ints, DM_index: Indices, DM: Floats, mu: Floats,
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
    rows = np.arange(m).astype(np.int32)
    tangents = np.arange(friction_impulse.size).astype(np.int32)
    excess = np.zeros(m)
    while True:
        if sweeps % REFRESH == 0:
            # The velocity anew: increments would collect rounding.
            v[:] = v_pre
            _push(rows, JM_start, JM_index, JM, impulse, v)
            if frictional:
                _push(tangents, DM_start, DM_index, DM, friction_impulse, v)
        change = _normal_sweep(rows, J_start, J_index, J, JM_start, JM_index, JM, W_diagonal, target, impulse, v)
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
            _push(rows, JM_start, JM_index, JM, impulse, v)
            if frictional:
                _push(tangents, DM_start, DM_index, DM, friction_impulse, v)
            residual = 0.0
            _excess(rows, J_start, J_index, J, target, v, excess)
            for i in range(m):
                residual = max(residual, abs(min(excess[i], impulse[i] * W_diagonal[i])))
            if frictional:
                slip = _tangent_residual(D_start, D_index, D, diagonal, mu, impulse, friction_impulse, v)
                residual = max(residual, slip)
            visits += m + 2 * frictional
            if residual <= tolerance or sweeps >= max_sweeps:
                return v, sweeps, visits, residual


@kernel
def _dissipate(
    D_start: Ints, D_index: Indices, D: Floats, DM_start: Ints, DM_index: Indices, DM: Floats, mu: Floats,
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
def _part_of(
    rows: Ints, start: Ints, index: Indices, value: Floats, number: Ints, columns: Ints, count: int
) -> tuple[Ints, Indices, Floats, int]:
    """Some rows of a CSR matrix, with columns renumbered in the order in which they are met; and how many there are."""
    size = 0
    for position in range(rows.size):
        size += start[rows[position] + 1] - start[rows[position]]
    new_start = np.zeros(rows.size + 1, np.int32)
    new_index = np.empty(size, np.uint32)
    new_value = np.empty(size)
    place = 0
    for position in range(rows.size):
        i = rows[position]
        for q in range(start[i], start[i + 1]):
            d = index[q]
            if number[d] < 0:
                number[d] = count
                columns[count] = d
                count += 1
            new_index[place] = number[d]
            new_value[place] = value[q]
            place += 1
        new_start[position + 1] = place
    return new_start, new_index, new_value, count


@kernel
def _part(
    rows: Ints, J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats, n: int
) -> tuple[Ints, Indices, Floats, Ints, Indices, Floats, Ints]:
    """Some rows of J and J M⁻¹ over the velocities that they touch, and which those are."""
    number = np.full(n, -1, np.int32)
    columns = np.empty(n, np.int32)
    part_start, part_index, part, count = _part_of(rows, J_start, J_index, J, number, columns, 0)
    M_start, M_index, M, count = _part_of(rows, JM_start, JM_index, JM, number, columns, count)
    return part_start, part_index, part, M_start, M_index, M, columns[:count].copy()


@kernel
def _project(
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats, W_diagonal: Floats,
    v: Floats, target: Floats, tolerance: float, max_sweeps: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """Gauss-Seidel and conjugate gradients in turn, v changed; returns λ, sweeps, visits, residual [m/s]."""
    m = target.size
    impulse = np.zeros(m)
    best = np.zeros(m)
    best_residual = np.inf
    r = np.zeros(m)
    z = np.zeros(m)
    p = np.zeros(m)
    Wp = np.zeros(m)
    rest = np.zeros(m)
    v_start = v.copy()
    dv = np.zeros(v.size)
    rows = np.arange(m).astype(np.int32)
    pushing_rows = np.zeros(m, np.int32)
    sweeps = 0
    visits = 0
    idle = 0
    while True:
        # Gauss-Seidel: contacts that start or stop pushing.
        for _ in range(SWEEPS_PER_FACE):
            change = _normal_sweep(rows, J_start, J_index, J, JM_start, JM_index, JM, W_diagonal, target, impulse, v)
            sweeps += 1
            visits += rows.size
            if change <= 0.1 * tolerance:
                break
        # Velocity and residual anew.
        v[:] = v_start
        _push(rows, JM_start, JM_index, JM, impulse, v)
        residual = 0.0
        pushing = 0
        _excess(rows, J_start, J_index, J, target, v, r)
        for i in range(m):
            residual = max(residual, abs(min(r[i], impulse[i] * W_diagonal[i])))
            pushing_rows[pushing] = i
            pushing += impulse[i] > 0.0
            r[i] = -r[i]
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
        free = pushing_rows[:pushing]
        rz = 0.0
        for q in range(pushing):
            i = free[q]
            z[i] = r[i] / W_diagonal[i]
            p[i] = z[i]
            rz += r[i] * z[i]
        rz_start = rz
        for _ in range(2 * pushing + 10):
            if not rz > 1e-30 * rz_start or sweeps >= max_sweeps:
                break
            dv[:] = 0.0
            _push(free, JM_start, JM_index, JM, p, dv)
            _excess(free, J_start, J_index, J, rest, dv, Wp)
            pWp = 0.0
            longest = np.inf
            for q in range(pushing):
                i = free[q]
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
            for q in range(pushing):
                i = free[q]
                impulse[i] = max(impulse[i] + length * p[i], 0.0)
                r[i] -= length * Wp[i]
                largest = max(largest, abs(r[i]))
            if blocked or largest <= 0.1 * tolerance:
                break
            rz_new = 0.0
            for q in range(pushing):
                i = free[q]
                z[i] = r[i] / W_diagonal[i]
                rz_new += r[i] * z[i]
            beta = rz_new / rz
            rz = rz_new
            for q in range(pushing):
                i = free[q]
                p[i] = z[i] + beta * p[i]
        v[:] = v_start
        _push(rows, JM_start, JM_index, JM, impulse, v)
    v[:] = v_start
    _push(rows, JM_start, JM_index, JM, best, v)
    return best, sweeps, visits, best_residual

"""Projected Gauss-Seidel for contacts with friction, matrix-free: one row after the other, each to its own optimum.

    λ ← max(0, λ - (J v - target) / W_ii)                                normals
    λ_f ← min(max(λ_f - (D v + β₀ D v_pre) / (D M⁻¹ Dᵀ)_kk, -μ λ), μ λ)  tangents

v follows every step, so that a visit touches the velocities of one contact and never a row of W. Normals come in two
forms: packed where the problem is of spheres (`sphere_rows`: 32 bytes a contact, neighbors in space are neighbors in
memory), CSR otherwise. Tangents are CSR over the same velocities, as spin may make their rows long.

With friction sweeps may creep (see `proximal_newton`), and where contacts are redundant friction leaves the velocity
open: how a face's load is shared by its corners decides what each of them holds, and sweeps share it by the order of
the contacts. Where the problem is small enough proximal steps come first, which do not depend on that order, each
measured on the problem itself; an iteration of Newton's counts as a sweep. What they leave is left to sweeps. What ends
early is cut to the share with which no kinetic energy is gained.

Sources: Zhang 2015, Eq. 20-21; Stewart 1996; Tonge 2012.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from solvers._jit import kernel
from solvers.problem import ImpactProblem, Matrix
from solvers.proximal_newton import ITERATIONS, eliminate, proximal_step
from solvers.solution import Floats
from solvers.sphere_rows import SphereRows, sphere_rows

Ints = npt.NDArray[np.int32]
# Unsigned where an entry is itself an index: a signed one costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]

# The velocity is carried along incrementally; so often it is computed anew, as rounding grows with √visits in between.
REFRESH = 64
# Packing a smaller problem takes longer than it saves.
PACKED = 200
# ε of the first proximal step, and its bounds: rounding below, less than a sweep above.
START, SMALLEST, LARGEST = 1e-3, 1e-7, 10.0
# Newton's iterations at most: what they do not solve is left to sweeps.
NEWTON = 1_000
# Factor by which ε shrinks after a step that was solved, and grows after one that was not.
CHANGE = 4.0
# The least ε that is tried is twice the last one that failed; it is halved with each step that is solved.
GUARD = 2.0
# Packed velocities: three entries of a body, then its inverse mass.
STRIDE = 4
MASS = 3


def sweep(
    problem: ImpactProblem,
    target: Floats,
    impulse: Floats,
    friction_impulse: Floats,
    *,
    tolerance: float,
    max_sweeps: int,
    max_visits: int,
) -> tuple[Floats, Floats, Floats, int, int, float]:
    """Alternate sweeps over the normals and over the tangents (Zhang 2015, Eq. 21).

    Args:
        problem: bodies, contacts, friction.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        impulse: first guess of λ [N s], shape (m,), ≥ 0.
        friction_impulse: first guess of λ_f [N s], shape (2m,), within its bounds.
        tolerance: natural map at which to stop [m/s].
        max_sweeps: bound on sweeps over normals and tangents, and Newton's iterations.
        max_visits: bound on row visits, and products of blocks; the sweep in progress is finished.

    Returns:
        impulse, friction impulse [N s], velocity [m/s, rad/s], sweeps, row visits, natural map [m/s].
    """
    found, found_friction = impulse.copy(), friction_impulse.copy()
    rows = sphere_rows(problem) if problem.m >= PACKED else None
    first = 0 if problem.has_friction else max_sweeps
    v, sweeps, visits, residual = _swept(problem, target, found, found_friction, rows, tolerance, first, max_visits)
    if residual > tolerance and problem.has_friction:
        v, sweeps, visits, residual = _proximal_steps(
            problem, target, found, found_friction, v, residual, visits,
            tolerance=tolerance, max_steps=min(max_sweeps, NEWTON), max_visits=max_visits,
        )  # fmt: skip
    if residual > tolerance and sweeps < max_sweeps and visits < max_visits:
        v, more, more_visits, residual = _swept(
            problem, target, found, found_friction, rows, tolerance, max_sweeps - sweeps, max_visits - visits
        )
        sweeps, visits = sweeps + more, visits + more_visits
    if residual > tolerance and problem.has_friction:
        share = _share_without_gain(problem, found, found_friction, v)
        if share < 1.0:
            found, found_friction = share * found, share * found_friction
            v, _, _, residual = _swept(problem, target, found, found_friction, rows, tolerance, 0, max_visits)
    return found, found_friction, v, sweeps, visits, residual


def _share_without_gain(problem: ImpactProblem, impulse: Floats, friction_impulse: Floats, v: Floats) -> float:
    """Share of impulses that ended early, ≤ 1, with which no kinetic energy is gained.

    The change is s p·u + ½ s² p·W p at the share s, with u before and u + W p after the whole impulse.
    """
    tangents = problem.DM if problem.D is None else problem.D
    before = float(impulse @ problem.u_pre + friction_impulse @ (tangents @ problem.v_pre))
    after = float(impulse @ (problem.J @ v) + friction_impulse @ (tangents @ v))
    gained = before + after > 0.0 > before
    return -2.0 * before / (after - before) if gained else 1.0


def _proximal_steps(
    problem: ImpactProblem, target: Floats, impulse: Floats, friction_impulse: Floats, v: Floats, residual: float,
    visits: int, *, tolerance: float, max_steps: int, max_visits: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """Proximal steps from given impulses (changed in place), with their velocity and natural map; returns as `_sweep`.

    A step that was solved may be followed by a longer one, though not at once by one as long as failed; one that was
    not is tried again with a shorter one, from where it came to if that is nearer.
    """
    elimination = eliminate(problem) if max_steps >= ITERATIONS else None
    epsilon, least, steps = START, SMALLEST, 0
    while (
        elimination is not None and residual > tolerance and epsilon <= LARGEST
        and steps + ITERATIONS <= max_steps and visits < max_visits
    ):  # fmt: skip
        trial, trial_friction, solved, more = proximal_step(
            problem, elimination, target, impulse, friction_impulse, epsilon=epsilon, tolerance=tolerance
        )
        trial_v, _, more_visits, left = _swept(problem, target, trial, trial_friction, None, tolerance, 0, max_visits)
        if solved or left < residual:
            impulse[:], friction_impulse[:], v, residual = trial, trial_friction, trial_v, left
        if solved:
            epsilon, least = max(epsilon / CHANGE, least), max(least / GUARD, SMALLEST)
        else:
            epsilon, least = CHANGE * epsilon, GUARD * epsilon
        steps += more
        visits += more_visits + more * elimination.products
    return v, steps, visits, residual


def _swept(
    problem: ImpactProblem, target: Floats, impulse: Floats, friction_impulse: Floats, rows: SphereRows | None,
    tolerance: float, max_sweeps: int, max_visits: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """Sweeps from given impulses (changed in place); returns as `_sweep`, in the problem's order."""
    order, tangent_order = _orders(problem, rows)
    found, found_friction = impulse[order], friction_impulse[tangent_order]
    v, sweeps, visits, residual = _sweep(
        *_normals(problem, rows), *_tangents(problem, rows), problem.W_diagonal[order], problem.friction[order],
        problem.v_pre.copy() if rows is None else rows.V.ravel(), target[order], problem.slip_target[tangent_order],
        found, found_friction, tolerance, max_sweeps, max_visits,
    )  # fmt: skip
    impulse[order], friction_impulse[tangent_order] = found, found_friction
    velocity = v if rows is None else rows.velocity_in_problem_order(v.reshape(-1, STRIDE), problem.n)
    return velocity, sweeps, visits, residual


def dissipate(
    problem: ImpactProblem, impulse: Floats, v_start: Floats, *, tolerance: float, max_sweeps: int, max_visits: int
) -> tuple[Floats, Floats, int, int, float]:
    """Sweep over the tangents alone, the normal impulses held.

    Args:
        problem: bodies, contacts, friction.
        impulse: λ [N s], shape (m,).
        v_start: velocity with these normal impulses [m/s, rad/s], shape (n,).
        tolerance: natural map at which to stop [m/s].
        max_sweeps: bound on sweeps.
        max_visits: bound on row visits; the sweep in progress is finished.

    Returns:
        friction impulse [N s], velocity [m/s, rad/s], sweeps, row visits, natural map [m/s].
    """
    friction_impulse = np.zeros(2 * problem.m)
    v, sweeps, visits, residual = _dissipate(
        *_tangents(problem, None), problem.friction, problem.slip_target, v_start.copy(), impulse, friction_impulse,
        tolerance, max_sweeps, max_visits,
    )  # fmt: skip
    return friction_impulse, v, sweeps, visits, residual


def _orders(problem: ImpactProblem, rows: SphereRows | None) -> tuple[Ints, Ints]:
    """The problem's numbers of the kernels' contacts, shape (m,), and of their tangents, shape (2m,)."""
    order = np.arange(problem.m, dtype=np.int32) if rows is None else rows.contact
    tangent_order: Ints = np.repeat(2 * order, 2)
    tangent_order[1::2] += 1
    return order, tangent_order


def _normals(
    problem: ImpactProblem, rows: SphereRows | None
) -> tuple[Floats, Indices, Ints, Indices, Floats, Ints, Indices, Floats]:
    """Packed normals and bodies, empty where there are none, and the rows of J and J M⁻¹."""
    matrices = *_parts(problem.J), *_parts(problem.JM)
    if rows is None:
        return np.empty((0, 3)), np.empty((0, 2), np.uint32), *matrices
    return rows.normal, rows.body, *matrices


def _tangents(problem: ImpactProblem, rows: SphereRows | None) -> tuple[Ints, Indices, Floats, Ints, Indices, Floats]:
    """Rows of D and D M⁻¹ over the kernels' velocities; the empty D M⁻¹ stands for both without friction."""
    D, DM = (problem.DM if problem.D is None else problem.D), problem.DM
    if rows is None or not problem.has_friction:
        return *_parts(D), *_parts(DM)
    return *_parts(_over_packed(D, problem, rows)), *_parts(_over_packed(DM, problem, rows))


def _over_packed(matrix: Matrix, problem: ImpactProblem, rows: SphereRows) -> Matrix:
    """Rows of D or D M⁻¹ in the packed order of contacts, its columns those of the packed velocities."""
    bodies = rows.owner.size - 1
    width = problem.n // bodies
    number = np.empty_like(rows.owner)
    number[rows.owner] = np.arange(bodies + 1, dtype=np.int32)
    taken = matrix[_orders(problem, rows)[1]]
    columns = STRIDE * number[taken.indices // width] + taken.indices % width
    packed = sp.csr_array(
        (taken.data, columns.astype(np.int32), taken.indptr.astype(np.int32)),
        shape=(2 * problem.m, STRIDE * (bodies + 1)),
    )
    for part in (packed.data, packed.indices, packed.indptr):
        # As the problem's own arrays are, so that each kernel compiles once.
        part.flags.writeable = False
    return packed


def _parts(matrix: Matrix) -> tuple[Ints, Indices, Floats]:
    """CSR as the kernels read it; no copy."""
    return matrix.indptr, matrix.indices.view(np.uint32), matrix.data


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
def _add_rows(start: Ints, index: Indices, value: Floats, factors: Floats, v: Floats) -> None:
    """Add the transposed matrix times factors to v."""
    for i in range(factors.size):
        if factors[i] != 0.0:
            _add_row(start, index, value, i, factors[i], v)


@kernel
def _gap_rate(normal: Floats, body: Indices, i: int, v: Floats) -> float:
    """Relative velocity u of a packed contact."""
    a = STRIDE * body[i, 0]
    b = STRIDE * body[i, 1]
    u = 0.0
    for axis in range(3):
        u += normal[i, axis] * (v[b + axis] - v[a + axis])
    return u


@kernel
def _strike(normal: Floats, body: Indices, i: int, impulse: float, v: Floats) -> None:
    """Add what an impulse at a packed contact does to its bodies."""
    a = STRIDE * body[i, 0]
    b = STRIDE * body[i, 1]
    for axis in range(3):
        v[a + axis] -= v[a + MASS] * impulse * normal[i, axis]
        v[b + axis] += v[b + MASS] * impulse * normal[i, axis]


@kernel
def _normal_sweep(
    normal: Floats, body: Indices,
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    W_diagonal: Floats, target: Floats, impulse: Floats, v: Floats,
) -> float:  # fmt: skip
    """One projected sweep over the normals; returns the largest velocity change that it made.

    Without branches, also where the step is zero: half of the contacts push, at random, and a mispredicted branch
    costs as much as the row.
    """
    change = 0.0
    packed = normal.shape[0] > 0
    for i in range(target.size):
        u = _gap_rate(normal, body, i, v) if packed else _row(J_start, J_index, J, i, v)
        step = -(u - target[i]) / W_diagonal[i]
        step = step if step > -impulse[i] else -impulse[i]
        impulse[i] += step
        if packed:
            _strike(normal, body, i, step, v)
        else:
            _add_row(JM_start, JM_index, JM, i, step, v)
        jump = abs(step) * W_diagonal[i]
        change = jump if jump > change else change
    return change


@kernel
def _tangent_sweep(
    D_start: Ints, D_index: Indices, D: Floats, DM_start: Ints, DM_index: Indices, DM: Floats,
    diagonal: Floats, mu: Floats, slip: Floats, impulse: Floats, friction_impulse: Floats, v: Floats,
) -> float:  # fmt: skip
    """One projected sweep over the tangents, |λ_f| ≤ μ λ; returns the largest velocity change that it made.

    `slip`: velocity along each tangent of what sticks afterwards.
    """
    change = 0.0
    for i in range(mu.size):
        if mu[i] == 0.0:
            continue
        bound = mu[i] * impulse[i]
        for row in range(2 * i, 2 * i + 2):
            if diagonal[row] <= 0.0:
                continue
            wanted = friction_impulse[row] - (_row(D_start, D_index, D, row, v) - slip[row]) / diagonal[row]
            step = min(max(wanted, -bound), bound) - friction_impulse[row]
            if step != 0.0:
                friction_impulse[row] += step
                _add_row(DM_start, DM_index, DM, row, step, v)
                change = max(change, abs(step) * diagonal[row])
    return change


@kernel
def _tangent_residual(
    D_start: Ints, D_index: Indices, D: Floats,
    diagonal: Floats, mu: Floats, slip: Floats, impulse: Floats, friction_impulse: Floats, v: Floats,
) -> float:  # fmt: skip
    """Natural map of the tangents [m/s]."""
    residual = 0.0
    for i in range(mu.size):
        if mu[i] == 0.0:
            continue
        bound = mu[i] * impulse[i]
        for row in range(2 * i, 2 * i + 2):
            if diagonal[row] <= 0.0:
                continue
            wanted = friction_impulse[row] - (_row(D_start, D_index, D, row, v) - slip[row]) / diagonal[row]
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
    normal: Floats, body: Indices,
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    D_start: Ints, D_index: Indices, D: Floats, DM_start: Ints, DM_index: Indices, DM: Floats,
    W_diagonal: Floats, mu: Floats, v_pre: Floats, target: Floats, slip: Floats, impulse: Floats,
    friction_impulse: Floats,
    tolerance: float, max_sweeps: int, max_visits: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """Sweeps from given impulses (changed in place); returns v, sweeps, visits, natural map [m/s]."""
    m = target.size
    packed = normal.shape[0] > 0
    diagonal = _tangent_diagonal(D_start, D_index, D, DM_start, DM_index, DM, v_pre.size)
    frictional = 0
    for i in range(m):
        if mu[i] > 0.0:
            frictional += 1
    v = v_pre.copy()
    sweeps = 0
    visits = 0
    change = 0.0
    while True:
        bounded = sweeps >= max_sweeps or visits >= max_visits
        if change <= tolerance or bounded or sweeps % REFRESH == 0:
            # The changes of a sweep are only an estimate: measure the natural map itself, on a fresh velocity.
            v[:] = v_pre
            if packed:
                for i in range(m):
                    _strike(normal, body, i, impulse[i], v)
            else:
                _add_rows(JM_start, JM_index, JM, impulse, v)
            if frictional > 0:
                _add_rows(DM_start, DM_index, DM, friction_impulse, v)
            residual = 0.0
            for i in range(m):
                u = _gap_rate(normal, body, i, v) if packed else _row(J_start, J_index, J, i, v)
                residual = max(residual, abs(min(u - target[i], impulse[i] * W_diagonal[i])))
            if frictional > 0:
                left = _tangent_residual(D_start, D_index, D, diagonal, mu, slip, impulse, friction_impulse, v)
                residual = max(residual, left)
            visits += m + 2 * frictional
            if residual <= tolerance or bounded:
                return v, sweeps, visits, residual
        change = _normal_sweep(
            normal, body, J_start, J_index, J, JM_start, JM_index, JM, W_diagonal, target, impulse, v
        )
        if frictional > 0:
            step = _tangent_sweep(
                D_start, D_index, D, DM_start, DM_index, DM, diagonal, mu, slip, impulse, friction_impulse, v
            )
            change = max(change, step)
        sweeps += 1
        visits += m + 2 * frictional


@kernel
def _dissipate(
    D_start: Ints, D_index: Indices, D: Floats, DM_start: Ints, DM_index: Indices, DM: Floats, mu: Floats,
    slip: Floats, v: Floats, impulse: Floats, friction_impulse: Floats, tolerance: float, max_sweeps: int,
    max_visits: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """Sweeps over the tangents alone (λ_f and v changed); returns v, sweeps, visits, natural map [m/s]."""
    diagonal = _tangent_diagonal(D_start, D_index, D, DM_start, DM_index, DM, v.size)
    sweeps = 0
    visits = 0
    residual = np.inf
    while residual > tolerance and sweeps < max_sweeps and visits < max_visits:
        _tangent_sweep(D_start, D_index, D, DM_start, DM_index, DM, diagonal, mu, slip, impulse, friction_impulse, v)
        residual = _tangent_residual(D_start, D_index, D, diagonal, mu, slip, impulse, friction_impulse, v)
        sweeps += 1
        visits += 4 * mu.size
    return v, sweeps, visits, residual

"""One step's impact of rigid bodies: rows of J and D from contacts and poses.

    u = n · (v_b + ω_b × r_b - v_a - ω_a × r_a)        r: from the center of mass to the contact, n from a to b
    row of J:  -n, -R_aᵀ (r_a × n) | n, R_bᵀ (r_b × n)          columns (v, ω), spin along principal axes
    rows of D: the same with t₁ and t₂ for n

t₁ lies along the sliding before the impact where there is some, so that a body that slides sees the friction μ and not
that of a corner of the pyramid, which is √2 μ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from scenarios.world.collision import RigidContacts
from scenarios.world.spheres import Ints
from solvers import ImpactProblem
from solvers._jit import kernel
from solvers.boxed_lcp import sweep
from solvers.problem import Matrix
from solvers.solution import Floats

Flags = npt.NDArray[np.bool_]

# Sliding slower than this share of the normal velocity says nothing of a direction: what lies still has rounding there.
SLIDING = 1e-3
# Natural map of a first guess for what rests, relative to the fastest approach, and sweeps until then at most.
HELD, HOLDING = 1e-9, 60
# A force that passes an axle so near, as the square of a share of its arm, does not turn the body: rounding.
DEAD = 1e-12


@dataclass(frozen=True)
class ContactRows:
    """What the contacts of one step are to their bodies."""

    block: Floats
    """Along n, t₁ and t₂, of the first and the second body; shape (m, 3, 2, 6), zeros for what cannot move."""
    tangent: Floats
    """t₁ and t₂, shape (m, 2, 3)."""
    u: Floats
    """Normal relative velocity [m/s], shape (m,)."""


@dataclass(frozen=True)
class RigidImpact:
    """Bodies and contacts of one step, before the impact."""

    contacts: RigidContacts
    rows: ContactRows
    velocity: Floats
    """(v, ω) before the impact, shape (b, 6)."""
    inverse_mass: Floats
    """Shape (b, 6), zeros where nothing moves."""
    friction: Floats
    """μ of each contact, shape (m,)."""
    restitution: Floats
    """c_r of each contact, shape (m,)."""
    flight: Floats
    """Time from the start of the step to the impact of each body [s], shape (b,)."""
    closing: Floats
    """The same time for each contact [s], shape (m,)."""
    borne: Floats
    """`velocity`, without gravity's share for what rests, shape (b, 6)."""

    def problem(self) -> ImpactProblem:
        """The impact for any solver.

        All of it comes from kernels and from bodies that were checked: it is put together without checking it in every
        step again. A velocity that is not finite is found after the step.
        """
        n, m = self.velocity.size, self.contacts.m
        inverse_mass = self.inverse_mass.ravel()
        J, JM = self._matrices(0, 1)
        has_friction = bool(self.friction.any())
        D, DM = (
            self._matrices(1, 3)
            if has_friction
            else (None, _csr((np.zeros(2 * m + 1, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0)), n))
        )
        diagonal = np.flatnonzero(inverse_mass).astype(np.int32)
        start = np.zeros(n + 1, dtype=np.int32)
        np.cumsum(inverse_mass > 0.0, out=start[1:])
        problem = object.__new__(ImpactProblem)
        problem.__dict__.update(
            v_pre=_read_only(self.velocity.ravel()), J=J, D=D, JM=JM, DM=DM,
            inverse_mass=_csr((start, diagonal, inverse_mass[diagonal]), n),
            restitution=_read_only(self.restitution), friction=_read_only(self.friction),
            stiffness=_read_only(np.ones(m)), tangential_restitution=_read_only(np.zeros(m)),
            has_friction=has_friction,
            W_diagonal=_read_only(_diagonal(self.contacts.body, self.rows.block, self.inverse_mass)),
            u_pre=_read_only(self.rows.u),
        )  # fmt: skip
        return problem

    def _matrices(self, first: int, last: int) -> tuple[Matrix, Matrix]:
        """Rows first … last - 1 of each contact, and the same times the inverse mass."""
        n = self.velocity.size
        plain, weighted = _as_csr(self.contacts.body, self.rows.block, self.inverse_mass, first, last)
        return _csr(plain, n), _csr(weighted, n)

    def starts(self, problem: ImpactProblem, impulse: Floats) -> tuple[Floats, Floats]:
        """First guesses of λ, shape (m,), and of λ_f, shape (2m,).

        Where nothing bounces the last step's impulses are carried further than a law's own tolerance: what rests would
        creep by as much as it leaves. The law that is given the guess makes its own test.

        Args:
            problem: of this impact.
            impulse: of the step before, in space [N s], shape (m, 3).
        """
        axes = np.concatenate([self.contacts.normal[:, None], self.rows.tangent], axis=1)
        guess = np.ascontiguousarray(np.einsum("mtx,mx->mt", axes, impulse))
        normal, friction = guess[:, 0], guess[:, 1:].ravel()
        if self.restitution.any() or not problem.has_friction:
            return normal, friction
        held = sweep(
            problem, np.zeros(problem.m), tolerance=HELD, max_sweeps=HOLDING, start=normal, friction_start=friction
        )  # fmt: skip
        return held.impulse, friction if held.friction_impulse is None else held.friction_impulse

    def in_space(self, impulse: Floats, friction_impulse: Floats | None) -> Floats:
        """Impulses of normal and friction together as vectors on the second bodies [N s], shape (m, 3)."""
        total: Floats = impulse[:, None] * self.contacts.normal
        if friction_impulse is not None:
            total = total + np.einsum("mtx,mt->mx", self.rows.tangent, friction_impulse.reshape(-1, 2))
        return total


def _read_only(array: Floats) -> Floats:
    """The same array, which nobody can write to through this view."""
    view = array.view()
    view.flags.writeable = False
    return view


def _csr(parts: tuple[Ints, Ints, Floats], columns: int) -> Matrix:
    """A read-only matrix from its parts: starts of rows, columns, values."""
    start, column, value = parts
    matrix = sp.csr_array((value, column, start), shape=(start.size - 1, columns))
    matrix.has_sorted_indices = matrix.has_canonical_format = True
    for part in (matrix.data, matrix.indices, matrix.indptr):
        part.flags.writeable = False
    return matrix


def contact_rows(contacts: RigidContacts, position: Floats, orientation: Floats, velocity: Floats) -> ContactRows:
    """Form the rows of all contacts.

    Args:
        contacts: of the step.
        position: centers of mass of all bodies [m], shape (bodies, 3); those of the movable ones are read.
        orientation: quaternions of their principal axes, shape (bodies, 4).
        velocity: (v, ω) before the impact, shape (b, 6): the first tangent lies along the sliding.
    """
    block, tangent, u = _rows(contacts.body, contacts.point, contacts.normal, position, orientation, velocity)
    return ContactRows(block, tangent, u)


def approach(contacts: RigidContacts, position: Floats, orientation: Floats, velocity: Floats) -> Floats:
    """Normal relative velocity of all contacts [m/s], shape (m,); arguments as those of `contact_rows`."""
    return _approach(contacts.body, contacts.point, contacts.normal, position, orientation, velocity)


def meeting(
    contacts: RigidContacts, position: Floats, orientation: Floats, velocity: Floats, inverse_mass: Floats, *,
    step: float, touching: float,
) -> Flags:  # fmt: skip
    """Which contacts touch, or would overlap after the step if nothing held them; and move a body; shape (m,).

    Args:
        contacts: all near ones.
        position: centers of mass [m], shape (bodies, 3).
        orientation: quaternions, shape (bodies, 4).
        velocity: (v, ω) before the impact, shape (b, 6).
        inverse_mass: shape (b, 6).
        step: Δt [s].
        touching: gap up to which bodies touch [m].
    """
    return _meeting(
        contacts.body, contacts.point, contacts.normal, contacts.gap, position, orientation, velocity, inverse_mass,
        step, touching,
    )  # fmt: skip


def islands(contacts: RigidContacts, inverse_mass: Floats) -> Ints:
    """Body that stands for the island of each contact, shape (m,): bodies connected through contacts of what moves."""
    return _islands(contacts.body, inverse_mass)


def largest_of_island(island: Ints, value: Floats) -> Floats:
    """Largest value of all contacts of the island that each belongs to, shape (m,)."""
    return _largest_of_island(island, value)


@kernel
def _row(body: int, sign: float, point: Floats, direction: Floats, position: Floats, orientation: Floats,
         row: Floats) -> None:  # fmt: skip
    """What a unit impulse along a direction at a point gives a body: momentum, and spin along its principal axes."""
    rx = point[0] - position[body, 0]
    ry = point[1] - position[body, 1]
    rz = point[2] - position[body, 2]
    tx = ry * direction[2] - rz * direction[1]
    ty = rz * direction[0] - rx * direction[2]
    tz = rx * direction[1] - ry * direction[0]
    # Rᵀ t as a rotation by the inverse quaternion: t - 2w (q × t) + 2 q × (q × t).
    w = orientation[body, 0]
    x = orientation[body, 1]
    y = orientation[body, 2]
    z = orientation[body, 3]
    cx = y * tz - z * ty
    cy = z * tx - x * tz
    cz = x * ty - y * tx
    for axis in range(3):
        row[axis] = sign * direction[axis]
    row[3] = sign * (tx + 2.0 * (y * cz - z * cy - w * cx))
    row[4] = sign * (ty + 2.0 * (z * cx - x * cz - w * cy))
    row[5] = sign * (tz + 2.0 * (x * cy - y * cx - w * cz))


@kernel
def _blocks(
    body: Ints, i: int, point: Floats, direction: Floats, position: Floats, orientation: Floats, movable: int,
    blocks: Floats,
) -> None:  # fmt: skip
    """Both blocks of one row; zero for a body that does not move."""
    for side in range(2):
        owner = body[i, side]
        if owner < movable:
            _row(owner, 2.0 * side - 1.0, point[i], direction, position, orientation, blocks[side])
        else:
            for k in range(6):
                blocks[side, k] = 0.0


@kernel
def _velocity_along(body: Ints, i: int, blocks: Floats, velocity: Floats) -> float:
    """One row times the velocities."""
    u = 0.0
    for side in range(2):
        owner = body[i, side]
        if owner < velocity.shape[0]:
            for k in range(6):
                u += blocks[side, k] * velocity[owner, k]
    return u


@kernel
def _approach(
    body: Ints, point: Floats, normal: Floats, position: Floats, orientation: Floats, velocity: Floats
) -> Floats:
    blocks = np.zeros((2, 6))
    u = np.empty(body.shape[0])
    for i in range(u.size):
        _blocks(body, i, point, normal[i], position, orientation, velocity.shape[0], blocks)
        u[i] = _velocity_along(body, i, blocks, velocity)
    return u


@kernel
def _rows(
    body: Ints, point: Floats, normal: Floats, position: Floats, orientation: Floats, velocity: Floats
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    m = body.shape[0]
    movable = velocity.shape[0]
    rows = np.zeros((m, 3, 2, 6))
    tangent = np.empty((m, 2, 3))
    relative = np.empty(m)
    slip = np.empty(3)
    for i in range(m):
        n = normal[i]
        t = tangent[i, 0]
        _blocks(body, i, point, n, position, orientation, movable, rows[i, 0])
        u = _velocity_along(body, i, rows[i, 0], velocity)
        relative[i] = u
        # Sliding velocity: components along the axes, less the normal one.
        square = 0.0
        for axis in range(3):
            for k in range(3):
                t[k] = 1.0 if k == axis else 0.0
            _blocks(body, i, point, t, position, orientation, movable, rows[i, 1])
            slip[axis] = _velocity_along(body, i, rows[i, 1], velocity) - u * n[axis]
            square += slip[axis] ** 2
        if square > (SLIDING * u) ** 2:
            for axis in range(3):
                t[axis] = slip[axis]
        else:
            # The axis that is farthest from the normal.
            axis = 0
            for k in range(1, 3):
                if abs(n[k]) < abs(n[axis]):
                    axis = k
            for k in range(3):
                t[k] = (1.0 if k == axis else 0.0) - n[axis] * n[k]
        # The sliding is orthogonal to n but for rounding, which is large beside a small difference.
        along = t[0] * n[0] + t[1] * n[1] + t[2] * n[2]
        length = 0.0
        for axis in range(3):
            t[axis] -= along * n[axis]
            length += t[axis] ** 2
        length = length**0.5
        for axis in range(3):
            t[axis] /= length
        _blocks(body, i, point, t, position, orientation, movable, rows[i, 1])
        other = tangent[i, 1]
        other[0] = n[1] * t[2] - n[2] * t[1]
        other[1] = n[2] * t[0] - n[0] * t[2]
        other[2] = n[0] * t[1] - n[1] * t[0]
        _blocks(body, i, point, other, position, orientation, movable, rows[i, 2])
    return rows, tangent, relative


@kernel
def _as_csr(
    body: Ints, rows: Floats, inverse_mass: Floats, first: int, last: int
) -> tuple[tuple[Ints, Ints, Floats], tuple[Ints, Ints, Floats]]:
    """Rows first … last - 1 of each contact as CSR without zeros, plain and times the inverse mass; columns ascend."""
    m = body.shape[0]
    movable = inverse_mass.shape[0]
    width = last - first
    start = np.zeros(m * width + 1, np.int32)
    column = np.empty(m * width * 12, np.int32)
    value = np.empty(m * width * 12)
    weighted_start = np.zeros(m * width + 1, np.int32)
    weighted_column = np.empty(m * width * 12, np.int32)
    weighted = np.empty(m * width * 12)
    filled = 0
    weighed = 0
    for i in range(m):
        low = 0 if body[i, 0] < body[i, 1] else 1
        for row in range(first, last):
            for turn in range(2):
                side = low if turn == 0 else 1 - low
                owner = body[i, side]
                if owner >= movable:
                    continue
                for k in range(6):
                    entry = rows[i, row, side, k]
                    if entry == 0.0:
                        continue
                    column[filled] = 6 * owner + k
                    value[filled] = entry
                    filled += 1
                    if inverse_mass[owner, k] > 0.0:
                        weighted_column[weighed] = 6 * owner + k
                        weighted[weighed] = entry * inverse_mass[owner, k]
                        weighed += 1
            start[i * width + row - first + 1] = filled
            weighted_start[i * width + row - first + 1] = weighed
    return (
        (start, column[:filled].copy(), value[:filled].copy()),
        (weighted_start, weighted_column[:weighed].copy(), weighted[:weighed].copy()),
    )


@kernel
def _diagonal(body: Ints, rows: Floats, inverse_mass: Floats) -> Floats:
    """Diagonal of W."""
    diagonal = np.zeros(body.shape[0])
    for i in range(body.shape[0]):
        for side in range(2):
            owner = body[i, side]
            if owner < inverse_mass.shape[0]:
                for k in range(6):
                    diagonal[i] += rows[i, 0, side, k] ** 2 * inverse_mass[owner, k]
    return diagonal


@kernel
def _meeting(
    body: Ints, point: Floats, normal: Floats, gap: Floats, position: Floats, orientation: Floats, velocity: Floats,
    inverse_mass: Floats, step: float, touching: float,
) -> Flags:  # fmt: skip
    m = gap.size
    movable = velocity.shape[0]
    meets = np.zeros(m, np.bool_)
    blocks = np.zeros((2, 6))
    for i in range(m):
        _blocks(body, i, point, normal[i], position, orientation, movable, blocks)
        if gap[i] > touching and gap[i] + step * _velocity_along(body, i, blocks, velocity) > 0.0:
            continue
        for side in range(2):
            owner = body[i, side]
            if owner >= movable:
                continue
            if inverse_mass[owner, 0] > 0.0:
                meets[i] = True
                break
            # Held, or on a hinge: only a moment about the axle moves it.
            moved = 0.0
            arm = 0.0
            loose = 0.0
            for k in range(3, 6):
                moved += blocks[side, k] ** 2 * inverse_mass[owner, k]
                arm += blocks[side, k] ** 2
                loose += inverse_mass[owner, k]
            if moved > DEAD * arm * loose:
                meets[i] = True
                break
    return meets


@kernel
def _root(parent: Ints, i: int) -> int:
    """The body that stands for an island; paths are halved on the way."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def _islands(body: Ints, inverse_mass: Floats) -> Ints:
    movable = inverse_mass.shape[0]
    moves = np.zeros(movable, np.bool_)
    for b in range(movable):
        for k in range(6):
            if inverse_mass[b, k] > 0.0:
                moves[b] = True
    parent = np.arange(movable).astype(np.int32)
    m = body.shape[0]
    for i in range(m):
        a = body[i, 0]
        b = body[i, 1]
        if a < movable and b < movable and moves[a] and moves[b]:
            one = _root(parent, a)
            other = _root(parent, b)
            parent[max(one, other)] = min(one, other)
    island = np.empty(m, np.int32)
    for i in range(m):
        a = body[i, 0]
        island[i] = _root(parent, a if a < movable and moves[a] else body[i, 1])
    return island


@kernel
def _largest_of_island(island: Ints, value: Floats) -> Floats:
    count = 0
    for i in range(island.size):
        count = max(count, island[i] + 1)
    largest = np.full(count, -np.inf)
    for i in range(island.size):
        largest[island[i]] = max(largest[island[i]], value[i])
    result = np.empty(island.size)
    for i in range(island.size):
        result[i] = largest[island[i]]
    return result

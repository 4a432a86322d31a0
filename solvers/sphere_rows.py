"""Contacts whose row is one vector between two points: spheres, discs, beads on a line.

    u_i = n_i · (v_b - v_a),   M⁻¹ of body b is 1/m_b times the identity

Such a row of J fits in 32 bytes (a normal, two bodies) instead of 72 in CSR with 64-bit values, and W needs no
storage at all: two contacts that share body b have W_ij = ± n_i · n_j / m_b. Any problem of that form is recognized
from J's sparsity, whatever it was made from; a row on one body has the last, immovable entry of `V` as its other.

Large problems are renumbered on the way: bodies in breadth-first order of the contact graph, contacts in the order in
which that search meets them, so that neighbors in space are neighbors in memory.

Packing and renumbering read the geometry alone: a problem keeps what comes of them (36 bytes a contact, and 36 a body;
where chunks are asked for, as much as `sphere_chunks` says beside), and every solve starts from a copy of the
velocities.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.solution import Floats
from solvers.sphere_chunks import SphereChunks, chunks

if TYPE_CHECKING:
    from solvers.problem import ImpactProblem, Matrix

Ints = npt.NDArray[np.int32]
# Unsigned, because a signed index costs a test for negative ones at every access: 25 % of a scan (measured).
Indices = npt.NDArray[np.uint32]

# Below this many contacts everything fits in the cache and a renumbering does not pay.
RENUMBERED = 8_000
# Strips of contacts that threads share out, those of even number, then those of odd number; as many for any number of
# threads. They keep two threads busy. More would serve more, but what lies along a border costs extra work.
STRIPS = 4


@dataclass(frozen=True)
class SphereRows:
    """A problem of this form, packed."""

    normal: Floats
    """n [dimensionless], shape (m, 3); body b moves along +n, body a along -n. Padded with zeros on a line or plane."""

    body: Indices
    """Bodies a and b of each contact, shape (m, 2)."""

    V: Floats
    """Velocity and inverse mass of each body, shape (bodies + 1, 4); the last is immovable and at rest."""

    contact: Ints
    """The problem's number of each contact, shape (m,)."""

    owner: Ints = field(default_factory=lambda: np.empty(0, np.int32))
    """The problem's number of each body, shape (bodies + 1,); empty for rows that come without an `ImpactProblem`."""

    strip: Ints = field(default_factory=lambda: np.empty(0, np.int32))
    """Where strips of contacts begin, shape (strips + 1,), their last entry the end: those of even number share no
    movable body, nor do those of odd number. Empty where none are known."""

    @cached_property
    def chunks(self) -> SphereChunks:
        """The contacts cut into chunks, with what the geometry says there; the velocities have no part in it."""
        return chunks(self)

    def in_problem_order(self, per_contact: Floats) -> Floats:
        """Put an array over these contacts, shape (m,), in the problem's order."""
        ordered = np.empty_like(per_contact)
        ordered[self.contact] = per_contact
        return ordered

    def velocity_in_problem_order(self, V: Floats, n: int) -> Floats:
        """Put velocities of these bodies, shape (bodies + 1, ≥ 3), in the problem's order, shape (n,)."""
        bodies = self.owner.size - 1
        ordered = np.empty((bodies, n // bodies))
        ordered[self.owner[:-1]] = V[:-1, : n // bodies]
        return ordered.reshape(n)


def sphere_rows(problem: ImpactProblem) -> SphereRows | None:
    """Pack a problem; None where it has another form. Only `V` is the caller's own: the problem keeps the rest."""
    still = problem.spheres_at_rest
    if still is None:
        return None
    bodies = still.owner[:-1]
    V = still.V.copy()
    width = problem.n // max(bodies.size, 1)
    V[:-1, :width] = problem.v_pre.reshape(bodies.size, width)[bodies]
    return replace(still, V=V)


def pack(J: Matrix, inverse_mass: Matrix) -> SphereRows | None:
    """Pack contacts and bodies, with velocities of zero; None where a row, or a mass, has another form.

    Args:
        J: contact Jacobian, shape (m, n).
        inverse_mass: M⁻¹ [1/kg], shape (n, n).
    """
    n = J.shape[1]
    if inverse_mass.nnz > n:
        return None
    diagonal = inverse_mass.diagonal()
    if inverse_mass.nnz != np.count_nonzero(diagonal):
        return None
    for width in (3, 2, 1):
        if n % width == 0 and (diagonal.reshape(-1, width) == diagonal[::width, None]).all():
            rows = _packed(J, width, diagonal[::width])
            if rows is not None:
                return rows
    return None


def _packed(J: Matrix, width: int, inverse_mass: Floats) -> SphereRows | None:
    """Pack with bodies of `width` velocities each; None where a row has another form."""
    m = J.shape[0]
    normal = np.zeros((m, 3))
    body = np.empty((m, 2), np.uint32)
    bodies = inverse_mass.size
    if not _pack(J.indptr, J.indices, J.data, width, bodies, normal, body):
        return None
    V = np.zeros((bodies + 1, 4))
    V[:bodies, 3] = inverse_mass
    if m < RENUMBERED:
        every = np.arange(max(m, bodies + 1), dtype=np.int32)
        return SphereRows(normal, body, V, every[:m], every[: bodies + 1])
    normal, body, V, contact, owner = _renumber(normal, body, V)
    return SphereRows(normal, body, V, contact, owner, _strips(body, V))


@kernel
def _owner(index: int, width: int) -> int:
    """Body of a velocity; division by a constant is a multiplication."""
    if width == 3:
        return index // 3
    if width == 2:
        return index // 2
    return index


@kernel
def _pack(
    J_start: Ints, J_index: Ints, J: Floats, width: int, bodies: int, normal: Floats, body: Indices
) -> bool:  # fmt: skip
    """Fill normals and bodies; false at the first row that is not n on one body and -n on another."""
    other = np.zeros(3)
    for i in range(J_start.size - 1):
        # Most rows: all entries of one body, then their negatives on another.
        q = J_start[i]
        if J_start[i + 1] - q == 2 * width:
            b = _owner(J_index[q], width)
            a = _owner(J_index[q + width], width)
            opposite = 0
            for axis in range(width):
                normal[i, axis] = J[q + axis]
                opposite += (J_index[q + axis] == b * width + axis) & (J_index[q + width + axis] == a * width + axis)
                opposite += J[q + width + axis] == -J[q + axis]
            if opposite == 2 * width:
                body[i, 0] = a
                body[i, 1] = b
                continue
            normal[i, 0] = normal[i, 1] = normal[i, 2] = 0.0
        a = b = bodies
        other[0] = other[1] = other[2] = 0.0
        for q in range(J_start[i], J_start[i + 1]):
            owner = _owner(J_index[q], width)
            axis = J_index[q] - owner * width
            if b in (bodies, owner):
                b = owner
                normal[i, axis] = J[q]
            elif a in (bodies, owner):
                a = owner
                other[axis] = J[q]
            else:
                return False
        if a != bodies:
            for axis in range(3):
                if other[axis] != -normal[i, axis]:
                    return False
        body[i, 0] = a
        body[i, 1] = b
    return True


@kernel
def _renumber(normal: Floats, body: Indices, V: Floats) -> tuple[Floats, Indices, Floats, Ints, Ints]:
    """Normals, bodies, velocities, contacts and bodies in the order in which a breadth-first search meets them."""
    m = body.shape[0]
    bodies = V.shape[0] - 1
    first = np.zeros(bodies + 3, np.int32)
    for i in range(m):
        first[body[i, 0] + 2] += 1
        first[body[i, 1] + 2] += 1
    for b in range(2, bodies + 3):
        first[b] += first[b - 1]
    # Contacts of each body: twice their number, plus its side; and the body on the other side.
    link = np.empty((2 * m, 2), np.int32)
    for i in range(m):
        for side in range(2):
            b = body[i, side] + 1
            link[first[b], 0] = 2 * i + side
            link[first[b], 1] = body[i, 1 - side]
            first[b] += 1
    contact = np.empty(m, np.int32)
    new_normal = np.empty((m, 3))
    new_body = np.empty((m, 2), np.uint32)
    order = np.empty(bodies + 1, np.int32)
    order[bodies] = bodies
    number = np.full(bodies + 1, -1, np.int32)
    number[bodies] = bodies
    k = 0
    head = 0
    tail = 0
    for root in range(bodies):
        if number[root] >= 0:
            continue
        number[root] = tail
        order[tail] = root
        tail += 1
        while head < tail:
            b = order[head]
            for q in range(first[b], first[b + 1]):
                c = link[q, 1]
                if number[c] < 0:
                    number[c] = tail
                    order[tail] = c
                    tail += 1
                if number[c] < head:
                    # Met from its other body.
                    continue
                i = link[q, 0] >> 1
                side = link[q, 0] & 1
                contact[k] = i
                new_body[k, side] = head
                new_body[k, 1 - side] = number[c]
                for axis in range(3):
                    new_normal[k, axis] = normal[i, axis]
                k += 1
            head += 1
    new_V = np.empty_like(V)
    for k in range(bodies + 1):
        for column in range(4):
            new_V[k, column] = V[order[k], column]
    return new_normal, new_body, new_V, contact, order


@kernel
def _strips(body: Indices, V: Floats) -> Ints:
    """Cut the contacts into strips; into one where those of even number, or of odd, would share a movable body."""
    m = body.shape[0]
    bodies = V.shape[0]
    strip = np.empty(STRIPS + 1, np.int32)
    low = np.full(STRIPS + 2, bodies, np.int64)
    high = np.full(STRIPS, -1, np.int64)
    for c in range(STRIPS + 1):
        strip[c] = m * c // STRIPS
    for c in range(STRIPS):
        for i in range(strip[c], strip[c + 1]):
            for side in range(2):
                b = body[i, side]
                if V[b, 3] > 0.0:
                    low[c] = min(low[c], np.int64(b))
                    high[c] = max(high[c], np.int64(b))
    for c in range(STRIPS - 1, -1, -1):
        # The lowest of this strip and of all after it with the same parity.
        if high[c] >= low[c + 2]:
            return np.array([0, m], np.int32)
        low[c] = min(low[c], low[c + 2])
    return strip


def sparse_rows(rows: SphereRows) -> tuple[Ints, Indices, Floats, Ints, Indices, Floats]:
    """J and J M⁻¹ of packed contacts as CSR (start, index, value), three velocities a body, all in the packed order."""
    return _sparse_rows(rows.normal, rows.body, rows.V)


@kernel
def _sparse_rows(normal: Floats, body: Indices, V: Floats) -> tuple[Ints, Indices, Floats, Ints, Indices, Floats]:
    """Entries that are zero, and immovable bodies in J M⁻¹, are left out."""
    m = normal.shape[0]
    J_start = np.zeros(m + 1, np.int32)
    J_index = np.empty(6 * m, np.uint32)
    J = np.empty(6 * m)
    JM_start = np.zeros(m + 1, np.int32)
    JM_index = np.empty(6 * m, np.uint32)
    JM = np.empty(6 * m)
    p = 0
    q = 0
    for i in range(m):
        for side in range(2):
            b = body[i, side]
            for axis in range(3):
                n = normal[i, axis] if side == 1 else -normal[i, axis]
                if n != 0.0 and b < V.shape[0] - 1:
                    J_index[p] = 3 * b + axis
                    J[p] = n
                    p += 1
                    if V[b, 3] > 0.0:
                        JM_index[q] = 3 * b + axis
                        JM[q] = n * V[b, 3]
                        q += 1
        J_start[i + 1] = p
        JM_start[i + 1] = q
    return J_start, J_index[:p], J[:p], JM_start, JM_index[:q], JM[:q]

"""Geometry → Jacobian for spheres and discs, their symmetries and their momenta.

    u = n · (v_second - v_first)      n points from the first body to the second, or from a fixed surface to it

A frictionless sphere turns without being felt, so its velocity is that of its center alone. With friction the contact
point counts: x + ω × r, with r = ±radius · n, and a body's block is (v, ω).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.spatial import cKDTree

from scenarios.scenario import Invariant, Symmetry
from solvers.solution import Floats

Indices = npt.NDArray[np.intp]

FIXED = -1
"""Stands for the first body where a contact is with something immovable."""

# A symmetry maps a center on another one to rounding: far below any distance between two centers.
MATCH_TOLERANCE = 1e-9
# Closer to the vertical than this, a normal leaves no usable horizontal direction beside it.
VERTICAL_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Contacts:
    """Which bodies touch, and along which normal."""

    first: Indices
    """Index of the body that the normal comes from, shape (m,); FIXED for an immovable one."""

    second: Indices
    """Index of the body that the normal points to, shape (m,)."""

    normals: Floats
    """Unit normals from the first body to the second, shape (m, 2 or 3)."""

    @property
    def m(self) -> int:
        """Number of contacts."""
        return int(self.first.size)

    def __add__(self, other: Contacts) -> Contacts:
        return Contacts(
            np.concatenate([self.first, other.first]),
            np.concatenate([self.second, other.second]),
            np.concatenate([self.normals, other.normals]),
        )


def line_of_contacts(bodies: int) -> sp.csr_array:
    """Jacobian of a free chain on a line: contact i lies between bodies i and i + 1; shape (bodies - 1, bodies)."""
    return sp.csr_array(
        sp.diags_array(
            [np.full(bodies - 1, -1.0), np.full(bodies - 1, 1.0)], offsets=[0, 1], shape=(bodies - 1, bodies)
        )
    )


def pair_contacts(centers: Floats, pairs: npt.ArrayLike) -> Contacts:
    """Contacts of given pairs of bodies; the normal joins the centers.

    Args:
        centers: centers of the bodies [m], shape (bodies, 2 or 3).
        pairs: indices of two bodies each, shape (m, 2).
    """
    first, second = np.asarray(pairs, dtype=np.intp).reshape(-1, 2).T
    offset = centers[second] - centers[first]
    return Contacts(first.copy(), second.copy(), offset / np.linalg.norm(offset, axis=1)[:, None])


def touching_pairs(centers: Floats, reach: float) -> Indices:
    """Pairs of bodies whose centers are at most `reach` [m] apart, in order of their indices; shape (m, 2)."""
    pairs: Indices = cKDTree(centers).query_pairs(reach, output_type="ndarray").astype(np.intp)
    pairs.sort(axis=1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def fixed_contacts(bodies: npt.ArrayLike, normals: npt.ArrayLike) -> Contacts:
    """Contacts with something immovable; normals, shape (m, 2 or 3), point from it to the body."""
    second = np.asarray(bodies, dtype=np.intp)
    return Contacts(np.full(second.size, FIXED, dtype=np.intp), second, np.asarray(normals, dtype=np.float64))


def normal_rows(contacts: Contacts, bodies: int) -> sp.csr_array:
    """Jacobian J for bodies without spin, shape (m, bodies · d), d = 2 for discs and 3 for spheres."""
    return _rows(contacts, contacts.normals, -contacts.normals, bodies)


def normal_rows_with_spin(contacts: Contacts, bodies: int) -> sp.csr_array:
    """Jacobian J for bodies with blocks (v, ω) in space, shape (m, 6 · bodies); a normal has no lever on a sphere."""
    normals = in_space(contacts.normals)
    row = np.hstack([normals, np.zeros_like(normals)])
    return _rows(contacts, row, -row, bodies)


def tangent_rows(contacts: Contacts, bodies: int, radius: float) -> sp.csr_array:
    """Friction pyramid D for equal spheres with blocks (v, ω) in space, shape (2m, 6 · bodies).

    The first direction is horizontal, the second completes n, t₁, t₂ to a right-handed frame, so that a scene's mirror
    planes and quarter turns about the vertical map the pyramid on itself.

    Args:
        contacts: the contacts.
        bodies: number of bodies.
        radius: of the spheres [m].
    """
    normals = in_space(contacts.normals)
    tangents = np.stack(tangents_of(normals), axis=1).reshape(-1, 3)
    lever = np.cross(np.repeat(normals, 2, axis=0), tangents) * radius
    doubled = Contacts(np.repeat(contacts.first, 2), np.repeat(contacts.second, 2), tangents)
    # The contact point lies at -radius n from the second center and at +radius n from the first.
    return _rows(doubled, np.hstack([tangents, -lever]), np.hstack([-tangents, -lever]), bodies)


def tangents_of(normals: Floats) -> tuple[Floats, Floats]:
    """Two unit directions across each normal, shape (m, 3) each: horizontal, and across both."""
    horizontal = np.column_stack([-normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    length = np.linalg.norm(horizontal, axis=1)
    upright = length < VERTICAL_TOLERANCE
    horizontal[upright] = (1.0, 0.0, 0.0)
    length[upright] = 1.0
    horizontal /= length[:, None]
    return horizontal, np.cross(normals, horizontal)


def in_space(vectors: Floats) -> Floats:
    """Vectors of a plane scene as vectors in space, shape (m, 3); those in space as they are."""
    if vectors.shape[1] == 3:
        return vectors
    return np.column_stack([vectors, np.zeros(len(vectors))])


def sphere_inverse_mass(mass: Floats, radius: float) -> Floats:
    """Inverse mass of solid spheres with blocks (v, ω), as a diagonal of shape (6 · bodies,); inertia 2/5 m r²."""
    block = np.column_stack([np.repeat(1.0 / mass[:, None], 3, axis=1)] * 2)
    block[:, 3:] /= 0.4 * radius**2
    return block.ravel()


def velocities_with_spin(velocity: Floats) -> Floats:
    """Velocities of the centers, shape (bodies, 2 or 3), as blocks (v, ω) without spin, shape (6 · bodies,)."""
    flat = in_space(velocity)
    return np.hstack([flat, np.zeros_like(flat)]).ravel()


def map_of_bodies(name: str, turn: npt.ArrayLike, centers: Floats) -> Symmetry:
    """Symmetry of bodies without spin: the center x goes to R x, where an equal body must stand.

    Args:
        name: of the symmetry.
        turn: rotation or mirror R about the origin, shape (d, d).
        centers: centers [m], shape (bodies, d).
    """
    R = np.asarray(turn, dtype=np.float64)
    return Symmetry(name, _carried(R, centers, R))


def map_of_bodies_with_spin(name: str, turn: npt.ArrayLike, centers: Floats) -> Symmetry:
    """Symmetry of bodies with blocks (v, ω): as `map_of_bodies`; ω is an axial vector and turns with det(R) R."""
    R = np.asarray(turn, dtype=np.float64)
    space = np.eye(3)
    space[: len(R), : len(R)] = R
    block = np.zeros((6, 6))
    block[:3, :3] = space
    block[3:, 3:] = np.linalg.det(space) * space
    return Symmetry(name, _carried(R, centers, block))


def linear_momenta(bodies: int, block: int, axes: Sequence[str]) -> tuple[Invariant, ...]:
    """Total momentum along each axis; `block` is the number of velocities of one body."""
    found = []
    for axis, letter in enumerate(axes):
        direction = np.zeros((bodies, block))
        direction[:, axis] = 1.0
        found.append(Invariant(f"linear momentum {letter}", direction.ravel()))
    return tuple(found)


def plane_angular_momentum(centers: Floats) -> Invariant:
    """Angular momentum of discs about the origin: c = (-y, x) at every center; shape (2 · bodies,)."""
    return Invariant("angular momentum z", np.column_stack([-centers[:, 1], centers[:, 0]]).ravel())


def angular_momenta_with_spin(centers: Floats) -> tuple[Invariant, ...]:
    """Angular momentum about the origin of bodies with blocks (v, ω): c = (axis × x, axis)."""
    space = in_space(centers)
    found = []
    for axis, letter in enumerate("xyz"):
        direction = np.zeros((len(space), 6))
        direction[:, :3] = np.cross(np.eye(3)[axis], space)
        direction[:, 3 + axis] = 1.0
        found.append(Invariant(f"angular momentum {letter}", direction.ravel()))
    return tuple(found)


def _rows(contacts: Contacts, on_second: Floats, on_first: Floats, bodies: int) -> sp.csr_array:
    """Sparse rows from the blocks of the second and, where it is movable, of the first body."""
    block = on_second.shape[1]
    movable = np.flatnonzero(contacts.first != FIXED)
    row = np.concatenate([np.arange(contacts.m), movable])
    body = np.concatenate([contacts.second, contacts.first[movable]])
    values = np.concatenate([on_second, on_first[movable]])
    columns = body[:, None] * block + np.arange(block)
    return sp.csr_array((values.ravel(), (np.repeat(row, block), columns.ravel())), shape=(contacts.m, bodies * block))


def _carried(turn: Floats, centers: Floats, block: Floats) -> sp.csr_array:
    """S as a block permutation: body b stands where body `target[b]` stood."""
    distance, target = cKDTree(centers).query(centers @ turn.T)
    if distance.max(initial=0.0) > MATCH_TOLERANCE or np.unique(target).size != len(centers):
        raise AssertionError("the map does not carry the bodies of the scene on one another")
    bodies = len(centers)
    permutation = sp.coo_array((np.ones(bodies), (target, np.arange(bodies))), shape=(bodies, bodies))
    return sp.csr_array(sp.kron(permutation, block))

"""Two edges that lie along one another touch at both ends of what they share, and not at one point of it.

A collision library may answer with a single closest point there, which jumps from end to end between steps: what leans
on that edge would start from nothing each time. Where two convex parts have one contact, and the farthest corners of
each along its normal are those of an edge, and the two edges are parallel, the ends of their overlap are taken instead.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scenarios.world.spheres import Ints
from solvers._jit import kernel
from solvers.solution import Floats

# Sine of the largest angle between two edges that lie along one another.
PARALLEL = 0.05
# An overlap shorter than this share of the shorter edge is a point.
SHORT = 1e-3


def ends_of_edges(
    body: Ints, geometry: Ints, normal: Floats, position: Floats, orientation: Floats, corner: Floats, start: Ints,
    reach: float,
) -> tuple[npt.NDArray[np.bool_], Floats, Floats]:  # fmt: skip
    """Find contacts that stand for two parallel edges.

    Args:
        body: of each contact, shape (m, 2).
        geometry: parts of each contact, shape (m, 2); corners of part g are start[g] … start[g + 1] - 1.
        normal: from the first to the second, shape (m, 3).
        position: centers of mass of all bodies [m], shape (bodies, 3).
        orientation: quaternions, shape (bodies, 4).
        corner: of all parts in their bodies' frames [m], shape (corners, 3).
        start: first corner of each part, shape (parts + 1,); round parts have none.
        reach: gap up to which a corner belongs to an edge that touches [m].

    Returns:
        which contacts do, shape (m,); both ends of each, midway between the edges [m], shape (m, 2, 3); and the gaps
        there [m], shape (m, 2).
    """
    return _ends(body, geometry, normal, position, orientation, corner, start, reach)


@kernel
def _turned(q: Floats, v: Floats, place: Floats, out: Floats) -> None:
    """A point of a body in space: place + v + 2 w (q × v) + 2 q × (q × v)."""
    cx = q[2] * v[2] - q[3] * v[1]
    cy = q[3] * v[0] - q[1] * v[2]
    cz = q[1] * v[1] - q[2] * v[0]
    out[0] = place[0] + v[0] + 2.0 * (q[0] * cx + q[2] * cz - q[3] * cy)
    out[1] = place[1] + v[1] + 2.0 * (q[0] * cy + q[3] * cx - q[1] * cz)
    out[2] = place[2] + v[2] + 2.0 * (q[0] * cz + q[1] * cy - q[2] * cx)


@kernel
def _edge(
    first: int, last: int, corner: Floats, q: Floats, place: Floats, n: Floats, sign: float, reach: float, edge: Floats
) -> bool:
    """The farthest edge of a part along ± n, and whether there is one: two corners within reach of the farthest."""
    point = np.empty(3)
    highest = -np.inf
    for c in range(first, last):
        _turned(q, corner[c], place, point)
        highest = max(highest, sign * (n[0] * point[0] + n[1] * point[1] + n[2] * point[2]))
    count = 0
    for c in range(first, last):
        _turned(q, corner[c], place, point)
        if sign * (n[0] * point[0] + n[1] * point[1] + n[2] * point[2]) >= highest - reach:
            if count == 2:
                return False
            for axis in range(3):
                edge[count, axis] = point[axis]
            count += 1
    return count == 2


@kernel
def _ends(
    body: Ints, geometry: Ints, normal: Floats, position: Floats, orientation: Floats, corner: Floats, start: Ints,
    reach: float,
) -> tuple[npt.NDArray[np.bool_], Floats, Floats]:  # fmt: skip
    m = body.shape[0]
    found = np.zeros(m, np.bool_)
    point = np.zeros((m, 2, 3))
    gap = np.zeros((m, 2))
    one = np.empty((2, 3))
    other = np.empty((2, 3))
    along = np.empty(3)
    parts = start.size - 1
    for i in range(m):
        a = geometry[i, 0]
        b = geometry[i, 1]
        if a >= parts or b >= parts:
            continue
        n = normal[i]
        if not _edge(
            start[a], start[a + 1], corner, orientation[body[i, 0]], position[body[i, 0]], n, 1.0, reach, one
        ) or not _edge(
            start[b], start[b + 1], corner, orientation[body[i, 1]], position[body[i, 1]], n, -1.0, reach, other
        ):
            continue
        length = 0.0
        for axis in range(3):
            along[axis] = one[1, axis] - one[0, axis]
            length += along[axis] ** 2
        length = length**0.5
        # Both ends of each edge as lengths along the first one.
        s0 = 0.0
        s1 = 0.0
        width = 0.0
        for axis in range(3):
            along[axis] /= length
            s0 += along[axis] * (other[0, axis] - one[0, axis])
            s1 += along[axis] * (other[1, axis] - one[0, axis])
            width += (other[1, axis] - other[0, axis]) ** 2
        width = width**0.5
        if abs(s1 - s0) < (1.0 - PARALLEL * PARALLEL) ** 0.5 * width:
            continue
        low = max(0.0, min(s0, s1))
        high = min(length, max(s0, s1))
        if high - low < SHORT * min(length, width):
            continue
        found[i] = True
        for end in range(2):
            s = low if end == 0 else high
            share = (s - s0) / (s1 - s0)
            for axis in range(3):
                x = one[0, axis] + s * along[axis]
                y = other[0, axis] + share * (other[1, axis] - other[0, axis])
                point[i, end, axis] = 0.5 * (x + y)
                gap[i, end] += n[axis] * (y - x)
    return found, point, gap

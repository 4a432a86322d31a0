"""Which spheres touch one another and the walls: one pass over a grid of upright columns.

The spheres are sorted into columns a little wider than the largest diameter. Each is compared with the later ones of
its own column and the next, and with those of three columns of the next row: two runs of neighbors in memory. Whole
rows of columns form stripes, `STRIPES` of them whatever the number of threads: a stripe writes to a place of its own,
so that the order of the contacts depends on the positions alone.

A contact of stripe k is on bodies of stripes k and k + 1 alone. Contacts of stripes 0, 2, 4, … therefore share no body,
and neither do those of 1, 3, 5, …: sweeps may take each half at once, on any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.world.container import Container
from solvers import ProblemError
from solvers._jit import kernel, parallel_kernel, prange
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]
# Unsigned, because a signed index costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]

STRIPES = 16
"""Stripes of a scene: enough for the threads of a desktop machine, few enough that a stripe has work."""

# A sphere touches at most about 14 others that do not overlap, half of which count it, and a few walls.
MOST_CONTACTS = 16
# Contacts count as touching below this gap over the smallest radius: positions carry rounding.
TOUCHING = 1e-9
# Columns along each side of the scene, over the root of the number of spheres: a lone ball far away makes them wider.
MOST_COLUMNS = 4.0


@dataclass(frozen=True)
class Contacts:
    """What touches. The immovable body has the number of the last row of `Spheres.motion`."""

    normal: Floats
    """Unit normal from the first body to the second, shape (m, 3)."""

    body: Indices
    """First and second body, shape (m, 2); the first is the immovable one where there is one."""

    gap: Floats
    """Distance of the surfaces [m], < 0 overlaps, shape (m,)."""

    stripe: Ints
    """Where each stripe's contacts begin, and m; shape (STRIPES + 1,)."""

    order: Ints
    """The spheres sorted by column, shape (bodies,): an order in which neighbors are near."""

    @property
    def m(self) -> int:
        """Number of contacts."""
        return int(self.gap.size)


def find_contacts(place: Floats, container: Container) -> Contacts:
    """Find all pairs of spheres that touch or overlap, and all spheres at a wall.

    Args:
        place: centers and radii [m], shape (bodies, 4).
        container: the walls.

    Raises:
        ProblemError: a position is not finite, or the spheres overlap so much that they cannot be told apart.
    """
    low_x, high_x, low_y, high_y, smallest, largest = _extent(place)
    if not np.isfinite(high_x - low_x + high_y - low_y):
        raise ProblemError("position must be finite")
    touching = TOUCHING * smallest
    width = 2.0 * largest + touching
    most = int(MOST_COLUMNS * np.sqrt(len(place))) + 1
    columns = min(int((high_x - low_x) / width) + 1, most)
    rows = min(int((high_y - low_y) / width) + 1, most)
    start, order, sorted_place = _sort(
        place, low_x, low_y, max((high_x - low_x) / columns, width), max((high_y - low_y) / rows, width), columns, rows
    )
    # Empty stripes come last: one between two others would make neighbors of an even and an even one.
    used = min(STRIPES, rows)
    row_start = (np.minimum(np.arange(STRIPES + 1), used) * rows // used).astype(np.int32)
    pair, count = _touching(sorted_place, start, columns, rows, row_start, container.planes, container.drums, touching)
    if (count < 0).any():
        raise ProblemError(f"position: a region has more than {MOST_CONTACTS} contacts a sphere: the spheres overlap")
    stripe = np.zeros(STRIPES + 1, dtype=np.int32)
    np.cumsum(count, out=stripe[1:])
    normal, body, gap = _describe(
        sorted_place, start, columns, row_start, container.planes, container.drums, order, pair, stripe
    )
    return Contacts(normal, body, gap, stripe, order)


@kernel
def _extent(place: Floats) -> tuple[float, float, float, float, float, float]:
    """Least and greatest x, y and radius; NaN where any place is."""
    low_x = high_x = place[0, 0]
    low_y = high_y = place[0, 1]
    smallest = largest = place[0, 3]
    total = 0.0
    for b in range(place.shape[0]):
        low_x = min(low_x, place[b, 0])
        high_x = max(high_x, place[b, 0])
        low_y = min(low_y, place[b, 1])
        high_y = max(high_y, place[b, 1])
        smallest = min(smallest, place[b, 3])
        largest = max(largest, place[b, 3])
        total += place[b, 0] + place[b, 1] + place[b, 2]
    # NaN is lost in comparisons, not in a sum.
    return low_x + 0.0 * total, high_x, low_y, high_y, smallest, largest


@kernel
def _sort(
    place: Floats, low_x: float, low_y: float, step_x: float, step_y: float, columns: int, rows: int
) -> tuple[Ints, Ints, Floats]:
    """Counting sort by column: where each column begins, the spheres' numbers, and their places."""
    bodies = place.shape[0]
    column_of = np.empty(bodies, np.int32)
    start = np.zeros(columns * rows + 1, np.int32)
    for b in range(bodies):
        x = min(max(int((place[b, 0] - low_x) / step_x), 0), columns - 1)
        y = min(max(int((place[b, 1] - low_y) / step_y), 0), rows - 1)
        column_of[b] = y * columns + x
        start[column_of[b] + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    order = np.empty(bodies, np.int32)
    sorted_place = np.empty((bodies, 4))
    free = start.copy()
    for b in range(bodies):
        k = free[column_of[b]]
        free[column_of[b]] = k + 1
        order[k] = b
        for axis in range(4):
            sorted_place[k, axis] = place[b, axis]
    return start, order, sorted_place


@kernel
def _overlap(
    place: Floats, k: int, begin: int, end: int, touching: float, pair: Indices, size: int, room: int
) -> int:  # fmt: skip
    """Append the spheres of a run that touch sphere k; returns the number of pairs, also of those beyond the room."""
    x = place[k, 0]
    y = place[k, 1]
    z = place[k, 2]
    reach = place[k, 3] + touching
    for j in range(begin, end):
        dx = place[j, 0] - x
        dy = place[j, 1] - y
        dz = place[j, 2] - z
        distance = place[j, 3] + reach
        if dx * dx + dy * dy + dz * dz <= distance * distance:
            if size < room:
                pair[size, 0] = k
                pair[size, 1] = j
            size += 1
    return size


@kernel
def _height(place: Floats, k: int, planes: Floats, p: int) -> float:
    """Height of a center over a plane."""
    return float(planes[p, 0] * place[k, 0] + planes[p, 1] * place[k, 1] + planes[p, 2] * place[k, 2] - planes[p, 3])


@kernel
def _at_walls(
    place: Floats, k: int, planes: Floats, drums: Floats, touching: float, pair: Indices, size: int, room: int
) -> int:  # fmt: skip
    """Append the walls that sphere k touches, numbered after the spheres: planes, then drums."""
    reach = place[k, 3] + touching
    for p in range(planes.shape[0] + drums.shape[0]):
        if p < planes.shape[0]:
            height = _height(place, k, planes, p)
        else:
            d = p - planes.shape[0]
            height = drums[d, 2] - np.sqrt((place[k, 0] - drums[d, 0]) ** 2 + (place[k, 1] - drums[d, 1]) ** 2)
        if height <= reach:
            if size < room:
                pair[size, 0] = k
                pair[size, 1] = place.shape[0] + p
            size += 1
    return size


@kernel
def _touching_in(
    place: Floats, start: Ints, columns: int, rows: int, first_row: int, end_row: int,
    planes: Floats, drums: Floats, touching: float, pair: Indices, begin: int, room: int,
) -> int:  # fmt: skip
    """Pairs of some rows of columns, written from `begin` on; returns where they end, were there room for all."""
    size = begin
    for row in range(first_row, end_row):
        for column in range(columns):
            c = row * columns + column
            last = min(column + 1, columns - 1)
            own_end = start[row * columns + last + 1]
            above = own_end
            above_end = own_end
            if row + 1 < rows:
                above = start[(row + 1) * columns + max(column - 1, 0)]
                above_end = start[(row + 1) * columns + last + 1]
            for k in range(start[c], start[c + 1]):
                size = _overlap(place, k, k + 1, own_end, touching, pair, size, room)
                size = _overlap(place, k, above, above_end, touching, pair, size, room)
                size = _at_walls(place, k, planes, drums, touching, pair, size, room)
    return size


@parallel_kernel
def _touching(
    place: Floats, start: Ints, columns: int, rows: int, row_start: Ints, planes: Floats, drums: Floats, touching: float
) -> tuple[Indices, Ints]:
    """Pairs of each stripe, from MOST_CONTACTS times its first sphere on; and how many, -1 for too many."""
    pair = np.empty((MOST_CONTACTS * place.shape[0], 2), np.uint32)
    count = np.zeros(STRIPES, np.int32)
    for stripe in prange(STRIPES):
        first_row = row_start[stripe]
        end_row = row_start[stripe + 1]
        begin = MOST_CONTACTS * start[first_row * columns]
        room = MOST_CONTACTS * start[end_row * columns]
        end = _touching_in(
            place, start, columns, rows, first_row, end_row, planes, drums, touching, pair, begin, room
        )  # fmt: skip
        count[stripe] = end - begin if end <= room else -1
    return pair, count


@parallel_kernel
def _describe(
    place: Floats, start: Ints, columns: int, row_start: Ints, planes: Floats, drums: Floats,
    order: Ints, pair: Indices, stripe_start: Ints,
) -> tuple[Floats, Indices, Floats]:  # fmt: skip
    """Normals, bodies and gaps of the pairs found, without the room between the stripes."""
    bodies = place.shape[0]
    m = stripe_start[STRIPES]
    normal = np.empty((m, 3))
    body = np.empty((m, 2), np.uint32)
    gap = np.empty(m)
    for stripe in prange(STRIPES):
        read = MOST_CONTACTS * start[row_start[stripe] * columns]
        for i in range(stripe_start[stripe], stripe_start[stripe + 1]):
            k = pair[read, 0]
            j = pair[read, 1]
            read += 1
            if j < bodies:
                dx = place[j, 0] - place[k, 0]
                dy = place[j, 1] - place[k, 1]
                dz = place[j, 2] - place[k, 2]
                distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                normal[i, 0] = dx / distance
                normal[i, 1] = dy / distance
                normal[i, 2] = dz / distance
                body[i, 0] = order[k]
                body[i, 1] = order[j]
                gap[i] = distance - (place[k, 3] + place[j, 3])
                continue
            p = j - bodies
            body[i, 0] = bodies
            body[i, 1] = order[k]
            if p < planes.shape[0]:
                for axis in range(3):
                    normal[i, axis] = planes[p, axis]
                gap[i] = _height(place, k, planes, p) - place[k, 3]
            else:
                d = p - planes.shape[0]
                dx = drums[d, 0] - place[k, 0]
                dy = drums[d, 1] - place[k, 1]
                distance = np.sqrt(dx * dx + dy * dy)
                normal[i, 0] = dx / distance
                normal[i, 1] = dy / distance
                normal[i, 2] = 0.0
                gap[i] = drums[d, 2] - distance - place[k, 3]
    return normal, body, gap

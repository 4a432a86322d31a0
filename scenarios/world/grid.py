"""Which spheres touch one another and the walls: one pass over a grid of upright columns.

The spheres are sorted into columns a little wider than the largest diameter. Each is compared with the later ones of
its own column and the next, and with those of three columns of the next row: two runs of neighbors in memory. Whole
rows of columns form stripes, `STRIPES` of them whatever the number of threads: a stripe writes to a place of its own,
so that the order of the contacts depends on the positions alone: a stripe's walls, then its pairs, column by column.

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
from solvers.buffers import Buffers
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]
# Unsigned, because a signed index costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]
Pairs = npt.NDArray[np.uint64]

STRIPES = 16
"""Stripes of a scene: enough for the threads of a desktop machine, few enough that a stripe has work."""

# A sphere touches at most about 14 others that do not overlap, half of which count it, and a few walls.
MOST_CONTACTS = 16
# Contacts count as touching below this gap over the smallest radius: positions carry rounding.
TOUCHING = 1e-9
# A pair of sorted numbers is one entry: the later one in its upper half.
HALF = np.uint64(32)
LOWER = np.uint64((1 << 32) - 1)
ONE = np.uint64(1)
ZERO = np.uint64(0)
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


def find_contacts(place: Floats, container: Container, *, buffers: Buffers | None = None) -> Contacts:
    """Find all pairs of spheres that touch or overlap, and all spheres at a wall.

    Args:
        place: centers and radii [m], shape (bodies, 4).
        container: the walls.
        buffers: memory for the contacts, which are then valid until the next call with it.

    Raises:
        ProblemError: a position is not finite, or the spheres overlap so much that they cannot be told apart.
    """
    buffers = buffers or Buffers()
    low_x, high_x, low_y, high_y, smallest, largest = _extent(place)
    if not np.isfinite(high_x - low_x + high_y - low_y):
        raise ProblemError("position must be finite")
    bodies = len(place)
    touching = TOUCHING * smallest
    width = 2.0 * largest + touching
    most = int(MOST_COLUMNS * np.sqrt(bodies)) + 1
    columns = min(int((high_x - low_x) / width) + 1, most)
    rows = min(int((high_y - low_y) / width) + 1, most)
    order, sorted_place = np.empty(bodies, np.int32), buffers.array("sorted place", (4, bodies))
    first = _sort(
        place, low_x, low_y, max((high_x - low_x) / columns, width), max((high_y - low_y) / rows, width),
        columns, rows, order, sorted_place,
    )  # fmt: skip
    # Empty stripes come last: one between two others would make neighbors of an even and an even one.
    used = min(STRIPES, rows)
    row_start = (np.minimum(np.arange(STRIPES + 1), used) * rows // used).astype(np.int32)
    # Each stripe has room for one sphere's comparisons more: what is no pair is written as well, and then overwritten.
    pair = buffers.array("pair", ((MOST_CONTACTS + STRIPES) * bodies,), np.uint64)
    planes, drums = container.planes, container.drums
    count = _touching(sorted_place, first, columns, rows, row_start, planes, drums, touching, pair)
    if (count < 0).any():
        raise ProblemError(f"position: a region has more than {MOST_CONTACTS} contacts a sphere: the spheres overlap")
    stripe = np.zeros(STRIPES + 1, dtype=np.int32)
    np.cumsum(count, out=stripe[1:])
    m = int(stripe[-1])
    normal, gap = buffers.array("normal", (m, 3)), buffers.array("gap", (m,))
    body = buffers.array("body", (m, 2), np.uint32)
    _describe(sorted_place, first[row_start * columns], planes, drums, order, pair, stripe, normal, body, gap)
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
    place: Floats, low_x: float, low_y: float, step_x: float, step_y: float, columns: int, rows: int, order: Ints,
    sorted_place: Floats,
) -> Ints:  # fmt: skip
    """Counting sort by column: the spheres' numbers, their x, y, z and radius, and where each column begins."""
    bodies = place.shape[0]
    column_of = np.empty(bodies, np.int32)
    first = np.zeros(columns * rows + 2, np.int32)
    for b in range(bodies):
        x = min(max(int((place[b, 0] - low_x) / step_x), 0), columns - 1)
        y = min(max(int((place[b, 1] - low_y) / step_y), 0), rows - 1)
        column_of[b] = y * columns + x
        first[column_of[b] + 2] += 1
    # One entry further on than needed: filling moves each beginning to the next.
    for c in range(2, first.size):
        first[c] += first[c - 1]
    for b in range(bodies):
        c = column_of[b] + 1
        k = first[c]
        first[c] = k + 1
        order[k] = b
        for axis in range(4):
            sorted_place[axis, k] = place[b, axis]
    return first


@kernel
def _height(place: Floats, k: int, planes: Floats, drums: Floats, p: int) -> float:
    """Height of a center over a wall: planes come first, then drums."""
    if p < planes.shape[0]:
        return float(
            planes[p, 0] * place[0, k] + planes[p, 1] * place[1, k] + planes[p, 2] * place[2, k] - planes[p, 3]
        )
    d = p - planes.shape[0]
    return float(drums[d, 2] - np.sqrt((place[0, k] - drums[d, 0]) ** 2 + (place[1, k] - drums[d, 1]) ** 2))


@kernel
def _at_walls(
    place: Floats, begin: int, end: int, planes: Floats, drums: Floats, touching: float, pair: Pairs, size: int,
    room: int,
) -> int:  # fmt: skip
    """Append the walls that some spheres touch, numbered after the spheres; returns where the pairs end."""
    for p in range(planes.shape[0] + drums.shape[0]):
        wall = np.uint64(place.shape[1] + p) << HALF
        for k in range(np.uint64(begin), np.uint64(end)):
            if _height(place, k, planes, drums, p) <= place[3, k] + touching:
                pair[size] = wall | k
                size += 1
        if size > room:
            break
    return size


@kernel
def _overlap(
    x: Floats, y: Floats, z: Floats, radius: Floats, first: Ints, columns: int, rows: int, begin_row: int,
    end_row: int, touching: float, pair: Pairs, size: int, room: int,
) -> int:  # fmt: skip
    """Append the pairs of some rows of columns that touch; returns where they end, or first are too many."""
    here = np.uint64(size)
    for row in range(begin_row, end_row):
        for column in range(columns):
            right = min(column + 1, columns - 1)
            own_end = np.uint64(first[row * columns + right + 1])
            above = above_end = own_end
            if row + 1 < rows:
                above = np.uint64(first[(row + 1) * columns + max(column - 1, 0)])
                above_end = np.uint64(first[(row + 1) * columns + right + 1])
            for k in range(np.uint64(first[row * columns + column]), np.uint64(first[row * columns + column + 1])):
                x_k = x[k]
                y_k = y[k]
                z_k = z[k]
                reach = radius[k] + touching
                # No branch for what is no pair: it would be mispredicted too often.
                for j in range(k + ONE, own_end):
                    dx = x[j] - x_k
                    dy = y[j] - y_k
                    dz = z[j] - z_k
                    distance = radius[j] + reach
                    pair[here] = j << HALF | k
                    here += ONE if dx * dx + dy * dy + dz * dz <= distance * distance else ZERO
                for j in range(above, above_end):
                    dx = x[j] - x_k
                    dy = y[j] - y_k
                    dz = z[j] - z_k
                    distance = radius[j] + reach
                    pair[here] = j << HALF | k
                    here += ONE if dx * dx + dy * dy + dz * dz <= distance * distance else ZERO
                if here > np.uint64(room):
                    return int(np.int64(here))
    return int(np.int64(here))


@parallel_kernel
def _touching(
    place: Floats, first: Ints, columns: int, rows: int, row_start: Ints, planes: Floats, drums: Floats,
    touching: float, pair: Pairs,
) -> Ints:  # fmt: skip
    """Pairs of each stripe in a room of its own, and how many: -1 for too many."""
    count = np.empty(STRIPES, np.int32)
    for stripe in prange(STRIPES):
        begin_row = row_start[stripe]
        end_row = row_start[stripe + 1]
        begin = first[begin_row * columns]
        end = first[end_row * columns]
        own = MOST_CONTACTS * begin + np.int64(stripe) * place.shape[1]
        room = own + MOST_CONTACTS * (end - begin)
        size = _at_walls(place, begin, end, planes, drums, touching, pair, own, room)
        size = _overlap(
            place[0], place[1], place[2], place[3], first, columns, rows, begin_row, end_row, touching, pair, size, room
        )
        count[stripe] = size - own if size <= room else -1
    return count


@kernel
def _describe_stripe(
    place: Floats, planes: Floats, drums: Floats, order: Ints, pair: Pairs, read: int, begin: int, end: int,
    normal: Floats, body: Indices, gap: Floats,
) -> None:  # fmt: skip
    """Normals, bodies and gaps of the contacts from `begin` to `end`, whose pairs stand from `read` on."""
    bodies = place.shape[1]
    ahead = np.uint64(read - begin)
    for i in range(np.uint64(begin), np.uint64(end)):
        k = pair[ahead + i] & LOWER
        j = pair[ahead + i] >> HALF
        body[i, 1] = order[k]
        if j < np.uint64(bodies):
            dx = place[0, j] - place[0, k]
            dy = place[1, j] - place[1, k]
            dz = place[2, j] - place[2, k]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            normal[i, 0] = dx / distance
            normal[i, 1] = dy / distance
            normal[i, 2] = dz / distance
            body[i, 0] = order[k]
            body[i, 1] = order[j]
            gap[i] = distance - (place[3, k] + place[3, j])
            continue
        p = np.int64(j) - bodies
        body[i, 0] = bodies
        height = _height(place, k, planes, drums, p)
        gap[i] = height - place[3, k]
        if p < planes.shape[0]:
            for axis in range(3):
                normal[i, axis] = planes[p, axis]
        else:
            d = p - planes.shape[0]
            distance = drums[d, 2] - height
            normal[i, 0] = (drums[d, 0] - place[0, k]) / distance
            normal[i, 1] = (drums[d, 1] - place[1, k]) / distance
            normal[i, 2] = 0.0


@parallel_kernel
def _describe(
    place: Floats, row_sphere: Ints, planes: Floats, drums: Floats, order: Ints, pair: Pairs, stripe_start: Ints,
    normal: Floats, body: Indices, gap: Floats,
) -> None:  # fmt: skip
    """Normals, bodies and gaps of the pairs found, without the room between the stripes."""
    for stripe in prange(STRIPES):
        read = MOST_CONTACTS * row_sphere[stripe] + np.int64(stripe) * place.shape[1]
        _describe_stripe(
            place, planes, drums, order, pair, read, stripe_start[stripe], stripe_start[stripe + 1], normal, body, gap
        )

"""Which spheres touch one another and the walls: a list of neighbors that lasts some steps, from a grid.

    |x_i - x_j| <= r_i + r_j   only if   |y_i - y_j| <= r_i + r_j + 2 s      while |x - y - d| <= s for both

y are the places at which the list was made, s is the reach [m], and d is a drift that all spheres share. What touches
is looked for among the listed pairs; a stray, which has gone further than the reach, is compared with the spheres of
the columns around it instead. When there are many strays the list is made anew.

The grid is one of upright columns half as wide as the largest sphere with its reach. Each sphere is compared with the
later ones of its own column and the next two, and with those of five columns of each of the next two rows: three runs
of neighbors in memory. Whole rows of columns form stripes, `STRIPES` of them at most and whatever the number of
threads: a stripe writes to a place of its own, so that the order of the contacts depends on the places alone: a
stripe's walls, then its pairs, column by column, then those of its strays.

A contact of stripe k is on bodies of stripes k and k + 1 alone, as a stripe has two rows or more. Contacts of stripes
0, 2, 4, … therefore share no body, and neither do those of 1, 3, 5, …: sweeps may take each half at once, on any number
of threads.
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
"""Most stripes of a scene: enough for the threads of a desktop machine, few enough that a stripe has work."""

# A sphere touches at most about 14 others that do not overlap, half of which count it, and a few walls; a few more are
# within reach.
MOST_CONTACTS = 16
# Contacts count as touching below this gap over the smallest radius: positions carry rounding.
TOUCHING = 1e-9
# A pair of numbers is one entry: the later one in its upper half. Walls are numbered after the spheres.
HALF = np.uint64(32)
LOWER = np.uint64((1 << 32) - 1)
ONE = np.uint64(1)
ZERO = np.uint64(0)
# Columns along each side of the scene, over the root of the number of spheres: a lone ball far away makes them wider.
MOST_COLUMNS = 4.0
# Two neighbors stand so many columns apart at most, and so many rows.
NEXT = 2
# Each stripe has room for so many contacts of a stray, all of whose may be in one.
MOST_OF_A_STRAY = 32
NO_STRAYS = np.zeros(0, dtype=np.uint32)


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

    @property
    def m(self) -> int:
        """Number of contacts."""
        return int(self.gap.size)


@dataclass(frozen=True)
class Grid:
    """Columns of spheres, row after row."""

    low: tuple[float, float]
    """Least x and y of the centers [m]."""

    step: tuple[float, float]
    """Size of a column along x and y [m]."""

    shape: tuple[int, int]
    """Rows, and columns in each."""

    first: Ints
    """Where the spheres of each column begin in `order`, and their number; shape (rows * columns + 1,) or longer."""

    order: Ints
    """The spheres sorted by column, shape (bodies,): an order in which neighbors are near."""

    row_start: Ints
    """First row of each stripe, and the number of rows; shape (STRIPES + 1,)."""


@dataclass(frozen=True)
class Neighbors:
    """Spheres and walls that may touch as long as the spheres stay within reach."""

    place: Floats
    """Centers [m] and radii [m] when the list was made, shape (bodies, 4)."""

    slack: float
    """Gap up to which spheres touch [m]."""

    reach: float
    """How far a sphere may go from there, besides the drift of all, before it is a stray [m]."""

    drift: float
    """How far all spheres may go along z together [m]: walls are listed where that brings a sphere to them."""

    furthest: float
    """How far a stray may go [m]: its contacts must be on bodies of its stripe and the next."""

    grid: Grid
    """The spheres when the list was made."""

    pair: Pairs
    """Two spheres, or a wall and a sphere, by their numbers, in stripes; shape (pairs,)."""

    stripe: Ints
    """Where the pairs of each stripe begin, and their number; shape (STRIPES + 1,)."""

    walls: Ints
    """How many of a stripe's pairs, its first ones, are with walls; shape (STRIPES,)."""

    def touching(
        self, place: Floats, container: Container, *, strays: Indices = NO_STRAYS, buffers: Buffers | None = None
    ) -> Contacts:
        """Find those of the neighbors that touch or overlap.

        Args:
            place: centers [m] and radii [m], shape (bodies, 4); where there are strays, it is written to meanwhile.
            container: the walls.
            strays: the spheres beyond the reach, in ascending order.
            buffers: memory for the contacts, which are then valid until the next call with it.
        """
        buffers = buffers or Buffers()
        planes, drums = container.planes, container.drums
        # Behind the pairs of a stripe there is room for those of all strays.
        room = MOST_OF_A_STRAY * strays.size
        start = self.stripe + room * np.arange(STRIPES + 1, dtype=np.int32)
        found = buffers.array("found", (int(start[-1]),), np.uint64)
        if strays.size:
            radius = place[strays, 3]
            # Strays touch nothing in the list.
            place[strays, 3] = np.nan
        count = _touching(place, self.pair, self.stripe, self.walls, planes, drums, self.slack, start, found)
        if strays.size:
            place[strays, 3] = radius
            grid = self.grid
            fit = _touching_strays(
                place, strays, self.place, grid.low, grid.step, grid.shape, grid.first, grid.order, grid.row_start,
                planes, drums, self.slack, start, found, count,
            )  # fmt: skip
            if not fit:
                return find_contacts(place, container)
        stripe = np.zeros(STRIPES + 1, dtype=np.int32)
        np.cumsum(count, out=stripe[1:])
        m = int(stripe[-1])
        normal, gap = buffers.array("normal", (m, 3)), buffers.array("gap", (m,))
        body = buffers.array("body", (m, 2), np.uint32)
        _describe(place, planes, drums, found, start, stripe, normal, body, gap)
        return Contacts(normal, body, gap, stripe)


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
    return find_neighbors(place, 0.0, container, buffers=buffers).touching(place, container, buffers=buffers)


def find_neighbors(
    place: Floats, reach: float, container: Container, *, drift: float = 0.0, buffers: Buffers | None = None
) -> Neighbors:
    """List all pairs of spheres, and all spheres and walls, that may touch while the spheres stay within reach.

    Args:
        place: centers and radii [m], shape (bodies, 4); it is kept.
        reach: how far each sphere may go [m].
        container: the walls.
        drift: how far all spheres may go along z together besides [m].
        buffers: memory for the list, which is then valid until the next call with it.

    Raises:
        ProblemError: a position is not finite, or the spheres overlap so much that they cannot be told apart.
    """
    buffers = buffers or Buffers()
    low_x, high_x, low_y, high_y, smallest, largest = _extent(place)
    if not np.isfinite(high_x - low_x + high_y - low_y):
        raise ProblemError("position must be finite")
    bodies = len(place)
    touching = TOUCHING * smallest
    # Twice that: places and the reach are rounded.
    slack = 2.0 * touching
    width = (2.0 * (largest + reach) + slack) / NEXT
    most = int(MOST_COLUMNS * np.sqrt(bodies)) + 1
    columns = min(int((high_x - low_x) / width) + 1, most)
    rows = min(int((high_y - low_y) / width) + 1, most)
    low, step = (low_x, low_y), (max((high_x - low_x) / columns, width), max((high_y - low_y) / rows, width))
    order, sorted_place = np.empty(bodies, np.int32), buffers.array("sorted place", (4, bodies))
    first = _sort(place, reach, low, step, (rows, columns), order, sorted_place)
    # Empty stripes come last: one between two others would make neighbors of an even and an even one.
    used = min(STRIPES, max(rows // NEXT, 1))
    row_start = (np.minimum(np.arange(STRIPES + 1), used) * rows // used).astype(np.int32)
    # Two strays that touch were not further apart in the list than a stripe is wide. Of one stripe none leaves, unless
    # it is lost.
    furthest = float(np.finfo(np.float64).max)
    if used > 1:
        furthest = 0.5 * (rows // used * step[1] - 2.0 * largest - slack)
    # Each stripe has room for one sphere's comparisons more: what is no pair is written as well, and then overwritten.
    room = buffers.array("neighbor", ((MOST_CONTACTS + STRIPES) * bodies,), np.uint64)
    count = _compare(
        sorted_place, first, (rows, columns), row_start, container.planes, container.drums, drift, slack, room
    )
    if (count < 0).any():
        raise ProblemError(f"position: a region has more than {MOST_CONTACTS} contacts a sphere: the spheres overlap")
    stripe = np.zeros(STRIPES + 1, dtype=np.int32)
    np.cumsum(count.sum(axis=1), out=stripe[1:])
    pair = buffers.array("pair", (int(stripe[-1]),), np.uint64)
    _number(first[row_start * columns], bodies, order, room, stripe, pair)
    grid = Grid(low, step, (rows, columns), first, order, row_start)
    return Neighbors(place, touching, reach, drift, furthest, grid, pair, stripe, count[:, 0].copy())


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
def _column(
    place: Floats, b: int, low: tuple[float, float], step: tuple[float, float], shape: tuple[int, int]
) -> tuple[int, int]:
    """Row and column of a sphere; what is outside belongs to the border."""
    column = min(max(int((place[b, 0] - low[0]) / step[0]), 0), shape[1] - 1)
    row = min(max(int((place[b, 1] - low[1]) / step[1]), 0), shape[0] - 1)
    return row, column


@kernel
def _sort(
    place: Floats, reach: float, low: tuple[float, float], step: tuple[float, float], shape: tuple[int, int],
    order: Ints, sorted_place: Floats,
) -> Ints:  # fmt: skip
    """Counting sort by column: the spheres' numbers, their x, y, z and radius with reach, where each column begins."""
    bodies = place.shape[0]
    column_of = np.empty(bodies, np.int32)
    first = np.zeros(shape[0] * shape[1] + 2, np.int32)
    for b in range(bodies):
        row, column = _column(place, b, low, step, shape)
        column_of[b] = row * shape[1] + column
        first[column_of[b] + 2] += 1
    # One entry further on than needed: filling moves each beginning to the next.
    for c in range(2, first.size):
        first[c] += first[c - 1]
    for b in range(bodies):
        c = column_of[b] + 1
        k = first[c]
        first[c] = k + 1
        order[k] = b
        for axis in range(3):
            sorted_place[axis, k] = place[b, axis]
        sorted_place[3, k] = place[b, 3] + reach
    return first


@kernel
def _height(x: float, y: float, z: float, planes: Floats, drums: Floats, p: int) -> float:
    """Height of a center over a wall: planes come first, then drums."""
    if p < planes.shape[0]:
        return float(planes[p, 0] * x + planes[p, 1] * y + planes[p, 2] * z - planes[p, 3])
    d = p - planes.shape[0]
    return float(drums[d, 2] - np.sqrt((x - drums[d, 0]) ** 2 + (y - drums[d, 1]) ** 2))


@kernel
def _near_walls(
    place: Floats, begin: int, end: int, planes: Floats, drums: Floats, drift: float, slack: float, room: Pairs,
    size: int, most: int,
) -> int:  # fmt: skip
    """Append the walls that some spheres may touch, numbered after the spheres; returns where the pairs end."""
    for p in range(planes.shape[0] + drums.shape[0]):
        wall = np.uint64(place.shape[1] + p) << HALF
        near = slack
        if p < planes.shape[0]:
            near += drift * abs(planes[p, 2])
        for k in range(np.uint64(begin), np.uint64(end)):
            if _height(place[0, k], place[1, k], place[2, k], planes, drums, p) <= place[3, k] + near:
                room[size] = wall | k
                size += 1
        if size > most:
            break
    return size


@kernel
def _compare_run(
    x: Floats, y: Floats, z: Floats, reach: Floats, k: np.uint64, begin: np.uint64, end: np.uint64, slack: float,
    room: Pairs, here: np.uint64,
) -> np.uint64:  # fmt: skip
    """Append the pairs of one sphere with a run of others; returns where they end."""
    x_k = x[k]
    y_k = y[k]
    z_k = z[k]
    own = reach[k] + slack
    # No branch for what is no pair: it would be mispredicted too often.
    for j in range(begin, end):
        dx = x[j] - x_k
        dy = y[j] - y_k
        dz = z[j] - z_k
        distance = reach[j] + own
        room[here] = np.uint64(j) << HALF | k
        here += ONE if dx * dx + dy * dy + dz * dz <= distance * distance else ZERO
    return here


@kernel
def _compare_rows(
    x: Floats, y: Floats, z: Floats, reach: Floats, first: Ints, shape: tuple[int, int], begin_row: int, end_row: int,
    slack: float, room: Pairs, size: int, most: int,
) -> int:  # fmt: skip
    """Append the pairs of some rows of columns; returns where they end, or first are too many."""
    here = np.uint64(size)
    rows, columns = shape
    for row in range(begin_row, end_row):
        for column in range(columns):
            left = max(column - NEXT, 0)
            right = min(column + NEXT, columns - 1) + 1
            own_end = np.uint64(first[row * columns + right])
            # Without a next row there is an empty run.
            one = min(row + 1, rows - 1) * columns
            two = min(row + 2, rows - 1) * columns
            one_begin = np.uint64(first[one + left])
            one_end = np.uint64(first[one + right]) if row + 1 < rows else one_begin
            two_begin = np.uint64(first[two + left])
            two_end = np.uint64(first[two + right]) if row + 2 < rows else two_begin
            for own in range(first[row * columns + column], first[row * columns + column + 1]):
                k = np.uint64(own)
                here = _compare_run(x, y, z, reach, k, k + ONE, own_end, slack, room, here)
                here = _compare_run(x, y, z, reach, k, one_begin, one_end, slack, room, here)
                here = _compare_run(x, y, z, reach, k, two_begin, two_end, slack, room, here)
                if here > np.uint64(most):
                    return int(np.int64(here))
    return int(np.int64(here))


@kernel
def _room(bodies: int, begin: int, stripe: int) -> int:
    """Where the room of a stripe begins whose first sphere in the sorted order is `begin`."""
    return int(MOST_CONTACTS * np.int64(begin) + np.int64(stripe) * bodies)


@parallel_kernel
def _compare(
    place: Floats, first: Ints, shape: tuple[int, int], row_start: Ints, planes: Floats, drums: Floats, drift: float,
    slack: float, room: Pairs,
) -> Ints:  # fmt: skip
    """Pairs of each stripe in a room of its own; how many with walls and with spheres, below 0 for too many."""
    count = np.empty((STRIPES, 2), np.int32)
    for stripe in prange(STRIPES):
        begin_row = row_start[stripe]
        end_row = row_start[stripe + 1]
        begin = first[begin_row * shape[1]]
        end = first[end_row * shape[1]]
        own = _room(place.shape[1], begin, stripe)
        most = own + MOST_CONTACTS * (end - begin)
        walls = _near_walls(place, begin, end, planes, drums, drift, slack, room, own, most)
        size = walls
        if size <= most:
            size = _compare_rows(
                place[0], place[1], place[2], place[3], first, shape, begin_row, end_row, slack, room, size, most
            )
        count[stripe, 0] = walls - own
        count[stripe, 1] = size - walls if size <= most else -size
    return count


@parallel_kernel
def _number(row_sphere: Ints, bodies: int, order: Ints, room: Pairs, stripe_start: Ints, pair: Pairs) -> None:
    """Take the pairs out of their rooms, and give the spheres their numbers before the sorting."""
    for stripe in prange(STRIPES):
        begin = stripe_start[stripe]
        ahead = np.uint64(_room(bodies, row_sphere[stripe], stripe) - begin)
        for c in range(np.uint64(begin), np.uint64(stripe_start[stripe + 1])):
            k = room[ahead + c] & LOWER
            j = room[ahead + c] >> HALF
            other = np.uint64(order[j]) if j < np.uint64(bodies) else j
            pair[c] = other << HALF | np.uint64(order[k])


@kernel
def _touching_stripe(
    place: Floats, pair: Pairs, begin: int, walls_end: int, end: int, planes: Floats, drums: Floats, slack: float,
    start: int, found: Pairs,
) -> int:  # fmt: skip
    """Put those of some pairs that touch one after another, from `start` on; returns how many."""
    here = np.uint64(start)
    for c in range(np.uint64(begin), np.uint64(walls_end)):
        k = pair[c] & LOWER
        p = np.int64(pair[c] >> HALF) - place.shape[0]
        height = _height(place[k, 0], place[k, 1], place[k, 2], planes, drums, p)
        found[here] = pair[c]
        here += ONE if height <= place[k, 3] + slack else ZERO
    for c in range(np.uint64(walls_end), np.uint64(end)):
        k = pair[c] & LOWER
        j = pair[c] >> HALF
        dx = place[j, 0] - place[k, 0]
        dy = place[j, 1] - place[k, 1]
        dz = place[j, 2] - place[k, 2]
        distance = place[j, 3] + (place[k, 3] + slack)
        found[here] = pair[c]
        here += ONE if dx * dx + dy * dy + dz * dz <= distance * distance else ZERO
    return int(np.int64(here)) - start


@parallel_kernel
def _touching(
    place: Floats, pair: Pairs, stripe: Ints, walls: Ints, planes: Floats, drums: Floats, slack: float, start: Ints,
    found: Pairs,
) -> Ints:  # fmt: skip
    """Pairs of each stripe that touch, from its start on, and how many."""
    count = np.empty(STRIPES, np.int32)
    for k in prange(STRIPES):
        begin = stripe[k]
        count[k] = _touching_stripe(
            place, pair, begin, begin + walls[k], stripe[k + 1], planes, drums, slack, start[k], found
        )
    return count


@kernel
def _touch(place: Floats, a: int, b: int, slack: float) -> bool:
    """Whether two spheres touch."""
    dx = place[b, 0] - place[a, 0]
    dy = place[b, 1] - place[a, 1]
    dz = place[b, 2] - place[a, 2]
    distance = place[b, 3] + (place[a, 3] + slack)
    return bool(dx * dx + dy * dy + dz * dz <= distance * distance)


@kernel
def _stripe_of(
    listed: Floats, b: int, low: tuple[float, float], step: tuple[float, float], shape: tuple[int, int],
    row_start: Ints,
) -> int:  # fmt: skip
    """Stripe of a sphere in the list."""
    row, _ = _column(listed, b, low, step, shape)
    stripe = 0
    while row >= row_start[stripe + 1]:
        stripe += 1
    return stripe


@kernel
def _append(found: Pairs, start: Ints, count: Ints, stripe: int, later: int, earlier: int) -> bool:
    """Append a pair to those of a stripe; false where there is no room."""
    place = start[stripe] + count[stripe]
    if place >= start[stripe + 1]:
        return False
    found[place] = np.uint64(later) << HALF | np.uint64(earlier)
    count[stripe] += 1
    return True


@kernel
def _touching_strays(
    place: Floats, strays: Indices, listed: Floats, low: tuple[float, float], step: tuple[float, float],
    shape: tuple[int, int], first: Ints, order: Ints, row_start: Ints, planes: Floats, drums: Floats, slack: float,
    start: Ints, found: Pairs, count: Ints,
) -> bool:  # fmt: skip
    """Append what touches the strays to the pairs of the stripes; false where there is no room."""
    bodies = place.shape[0]
    fit = True
    stray = np.zeros(bodies, np.bool_)
    for b in strays:
        stray[b] = True
    for q in range(strays.size):
        b = int(strays[q])
        own = _stripe_of(listed, b, low, step, shape, row_start)
        for p in range(planes.shape[0] + drums.shape[0]):
            if _height(place[b, 0], place[b, 1], place[b, 2], planes, drums, p) <= place[b, 3] + slack:
                fit &= _append(found, start, count, own, bodies + p, b)
        # Spheres within reach are listed near enough.
        row, column = _column(place, b, low, step, shape)
        for r in range(max(row - NEXT, 0), min(row + NEXT + 1, shape[0])):
            line = r * shape[1]
            for k in range(first[line + max(column - NEXT, 0)], first[line + min(column + NEXT + 1, shape[1])]):
                c = int(order[k])
                if not stray[c] and _touch(place, b, c, slack):
                    stripe = min(own, _stripe_of(listed, c, low, step, shape, row_start))
                    fit &= _append(found, start, count, stripe, c, b)
        # Strays may be listed anywhere.
        for other in range(q + 1, strays.size):
            c = int(strays[other])
            if _touch(place, b, c, slack):
                stripe = min(own, _stripe_of(listed, c, low, step, shape, row_start))
                fit &= _append(found, start, count, stripe, c, b)
    return fit


@kernel
def _describe_stripe(
    place: Floats, planes: Floats, drums: Floats, found: Pairs, read: int, begin: int, end: int, normal: Floats,
    body: Indices, gap: Floats,
) -> None:  # fmt: skip
    """Normals, bodies and gaps of the contacts from `begin` to `end`, whose pairs stand from `read` on."""
    bodies = place.shape[0]
    ahead = np.uint64(read - begin)
    for i in range(np.uint64(begin), np.uint64(end)):
        k = found[ahead + i] & LOWER
        j = found[ahead + i] >> HALF
        if j < np.uint64(bodies):
            dx = place[j, 0] - place[k, 0]
            dy = place[j, 1] - place[k, 1]
            dz = place[j, 2] - place[k, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            normal[i, 0] = dx / distance
            normal[i, 1] = dy / distance
            normal[i, 2] = dz / distance
            body[i, 0] = k
            body[i, 1] = j
            gap[i] = distance - (place[k, 3] + place[j, 3])
            continue
        p = np.int64(j) - bodies
        body[i, 0] = bodies
        body[i, 1] = k
        height = _height(place[k, 0], place[k, 1], place[k, 2], planes, drums, p)
        gap[i] = height - place[k, 3]
        if p < planes.shape[0]:
            for axis in range(3):
                normal[i, axis] = planes[p, axis]
        else:
            d = p - planes.shape[0]
            distance = drums[d, 2] - height
            normal[i, 0] = (drums[d, 0] - place[k, 0]) / distance
            normal[i, 1] = (drums[d, 1] - place[k, 1]) / distance
            normal[i, 2] = 0.0


@parallel_kernel
def _describe(
    place: Floats, planes: Floats, drums: Floats, found: Pairs, pair_start: Ints, stripe_start: Ints, normal: Floats,
    body: Indices, gap: Floats,
) -> None:  # fmt: skip
    """Normals, bodies and gaps of the pairs found, without the room between the stripes."""
    for stripe in prange(STRIPES):
        _describe_stripe(
            place, planes, drums, found, pair_start[stripe], stripe_start[stripe], stripe_start[stripe + 1], normal,
            body, gap,
        )  # fmt: skip

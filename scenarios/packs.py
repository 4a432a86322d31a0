"""A dense random layer of equal spheres on a floor, hit by the floor, all at once.

The layer is made by dropping spheres one after the other: each falls, rolls down over what it meets, first over one
sphere, then in the groove between two, and stays where three hold it (or the floor does). The cell is periodic in x
and y: no side wall breaks the layer. Only square roots are used, so that a seed gives the same layer everywhere.

    steepest way down with contacts n_1 … n_k:  the direction d next to -z with d · n_i ≥ 0 for all of them

Six spheres stand on each D² of floor, as in Bizon et al. 1998 (60,000 on 100 D × 100 D): 5.42 D deep at a volume
fraction of 0.58. This layer's own fraction is 0.56 (between 1.5 D and 3.5 D), its depth 5.6 D.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scenarios.contacts import (
    Contacts,
    fixed_contacts,
    linear_momenta,
    normal_rows,
    normal_rows_with_spin,
    sphere_inverse_mass,
    tangent_rows,
    velocities_with_spin,
)
from scenarios.parameters import check_choice, check_count, check_number, given
from scenarios.references import hertz
from scenarios.scenario import Reference, Scenario
from solvers import ImpactProblem
from solvers._jit import kernel
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]

# Changes whenever the same parameters give other centers: old cache files are then left alone.
GENERATOR = 1
RADIUS = 0.5
# 60,000 spheres on 100 D × 100 D (Bizon et al. 1998).
SPHERES_PER_AREA = 6.0
# 100 spheres make a cell four diameters wide: two spheres then meet only once across its borders, and what a rolling
# sphere can reach from another one (two diameters) is unambiguous.
FEWEST_SPHERES = 100
# Pairs with a gap below this share of a diameter count as touching in the frozen geometry. That makes 3.03-3.05
# contacts a sphere from 1,000 to 60,000 spheres, so that W is singular; those that really touch are 2.87 a sphere.
GAP = 0.03
# Width of the part of the layer that moves with start = "patch" [diameters].
PATCH = 3.0
# Standard deviation of each velocity with start = "hot", beside an impact speed of 1 [m/s].
HOT_SPEED = 1.0
# A rolling sphere meets far fewer others than this; one that does not come to rest is dropped anew elsewhere.
ROLLING_STEPS = 200
# Rounding of a position after a few hundred square roots, in diameters.
ON_CONTACT = 1e-10
# Where a path grazes a sphere, leaving and meeting are apart by the root of a rounding error.
LEAVING = 1e-7
FLOOR = -1
NOTHING = -2


def sphere_pack(
    *,
    spheres: int = 1000,
    start: str = "kick",
    seed: int = 0,
    restitution: float = 1.0,
    friction: float = 0.0,
) -> Scenario:
    """Dense random layer of equal spheres, about 5.6 diameters deep, that lands on its floor as a whole.

    Diameter 1 m, mass 1 kg, frozen geometry. The cell is periodic in x and y.

    Args:
        spheres: how many, ≥ 100.
        start: "kick": the whole layer comes down with speed 1 (a layer at rest whose floor is struck upward, seen from
            the floor); "hot": the same with a Gaussian velocity of standard deviation 1 added along each axis;
            "patch": only a round column 3 diameters wide comes down.
        seed: of the positions and velocities, ≥ 0.
        restitution: of all contacts, in [0, 1].
        friction: coefficient of all contacts, ≥ 0; with friction the spheres spin.

    Source: chosen here; depth after Bizon et al. 1998.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("spheres", spheres, FEWEST_SPHERES)
    check_choice("start", start, ("kick", "hot", "patch"))
    check_count("seed", seed, 0)
    check_number("restitution", restitution, low=0.0, high=1.0)
    check_number("friction", friction, low=0.0)
    centers = layer(spheres, seed)
    contacts = layer_contacts(centers)
    problem = _problem(contacts, _velocity(centers, start, seed), restitution, friction)
    elastic: list[Callable[[], Reference]] = [partial(hertz, problem)] if restitution == 1.0 and friction == 0 else []
    return Scenario(
        "sphere-pack",
        given(sphere_pack, locals()),
        problem,
        "chosen here; depth after Bizon et al. 1998",
        reference_builders=tuple(elastic),
        # The floor takes the vertical momentum and, by friction, the others; the borders of the cell the angular one.
        invariants=() if friction else linear_momenta(spheres, 3, "xy"),
        tags=frozenset({"pack", "friction"} if friction else {"pack"}),
        dofs_per_body=3,
        positions=centers,
    )


def cell_width(spheres: int) -> float:
    """Width of the periodic cell [diameters]."""
    return float(np.sqrt(spheres / SPHERES_PER_AREA))


def layer(spheres: int, seed: int) -> Floats:
    """Centers of a layer [diameters], shape (spheres, 3), in order of their fall; the floor is z = 0.

    Kept in a folder of the user (`IMPACTBENCH_CACHE`, or ~/.cache/impactbench); without one it is made each time.
    """
    kept = _cache_file(spheres, seed)
    centers = _read(kept, spheres)
    if centers is None:
        centers = _drop_and_roll(spheres, cell_width(spheres), np.random.default_rng([seed, 0]))
        _write(kept, centers)
    return centers


def layer_contacts(centers: Floats) -> Contacts:
    """Contacts of a layer: with the floor, then between spheres across the borders of the cell."""
    width = cell_width(len(centers))
    on_floor = np.flatnonzero(centers[:, 2] < RADIUS + GAP)
    floor = fixed_contacts(on_floor, np.tile([0.0, 0.0, 1.0], (on_floor.size, 1)))
    # The vertical is no border: a period that nothing reaches across stands in for none.
    height = float(centers[:, 2].max()) + 4.0
    inside = np.column_stack([centers[:, :2] % width, centers[:, 2]])
    # A remainder just below zero rounds up to the width itself, which the tree refuses.
    inside[:, :2] = np.where(inside[:, :2] < width, inside[:, :2], 0.0)
    pairs = cKDTree(inside, boxsize=[width, width, height]).query_pairs(1.0 + GAP, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.intp)
    offset = inside[pairs[:, 1]] - inside[pairs[:, 0]]
    offset[:, :2] -= width * np.round(offset[:, :2] / width)
    normals = offset / np.linalg.norm(offset, axis=1)[:, None]
    return floor + Contacts(pairs[:, 0].copy(), pairs[:, 1].copy(), normals)


def _velocity(centers: Floats, start: str, seed: int) -> Floats:
    """Velocities of the centers [m/s], shape (spheres, 3)."""
    velocity = np.zeros_like(centers)
    velocity[:, 2] = -1.0
    if start == "hot":
        velocity += HOT_SPEED * np.random.default_rng([seed, 1]).standard_normal(centers.shape)
    elif start == "patch":
        width = cell_width(len(centers))
        outside = np.linalg.norm(centers[:, :2] % width - width / 2, axis=1) > PATCH / 2
        velocity[outside] = 0.0
    return velocity


def _problem(contacts: Contacts, velocity: Floats, restitution: float, friction: float) -> ImpactProblem:
    spheres = len(velocity)
    if friction == 0:
        return ImpactProblem(np.ones(3 * spheres), normal_rows(contacts, spheres), velocity.ravel(), restitution)
    return ImpactProblem(
        sphere_inverse_mass(np.ones(spheres), RADIUS),
        normal_rows_with_spin(contacts, spheres),
        velocities_with_spin(velocity),
        restitution,
        friction,
        tangent_rows(contacts, spheres, RADIUS),
    )


def _cache_file(spheres: int, seed: int) -> Path | None:
    """Where a layer is kept; the name holds all that it depends on. None where the user has no folder."""
    named = os.environ.get("IMPACTBENCH_CACHE")
    try:
        folder = Path(named) if named else Path.home() / ".cache" / "impactbench"
    except RuntimeError:
        return None
    key = f"layer {GENERATOR} {spheres} {seed} {SPHERES_PER_AREA!r}"
    return folder / f"layer-{hashlib.sha256(key.encode()).hexdigest()[:20]}.npz"


def _read(kept: Path | None, spheres: int) -> Floats | None:
    """A kept layer, or None where there is none or it cannot be one: it is then made anew."""
    if kept is None:
        return None
    try:
        # Opened here: NumPy would leave the file of a broken archive open.
        with kept.open("rb") as file, np.load(file) as archive:
            centers = np.asarray(archive["centers"], dtype=np.float64)
            same = archive["digest"].tobytes() == _digest(centers)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return centers if same and centers.shape == (spheres, 3) else None


def _write(kept: Path | None, centers: Floats) -> None:
    """Keep a layer; a folder that cannot be written to only costs the time to make it again."""
    if kept is None:
        return
    # Written aside and moved: another process never sees half a file.
    aside = kept.with_suffix(f".{os.getpid()}.npz")
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez(aside, centers=centers, digest=np.frombuffer(_digest(centers), dtype=np.uint8))
        os.replace(aside, kept)
    except OSError:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)


def _digest(centers: Floats) -> bytes:
    return hashlib.sha256(centers.tobytes()).digest()


def _drop_and_roll(spheres: int, width: float, random: np.random.Generator) -> Floats:
    """Drop the spheres one after the other at random places; a place where one does not come to rest is given up."""
    columns = int(width)
    centers = np.zeros((spheres, 3))
    # Column lists: head of each column of the cell, and from each sphere to the next below it in the list.
    head = np.full(columns * columns, NOTHING, dtype=np.int32)
    following = np.full(spheres, NOTHING, dtype=np.int32)
    dropped = 0
    while dropped < spheres:
        places = random.uniform(0.0, width, (spheres - dropped, 2))
        dropped = _drop(centers, head, following, places, dropped, width)
    return centers


@kernel
def _column(x: float, width: float, columns: int) -> int:
    """Column of a coordinate in the periodic cell."""
    c = int(np.floor(x / width * columns))
    return c % columns


@kernel
def _nearest_image(offset: float, width: float) -> float:
    """Offset to the nearest periodic image."""
    return float(offset - width * np.floor(offset / width + 0.5))


@kernel
def _columns_near(head: Ints, following: Ints, width: float, x: float, y: float, columns_away: int, found: Ints) -> int:
    """Collect the spheres of all columns at most `columns_away` columns away from (x, y); returns how many."""
    columns = int(np.sqrt(head.size) + 0.5)
    low, high = -columns_away, columns_away
    if 2 * columns_away + 1 > columns:
        # A narrow cell is searched once, not around.
        low, high = 0, columns - 1
    middle_x = _column(x, width, columns)
    middle_y = _column(y, width, columns)
    count = 0
    for a in range(low, high + 1):
        column_x = (middle_x + a) % columns
        for b in range(low, high + 1):
            column_y = (middle_y + b) % columns
            i = head[column_x * columns + column_y]
            while i >= 0:
                found[count] = i
                count += 1
                i = following[i]
    return count


@kernel
def _drop(centers: Floats, head: Ints, following: Ints, places: Floats, dropped: int, width: float) -> int:
    """Drop a sphere at each place; returns how many lie in the layer."""
    columns = int(np.sqrt(head.size) + 0.5)
    found = np.zeros(centers.shape[0], np.int32)
    p = np.zeros(3)
    top = 0.0
    for i in range(dropped):
        top = max(top, centers[i, 2])
    for k in range(places.shape[0]):
        p[0], p[1], p[2] = places[k, 0], places[k, 1], top + 2.0
        if not _settle(centers, head, following, width, p, found):
            continue
        for axis in range(2):
            p[axis] -= width * np.floor(p[axis] / width)
        for axis in range(3):
            centers[dropped, axis] = p[axis]
        column = _column(p[0], width, columns) * columns + _column(p[1], width, columns)
        following[dropped] = head[column]
        head[column] = dropped
        top = max(top, p[2])
        dropped += 1
    return dropped


@kernel
def _settle(centers: Floats, head: Ints, following: Ints, width: float, p: Floats, found: Ints) -> bool:
    """Let a sphere fall and roll from p until it lies; false where it does not come to rest."""
    n = np.zeros((3, 3))
    # The first `count` are touched, the next `left` were touched and are being left.
    order = np.full(4, NOTHING, np.int32)
    count = 0
    left = 0
    for _ in range(ROLLING_STEPS):
        for c in range(count):
            i = order[c]
            n[c, 0] = _nearest_image(p[0] - centers[i, 0], width)
            n[c, 1] = _nearest_image(p[1] - centers[i, 1], width)
            n[c, 2] = p[2] - centers[i, 2]
        if count > 0:
            held = _support(n, order, count)
            left += count - held
            count = held
        if count == 3:
            return True
        # Within one diameter of a falling sphere, and two of the middle of its path, lies all that it can meet.
        x, y, columns_away = p[0], p[1], 1
        if count == 1:
            x, y, columns_away = p[0] - n[0, 0], p[1] - n[0, 1], 2
        elif count == 2:
            x, y, columns_away = p[0] - 0.5 * (n[0, 0] + n[1, 0]), p[1] - 0.5 * (n[0, 1] + n[1, 1]), 2
        near = found[: _columns_near(head, following, width, x, y, columns_away, found)]
        if count == 0:
            event = _fall(centers, width, p, near, order, left)
        elif count == 1:
            event = _roll_over_one(centers, width, p, n, near, order, 1 + left)
        else:
            event = _roll_over_two(centers, width, p, n, near, order, 2 + left)
        if event == FLOOR:
            return True
        if event >= 0:
            # A new contact; what was left is behind.
            order[count] = event
            count += 1
            left = 0
        else:
            # Past the side of one sphere, or out of the groove over its lower one (kept first): the other is left.
            count -= 1
            left = 1
    return False


@kernel
def _support(n: Floats, order: Ints, count: int) -> int:
    """Put first the contacts that the steepest way down presses on; returns how many, 3 = the sphere lies.

    The way down is the projection of -z on {d : d · n_i ≥ 0}: exactly one set of contacts presses with forces ≥ 0 and
    moves away from the others.
    """
    # None presses: all contacts are above.
    free = True
    for c in range(count):
        free = free and n[c, 2] <= 0.0
    if free:
        return 0
    # One presses: d = -z + n_z n.
    for a in range(count):
        if n[a, 2] <= 0.0:
            continue
        away = True
        for c in range(count):
            if c != a:
                away = away and n[a, 2] * _dot(n, a, c) - n[c, 2] >= 0.0
        if away:
            _swap(n, order, 0, a)
            return 1
    if count == 2:
        return 2
    # Two press: d = -z + f n_a + g n_b.
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        q = _dot(n, a, b)
        f = (n[a, 2] - q * n[b, 2]) / (1.0 - q * q)
        g = (n[b, 2] - q * n[a, 2]) / (1.0 - q * q)
        if f >= 0.0 and g >= 0.0 and f * _dot(n, a, c) + g * _dot(n, b, c) - n[c, 2] >= 0.0:
            _swap(n, order, 2, c)
            return 2
    return 3


@kernel
def _dot(n: Floats, a: int, b: int) -> float:
    return float(n[a, 0] * n[b, 0] + n[a, 1] * n[b, 1] + n[a, 2] * n[b, 2])


@kernel
def _swap(n: Floats, order: Ints, a: int, b: int) -> None:
    """Exchange two contacts."""
    order[a], order[b] = order[b], order[a]
    for axis in range(3):
        n[a, axis], n[b, axis] = n[b, axis], n[a, axis]


@kernel
def _is_known(i: int, order: Ints, known: int) -> bool:
    """True for the spheres that are touched or being left."""
    known_here = False
    for c in range(known):
        known_here = known_here or order[c] == i
    return known_here


@kernel
def _fall(centers: Floats, width: float, p: Floats, near: Ints, order: Ints, known: int) -> int:
    """Fall from p to the highest sphere below, or to the floor; returns which."""
    event = FLOOR
    height = RADIUS
    for i in near:
        if _is_known(i, order, known):
            continue
        x = _nearest_image(p[0] - centers[i, 0], width)
        y = _nearest_image(p[1] - centers[i, 1], width)
        rest = 1.0 - x * x - y * y
        if rest <= 0.0:
            continue
        z = centers[i, 2] + np.sqrt(rest)
        if height < z <= p[2] + ON_CONTACT:
            height = z
            event = i
    p[2] = height
    return event


@kernel
def _entry(along_h: float, along_k: float, level: float) -> tuple[float, float]:
    """First angle, as (cos, sin), at which b_h sin + b_k cos rises to `level`; (2, 0) where it never does."""
    R = np.sqrt(along_h * along_h + along_k * along_k)
    if not -R < level < R:
        return 2.0, 0.0
    cos_half = level / R
    sin_half = np.sqrt(1.0 - cos_half * cos_half)
    cos_middle = along_k / R
    sin_middle = along_h / R
    return cos_middle * cos_half + sin_middle * sin_half, sin_middle * cos_half - cos_middle * sin_half


@kernel
def _roll_over_one(centers: Floats, width: float, p: Floats, n: Floats, near: Ints, order: Ints, known: int) -> int:
    """Roll down a meridian of one sphere until another is met; past its side the sphere falls (NOTHING)."""
    a = order[0]
    level = np.sqrt(n[0, 0] ** 2 + n[0, 1] ** 2)
    hx, hy = 1.0, 0.0
    if level > 0.0:
        hx, hy = n[0, 0] / level, n[0, 1] / level
    event = NOTHING
    cos_end, sin_end = 0.0, 1.0
    for i in near:
        if _is_known(i, order, known):
            continue
        x = _nearest_image(centers[i, 0] - centers[a, 0], width)
        y = _nearest_image(centers[i, 1] - centers[a, 1], width)
        z = centers[i, 2] - centers[a, 2]
        square = x * x + y * y + z * z
        if square >= 4.0:
            continue
        # |p - b| = 1 on the circle |p| = 1: p · b = |b|²/2.
        cos_i, sin_i = _entry(x * hx + y * hy, z, 0.5 * square)
        if sin_i >= 0.0 and cos_end < cos_i <= n[0, 2] + ON_CONTACT:
            cos_end, sin_end = cos_i, sin_i
            event = i
    p[0] = centers[a, 0] + hx * sin_end
    p[1] = centers[a, 1] + hy * sin_end
    p[2] = centers[a, 2] + cos_end
    return event


@kernel
def _roll_over_two(centers: Floats, width: float, p: Floats, n: Floats, near: Ints, order: Ints, known: int) -> int:
    """Roll down the groove of two spheres until a third or the floor is met, or the upper one lets go (NOTHING).

    The path is a circle about the middle of the two, from its top in the direction h. The upper sphere carries nothing
    below the height 2 ρ² |e_z| / L over the middle, e their unit distance, L its length.
    """
    if n[0, 2] < n[1, 2]:
        # The lower sphere is the one farther below p: keep it first.
        _swap(n, order, 0, 1)
    # e from the first (lower) sphere to the second (upper) one.
    ex, ey, ez = n[0, 0] - n[1, 0], n[0, 1] - n[1, 1], n[0, 2] - n[1, 2]
    L = np.sqrt(ex * ex + ey * ey + ez * ez)
    ex, ey, ez = ex / L, ey / L, ez / L
    radius = np.sqrt(max(1.0 - 0.25 * L * L, 0.0))
    # k points up in the plane of the circle, h across it.
    k_length = np.sqrt(max(1.0 - ez * ez, 0.0))
    kx, ky, kz = -ez * ex / k_length, -ez * ey / k_length, k_length
    hx, hy = -ey / k_length, ex / k_length
    rx, ry, rz = 0.5 * (n[0, 0] + n[1, 0]), 0.5 * (n[0, 1] + n[1, 1]), 0.5 * (n[0, 2] + n[1, 2])
    if rx * hx + ry * hy < 0.0:
        hx, hy = -hx, -hy
    cos_now = (rx * kx + ry * ky + rz * kz) / radius
    middle_x, middle_y, middle_z = p[0] - rx, p[1] - ry, p[2] - rz
    event = NOTHING
    cos_end = min(2.0 * radius * ez / (L * kz), cos_now)
    sin_end = np.sqrt(max(1.0 - cos_end * cos_end, 0.0))
    cos_floor = (RADIUS - middle_z) / (radius * kz)
    if cos_floor > cos_end:
        event = FLOOR
        cos_end = cos_floor
        sin_end = np.sqrt(max(1.0 - cos_end * cos_end, 0.0))
    for i in near:
        if _is_known(i, order, 2):
            continue
        # A groove can lead back to the sphere that was left: it counts again once the path has moved on.
        limit = cos_now - LEAVING if _is_known(i, order, known) else cos_now + ON_CONTACT
        x = _nearest_image(centers[i, 0] - middle_x, width)
        y = _nearest_image(centers[i, 1] - middle_y, width)
        z = centers[i, 2] - middle_z
        square = x * x + y * y + z * z
        if square >= 4.0:
            continue
        # |p - b| = 1 on the circle |p| = ρ: p · b = (ρ² + |b|² - 1)/2.
        level = 0.5 * (radius * radius + square - 1.0) / radius
        cos_i, sin_i = _entry(x * hx + y * hy, x * kx + y * ky + z * kz, level)
        if sin_i >= 0.0 and cos_end < cos_i <= limit:
            cos_end, sin_end = cos_i, sin_i
            event = i
    p[0] = middle_x + radius * (hx * sin_end + kx * cos_end)
    p[1] = middle_y + radius * (hy * sin_end + ky * cos_end)
    p[2] = middle_z + radius * kz * cos_end
    return event

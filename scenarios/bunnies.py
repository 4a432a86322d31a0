"""Bunnies that fall on the ground, and pawns that fall on them.

    d_i(x) = (|S_i⁻¹ Rᵀ (x - c_i)| - 1) min S_i         one ellipsoid S of the bunny: body, haunches, head, ears, …
    F(x) = -log Σ_i exp(-k d_i(x)) / k = 0              the bunny's surface (smooth minimum, Quilez 2013)

The bunny is our own: no scan, nothing to download. Its triangles come from marching cubes, its convex parts are the
hulls of what belongs to one ellipsoid or two. The pawn is a solid of revolution, cut into rings that are convex.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path

import numpy as np

from scenarios.parameters import check_count, check_number, check_positive
from scenarios.world.impact import Resolver
from scenarios.world.moving_scene import STAGES_FIRED, MovingScene, MovingWorld
from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.rigid_world import RigidSettings, RigidWorld, Trigger
from scenarios.world.rotation import about, rotation_matrix
from scenarios.world.shapes import Shape, extra, half_space, mesh, mesh_of_parts
from solvers import SOLVERS, ImpactProblem, ProblemError
from solvers.solution import Floats

# Center, half axes [m], tilt about y [rad] and part of each ellipsoid of a bunny that looks along +x and is 1.1 m tall.
ELLIPSOIDS = (
    ((0.00, 0.00, 0.00), (0.36, 0.27, 0.29), 0.00, 0),
    ((-0.24, 0.00, -0.02), (0.22, 0.25, 0.25), 0.00, 0),
    ((0.36, 0.00, 0.27), (0.19, 0.165, 0.17), 0.30, 1),
    ((0.25, 0.10, 0.56), (0.075, 0.055, 0.24), -0.35, 2),
    ((0.25, -0.10, 0.56), (0.075, 0.055, 0.24), -0.35, 3),
    ((-0.49, 0.00, 0.00), (0.09, 0.09, 0.09), 0.00, 4),
    ((0.25, 0.00, -0.24), (0.16, 0.20, 0.07), 0.00, 5),
)
# Sharpness of the smooth minimum [1/m]: fillets of about 1/k between body and head.
SHARPNESS = 25.0
# Cell of the marching cubes [m], and the box that holds the bunny.
CELL = 0.03
LOW, HIGH = (-0.72, -0.42, -0.45), (0.72, 0.42, 0.95)
# Directions in which a part's farthest point becomes a corner of its hull.
DIRECTIONS = 40
# Radius and height of the pawn's outline, from the bottom of its foot to the top of its head [m].
OUTLINE = (
    (0.00, 0.00), (0.30, 0.00), (0.30, 0.10), (0.22, 0.16), (0.12, 0.34), (0.10, 0.56), (0.19, 0.60), (0.19, 0.65),
    (0.10, 0.69), (0.17, 0.76), (0.19, 0.85), (0.16, 0.94), (0.09, 1.00), (0.00, 1.02),
)  # fmt: skip
# Where the outline is cut: each stretch revolves to a body that is nearly convex (foot, stem, collar, head).
CUTS = ((1, 3), (3, 5), (5, 8), (8, 12))
# Corners of a ring of the pawn.
SECTIONS = 20
# Distance of two bunnies' centers in the lattice that they start from: over twice the distance of the ears' tips.
SPACING = 1.8
BUNNIES_A_LAYER = 36
# Height of the lowest bounding sphere over the ground [m].
DROP = 0.5
# What is farther from the middle than this has escaped [m].
FARTHEST = 100.0
GRAVITY = 9.81
STAGES = ("the pawns are let go", "the pile is at rest")
SOLVER = "qce-lcp:tolerance=1e-9,max_sweeps=1000"
# The pile is at rest when this share of the energy of the fall is left in motion.
AT_REST = 1e-6


def bunnies_and_pawns(
    *,
    bunnies: int = 144,
    pawns: int = 16,
    restitution: float = 0.2,
    friction: float = 0.2,
    pawns_from: float = 2.0,
    mesh: str | None = None,
    step: float = 0.002,
) -> MovingScene:
    """Bunnies fall on the ground in layers of 36; later pawns fall on the pile, and all come to rest.

    Args:
        bunnies: how many, ≥ 1.
        pawns: how many, ≥ 0.
        restitution: of all contacts, in [0, 1].
        friction: coefficient of all contacts, ≥ 0.
        pawns_from: when the pawns are let go, ≥ 0 [s].
        mesh: file of a closed mesh that falls in the bunnies' place, scaled to their size; None: the bunny made here.
        step: > 0 [s].

    Source: Zhang 2015, Section 5.4 and Fig. 10; sizes and shapes are chosen here.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("bunnies", bunnies, 1)
    check_count("pawns", pawns, 0)
    check_number("restitution", restitution, low=0.0, high=1.0)
    check_number("friction", friction, low=0.0)
    check_number("pawns_from", pawns_from, low=0.0)
    check_positive("step", step)
    if mesh is not None:
        # Now, and not when a run has begun: a file that cannot be read is found before anything is made of it.
        loaded(mesh)
    # Without pawns there is nothing to let go.
    stages = STAGES if pawns else STAGES[1:]
    return MovingScene(
        "bunnies-and-pawns",
        {
            "bunnies": bunnies,
            "pawns": pawns,
            "restitution": restitution,
            "friction": friction,
            "pawns_from": pawns_from,
            "mesh": mesh,
            "step": step,
        },
        f"{bunnies} bunnies fall on the ground and are hit by {pawns} pawns",
        "Zhang 2015, Fig. 10",
        partial(_drop, bunnies, pawns, restitution, friction, pawns_from, mesh, step),
        default_solver=SOLVER,
        default_steps=round(12.0 / step),
        frame_every=max(round(0.04 / step), 1),
        measure=_measures,
        measure_every=1,
        stages=stages,
        reached=partial(_fired, len(stages)),
        color="kind",
    )


def _drop(
    bunnies: int,
    pawns: int,
    restitution: float,
    friction: float,
    pawns_from: float,
    file: str | None,
    step: float,
    identity: str,
    resolver: Resolver,
    seed: int,
) -> RigidWorld:
    """Both kinds in lattices over the ground, each turned at random; the pawns are held until their time."""
    random = np.random.default_rng(seed)
    shapes = [bunny() if file is None else loaded(file)] * bunnies + [pawn()] * pawns
    names = [f"bunny {k}" for k in range(bunnies)] + [f"pawn {k}" for k in range(pawns)]
    layers = -(-bunnies // BUNNIES_A_LAYER)
    lowest = DROP + max(shape.radius for shape in shapes)
    places = [*_lattice(bunnies, 6, lowest), *_lattice(pawns, 4, lowest + SPACING * (layers + 1))]
    bodies = [RigidBody("ground", half_space(), friction=friction, restitution=restitution, fixed=True)]
    for number, (name, shape, place) in enumerate(zip(names, shapes, places, strict=True)):
        turn = random.normal(size=4)
        bodies.append(
            RigidBody(name, shape, place, turn, friction=friction, restitution=restitution, held=number >= bunnies)
        )
    # All have fallen so far when the first one touches the ground: the peak of the kinetic energy is higher.
    least_peak = GRAVITY * DROP * bunnies * shapes[0].volume
    landed = pawns_from + np.sqrt(2.0 * lowest / GRAVITY) if pawns else 0.0
    triggers = [
        Trigger(STAGES[0], lambda world: world.time >= pawns_from, tuple(names[bunnies:])),
        Trigger(STAGES[1], lambda world: world.time > landed and world.kinetic_energy() < AT_REST * least_peak),
    ]
    return RigidWorld(
        identity, bodies, RigidSettings(step=step, gravity=GRAVITY), resolver, triggers=triggers[0 if pawns else 1 :]
    )  # fmt: skip


def _lattice(count: int, side: int, lowest: float) -> list[tuple[float, float, float]]:
    """Places in square layers over the origin, the lowest at a height [m]."""
    places = []
    for k in range(count):
        layer, cell = divmod(k, side * side)
        row, column = divmod(cell, side)
        middle = 0.5 * (side - 1)
        places.append((SPACING * (column - middle), SPACING * (row - middle), lowest + SPACING * layer))
    return places


def _measures(world: MovingWorld) -> dict[str, float]:
    """Whether the pile rests, and whether anything was lost."""
    assert isinstance(world, RigidWorld)
    place = world.position
    return {
        STAGES_FIRED: float(len(world.fired)),
        "kinetic energy [J]": world.kinetic_energy(),
        "overlap [m]": world.overlap,
        "bodies lost": float(((place[:, 2] < 0.0) | (np.abs(place[:, :2]) > FARTHEST).any(axis=1)).sum()),
        "top of the pile [m]": float(place[:, 2].max()),
        "energy error of the QCE step": np.nan if world.solved is None else elastic_energy_error(world.solved),
    }


def elastic_energy_error(problem: ImpactProblem) -> float:
    """|K⁺ - K⁻| / K⁻ of QCE alone, before restitution and friction (Zhang 2015, Section 5.4); NaN without approach."""
    before = problem.kinetic_energy(problem.v_pre)
    if before == 0.0 or problem.m == 0 or problem.u_pre.min() >= 0.0:
        return np.nan
    after = problem.kinetic_energy(SOLVERS["qce"]().solve(problem.replace(restitution=1.0, friction=0.0)).v_post)
    return abs(after - before) / before


def _fired(stages: int, measures: Mapping[str, float]) -> bool:
    return measures[STAGES_FIRED] == stages


@cache
def bunny() -> Shape:
    """A sitting bunny that looks along +x, 1.1 m tall, in six convex parts."""
    low = np.array(LOW)
    cells = np.ceil((np.array(HIGH) - low) / CELL).astype(int) + 1
    grid = np.stack(np.meshgrid(*[low[k] + CELL * np.arange(cells[k]) for k in range(3)], indexing="ij"), axis=-1)
    surface = -np.log(np.exp(-SHARPNESS * _distances(grid.reshape(-1, 3))).sum(axis=0)) / SHARPNESS
    corners, faces, _, _ = extra("skimage.measure").marching_cubes(surface.reshape(cells), 0.0)
    vertices = low + CELL * corners.astype(np.float64)
    part = np.array([ellipsoid[-1] for ellipsoid in ELLIPSOIDS])[_distances(vertices).argmin(axis=0)]
    pieces = [_thinned(vertices[part == number]) for number in range(part.max() + 1)]
    return mesh_of_parts(vertices, faces, pieces)


def _distances(points: Floats) -> Floats:
    """d_i(x), shape (ellipsoids, points)."""
    rows = []
    for center, half_axes, tilt, _ in ELLIPSOIDS:
        turn = rotation_matrix(about((0.0, 1.0, 0.0), tilt))
        scaled = (points - np.array(center)) @ turn / np.array(half_axes)
        rows.append((np.linalg.norm(scaled, axis=1) - 1.0) * min(half_axes))
    return np.array(rows)


def _thinned(points: Floats) -> Floats:
    """The farthest points in directions spread evenly over the sphere (golden spiral)."""
    k = np.arange(DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * k
    level = np.sqrt(1.0 - z**2)
    directions = np.column_stack([level * np.cos(turn), level * np.sin(turn), z])
    corners: Floats = points[np.unique((points @ directions.T).argmax(axis=0))]
    return corners


@cache
def pawn() -> Shape:
    """A pawn of chess, 1.02 m tall, in four convex parts."""
    turn = 2.0 * np.pi * np.arange(SECTIONS) / SECTIONS
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    rings = [np.column_stack([radius * circle, np.full(SECTIONS, z)]) for radius, z in OUTLINE[1:-1]]
    vertices = np.concatenate([[[0.0, 0.0, OUTLINE[0][1]]], *rings, [[0.0, 0.0, OUTLINE[-1][1]]]])
    top = len(vertices) - 1
    faces = []
    for k in range(SECTIONS):
        after = (k + 1) % SECTIONS
        faces.append((0, 1 + after, 1 + k))
        for ring in range(len(rings) - 1):
            low, high = 1 + ring * SECTIONS, 1 + (ring + 1) * SECTIONS
            faces += [(low + k, low + after, high + k), (low + after, high + after, high + k)]
        faces.append((top, top - SECTIONS + k, top - SECTIONS + after))
    pieces = [np.concatenate(rings[first - 1 : last]) for first, last in CUTS]
    pieces[-1] = np.concatenate([pieces[-1], vertices[-1:]])
    return mesh_of_parts(vertices, np.array(faces), pieces)


@cache
def loaded(file: str) -> Shape:
    """A mesh from a file, scaled so that it is as large as the bunny.

    Raises:
        ProblemError: the file is missing, of an unknown format, or its mesh not closed; names the body and the field.
    """
    try:
        radius = mesh(Path(file), concavity=1.0).radius
        return mesh(Path(file), scale=bunny().radius / radius)
    except ProblemError as error:
        raise ProblemError(f"body bunny 0: mesh: {error}") from None

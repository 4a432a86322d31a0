"""Billiards: equal discs of radius 0.5 (1 in the circle) that touch one another in the plane.

Frictionless discs have two velocities each. With friction they are balls on a table that is not felt during the
impact: blocks (v, ω) of six, solid spheres of the same radius. Normals come from lattice coordinates, so that mirror
images agree to the last bit and symmetric contacts tie exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt

from scenarios.contacts import (
    Contacts,
    angular_momenta_with_spin,
    fixed_contacts,
    linear_momenta,
    map_of_bodies,
    map_of_bodies_with_spin,
    normal_rows,
    normal_rows_with_spin,
    plane_angular_momentum,
    sphere_inverse_mass,
    tangent_rows,
    velocities_with_spin,
)
from scenarios.parameters import check_choice, check_count, check_number, check_positive, given
from scenarios.references import hertz, reflection_count, reversed_velocity, separate_contacts, two_targets
from scenarios.scenario import Invariant, Reference, ReferenceKind, Scenario, Symmetry
from solvers import ImpactProblem, ProblemError
from solvers.solution import Floats

Lattice = npt.NDArray[np.intp]

RADIUS = 0.5
# Lattice (a, c, b) → position: rows √3/2 apart, whole diameters along the axis, half ones along a row.
LATTICE = np.array([[np.sqrt(3.0) / 2.0, 0.0], [1.0, 0.0], [0.0, 0.5]])
DRUM_RADIUS = 4.0

MIRROR_X = ((-1.0, 0.0), (0.0, 1.0))
MIRROR_Y = ((1.0, 0.0), (0.0, -1.0))
HALF_TURN = ((-1.0, 0.0), (0.0, -1.0))
QUARTER_TURN = ((0.0, -1.0), (1.0, 0.0))
THREE_QUARTER_TURN = ((0.0, 1.0), (-1.0, 0.0))
DIAGONAL = ((0.0, 1.0), (1.0, 0.0))
ANTIDIAGONAL = ((0.0, -1.0), (-1.0, 0.0))


def bernoulli(*, mass_ratio: float = 1.0, restitution: float = 1.0, friction: float = 0.0) -> Scenario:
    """Bernoulli's problem: a ball hits two touching balls at once, along their axis of symmetry.

    Args:
        mass_ratio: mass of each target over that of the striker, > 0; Smith 2012 has 1, 12.1 and 23.3.
        restitution: of all three contacts, in [0, 1].
        friction: coefficient of all three contacts, ≥ 0.

    Source: Bernoulli's problem; Smith 2012, released scenes: striker at x = -2, targets at (0, ±0.5), radius 0.5;
    here at the instant of impact, with speed 1.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_positive("mass_ratio", mass_ratio)
    lattice = np.array([[-1, 0, 0], [0, 0, 1], [0, 0, -1]])
    velocity = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    mass = np.array([1.0, mass_ratio, mass_ratio])
    problem = _table(lattice, mass, velocity, restitution, friction)
    builders: list[Callable[[], Reference]] = []
    if friction == 0:
        builders.append(partial(two_targets, mass_ratio, restitution))
        if restitution == 1.0:
            builders.append(partial(hertz, problem))
    return Scenario(
        "bernoulli",
        given(bernoulli, locals()),
        problem,
        "Bernoulli's problem; Smith 2012, released scenes",
        reference_builders=tuple(builders),
        symmetries=(_table_symmetry("mirror y", MIRROR_Y, lattice, friction),),
        invariants=_table_momenta(lattice, friction),
        tags=_tags("billiards", friction),
        dofs_per_body=_vector_length(friction),
        positions=lattice @ LATTICE,
    )


def pool_break(
    *,
    rack: str = "triangle",
    balls: int | None = None,
    struck: str = "one",
    restitution: float = 1.0,
    friction: float = 0.0,
) -> Scenario:
    """Pool break: the cue ball comes with speed 1 along the axis of a rack of touching balls at rest.

    Args:
        rack: "triangle", or "nine-ball" for the diamond of rows 1, 2, 3, 2, 1.
        balls: in the rack, without cue balls. A triangle has 3, 6, 10, 15, … (None: 15), the diamond 9.
        struck: "one": by a cue ball at the head; "both": by a second one from behind too. Behind a triangle with an odd
            number of rows it meets the middle ball, with an even number the two middle balls.
        restitution: of all contacts, in [0, 1].
        friction: coefficient of all contacts, ≥ 0.

    Source: Smith 2012 (released scenes), Zhang 2015, Fig. 5.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_choice("rack", rack, ("triangle", "nine-ball"))
    check_choice("struck", struck, ("one", "both"))
    rows = _triangle_rows(balls) if rack == "triangle" else _diamond_rows(balls)
    lattice, velocity = _rack(rows, struck)
    problem = _table(lattice, np.ones(len(lattice)), velocity, restitution, friction)
    symmetries = [_table_symmetry("mirror y", MIRROR_Y, lattice, friction)]
    if rack == "nine-ball" and struck == "both":
        centered = lattice - np.array([2, 0, 0])
        symmetries += [
            _table_symmetry("mirror x", MIRROR_X, centered, friction),
            _table_symmetry("half turn", HALF_TURN, centered, friction),
        ]
    builders: list[Callable[[], Reference]] = []
    if restitution == 1.0 and friction == 0:
        builders.append(partial(hertz, problem))
        count = SMITH_COUNTS.get((rack, sum(rows), struck))
        if count is not None:
            builders.append(
                partial(reflection_count, count, "Smith 2012, released code", ("gr",), ReferenceKind.OTHER_CODE)
            )
    return Scenario(
        "pool-break",
        given(pool_break, locals()),
        problem,
        "Smith 2012, released scenes; Zhang 2015, Fig. 5",
        reference_builders=tuple(builders),
        symmetries=tuple(symmetries),
        invariants=_table_momenta(lattice, friction),
        tags=_tags("rack", friction),
        dofs_per_body=_vector_length(friction),
        positions=lattice @ LATTICE,
    )


# Iterations of generalized reflections by Smith 2012's released code, tolerance 1e-9 at speeds near 1.
SMITH_COUNTS = {("triangle", 15, "one"): 6, ("nine-ball", 9, "one"): 5}


def four_ball_circle(*, start: str = "top", restitution: float = 1.0) -> Scenario:
    """Four balls of radius 1 in a ring inside a fixed drum of radius 4: the symmetry test of the paper.

    The balls stand at (0, √2), (-√2, 0), (0, -√2), (√2, 0), each touching two others and none the drum.

    Args:
        start: "top": the top ball comes down on its two neighbors with speed 1, the others are at rest (in the released
            scene it starts upward, and this is its return from the drum). "inward": all four move to the center.
            "outward": the later instant at which all four, moving outward with speed 1, reach the drum 3 from the
            center; they no longer touch one another, so that it is four impacts at once, which keep their order only
            in a law that treats equals alike.
        restitution: of all contacts, in [0, 1].

    Source: Smith 2012, released scenes; Zhang 2015, Fig. 7.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_choice("start", start, ("top", "inward", "outward"))
    check_number("restitution", restitution, low=0.0, high=1.0)
    outward = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
    if start == "outward":
        centers = (DRUM_RADIUS - 1.0) * outward
        contacts = fixed_contacts(np.arange(4), -outward)
        velocity = outward
    else:
        centers = np.sqrt(2.0) * outward
        half = np.sqrt(0.5)
        # From one ball to the next around the ring; exact mirror images of one another.
        normals = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        contacts = Contacts(np.arange(4), np.roll(np.arange(4), -1), normals)
        velocity = -outward if start == "inward" else np.where(np.arange(4)[:, None] == 0, -outward, 0.0)
    problem = ImpactProblem(np.ones(8), normal_rows(contacts, 4), velocity.ravel(), restitution)
    return Scenario(
        "four-ball-circle",
        given(four_ball_circle, locals()),
        problem,
        "Smith 2012, released scenes; Zhang 2015, Fig. 7",
        reference_builders=_circle_references(problem, start),
        symmetries=tuple(map_of_bodies(name, turn, outward) for name, turn in SQUARE_GROUP.items()),
        invariants=_circle_momenta(centers, start),
        tags=frozenset({"billiards", "circle"}),
        dofs_per_body=2,
        positions=centers,
    )


SQUARE_GROUP = {
    "quarter turn": QUARTER_TURN,
    "half turn": HALF_TURN,
    "three-quarter turn": THREE_QUARTER_TURN,
    "mirror x": MIRROR_X,
    "mirror y": MIRROR_Y,
    "diagonal mirror": DIAGONAL,
    "antidiagonal mirror": ANTIDIAGONAL,
}


def _triangle_rows(balls: int | None) -> list[int]:
    """Lengths of the rows of a triangle."""
    if balls is None:
        return list(range(1, 6))
    check_count("balls", balls, 3)
    rows = int(np.sqrt(2 * balls))
    if rows * (rows + 1) // 2 != balls:
        raise ProblemError(f"balls must fill a triangle (3, 6, 10, 15, 21, …), not {balls}")
    return list(range(1, rows + 1))


def _diamond_rows(balls: int | None) -> list[int]:
    """Lengths of the rows of the nine-ball diamond."""
    if balls is not None and balls != 9:
        raise ProblemError(f"balls must be 9 (or None) in a nine-ball rack, not {balls}")
    return [1, 2, 3, 2, 1]


def _rack(rows: list[int], struck: str) -> tuple[Lattice, Floats]:
    """Lattice coordinates and velocities of the cue ball, the rack and, where struck is "both", the second cue ball."""
    lattice = [(0, -1, 0)] + [(a, 0, 2 * k - length + 1) for a, length in enumerate(rows) for k in range(length)]
    if struck == "both":
        # Behind an odd last row the cue ball meets its middle ball, behind an even one it is a row of its own.
        lattice.append((len(rows) - 1, 1, 0) if rows[-1] % 2 else (len(rows), 0, 0))
    velocity = np.zeros((len(lattice), 2))
    velocity[0] = (1.0, 0.0)
    if struck == "both":
        velocity[-1] = (-1.0, 0.0)
    return np.array(lattice), velocity


def _lattice_contacts(lattice: Lattice) -> Contacts:
    """Contacts of all discs that touch: one diameter along a row, into the next row, or along the axis."""
    offset = lattice[None, :, :] - lattice[:, None, :]
    touching = np.zeros(offset.shape[:2], dtype=bool)
    for step in ((0, 0, 2), (1, 0, 1), (0, 1, 0)):
        touching |= (np.abs(offset) == step).all(axis=2)
    first, second = np.nonzero(np.triu(touching))
    return Contacts(first, second, offset[first, second] @ LATTICE)


def _table(lattice: Lattice, mass: Floats, velocity: Floats, restitution: float, friction: float) -> ImpactProblem:
    """The impact problem of discs that stand on the lattice; with friction, of balls that spin."""
    check_number("restitution", restitution, low=0.0, high=1.0)
    check_number("friction", friction, low=0.0)
    contacts = _lattice_contacts(lattice)
    bodies = len(lattice)
    if friction == 0:
        return ImpactProblem(1.0 / np.repeat(mass, 2), normal_rows(contacts, bodies), velocity.ravel(), restitution)
    return ImpactProblem(
        sphere_inverse_mass(mass, RADIUS),
        normal_rows_with_spin(contacts, bodies),
        velocities_with_spin(velocity),
        restitution,
        friction,
        tangent_rows(contacts, bodies, RADIUS),
    )


def _table_symmetry(name: str, turn: npt.ArrayLike, lattice: Lattice, friction: float) -> Symmetry:
    positions = lattice @ LATTICE
    return map_of_bodies_with_spin(name, turn, positions) if friction else map_of_bodies(name, turn, positions)


def _table_momenta(lattice: Lattice, friction: float) -> tuple[Invariant, ...]:
    """Momenta of a free group of discs, or of spinning balls."""
    positions = lattice @ LATTICE
    bodies = len(lattice)
    if friction:
        return (*linear_momenta(bodies, 6, "xyz"), *angular_momenta_with_spin(positions))
    return (*linear_momenta(bodies, 2, "xy"), plane_angular_momentum(positions))


def _vector_length(friction: float) -> int:
    """Length of the vectors in v: in the plane, or in space where balls spin."""
    return 3 if friction else 2


def _tags(kind: str, friction: float) -> frozenset[str]:
    return frozenset({"billiards", kind, "friction"} if friction else {"billiards", kind})


def _circle_references(problem: ImpactProblem, start: str) -> tuple[Callable[[], Reference], ...]:
    found: list[Callable[[], Reference]] = []
    if start == "outward":
        return (partial(separate_contacts, problem),)
    if start == "inward":
        found.append(partial(reversed_velocity, problem, "four-fold symmetry: every contact rebounds alike"))
    if (problem.restitution == 1.0).all():
        found.append(partial(hertz, problem))
    return tuple(found)


def _circle_momenta(centers: Floats, start: str) -> tuple[Invariant, ...]:
    """A free ring keeps its momenta; at the drum every ball keeps its own along the drum."""
    if start != "outward":
        return (*linear_momenta(4, 2, "xy"), plane_angular_momentum(centers))
    along = np.column_stack([-centers[:, 1], centers[:, 0]]) / np.linalg.norm(centers, axis=1)[:, None]
    found = []
    for ball in range(4):
        direction = np.zeros((4, 2))
        direction[ball] = along[ball]
        found.append(Invariant(f"momentum of ball {ball} along the drum", direction.ravel()))
    return tuple(found)

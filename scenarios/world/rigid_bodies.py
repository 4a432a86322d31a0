"""Rigid bodies: how a scene names them, and the arrays that move.

    v    velocity of the center of mass, along the axes of the world [m/s]
    ω    spin, along the principal axes of the body [rad/s]

Along its principal axes a body's inverse inertia is three numbers that never change, so that the inverse mass of a
scene is a diagonal: (1/m, 1/m, 1/m, 1/I₁, 1/I₂, 1/I₃) for each body. A body that is held has zeros there, one on a
hinge is left with the entry of the axis that it turns about.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.world.obstacle import Obstacle
from scenarios.world.rotation import IDENTITY, inverse, multiply, rotation_matrix
from scenarios.world.shapes import Shape, given_pose, unit_quaternion
from solvers import ProblemError
from solvers.solution import Floats

Flags = npt.NDArray[np.bool_]

FREEDOMS = 6
"""Velocities of a body: three of its center, three of its spin."""
# Cosine from which on an axis is taken for a principal one: rounding of a rotated shape.
ALONG = 1.0 - 1e-9


@dataclass(frozen=True, eq=False)
class RigidBody:
    """One body of a scene, as it starts."""

    name: str
    shape: Shape
    position: npt.ArrayLike = (0.0, 0.0, 0.0)
    """Of the origin of the frame in which the shape was given [m], shape (3,)."""
    orientation: npt.ArrayLike = IDENTITY
    """Of that frame: a quaternion (w, x, y, z), shape (4,)."""
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0)
    """Of the center of mass [m/s], shape (3,)."""
    spin: npt.ArrayLike = (0.0, 0.0, 0.0)
    """Along the axes of the world [rad/s], shape (3,)."""
    density: float = 1.0
    """[kg/m³], > 0."""
    mass: float | None = None
    """[kg], > 0; from volume and density if None."""
    friction: float = 0.5
    """μ ≥ 0. A contact has √(μ_a μ_b), the geometric mean of its bodies: a slippery body slips on everything."""
    restitution: float = 0.0
    """c_r in [0, 1]. A contact has √(c_a c_b): what falls on a body without restitution does not bounce."""
    fixed: bool = False
    """Never moves."""
    held: bool = False
    """Does not move until it is released."""
    hinge: tuple[float, float, float] | None = None
    """Axis through the center of mass about which alone it turns, in the frame in which the shape was given."""

    def place(self) -> tuple[Floats, Floats]:
        """Center of mass [m], shape (3,), and quaternion of the principal axes, shape (4,).

        Raises:
            ProblemError: names the body and the rule.
        """
        try:
            where, turn = given_pose("position", self.position), unit_quaternion(self.orientation)
        except ProblemError as error:
            raise ProblemError(f"body {self.name}: {error}") from None
        return where + rotation_matrix(turn) @ self.shape.center, multiply(turn, self.shape.axes)


@dataclass
class RigidBodies:
    """All bodies of a scene as arrays: movable ones first, in the order in which they were named, then fixed ones.

    Obstacles are counted as fixed bodies, after the others.
    """

    names: tuple[str, ...]
    """Of all bodies and obstacles."""
    shapes: tuple[Shape, ...]
    """Of the bodies."""
    position: Floats
    """Centers of mass [m], shape (bodies, 3); obstacles are not among them."""
    orientation: Floats
    """Quaternions of the principal axes, shape (bodies, 4)."""
    velocity: Floats
    """(v, ω) of the movable bodies [m/s, rad/s], shape (b, 6), spin along principal axes."""
    mass: Floats
    """[kg, kg m²] of (v, ω), shape (b, 6)."""
    inverse_mass: Floats
    """[1/kg, 1/(kg m²)] of (v, ω) of a body that is free, shape (b, 6); on a hinge one entry is left."""
    held: Flags
    """Which movable bodies do not move yet, shape (b,)."""
    friction: Floats
    """μ of all bodies and obstacles."""
    restitution: Floats
    """c_r of all bodies and obstacles."""

    @property
    def movable(self) -> int:
        """How many bodies can move: b."""
        return len(self.velocity)

    @property
    def count(self) -> int:
        """How many bodies there are, obstacles not counted."""
        return len(self.shapes)

    def freedom(self) -> Floats:
        """Inverse mass of what moves now: zeros for what is held; shape (b, 6)."""
        return np.where(self.held[:, None], 0.0, self.inverse_mass)

    def index(self, name: str) -> int:
        """Number of a body or obstacle.

        Raises:
            ProblemError: there is none of that name.
        """
        try:
            return self.names.index(name)
        except ValueError:
            raise ProblemError(f"there is no body named {name}") from None


def assemble(bodies: Sequence[RigidBody], obstacles: Sequence[Obstacle] = ()) -> RigidBodies:
    """Check the bodies of a scene and make arrays of them.

    Raises:
        ProblemError: names the body and the rule.
    """
    ordered = [body for body in bodies if not body.fixed] + [body for body in bodies if body.fixed]
    names = tuple([body.name for body in ordered] + [obstacle.name for obstacle in obstacles])
    for name in names:
        if names.count(name) > 1:
            raise ProblemError(f"body {name}: names must differ")
    for body in ordered:
        _check(body)
    moving = [body for body in ordered if not body.fixed]
    if not moving:
        raise ProblemError("bodies must have at least one that is not fixed")
    places = [body.place() for body in ordered]
    masses = np.array([_mass(body) for body in moving])
    surfaces: list[RigidBody | Obstacle] = [*ordered, *obstacles]
    for surface in surfaces:
        _check_surface(surface)
    return RigidBodies(
        names,
        tuple(body.shape for body in ordered),
        np.array([position for position, _ in places]),
        np.array([orientation for _, orientation in places]),
        np.array([_velocity(body, places[k][1]) for k, body in enumerate(moving)]),
        masses,
        np.array([_inverse_mass(body, mass) for body, mass in zip(moving, masses, strict=True)]),
        np.array([body.held for body in moving]),
        np.array([surface.friction for surface in surfaces]),
        np.array([surface.restitution for surface in surfaces]),
    )


def _check(body: RigidBody) -> None:
    """Check what only a body has."""
    if body.shape.is_half_space and not body.fixed:
        raise ProblemError(f"body {body.name}: a half space must be fixed, it has no mass")
    if body.fixed and (body.held or body.hinge is not None or np.any(body.velocity) or np.any(body.spin)):
        raise ProblemError(f"body {body.name}: a fixed body is not held, has no hinge and no velocity")
    if body.held and (np.any(body.velocity) or np.any(body.spin)):
        raise ProblemError(f"body {body.name}: a body that is held has no velocity")
    if body.hinge is not None and np.any(body.velocity):
        raise ProblemError(f"body {body.name}: a body on a hinge has no velocity, only spin")


def _check_surface(surface: RigidBody | Obstacle) -> None:
    if not (np.isfinite(surface.friction) and surface.friction >= 0.0):
        raise ProblemError(f"body {surface.name}: friction must be finite and ≥ 0, not {surface.friction:g}")
    if not 0.0 <= surface.restitution <= 1.0:
        raise ProblemError(f"body {surface.name}: restitution must lie in [0, 1], not {surface.restitution:g}")


def _mass(body: RigidBody) -> Floats:
    """Mass and principal moments of (v, ω), shape (6,)."""
    if not (np.isfinite(body.density) and body.density > 0.0):
        raise ProblemError(f"body {body.name}: density must be finite and > 0, not {body.density:g}")
    mass = body.shape.volume * body.density if body.mass is None else body.mass
    if not (np.isfinite(mass) and mass > 0.0):
        raise ProblemError(f"body {body.name}: mass must be finite and > 0, not {mass:g}")
    return np.concatenate([np.full(3, mass), body.shape.inertia * (mass / body.shape.volume)])


def _inverse_mass(body: RigidBody, mass: Floats) -> Floats:
    """Inverse of what may move, shape (6,)."""
    if body.hinge is None:
        return 1.0 / mass
    axis = rotation_matrix(inverse(body.shape.axes)) @ given_pose("hinge", body.hinge)
    length = float(np.linalg.norm(axis))
    principal = int(np.abs(axis).argmax())
    if length == 0.0 or abs(axis[principal]) < ALONG * length:
        raise ProblemError(f"body {body.name}: hinge must be a principal axis of the shape")
    free = np.zeros(FREEDOMS)
    free[3 + principal] = 1.0 / mass[3 + principal]
    return free


def _velocity(body: RigidBody, orientation: Floats) -> Floats:
    """(v, ω) with the spin along principal axes, shape (6,)."""
    try:
        velocity, spin = given_pose("velocity", body.velocity), given_pose("spin", body.spin)
    except ProblemError as error:
        raise ProblemError(f"body {body.name}: {error}") from None
    own = rotation_matrix(orientation).T @ spin
    if body.hinge is not None:
        about = np.where(_inverse_mass(body, _mass(body))[3:] > 0.0, own, 0.0)
        if np.linalg.norm(about) < ALONG * np.linalg.norm(own):
            raise ProblemError(f"body {body.name}: spin must be about the hinge")
        own = about
    return np.concatenate([velocity, own])

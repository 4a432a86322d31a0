"""Small scenes of rigid bodies that several tests are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenarios.world.impact import ByProblem
from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.rigid_world import RigidSettings, RigidWorld
from scenarios.world.rotation import about, rotation_matrix
from scenarios.world.shapes import Shape, box, half_space
from scenarios.world.stepping import StepReport
from solvers import Solver
from solvers.newton_lcp import NewtonLcp
from solvers.qce_lcp import QceLcp
from solvers.solution import Floats

GRAVITY = 9.81
# Residual at which a step's impact is solved, relative to its fastest approach.
TOLERANCE = 1e-9
SOLVERS_WITH_FRICTION: dict[str, Solver] = {
    "qce-lcp": QceLcp(tolerance=TOLERANCE),
    "lcp-pgs": NewtonLcp(tolerance=TOLERANCE),
}
CUBE = box((0.5, 0.5, 0.5))


def world(bodies: Sequence[RigidBody], solver: Solver | None = None, **settings: float) -> RigidWorld:
    return RigidWorld(
        "test", bodies, RigidSettings(**{"gravity": GRAVITY, **settings}),
        ByProblem(solver or SOLVERS_WITH_FRICTION["qce-lcp"]),
    )  # fmt: skip


def run(moving: RigidWorld, seconds: float) -> list[StepReport]:
    return [moving.step() for _ in range(round(seconds / moving.settings.step))]


def floor(friction: float = 0.5, restitution: float = 0.0, angle: float = 0.0) -> RigidBody:
    """The ground, tilted about y by an angle [rad]: it falls toward +x."""
    return RigidBody(
        "floor", half_space(), orientation=about((0.0, 1.0, 0.0), angle), friction=friction, restitution=restitution,
        fixed=True,
    )  # fmt: skip


def lying(
    name: str, shape: Shape, height: float, angle: float = 0.0, *, friction: float = 0.5, restitution: float = 0.0,
    speed: float = 0.0,
) -> RigidBody:  # fmt: skip
    """A body that lies on the tilted floor, its center `height` [m] over it, with a speed downhill [m/s]."""
    turn = about((0.0, 1.0, 0.0), angle)
    return RigidBody(
        name, shape, height * rotation_matrix(turn)[:, 2], turn, speed * downhill(angle), friction=friction,
        restitution=restitution,
    )  # fmt: skip


def downhill(angle: float) -> Floats:
    """Unit vector down the tilted floor."""
    return np.array([np.cos(angle), 0.0, -np.sin(angle)])

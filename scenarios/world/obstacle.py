"""Fixed surfaces that balls roll on, in closed form: no facets, so that nothing but physics slows a ball."""

from __future__ import annotations

from typing import Protocol

import numpy.typing as npt

from scenarios.world.shapes import Faces
from scenarios.world.spheres import Ints
from solvers.solution import Floats

ObstacleContacts = tuple[Ints, Floats, Floats, Floats]
"""Ball, point [m], unit normal from the obstacle to the ball, gap [m] of each contact; shapes (m,), (m, 3), …, (m,)."""


class Obstacle(Protocol):
    """A smooth fixed surface; bodies of another shape than one ball do not see it."""

    @property
    def name(self) -> str:
        """For errors, and to ask what touches it."""
        ...

    @property
    def friction(self) -> float:
        """Coefficient of friction, ≥ 0; see `RigidBody.friction`."""
        ...

    @property
    def restitution(self) -> float:
        """Coefficient of restitution, in [0, 1]; see `RigidBody.restitution`."""
        ...

    def contacts(self, centers: Floats, radii: Floats, reach: float) -> ObstacleContacts:
        """All contacts whose gap is at most `reach` [m]; several a ball where it touches both flanks of a groove.

        Args:
            centers: of the balls [m], shape (k, 3).
            radii: [m], shape (k,).
            reach: largest gap [m].
        """
        ...

    def mesh(self) -> tuple[npt.ArrayLike, Faces]:
        """Vertices [m], shape (v, 3), and triangles, shape (f, 3), for pictures."""
        ...

"""Solid spheres as arrays: where they are, how they move, how they turn.

    s = r ω       the spin as a surface speed [m/s]

With s instead of ω a sphere's radius drops out of every friction row: the surfaces of two touching spheres slide with
t · (v_b - v_a - (s_a + s_b) × n), and an impulse P along t changes s of both by -5/2 P (n × t) / m (inertia 2/5 m r²).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers import ProblemError
from solvers.buffers import on_lines
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]

INVERSE_INERTIA = 2.5
"""m r² over the moment of inertia of a solid sphere; an impulse at the surface changes s so much more than v."""

PARTS = 16
"""Parts of a loop over the spheres: enough for the threads of a desktop machine. A sum is one of sums of parts, so that
it is the same on any number of threads."""


@dataclass
class Spheres:
    """The movable bodies of a scene; the arrays change from step to step."""

    place: Floats
    """Center [m] and radius [m], shape (bodies, 4)."""

    motion: Floats
    """Velocity v [m/s], inverse mass [1/kg], spin s = r ω [m/s] and a zero; shape (bodies + 1, 8).

    The last row stands for everything immovable: it stays zero.
    """

    label: Ints
    """Number that each sphere had at the start, shape (bodies,): large scenes are renumbered as they move."""

    @property
    def position(self) -> Floats:
        """Centers [m], shape (bodies, 3), a view."""
        return self.place[:, :3]

    @property
    def radius(self) -> Floats:
        """Radii [m], shape (bodies,), a view."""
        return self.place[:, 3]

    @property
    def velocity(self) -> Floats:
        """Velocities of the centers [m/s], shape (bodies, 3), a view."""
        return self.motion[:-1, :3]

    @property
    def inverse_mass(self) -> Floats:
        """Inverse masses [1/kg], shape (bodies,), a view."""
        return self.motion[:-1, 3]

    @property
    def spin(self) -> Floats:
        """Spins s = r ω [m/s], shape (bodies, 3), a view."""
        return self.motion[:-1, 4:7]

    @property
    def count(self) -> int:
        """Number of spheres."""
        return int(self.label.size)

    def kinetic_energy(self) -> float:
        """Of motion and spin [J]."""
        square = (self.velocity**2).sum(axis=1) + (self.spin**2).sum(axis=1) / INVERSE_INERTIA
        return float(0.5 * (square / self.inverse_mass).sum())

    def by_label(self, per_sphere: Floats) -> Floats:
        """Put an array over the spheres, shape (bodies, …), in the order of the start."""
        ordered = np.empty_like(per_sphere)
        ordered[self.label] = per_sphere
        return ordered

    def renumber(self, order: Ints) -> None:
        """Let the sphere that was number `order[k]` be number k; shape (bodies,)."""
        self.place[:] = self.place[order]
        self.motion[:-1] = self.motion[order]
        self.label = self.label[order]


def spheres(
    position: npt.ArrayLike, radius: npt.ArrayLike, mass: npt.ArrayLike, velocity: npt.ArrayLike | None = None
) -> Spheres:
    """Make spheres without spin.

    Args:
        position: centers [m], shape (bodies, 3).
        radius: > 0 [m], a number or shape (bodies,).
        mass: > 0 [kg], a number or shape (bodies,).
        velocity: [m/s], shape (bodies, 3); at rest if None.

    Raises:
        ProblemError: names the field and the rule.
    """
    centers = np.array(position, dtype=np.float64)
    if centers.ndim != 2 or centers.shape[1] != 3 or not len(centers):
        raise ProblemError(f"position must have shape (bodies, 3) with at least one body, not {centers.shape}")
    place, motion = on_lines((len(centers), 4)), on_lines((len(centers) + 1, 8))
    motion[:] = 0.0
    place[:, :3] = _finite("position", centers)
    place[:, 3] = _positive("radius", radius, len(centers))
    motion[:-1, 3] = 1.0 / _positive("mass", mass, len(centers))
    if velocity is not None:
        motion[:-1, :3] = _finite("velocity", np.broadcast_to(np.asarray(velocity, dtype=np.float64), centers.shape))
    return Spheres(place, motion, np.arange(len(centers), dtype=np.int32))


def _finite(field: str, array: Floats) -> Floats:
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise ProblemError(f"{field} must be finite: sphere {bad[0]} has {array[bad[0]]}")
    return array


def _positive(field: str, value: npt.ArrayLike, count: int) -> Floats:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (count,)):
        raise ProblemError(f"{field} must be a number or have shape ({count},), not {array.shape}")
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise ProblemError(f"{field} must be finite and > 0")
    return array

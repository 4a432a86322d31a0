"""What does not give way: planes and drums, all of one piece, and how that piece is shaken.

A scene is computed in the frame of its container: the walls stand still there, and shaking is a change of all
velocities by -(Δ of the container's velocity). A step's impact is then one with immovable walls at rest, whose kinetic
energy no law may raise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from solvers.solution import Floats


class Motion(Protocol):
    """Vertical motion of a container."""

    @property
    def period(self) -> float:
        """Time after which it repeats [s]; inf where it does not."""
        ...

    def height(self, time: float) -> float:
        """Height over its place at rest [m]."""
        ...

    def speed(self, time: float) -> float:
        """Vertical velocity [m/s]."""
        ...


@dataclass(frozen=True)
class Still:
    """No motion."""

    @property
    def period(self) -> float:
        """It does not repeat."""
        return np.inf

    def height(self, time: float) -> float:
        """Height over its place at rest [m]."""
        return 0.0

    def speed(self, time: float) -> float:
        """Vertical velocity [m/s]."""
        return 0.0


@dataclass(frozen=True)
class Vibration:
    """z = A sin 2πft, for ever."""

    amplitude: float
    """A [m]."""
    frequency: float
    """f [1/s]."""

    @property
    def period(self) -> float:
        """1 / f [s]."""
        return 1.0 / self.frequency

    def height(self, time: float) -> float:
        """Height over its place at rest [m]."""
        return float(self.amplitude * np.sin(2.0 * np.pi * self.frequency * time))

    def speed(self, time: float) -> float:
        """Vertical velocity [m/s]."""
        turn = 2.0 * np.pi * self.frequency
        return float(self.amplitude * turn * np.cos(turn * time))


@dataclass(frozen=True)
class Shake:
    """One smooth shake, up and down again: z = A (1 - cos 2π(t - t₀)/T) / 2 for t₀ ≤ t ≤ t₀ + T."""

    amplitude: float
    """A [m]."""
    duration: float
    """T [s]."""
    start: float
    """t₀ [s]."""

    @property
    def period(self) -> float:
        """It does not repeat."""
        return np.inf

    def height(self, time: float) -> float:
        """Height over its place at rest [m]."""
        return float(0.5 * self.amplitude * (1.0 - np.cos(self._phase(time))))

    def speed(self, time: float) -> float:
        """Vertical velocity [m/s]."""
        return float(np.pi * self.amplitude / self.duration * np.sin(self._phase(time)))

    def _phase(self, time: float) -> float:
        share = min(max((time - self.start) / self.duration, 0.0), 1.0)
        # A whole turn is none: sin 2π is a rounding error beside 0.
        return 2.0 * np.pi * share if share < 1.0 else 0.0


@dataclass(frozen=True)
class Container:
    """Walls of one piece around the spheres."""

    planes: Floats = field(default_factory=lambda: np.zeros((0, 4)))
    """Inner unit normal n and offset d of each plane: spheres stay where n · x ≥ d + r; shape (planes, 4)."""

    drums: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """Axis (x, y) and radius [m] of upright cylinders, seen from inside; shape (drums, 3)."""

    motion: Motion = field(default_factory=Still)


def box(width: float, depth: float, motion: Motion) -> Container:
    """A floor at z = 0 and four walls at x = 0, x = width, y = 0 and y = depth [m], without a lid."""
    planes = [[0, 0, 1, 0], [1, 0, 0, 0], [-1, 0, 0, -width], [0, 1, 0, 0], [0, -1, 0, -depth]]
    return Container(planes=np.array(planes, dtype=np.float64), motion=motion)


def drum(radius: float) -> Container:
    """An upright cylinder about the z axis [m], endless and without floor."""
    return Container(drums=np.array([[0.0, 0.0, radius]]))

"""Layers of soft spheres on a vibrating plate: a reference for how a layer takes the plate's blow.

    loading      f = k δ
    unloading    f = k (δ - δ_max (1 - e²)) / e²     two stiffnesses: a collision of two loses all but e²

e is that of the normal velocity at which the two have touched, friction a damper that ends slip long before the contact
ends, bounded by μ f. All is computed in the plate's frame, by semi-implicit Euler. As k grows the contacts become
collisions of two, which is what Bizon 1998 computed. Nothing here is shared with the solvers.

Sources: Walton & Braun 1986 (two stiffnesses); Bizon 1998 (e, μ, the plate).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scenarios.granular import extended_pattern, vibration
from solvers._jit import kernel

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# Semi-implicit Euler is of first order: with so many steps the two closed forms of `test_landing.py` hold to 5e-3.
STEPS_A_CONTACT = 25
# The damper ends a slip in this share of a contact, two steps: shorter, it would turn the slip round at every step.
SLIP = 1.0 / 15.0
# Pairs nearer than this between their surfaces are listed [D].
SKIN = 0.25
# The plate, and two sides along each horizontal axis.
WALLS = 5
# m r² / I of a solid sphere. An impulse P along its surface changes the velocity by P/m, and spin times radius by
# TURN P/m; the surface moves with both.
TURN = 2.5


@dataclass
class SoftLayer:
    """The layer of `extended-pattern` from the same start, with soft contacts."""

    pattern: str
    side: int
    stiffness: float
    """k [m g / D]."""
    restitution: float | None = None
    """e; None: max(1 - 0.3 v^(3/4), 0.7)."""
    friction: float = 0.5
    """Coefficient of all contacts."""
    seed: int = 0
    """Of the start."""
    time: float = 0.0
    """[√(D/g)]."""
    place: Floats = field(init=False)
    """Centers [D], shape (grains, 3)."""
    velocity: Floats = field(init=False)
    """[√(gD)], in the plate's frame, shape (grains, 3)."""
    spin: Floats = field(init=False)
    """ω times the radius [√(gD)], shape (grains, 3)."""
    mass: Floats = field(init=False)
    """In mean masses, shape (grains,)."""
    radius: Floats = field(init=False)
    """[D], shape (grains,)."""

    def __post_init__(self) -> None:
        start = (
            extended_pattern(pattern=self.pattern, side=self.side).world(solver="qce-lcp-fast", seed=self.seed).spheres
        )
        self.place, self.velocity, self.radius = start.position.copy(), start.velocity.copy(), start.radius.copy()
        self.spin, self.mass = np.zeros_like(self.place), 1.0 / start.motion[:-1, 3]
        self.duration = np.pi * np.sqrt(0.5 / self.stiffness)
        """Of a contact of two grains of mass 1 while it is loaded and unloaded alike."""
        self._walls = np.zeros((len(self.place), WALLS, 2))
        self._pairs, self._past = np.zeros((0, 2), np.int64), np.zeros((0, 2))
        self.renew()

    def go(self, until: float) -> None:
        """Go on to a time [√(D/g)]."""
        plate = vibration(self.pattern)
        steps = int(np.ceil((until - self.time) / (self.duration / STEPS_A_CONTACT)))
        step = (until - self.time) / steps
        made = 0
        while made < steps:
            made += _go(
                self.place, self.velocity, self.spin, self.radius, self.mass, self._pairs, self._past, self._walls,
                self._listed, float(self.side), self.time + made * step, step, steps - made, plate.amplitude,
                2.0 * np.pi * plate.frequency, self.stiffness, -1.0 if self.restitution is None else self.restitution,
                self.friction, SLIP * self.duration,
            )  # fmt: skip
            if made < steps:
                self.renew()
        self.time = until

    def renew(self) -> None:
        """List the pairs that are near; what they have been through goes with them."""
        reach = 2.0 * float(self.radius.max()) + SKIN
        pairs = cKDTree(self.place).query_pairs(reach, output_type="ndarray").astype(np.int64)
        count = len(self.place)
        pairs = pairs[np.argsort(pairs @ [count, 1])]
        old, new = (these @ [count, 1] for these in (self._pairs, pairs))
        past = np.zeros((len(pairs), 2))
        both, from_old, to_new = np.intersect1d(old, new, assume_unique=True, return_indices=True)
        past[to_new] = self._past[from_old]
        assert np.isin(old[self._past[:, 1] > 0.0], both).all(), "a pair that touches was not listed again"
        self._pairs, self._past, self._listed = pairs, past, self.place.copy()


def fluctuation(velocity: Floats, mass: Floats) -> float:
    """Kinetic energy about the layer's mean vertical motion, over the mass [g D]."""
    mean = np.average(velocity[:, 2], weights=mass)
    relative = velocity - [0.0, 0.0, mean]
    return float(0.5 * np.average((relative**2).sum(axis=1), weights=mass))


@kernel
def _press(overlap: float, speed: float, past: Floats, stiffness: float, restitution: float) -> float:
    """Normal force of one contact, whose deepest overlap and stiffness of unloading are `past`."""
    if past[1] == 0.0:
        v = max(-speed, 0.0)
        e = restitution if restitution >= 0.0 else max(1.0 - 0.3 * v**0.75, 0.7)
        past[0] = 0.0
        past[1] = stiffness / (e * e)
    past[0] = max(past[0], overlap)
    return float(max(min(stiffness * overlap, past[1] * overlap - past[0] * (past[1] - stiffness)), 0.0))


@kernel
def _go(
    place: Floats, velocity: Floats, spin: Floats, radius: Floats, mass: Floats, pairs: Ints, past: Floats,
    walls: Floats, listed: Floats, side: float, begin: float, step: float, steps: int, amplitude: float, turn: float,
    stiffness: float, restitution: float, friction: float, slip: float,
) -> int:  # fmt: skip
    """Make steps until pairs that are not listed could touch; returns how many."""
    count = place.shape[0]
    force = np.empty((count, 3))
    torque = np.empty((count, 3))
    n = np.empty(3)
    v = np.empty(3)
    s = np.empty(3)
    t = np.empty(3)
    for made in range(steps):
        drift = 0.0
        for b in range(count):
            drift += (place[b, 2] - listed[b, 2]) / count
        for b in range(count):
            gone = (
                (place[b, 0] - listed[b, 0]) ** 2
                + (place[b, 1] - listed[b, 1]) ** 2
                + (place[b, 2] - listed[b, 2] - drift) ** 2
            )
            if gone > (0.45 * SKIN) ** 2:
                return made
        force[:] = 0.0
        torque[:] = 0.0
        for k in range(pairs.shape[0] + count * WALLS):
            pair = k < pairs.shape[0]
            if pair:
                a = pairs[k, 0]
                b = pairs[k, 1]
                distance = 0.0
                for axis in range(3):
                    n[axis] = place[b, axis] - place[a, axis]
                    distance += n[axis] ** 2
                distance = np.sqrt(distance)
                overlap = radius[a] + radius[b] - distance
                state = past[k]
            else:
                b = (k - pairs.shape[0]) // WALLS
                wall = (k - pairs.shape[0]) % WALLS
                a = b
                axis = 2 if wall == 0 else (wall - 1) // 2
                far = wall in (2, 4)
                n[:] = 0.0
                n[axis] = -1.0 if far else 1.0
                distance = 1.0
                overlap = radius[b] - (side - place[b, axis] if far else place[b, axis])
                state = walls[b, wall]
            if overlap <= 0.0:
                state[1] = 0.0
                continue
            normal_speed = 0.0
            for axis in range(3):
                n[axis] /= distance
                v[axis] = velocity[b, axis] - (velocity[a, axis] if pair else 0.0)
                s[axis] = spin[b, axis] + (spin[a, axis] if pair else 0.0)
                normal_speed += v[axis] * n[axis]
            press = _press(overlap, normal_speed, state, stiffness, restitution)
            # Slip of b's surface past a's: v_b - v_a - (s_a + s_b) × n, without its normal part.
            slipping = 0.0
            for axis in range(3):
                cross = s[(axis + 1) % 3] * n[(axis + 2) % 3] - s[(axis + 2) % 3] * n[(axis + 1) % 3]
                t[axis] = v[axis] - normal_speed * n[axis] - cross
                slipping += t[axis] ** 2
            slipping = np.sqrt(slipping)
            # An impulse along the surfaces ends 1 + TURN times the inverse masses of slip.
            resisting = 1.0 / ((1.0 + TURN) * (1.0 / mass[b] + (1.0 / mass[a] if pair else 0.0)))
            rub = min(friction * press, resisting / slip * slipping)
            for axis in range(3):
                t[axis] *= -rub / slipping if slipping > 0.0 else 0.0
            for axis in range(3):
                total = press * n[axis] + t[axis]
                # On both spheres the friction acts at the same side of the normal: (-n) × t = (n) × (-t).
                twist = t[(axis + 1) % 3] * n[(axis + 2) % 3] - t[(axis + 2) % 3] * n[(axis + 1) % 3]
                force[b, axis] += total
                torque[b, axis] += twist
                if pair:
                    force[a, axis] -= total
                    torque[a, axis] += twist
        # The plate is at A sin ωt: in its frame all fall by this much more.
        fall = 1.0 - amplitude * turn**2 * np.sin(turn * (begin + (made + 0.5) * step))
        for b in range(count):
            for axis in range(3):
                velocity[b, axis] += step * (force[b, axis] / mass[b] - (fall if axis == 2 else 0.0))
                spin[b, axis] += step * TURN * torque[b, axis] / mass[b]
                place[b, axis] += step * velocity[b, axis]
    return steps

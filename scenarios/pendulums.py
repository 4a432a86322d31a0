"""Newton's cradle in motion: balls on strings that never slacken, one angle a ball.

    x = p + L (sin θ, 0, -cos θ),   L θ'' = -g sin θ,   velocity coordinate v = L θ'
    contact of neighbors: u = n · (t_b v_b - t_a v_a),   t = (cos θ, 0, sin θ)

The strings (a pair for each ball, so that it swings in one plane) are no constraints but coordinates: they hold and
need no solver. Between impacts the swing is exact too: sin(θ/2) = k sn(ω t + F(φ, k²), k²) with Jacobi's sn. All energy
that is lost or gained is the law's.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy.sparse as sp
from scipy.optimize import brentq
from scipy.special import ellipj, ellipk, ellipkinc

from scenarios.parameters import check_count, check_number, check_positive
from scenarios.world.checkpoint import Arrays
from scenarios.world.container import Container
from scenarios.world.events import LEFT_OVER, EventWorld
from scenarios.world.impact import Resolver
from scenarios.world.moving_scene import MovingScene, MovingWorld
from scenarios.world.spheres import Spheres, spheres
from solvers import ImpactProblem, ProblemError, UnsupportedProblem
from solvers.solution import Floats

RADIUS = 0.5
# Balls that hang side by side touch: below this gap [m] they belong to one impact.
TOUCHING = 1e-9
# A gap may close so far [m] before the impact is solved: above the rounding of a position, far below TOUCHING.
DEPTH = 1e-12
# The flight is searched for impacts at so many times a period: a gap that closes and opens in between is not seen.
SAMPLES = 500
# Root of the closing gap, in seconds relative to a period.
ROOT = 1e-15

SWINGS = 20
"""Periods that a cradle is watched for."""
# Frames a period: the turning points are among them.
FRAMES = 40
# A law that lets all balls creep has an impact every few milliseconds: more than this many in 20 periods end the run.
MOST_IMPACTS = 20_000
OPENING = "opening over ideal"
"""Measure: gap of the contact that is open in the ideal exchange, over the ideal gap, while balls are up there."""
# Share of the raised angle from which on a ball is up.
OPEN = 0.5


def cradle_3d(
    *,
    balls: int = 5,
    raised: int = 1,
    angle: float = 0.5,
    length: float = 5.0,
    gravity: float = 9.81,
    restitution: float = 1.0,
) -> MovingScene:
    """Newton's cradle of pendulums; some balls on the left are raised together and let go.

    Args:
        balls: how many, ≥ 2.
        raised: how many of them, 1 ≤ raised < balls.
        angle: by which they are raised, in [0.01, 1.5] [rad].
        length: of the strings, to the centers of the balls, > 0 [m]; the balls have radius 0.5 and mass 1.
        gravity: > 0 [m/s²].
        restitution: of all contacts, in [0, 1].

    Source: chosen here; Zhang 2015 and Smith 2012 show the cradle without strings.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("balls", balls, 2)
    check_count("raised", raised, 1)
    if raised >= balls:
        raise ProblemError(f"raised must be less than balls ({balls}), not {raised}")
    check_number("angle", angle, low=0.01, high=1.5)
    check_positive("length", length)
    check_positive("gravity", gravity)
    check_number("restitution", restitution, low=0.0, high=1.0)
    period = _period(angle, length, gravity)
    return MovingScene(
        "cradle-3d",
        {
            "balls": balls,
            "raised": raised,
            "angle": angle,
            "length": length,
            "gravity": gravity,
            "restitution": restitution,
        },
        f"a cradle of {balls} pendulums, {raised} raised",
        "chosen here",
        partial(_hang, balls, raised, angle, length, gravity, restitution),
        default_solver="qce" if restitution == 1.0 else "qce-lcp",
        default_steps=MOST_IMPACTS,
        frame_time=period / FRAMES,
        duration=SWINGS * period,
        period=period,
        measure=partial(cradle_measures, raised, angle),
        judged={"BRK": OPENING} if restitution == 1.0 else {},
        color="speed [m/s]",
        trace="tx",
    )


def cradle_measures(raised: int, angle: float, world: MovingWorld) -> dict[str, float]:
    """A cradle beside the ideal exchange, in which the raised balls and as many at the other end swing in turn."""
    assert isinstance(world, EventWorld)
    flight = world.flight
    assert isinstance(flight, Pendulums)
    ideal = flight.ideal(raised, angle, world.time)
    # The contact that is open in the ideal: before the last balls that fly, or behind the first.
    open_contact = flight.angle.size - raised - 1 if ideal[-1] > 0.0 else raised - 1
    gap, wanted = flight.gaps(flight.angle)[open_contact], flight.gaps(ideal)[open_contact]
    far = np.abs(ideal).max() >= OPEN * angle
    return {
        "energy error": abs(sum(flight.energies()) / flight.energy_of(raised, angle) - 1.0),
        "distance to ideal": float(np.sqrt(np.mean((flight.angle - ideal) ** 2))) / angle,
        OPENING: float(gap / wanted) if far else np.nan,
        "balls that fly": float((np.abs(flight.angle) >= OPEN * angle).sum()) if far else np.nan,
    }


def _period(angle: float, length: float, gravity: float) -> float:
    """Of a pendulum that swings as far as an angle [s]."""
    return float(4.0 * np.sqrt(length / gravity) * ellipk(np.sin(angle / 2.0) ** 2))


def _hang(
    balls: int,
    raised: int,
    angle: float,
    length: float,
    gravity: float,
    restitution: float,
    identity: str,
    resolver: Resolver,
    seed: int,
) -> EventWorld:
    # Without the other balls, one half swing lasts half a period: the last ball goes up while the first hangs still.
    period = _period(angle, length, gravity)
    start = np.where(np.arange(balls) < raised, -angle, 0.0)
    flight = Pendulums(start, length=length, gravity=gravity, period=period)
    return EventWorld(identity, flight, resolver, restitution=restitution, period=period)


class Pendulums:
    """Equal balls that hang side by side and swing in one plane.

    Args:
        angle: of each at the start, at rest [rad], shape (balls,).
        length: of the strings [m].
        gravity: [m/s²].
        period: time in which the flight is searched for impacts at `SAMPLES` times [s].
    """

    def __init__(self, angle: Floats, *, length: float, gravity: float, period: float) -> None:
        self.angle = angle.copy()
        self.velocity = np.zeros_like(angle)
        self.length = length
        self.gravity = gravity
        self._sample = period / SAMPLES
        self._pivot = 2.0 * RADIUS * np.arange(angle.size)
        self._fastest = float(np.sqrt(2.0 * gravity * length * (1.0 - np.cos(angle).min())))

    @property
    def spheres(self) -> Spheres:
        """Where the balls are and how they move."""
        x, _, z = self._centers(self.angle)
        motion = self.velocity[:, None] * np.column_stack([np.cos(self.angle), 0.0 * z, np.sin(self.angle)])
        return spheres(np.column_stack([x, 0.0 * x, z]), RADIUS, 1.0, motion)

    @property
    def container(self) -> Container:
        """No walls."""
        return Container()

    def time_to_impact(self) -> float:
        """Time until two neighbors that approach one another touch [s]; a gap smaller than rounding is none."""
        before = 0.0
        # A ball that hangs is met within a period by one that swings.
        for k in range(1, 2 * SAMPLES + 1):
            now = k * self._sample
            gap, closing = self._gaps(now)
            touched = np.flatnonzero((gap < -DEPTH) & (closing < -LEFT_OVER * self._fastest))
            if touched.size:
                return min(self._first(int(pair), before, now) for pair in touched)
            before = now
        return np.inf

    def _first(self, pair: int, before: float, now: float) -> float:
        """Time in an interval at which a gap falls below -DEPTH; its start where it was there already."""
        if self._gaps(before)[0][pair] < -DEPTH:
            return before
        found: float = brentq(lambda t: self._gaps(t)[0][pair] + DEPTH, before, now, xtol=ROOT * self._sample)
        return found

    def advance(self, duration: float) -> None:
        """Swing freely for a time [s]."""
        self.angle, self.velocity = self._swing(duration)

    def problem(self, restitution: float, friction: float) -> ImpactProblem:
        """The impact of all neighbors that touch now: one velocity a ball.

        Raises:
            UnsupportedProblem: there is friction, which the strings leave no room for.
        """
        if friction:
            raise UnsupportedProblem("pendulums have no friction: their strings keep the balls from turning")
        x, _, z = self._centers(self.angle)
        dx, dz = np.diff(x), np.diff(z)
        distance = np.hypot(dx, dz)
        first = np.flatnonzero(distance - 2.0 * RADIUS <= TOUCHING)
        normal = np.column_stack([dx, dz])[first] / distance[first, None]
        along = np.column_stack([np.cos(self.angle), np.sin(self.angle)])
        on_first, on_second = -(normal * along[first]).sum(axis=1), (normal * along[first + 1]).sum(axis=1)
        rows = np.repeat(np.arange(first.size), 2)
        columns = np.column_stack([first, first + 1]).ravel()
        values = np.column_stack([on_first, on_second]).ravel()
        J = sp.csr_array((values, (rows, columns)), shape=(first.size, self.angle.size))
        return ImpactProblem(np.ones(self.angle.size), J, self.velocity, restitution)

    def ideal(self, raised: int, angle: float, time: float) -> Floats:
        """Angles in the ideal exchange after a time [s], shape (balls,)."""
        alone = Pendulums(np.array([-angle]), length=self.length, gravity=self.gravity, period=1.0)
        alone.advance(time)
        (swing,) = alone.angle
        ideal = np.zeros_like(self.angle)
        if swing < 0.0:
            ideal[:raised] = swing
        else:
            ideal[-raised:] = swing
        return ideal

    def energy_of(self, raised: int, angle: float) -> float:
        """Energy of so many balls at rest at an angle [J]."""
        return float(raised * self.gravity * 2.0 * self.length * np.sin(angle / 2.0) ** 2)

    def gaps(self, angle: Floats) -> Floats:
        """Gap between neighbors at some angles [m], shape (balls - 1,)."""
        x, _, z = self._centers(angle)
        return np.asarray(np.hypot(np.diff(x), np.diff(z)) - 2.0 * RADIUS)

    def take(self, v_post: Floats) -> None:
        """Go on with the velocity after an impact, shape (balls,)."""
        self.velocity = v_post.copy()

    def energies(self) -> tuple[float, float]:
        """Kinetic energy, and potential energy over all balls hanging [J]."""
        height = 2.0 * self.length * np.sin(self.angle / 2.0) ** 2
        return float(0.5 * self.velocity @ self.velocity), float(self.gravity * height.sum())

    def state(self) -> Arrays:
        """All that changes."""
        return {"angle": self.angle, "velocity": self.velocity}

    def restore(self, state: Arrays) -> None:
        """Go on from such a state; other entries are ignored."""
        self.angle, self.velocity = state["angle"].copy(), state["velocity"].copy()

    def _centers(self, angle: Floats) -> tuple[Floats, Floats, Floats]:
        return self._pivot + self.length * np.sin(angle), 0.0 * angle, -self.length * np.cos(angle)

    def _gaps(self, duration: float) -> tuple[Floats, Floats]:
        """Gap between neighbors after a time, and its rate; shape (balls - 1,) each."""
        angle, velocity = self._swing(duration)
        x, _, z = self._centers(angle)
        dx, dz = np.diff(x), np.diff(z)
        distance = np.hypot(dx, dz)
        rate = (dx * np.diff(velocity * np.cos(angle)) + dz * np.diff(velocity * np.sin(angle))) / distance
        return distance - 2.0 * RADIUS, rate

    def _swing(self, duration: float) -> tuple[Floats, Floats]:
        """Angles and velocities after a time without impacts."""
        turn = np.sqrt(self.gravity / self.length)
        half, rate = np.sin(self.angle / 2.0), self.velocity / (2.0 * self.length * turn)
        # sin(θ/2) = k sn and θ' / 2ω = k cn: what is at rest at the bottom has k = 0 and stays.
        m = half**2 + rate**2
        start = ellipkinc(np.arctan2(half, rate), m)
        sn, cn, _, _ = ellipj(start + turn * duration, m)
        k = np.sqrt(m)
        return 2.0 * np.arcsin(np.clip(k * sn, -1.0, 1.0)), 2.0 * self.length * turn * k * cn

"""A scene in motion with a fixed step: gravity, contacts, impact, positions.

    v' = v - (g Δt + Δw) e_z               w: velocity of the container, in whose frame all is computed
    v⁺ = law(v', contacts at x + v' Δt)    one impact, solved by any law
    x⁺ = x + v⁺ Δt + correction            semi-implicit Euler

Contacts are those that would overlap at the end of the step if nothing held them, so that an impact comes up to a step
early instead of a step late: spheres that have run into one another would be pushed apart by the correction, which
lifts a layer and so feeds it. (Trial with 2,400 grains under the driving of hexagons, 30 sweeps: in the middle of the
second cycle the center of the layer is at 10.0 D with 3,200 steps a cycle and the contacts at x; with 200 steps it is
at 15.0 D with the contacts at x, and at 9.2 D as here.)

The correction moves spheres apart that overlap by more than a slop after the step; it changes positions alone, so that
no kinetic energy comes of it. Its work against gravity is counted by itself.

    K⁺ + U⁺ - K - U = impact + friction + correction + shaking + integration

Every term is measured by itself, in the frame of the container. `integration` is the error of the scheme: for a freely
falling mass m it is -½ m g² Δt² a step, which a bounce takes back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.world.checkpoint import Arrays, CheckpointError
from scenarios.world.container import Container
from scenarios.world.grid import NO_STRAYS, Indices, find_neighbors
from scenarios.world.impact import Impact, Resolver, Restitution
from scenarios.world.spheres import INVERSE_INERTIA, PARTS, Ints, Spheres
from scenarios.world.warm_start import NO_IMPULSES, LastImpulses
from solvers import ImpactProblem, ProblemError, Status
from solvers._jit import kernel, parallel_kernel, prange
from solvers.buffers import Buffers, on_lines
from solvers.solution import Floats

Counts = npt.NDArray[np.int64]

# A scene may start with spheres that overlap by this share of the smallest radius: rounding, or a layer made before.
LARGEST_OVERLAP = 0.02
# Sweeps of the correction: the rest of an overlap is left to the next steps.
CORRECTION_SWEEPS = 3
# Scenes of so many spheres are kept in an order in which neighbors in space are neighbors in memory.
RENUMBERED = 8_000
# Steps between two renumberings, at least: a sphere moves about a diameter meanwhile.
RENUMBER_EVERY = 32
# A sphere may go so far, over the smallest radius, before it is a stray, and one sphere in so many may be one; then the
# neighbors are listed anew. A longer reach makes more pairs, and strays take more time each.
REACH = 0.3
SPHERES_A_STRAY = 256
# How far all spheres together may go along z before that, over the smallest radius: so far off, walls are listed.
DRIFT = 2.0
# Sums over the spheres: kinetic energy [J], vertical momentum [N s], mass [kg], largest speed squared [m²/s²] (NaN
# where any is), Σ m z [kg m], and the correction's share of it.
KINETIC, MOMENTUM, MASS, FASTEST, HEIGHT, LIFTED, SUMS = range(7)


@dataclass(frozen=True)
class Settings:
    """What a scene is besides its spheres and walls."""

    step: float
    """Δt [s]."""

    gravity: float
    """g [m/s²], down along z."""

    restitution: Restitution
    friction: float = 0.0
    """Coefficient of friction of all contacts."""

    tangential_restitution: float = 0.0
    """β₀ of all contacts that stick, in [0, 1] (see `solvers.spinning_spheres`)."""

    largest_move: float = 1.0
    """Share of the smallest radius that no sphere may exceed in a step: faster ones could pass one another unseen."""

    slop: float = 0.005
    """Overlap that is left alone, over the smallest radius: contacts of what lies stay contacts."""

    correction: float = 0.3
    """Share of the overlap beyond the slop that a step takes away."""


@dataclass(frozen=True)
class Ledger:
    """Energy in the frame of the container, and where it went in a step [J]."""

    kinetic: float
    potential: float
    """m g z, zero at z = 0."""
    impact: float
    """Work of the normal impulses; restitution makes it negative."""
    friction: float
    """Work of the friction impulses."""
    correction: float
    """Work of the correction against gravity."""
    shaking: float
    """Work of the container's motion."""
    integration: float
    """Error of the integration scheme."""


@dataclass(frozen=True)
class StepReport:
    """What one step came to."""

    step: int
    """Number of steps made, this one included."""
    time: float
    """At the end of the step [s]."""
    contacts: int
    status: Status
    iterations: int
    """Outer iterations of QCE, or those that the solver reports."""
    sweeps: int
    """Sweeps of the LCP with friction."""
    residual: float
    """The law's own residual, relative to the largest approach velocity."""
    overlap: float
    """Deepest overlap that the step left, over the smallest radius, before the correction."""
    fastest: float
    """Largest speed after the step [m/s]."""
    gain: float
    """Kinetic energy that the impact's impulses gained, over that before them, gravity's share of the step included."""
    energy: Ledger


def relative_gain(before: float, after: float) -> float:
    """Gain of an energy over what it was; 0 where there was and is none, and infinite where it came from nothing."""
    if before > 0.0:
        return (after - before) / before
    return 0.0 if after <= 0.0 else np.inf


@dataclass
class World:
    """A scene in motion."""

    identity: str
    """What scene this is, with all that its trajectory depends on: a checkpoint fits the same identity alone."""
    spheres: Spheres
    container: Container
    settings: Settings
    resolver: Resolver
    steps: int = 0
    """Steps made."""

    def __post_init__(self) -> None:
        self._last = NO_IMPULSES
        self._buffers = Buffers()
        motion, place = self.spheres.motion, self.spheres.place
        self._spare_motion, self._spare_place = on_lines(motion.shape), on_lines(place.shape)
        self._smallest = float(self.spheres.radius.min())
        self._sums = self._sums_now()
        self._numbered = 0
        self._list(self.spheres.place.copy(), self._sums[HEIGHT] / self._sums[MASS])
        contacts = self._neighbors.touching(self.spheres.place, self.container)
        deepest = int(np.argmin(contacts.gap)) if contacts.m else 0
        if contacts.m and contacts.gap[deepest] < -LARGEST_OVERLAP * self._smallest:
            raise ProblemError(
                f"position: {_pair(contacts.body[deepest], self.spheres.count)} overlap at the start by "
                f"{-contacts.gap[deepest]:.3g} m, more than {LARGEST_OVERLAP:g} of the smallest radius"
            )

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self.steps * self.settings.step

    @property
    def period(self) -> float:
        """Period of the container's motion [s]; inf if it stands still."""
        return self.container.motion.period

    @property
    def over(self) -> bool:
        """A step can always follow."""
        return False

    def state(self) -> Arrays:
        """All that changes from step to step."""
        spheres = self.spheres
        return {
            "steps": np.array(self.steps), "place": spheres.place, "motion": spheres.motion, "label": spheres.label,
            "numbered": np.array(self._numbered), "listed height": np.array(self._listed_height),
            "listed place": self._neighbors.place,
            **self._last.state(),
        }  # fmt: skip

    def restore(self, state: Arrays) -> None:
        """Go on from a state of the same scene.

        Raises:
            CheckpointError: an array is missing or has another shape.
        """
        own = self.state()
        for name, array in own.items():
            # The impulses have as many rows as there were contacts.
            rows = slice(1, None) if name in self._last.state() else slice(None)
            if name not in state or state[name].shape[rows] != array.shape[rows] or state[name].dtype != array.dtype:
                raise CheckpointError(f"the checkpoint's {name} is missing or has another shape than this scene's")
        self.steps = int(state["steps"])
        self._last = LastImpulses(state["pair"], state["impulse"])
        for name in ("place", "motion", "label"):
            getattr(self.spheres, name)[:] = state[name]
        self._sums = self._sums_now()
        self._numbered = int(state["numbered"])
        self._list(state["listed place"], float(state["listed height"]))

    def problem(self) -> ImpactProblem:
        """The impact that the next step will solve, as any solver takes it."""
        return self.impact().problem()

    def step(self) -> StepReport:
        """Go on by one step. At an error the scene stays as it was before the step.

        Raises:
            ProblemError: a sphere moves too far in the step, or is lost.
            UnsupportedProblem: the solver refuses the impact.
        """
        impact = self._impact(self._spare_motion, self._spare_place, self._buffers)
        contacts, motion = impact.contacts, impact.motion
        u_pre = impact.u_pre
        outcome = self.resolver.resolve(impact)
        shift = self._buffers.array("shift", (len(motion), 3))
        overlap = _push_apart(
            contacts.normal, contacts.body, contacts.gap, contacts.stripe, u_pre, motion,
            self.settings.step, self.settings.slop * self._smallest, self.settings.correction,
            self._buffers.array("deep", (contacts.m,), np.uint32), self._buffers.array("wanted", (contacts.m,)), shift,
        )  # fmt: skip
        before, after = self._sums, _move(self.spheres.place, motion, self.settings.step, shift, self._spare_place)
        self._check_move(float(np.sqrt(after[FASTEST])))
        self._spare_motion, self.spheres.motion = self.spheres.motion, motion
        self._spare_place, self.spheres.place = self.spheres.place, self._spare_place
        self._last = outcome.impulses
        self._sums = after
        self.steps += 1
        ledger = self._ledger(before, after, outcome.normal_work)
        return StepReport(
            self.steps,
            self.time,
            contacts.m,
            outcome.status,
            outcome.iterations,
            outcome.sweeps,
            outcome.residual,
            overlap / self._smallest,
            float(np.sqrt(after[FASTEST])),
            relative_gain(ledger.kinetic - ledger.impact - ledger.friction, ledger.kinetic),
            ledger,
        )

    def _kick(self) -> float:
        """Velocity that the container gains in the next step [m/s]."""
        motion, now = self.container.motion, self.time
        return motion.speed(now + self.settings.step) - motion.speed(now)

    def impact(self) -> Impact:
        """The next step's impact: velocities after gravity and shaking, contacts where these would lead.

        It may renumber the spheres of a large scene, as the step itself would.
        """
        return self._impact(np.empty_like(self.spheres.motion), np.empty_like(self.spheres.place), Buffers())

    def _impact(self, motion: Floats, ahead: Floats, buffers: Buffers) -> Impact:
        """The next step's impact, in memory that is there."""
        settings, spheres = self.settings, self.spheres
        fall = settings.gravity * settings.step + self._kick()
        rise = self._sums[MOMENTUM] / self._sums[MASS] - fall
        height = self._sums[HEIGHT] / self._sums[MASS] + settings.step * rise
        strays = self._fall(fall, height, motion, ahead)
        if strays is None:
            if spheres.count >= RENUMBERED and self.steps >= self._numbered + RENUMBER_EVERY:
                spheres.renumber(self._neighbors.grid.order)
                self._numbered, self._sums = self.steps, self._sums_now()
                self._fall(fall, height, motion, ahead)
            self._list(ahead.copy(), height)
            strays = NO_STRAYS
        contacts = self._neighbors.touching(ahead, self.container, strays=strays, buffers=buffers)
        return Impact(
            contacts, motion, settings.restitution, settings.friction, spheres.label, settings.tangential_restitution,
            self._last, buffers,
        )  # fmt: skip

    def _fall(self, fall: float, height: float, motion: Floats, ahead: Floats) -> Indices | None:
        """Fill velocities after gravity and shaking, and the places ahead.

        Args:
            fall: velocity that all spheres lose [m/s].
            height: mean of z, weighted with the masses, ahead [m].
            motion: as `Spheres.motion`, shape (bodies + 1, 8).
            ahead: as `Spheres.place`, shape (bodies, 4).

        Returns:
            Spheres out of the neighbors' reach, in ascending order; None where the neighbors must be listed anew.
        """
        near, count = self._neighbors, self.spheres.count
        drift = height - self._listed_height
        stray = self._buffers.array("stray", (count,), np.uint32)
        gone, furthest = _fall(
            self.spheres.place, self.spheres.motion, fall, self.settings.step, near.place, near.reach, drift, motion,
            ahead, stray,
        )  # fmt: skip
        if abs(drift) > near.drift or gone.sum() * SPHERES_A_STRAY > count or furthest > near.furthest:
            return None
        return np.concatenate([stray[count * k // PARTS :][:n] for k, n in enumerate(gone)])

    def _list(self, place: Floats, height: float) -> None:
        """List the neighbors; `height` is the mean of z, weighted with the masses [m]."""
        reach, drift = REACH * self._smallest, DRIFT * self._smallest
        self._neighbors = find_neighbors(place, reach, self.container, drift=drift, buffers=self._buffers)
        self._listed_height = height

    def _sums_now(self) -> Floats:
        """Sums over the spheres, as `_move` returns them."""
        place, motion = self.spheres.place, self.spheres.motion
        return _move(place, motion, 0.0, np.zeros((len(motion), 3)), self._spare_place)

    def _check_move(self, fastest: float) -> None:
        move = fastest * self.settings.step
        if not np.isfinite(move):
            raise ProblemError(f"velocity must be finite: it is not after step {self.steps + 1}")
        if move > self.settings.largest_move * self._smallest:
            raise ProblemError(
                f"step: the fastest sphere moves {move:.3g} m in step {self.steps + 1}, more than "
                f"{self.settings.largest_move:g} of the smallest radius; a shorter step than {self.settings.step:g} s "
                "is needed"
            )

    def _ledger(self, before: Floats, after: Floats, normal_work: float) -> Ledger:
        """Where the energy of the last step went."""
        g, step = self.settings.gravity, self.settings.step
        # The step is counted already.
        motion = self.container.motion
        shaken = motion.speed(self.time) - motion.speed(self.time - step)
        mass, momentum = before[MASS], before[MOMENTUM]
        falling = -g * step * momentum + 0.5 * mass * (g * step) ** 2
        shaking = -shaken * (momentum - mass * g * step) + 0.5 * mass * shaken**2
        change = after[KINETIC] - (before[KINETIC] + falling + shaking)
        # Without friction, or where the solver gives no impulses, all of it is the impact's.
        impact = change if self.settings.friction == 0.0 or np.isnan(normal_work) else normal_work
        return Ledger(
            float(after[KINETIC]),
            float(g * after[HEIGHT]),
            float(impact),
            float(change - impact),
            float(g * after[LIFTED]),
            float(shaking),
            float(falling + g * step * after[MOMENTUM]),
        )


def _pair(body: Indices, spheres: int) -> str:
    """Name the two bodies of a contact."""
    return f"sphere {body[1]} and a wall" if body[0] == spheres else f"spheres {body[0]} and {body[1]}"


@parallel_kernel
def _fall(
    place: Floats, motion: Floats, fall: float, step: float, listed: Floats, reach: float, drift: float,
    after: Floats, ahead: Floats, stray: Indices,
) -> tuple[Counts, float]:  # fmt: skip
    """Velocities after gravity and shaking, and the places to which they lead.

    Lists the spheres that are out of reach there, those of each part from its first place on; returns how many there
    are in each part, and how far the furthest is gone, inf where a place is NaN.
    """
    bodies = place.shape[0]
    gone = np.zeros(PARTS, np.int64)
    furthest = np.zeros(PARTS)
    for part in prange(PARTS):
        begin = bodies * part // PARTS
        size = 0
        longest = 0.0
        for b in range(begin, bodies * (part + 1) // PARTS):
            for column in range(8):
                after[b, column] = motion[b, column]
            after[b, 2] -= fall
            for axis in range(3):
                ahead[b, axis] = place[b, axis] + step * after[b, axis]
            ahead[b, 3] = place[b, 3]
            dx = ahead[b, 0] - listed[b, 0]
            dy = ahead[b, 1] - listed[b, 1]
            dz = ahead[b, 2] - listed[b, 2] - drift
            square = dx * dx + dy * dy + dz * dz
            # Not "beyond the reach", which NaN never is.
            if not square <= reach * reach:
                stray[begin + size] = b
                size += 1
                longest = max(longest, square if square >= 0.0 else np.inf)
        gone[part] = size
        furthest[part] = np.sqrt(longest)
    after[bodies] = motion[bodies]
    return gone, furthest.max()


@kernel
def _along(normal: Floats, body: Indices, i: int, vector: Floats) -> float:
    """Difference of a vector of two bodies along their normal."""
    a = body[i, 0]
    b = body[i, 1]
    return float(
        normal[i, 0] * (vector[b, 0] - vector[a, 0])
        + normal[i, 1] * (vector[b, 1] - vector[a, 1])
        + normal[i, 2] * (vector[b, 2] - vector[a, 2])
    )


@kernel
def _deep_overlaps(
    normal: Floats, body: Indices, gap_ahead: Floats, begin: int, end: int, u_pre: Floats, motion: Floats,
    step: float, slop: float, share: float, deep: Indices, wanted: Floats,
) -> tuple[int, float]:  # fmt: skip
    """List the overlaps of a stripe, and what to take away; returns how many, and the deepest."""
    place = np.uint64(begin)
    deepest = 0.0
    for i in range(np.uint64(begin), np.uint64(end)):
        # The gap without contacts, less what the impact changed.
        overlap = -(gap_ahead[i] + step * (_along(normal, body, i, motion) - u_pre[i]))
        deepest = max(deepest, overlap)
        # No branch: a place is written again until it is taken.
        deep[place] = i
        wanted[place] = share * (overlap - slop)
        place += np.uint64(overlap > slop)
    return int(np.int64(place)) - begin, deepest


@parallel_kernel
def _push_apart(
    normal: Floats, body: Indices, gap_ahead: Floats, stripe: Ints, u_pre: Floats, motion: Floats,
    step: float, slop: float, share: float, deep: Indices, wanted: Floats, shift: Floats,
) -> float:  # fmt: skip
    """Displacements that take away a share of what overlaps after the step; returns the deepest overlap.

    Projected Gauss-Seidel, all sweeps of a stripe in a row:
    0 <= λ complementary to n · Δx - share (overlap - slop) >= 0.
    `deep` and `wanted` are memory for as many entries as there are contacts.
    """
    count = np.zeros(stripe.size - 1, np.int32)
    deepest = np.zeros(stripe.size - 1)
    for k in prange(stripe.size - 1):
        count[k], deepest[k] = _deep_overlaps(
            normal, body, gap_ahead, stripe[k], stripe[k + 1], u_pre, motion, step, slop, share, deep, wanted
        )
    shift[:] = 0.0
    for half in range(2):
        for k in prange((stripe.size - half) // 2):
            s = 2 * k + half
            _push_stripe(normal, body, motion, deep, wanted, stripe[s], stripe[s] + count[s], shift)
    return float(deepest.max())


@kernel
def _push_stripe(
    normal: Floats, body: Indices, motion: Floats, deep: Indices, wanted: Floats, begin: int, end: int, shift: Floats
) -> None:
    """Sweeps of the correction over the overlaps of a stripe."""
    push = np.zeros(end - begin)
    first = np.uint64(begin)
    for _ in range(CORRECTION_SWEEPS):
        for k in range(np.uint64(begin), np.uint64(end)):
            i = deep[k]
            a = body[i, 0]
            b = body[i, 1]
            wa = motion[a, 3]
            wb = motion[b, 3]
            change = max((wanted[k] - _along(normal, body, i, shift)) / (wa + wb), -push[k - first])
            push[k - first] += change
            for axis in range(3):
                # All stripes share the immovable body.
                if wa > 0.0:
                    shift[a, axis] -= wa * change * normal[i, axis]
                shift[b, axis] += wb * change * normal[i, axis]


@parallel_kernel
def _move(place: Floats, motion: Floats, step: float, shift: Floats, moved: Floats) -> Floats:
    """New places, and the sums over the spheres there, shape (SUMS,)."""
    bodies = place.shape[0]
    sums = np.zeros((PARTS, SUMS))
    for part in prange(PARTS):
        kinetic = momentum = total = fastest = height = lifted = 0.0
        for b in range(bodies * part // PARTS, bodies * (part + 1) // PARTS):
            mass = 1.0 / motion[b, 3]
            square = motion[b, 0] ** 2 + motion[b, 1] ** 2 + motion[b, 2] ** 2
            spin = motion[b, 4] ** 2 + motion[b, 5] ** 2 + motion[b, 6] ** 2
            for axis in range(3):
                moved[b, axis] = place[b, axis] + step * motion[b, axis] + shift[b, axis]
            moved[b, 3] = place[b, 3]
            kinetic += 0.5 * mass * (square + spin / INVERSE_INERTIA)
            momentum += mass * motion[b, 2]
            total += mass
            fastest = max(fastest, square)
            height += mass * moved[b, 2]
            lifted += mass * shift[b, 2]
        sums[part, KINETIC] = kinetic
        sums[part, MOMENTUM] = momentum
        sums[part, MASS] = total
        # NaN is lost in a comparison, not in a sum.
        sums[part, FASTEST] = fastest + 0.0 * kinetic
        sums[part, HEIGHT] = height
        sums[part, LIFTED] = lifted
    found: Floats = sums.sum(axis=0)
    found[FASTEST] = sums[:, FASTEST].max()
    return found

"""Rigid bodies in motion with a fixed step: gravity, contacts, impact, positions.

    v' = v - g Δt e_z
    v⁺ = law(v', contacts that would overlap at x + v' Δt)     one impact with friction, solved by any law
    x⁺ = x + v⁺ Δt + correction                                semi-implicit Euler; see `rigid_motion` for rotations

Bodies that fly meet on the way, a time τ after the start of the step, when the first contact of theirs closes: they
have fallen and moved for τ when the impact is solved, and do so for Δt - τ after it. For what touches τ = 0, and all of
gravity comes before the impact, which bears it.

Contacts are looked for at x, with a margin as wide as bodies can move, and are taken where bodies touch or the step
would make them overlap: what rests is held where it is, be it a hair's breadth above, and what meets is stopped before
it overlaps.

An impact is an island of bodies that touch. Where no contact of it approaches faster than `resting_speed`, it is none:
bodies that rest and are pulled down by gravity in a step; all its contacts then have c_r = 0. In every other island all
contacts have their own c_r, those without approach too, so that a wave goes through bodies that lie together.

The correction moves bodies apart that overlap by more than a slop after the step; it changes positions alone, so that
no kinetic energy comes of it, and leaves alone what overlaps less, so that what stands does not creep. No body is ever
put to sleep.

    K⁺ + U⁺ - K - U = impact + friction + correction + integration

`impact` and `friction` are the work of the impulses: on the mean of the velocities before and after, and for an island
that rests on that of the velocities at the ends of the step, as its impulses are the sum of a force that bears it all
the time. What rests then contributes to none of the terms. `integration` is the error of the scheme, measured by
itself; it is zero for bodies that touch nothing but for the splitting of their rotation.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scenarios.parameters import check_number, check_positive
from scenarios.world.checkpoint import Arrays, CheckpointError
from scenarios.world.collision import Collider, RigidContacts
from scenarios.world.container import Container
from scenarios.world.impact import ByProblem, Resolver
from scenarios.world.obstacle import Obstacle
from scenarios.world.persistent_contacts import NEAR, NOTHING_TOUCHED, LastContacts
from scenarios.world.rigid_bodies import FREEDOMS, RigidBodies, RigidBody, assemble
from scenarios.world.rigid_motion import displace, drift, kick, push_apart
from scenarios.world.rigid_rows import (
    RigidImpact,
    approach,
    contact_rows,
    islands,
    largest_of_island,
    meeting,
)
from scenarios.world.rotation import inverse, multiply, rotation_matrix
from scenarios.world.shapes import Faces, Shape
from scenarios.world.spheres import Ints, Spheres
from scenarios.world.stepping import Ledger, StepReport, relative_gain
from solvers import ImpactProblem, ImpactSolution, ProblemError, Solver
from solvers.solution import Floats

# A scene may start with bodies that overlap by this share of the thinner one's thickness: rounding of their places.
LARGEST_OVERLAP = 0.05
# Sweeps of the correction: the rest of an overlap is left to the next steps.
CORRECTION_SWEEPS = 10
# Bodies touch where their gap is below this share of the slop: two that lie on one another fall alike, so that nothing
# but their gap tells that the upper one will have to be held.
TOUCHING = 0.1
# How far a round surface may lie beyond the triangles that it is drawn with, as a factor.
ROUNDNESS = 1.01
# Bodies that fall for a step gain g Δt at their centers and up to half as much again at the end of a rod that tips;
# twice that is far below the speed of any fall that can be seen.
RESTING_STEPS = 4.0


@dataclass(frozen=True)
class RigidSettings:
    """What a scene is besides its bodies.

    Raises:
        ProblemError: names the setting and the rule.
    """

    step: float = 1e-3
    """Δt [s]."""

    gravity: float = 9.81
    """g [m/s²], down along z."""

    resting_speed: float | None = None
    """Approach below which an island rests [m/s]; `RESTING_STEPS` g Δt if None; 0 where nothing ever rests."""

    largest_move: float = 1.0
    """Share of its thickness that no body may move in a step: a faster one could pass through another unseen."""

    slop: float = 0.01
    """Overlap that is left alone, over the thinnest body's thickness: contacts of what stands stay contacts."""

    correction: float = 0.2
    """Share of the overlap beyond the slop that a step takes away."""

    def __post_init__(self) -> None:
        check_positive("step", self.step)
        check_number("gravity", self.gravity, low=0.0)
        if self.resting_speed is not None:
            check_number("resting_speed", self.resting_speed, low=0.0)
        check_positive("largest_move", self.largest_move)
        check_number("slop", self.slop, low=0.0)
        check_number("correction", self.correction, low=0.0, high=1.0)

    @property
    def rest(self) -> float:
        """Approach below which an island rests [m/s]."""
        return RESTING_STEPS * self.gravity * self.step if self.resting_speed is None else self.resting_speed


@dataclass(frozen=True)
class Trigger:
    """Something that happens once in a scene, and what it sets free."""

    name: str
    when: Callable[[RigidWorld], bool]
    """Looked at after each step, as soon as the triggers before it have fired."""
    release: tuple[str, ...] = ()
    """Bodies that are held until then."""


class RigidWorld:
    """Rigid bodies in motion.

    Args:
        identity: what scene this is, with all that its trajectory depends on: a checkpoint fits the same identity.
        bodies: as they start.
        settings: step, gravity, and how contacts are held.
        resolver: the law of the impacts, through an `ImpactProblem`.
        obstacles: smooth fixed surfaces, seen by balls.
        triggers: what is to happen, in this order.

    Raises:
        ProblemError: names the body and the rule.
    """

    def __init__(
        self, identity: str, bodies: Sequence[RigidBody], settings: RigidSettings, resolver: Resolver, *,
        obstacles: Sequence[Obstacle] = (), triggers: Sequence[Trigger] = (),
    ) -> None:  # fmt: skip
        if not isinstance(resolver, ByProblem):
            raise ProblemError("solver must be one of SOLVERS: the packed ones are for scenes of many spheres")
        self.identity = identity
        self.settings = settings
        self.solver: Solver = resolver.solver
        self._takes = set(inspect.signature(self.solver.solve).parameters)
        self.steps = 0
        """Steps made."""
        self.overlap = 0.0
        """Deepest overlap that the last step left, before the correction [m]."""
        self.solved: ImpactProblem | None = None
        """The impact that the last step solved; None before the first step, and after a restart."""
        self._bodies = assemble(bodies, obstacles)
        self._obstacles = tuple(obstacles)
        self._triggers = tuple(triggers)
        self._fired = np.full(len(self._triggers), np.nan)
        self._collider = Collider(self._bodies, self._obstacles)
        self._last = NOTHING_TOUCHED
        self._touched = np.zeros((0, 2), dtype=np.int32)
        self._normal_impulse = np.zeros(0)
        movable = self._bodies.shapes[: self._bodies.movable]
        self._thickness = np.array([shape.thickness for shape in movable])
        self._thinnest = float(self._thickness.min())
        self._slop = self.settings.slop * self._thinnest
        self._touching = TOUCHING * self._slop
        self._arms = np.array([_arms(shape) for shape in movable])
        self._reach = np.array([shape.radius for shape in movable])
        for trigger in self._triggers:
            for name in trigger.release:
                self._check_held(name)
        self._check_start()

    # What moves, and where it is.

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the movable bodies, shape (b,)."""
        return self._bodies.names[: self._bodies.movable]

    def index(self, name: str) -> int:
        """Number of a body; below b for movable ones.

        Raises:
            ProblemError: there is none of that name.
        """
        return self._bodies.index(name)

    @property
    def position(self) -> Floats:
        """Centers of mass of the movable bodies [m], shape (b, 3)."""
        return self._bodies.position[: self._bodies.movable]

    @property
    def orientation(self) -> Floats:
        """Quaternions (w, x, y, z) of their principal axes, shape (b, 4)."""
        return self._bodies.orientation[: self._bodies.movable]

    @property
    def velocity(self) -> Floats:
        """Velocities of their centers of mass [m/s], shape (b, 3)."""
        return self._bodies.velocity[:, :3]

    @property
    def spin(self) -> Floats:
        """Their spins along the axes of the world [rad/s], shape (b, 3)."""
        return self._in_space(self._bodies.velocity[:, 3:])

    @property
    def angular_momentum(self) -> Floats:
        """Of each about its own center, along the axes of the world [kg m²/s], shape (b, 3)."""
        return self._in_space(self._bodies.mass[:, 3:] * self._bodies.velocity[:, 3:])

    def given_pose(self, name: str) -> tuple[Floats, Floats]:
        """Position [m] and quaternion of the frame in which a body's shape was given."""
        k = self.index(name)
        shape = self._bodies.shapes[k]
        turn = multiply(self._bodies.orientation[k], inverse(shape.axes))
        return self._bodies.position[k] - rotation_matrix(turn) @ shape.center, turn

    def kinetic_energy(self) -> float:
        """Of all bodies [J]."""
        return self._kinetic(self._bodies.velocity)

    def potential_energy(self) -> float:
        """Of all bodies, zero at z = 0 [J]; those on a hinge or held have it too."""
        return float(self.settings.gravity * self._bodies.mass[:, 0] @ self.position[:, 2])

    @property
    def spheres(self) -> Spheres:
        """Spheres around the bodies, in the order of `names`: what is drawn and kept of every scene."""
        count = self._bodies.movable
        place = np.column_stack([self.position, [shape.radius for shape in self._bodies.shapes[:count]]])
        motion = np.zeros((count + 1, 8))
        motion[:-1, :3], motion[:-1, 3] = self.velocity, 1.0 / self._bodies.mass[:, 0]
        motion[:-1, 4:7] = place[:, 3:] * self.spin
        return Spheres(place, motion, np.arange(count, dtype=np.int32))

    @property
    def container(self) -> Container:
        """No walls: what is fixed is a body."""
        return Container()

    def meshes(self) -> list[tuple[str, Floats, Faces, int]]:
        """Name, vertices [m], triangles and number of all that can be drawn; -1 for what does not move.

        Vertices of movable bodies are in the body's frame (`position`, `orientation`), others in the world's.
        """
        drawn = []
        for k, shape in enumerate(self._bodies.shapes):
            fixed = k >= self._bodies.movable
            turn, where = rotation_matrix(self._bodies.orientation[k]), self._bodies.position[k]
            vertices = shape.vertices @ turn.T + where if fixed else shape.vertices
            drawn.append((self._bodies.names[k], vertices, shape.faces, -1 if fixed else k))
        for obstacle in self._obstacles:
            vertices, faces = obstacle.mesh()
            drawn.append((obstacle.name, np.asarray(vertices, dtype=np.float64), faces, -1))
        return drawn

    # What happens.

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self.steps * self.settings.step

    @property
    def period(self) -> float:
        """Nothing drives the scene."""
        return np.inf

    @property
    def over(self) -> bool:
        """A step can always follow."""
        return False

    @property
    def fired(self) -> Mapping[str, float]:
        """When each trigger fired [s]; only those that did."""
        return {
            trigger.name: float(time)
            for trigger, time in zip(self._triggers, self._fired, strict=True)
            if np.isfinite(time)
        }

    def release(self, name: str) -> None:
        """Let a body go that is held.

        Raises:
            ProblemError: there is no such body, or it cannot be held.
        """
        self._check_held(name)
        self._bodies.held[self.index(name)] = False

    def touching(self, one: str, other: str) -> float:
        """Largest normal impulse of the last step between two bodies or obstacles [N s]; 0 where they do not touch."""
        pair = {self.index(one), self.index(other)}
        between = [set(bodies.tolist()) == pair for bodies in self._touched]
        return float(self._normal_impulse[np.array(between, dtype=bool)].max(initial=0.0))

    def state(self) -> Arrays:
        """All that changes from step to step."""
        bodies = self._bodies
        return {
            "steps": np.array(self.steps), "position": self.position, "orientation": self.orientation,
            "velocity": bodies.velocity, "held": bodies.held, "fired": self._fired, "touched": self._touched,
            "normal_impulse": self._normal_impulse,
            **self._last.state(),
        }  # fmt: skip

    def restore(self, state: Arrays) -> None:
        """Go on from a state of the same scene.

        Raises:
            CheckpointError: an array is missing or has another shape.
        """
        contacts = {"touched", "normal_impulse", *self._last.state()}
        for name, array in self.state().items():
            # What the contacts carry has as many rows as there were contacts.
            rows = slice(1, None) if name in contacts else slice(None)
            if name not in state or state[name].shape[rows] != array.shape[rows] or state[name].dtype != array.dtype:
                raise CheckpointError(f"the checkpoint's {name} is missing or has another shape than this scene's")
        self.steps = int(state["steps"])
        self.position[:], self.orientation[:] = state["position"], state["orientation"]
        self._bodies.velocity[:], self._bodies.held[:] = state["velocity"], state["held"]
        self._fired[:] = state["fired"]
        self._touched, self._normal_impulse = state["touched"].copy(), state["normal_impulse"].copy()
        self._last = LastContacts.of_state(state)

    def impact(self) -> RigidImpact:
        """The impact that the next step will solve."""
        bodies, gravity, step = self._bodies, self.settings.gravity, self.settings.step
        freedom = bodies.freedom()
        place = bodies.position, bodies.orientation
        falling = kick(bodies.velocity, freedom, np.full(bodies.movable, gravity * step))
        contacts = self._contacts(falling, freedom)
        island = islands(contacts, freedom)
        closing = _time_to_close(
            contacts, island, approach(contacts, *place, falling),
            step=step, touching=self._touching, rest=self.settings.rest,
        )  # fmt: skip
        flight = _flight(contacts, closing, bodies, len(self._obstacles), step)
        # What flies is met by its impact on the way; what touches has the whole of gravity pressed on by it.
        velocity = kick(bodies.velocity, freedom, gravity * np.where(flight > 0.0, flight, step))
        rows = contact_rows(contacts, *place, velocity)
        restitution = _geometric_mean(bodies.restitution, contacts)
        rests = (largest_of_island(island, -rows.u) < self.settings.rest) & (self.settings.rest > 0.0)
        restitution[rests] = 0.0
        friction = _geometric_mean(bodies.friction, contacts)
        return RigidImpact(
            contacts, rows, velocity, freedom, friction, restitution, flight, closing,
            self._without_gravity(velocity, contacts.body[rests]),
        )  # fmt: skip

    def problem(self) -> ImpactProblem:
        """The impact that the next step will solve, as any solver takes it."""
        return self.impact().problem()

    def step(self) -> StepReport:
        """Go on by one step. At an error the scene stays as it was before the step.

        Raises:
            ProblemError: a body moves too far in the step, or is lost; the text names it.
            UnsupportedProblem: the solver refuses the impact.
        """
        impact, bodies = self.impact(), self._bodies
        problem = impact.problem()
        last = self._last.match(impact.contacts, NEAR * self._thinnest)
        solution = self._solve(problem, impact, last)
        velocity = solution.v_post.reshape(-1, FREEDOMS)
        fastest = self._check_move(velocity)
        before = self._energies()
        borne, struck = self._kinetic(impact.borne), self._kinetic(velocity)
        # What rests is held against gravity all the time: both work on the mean of the velocities at the step's ends.
        pulled = 0.5 * float((bodies.mass * (impact.velocity - impact.borne) * (impact.borne + velocity)).sum())
        self._move(impact, velocity)
        drifted = self._energies()
        self._correct(problem, impact, solution)
        self._keep(impact, solution, last)
        self.steps += 1
        self.solved = problem
        self._fire()
        kinetic, potential = self._energies()
        work = struck - borne - pulled
        normal = _normal_work(problem, solution, impact.borne, work)
        # Gravity's share of the kinetic energy and of the potential one are the same but for the scheme's error.
        integration = borne + pulled - before[0] + drifted[0] - struck + drifted[1] - before[1]
        return StepReport(
            step=self.steps, time=self.time, contacts=problem.m, status=solution.status,
            iterations=solution.iterations, sweeps=0, residual=solution.residual,
            overlap=self.overlap / self._thinnest, fastest=fastest,
            gain=relative_gain(self._kinetic(impact.velocity), struck),
            energy=Ledger(
                kinetic=kinetic, potential=potential, impact=normal, friction=work - normal,
                correction=potential - drifted[1], shaking=0.0, integration=integration,
            ),
        )  # fmt: skip

    def _without_gravity(self, velocity: Floats, resting: Ints) -> Floats:
        """Velocities before the impact (v, ω), shape (b, 6), of what rests those before gravity's share."""
        borne = velocity.copy()
        held = np.unique(resting)
        held = held[held < self._bodies.movable]
        borne[held] = self._bodies.velocity[held]
        return borne

    def _contacts(self, velocity: Floats, freedom: Floats) -> RigidContacts:
        """Contacts of the next step, velocities after gravity given."""
        bodies, step = self._bodies, self.settings.step
        reach = 2.0 * step * float(self._speeds(velocity).max()) + self._slop
        near = self._collider.contacts(self.position, self.orientation, reach)
        touching = meeting(
            near, bodies.position, bodies.orientation, velocity, freedom, step=step, touching=self._touching
        )  # fmt: skip
        return near.take(touching)

    def _solve(self, problem: ImpactProblem, impact: RigidImpact, last: LastContacts) -> ImpactSolution:
        """Solve the impact, from the last step's impulses where the solver takes a start."""
        solve: Callable[..., ImpactSolution] = self.solver.solve
        if "start" not in self._takes:
            return solve(problem)
        guesses = zip(("start", "friction_start"), impact.starts(problem, last.impulse), strict=True)
        return solve(problem, **{name: guess for name, guess in guesses if name in self._takes})

    def _move(self, impact: RigidImpact, velocity: Floats) -> None:
        """Go on by the flight before the impact, and with the velocities after it for the rest of the step."""
        bodies, gravity = self._bodies, self.settings.gravity
        freedom, flight = impact.inverse_mass, impact.flight
        place = self.position, self.orientation
        flown = impact.velocity.copy()
        start = rotation_matrix(self.orientation)
        drift(*place, flown, bodies.mass, freedom, flight, 0.5 * gravity * flight**2)
        flown += _turned_back(
            velocity - impact.velocity, start, rotation_matrix(self.orientation), bodies.mass, freedom
        )
        rest = self.settings.step - flight
        fall = np.where(flight > 0.0, rest, 0.0)
        drift(*place, flown, bodies.mass, freedom, rest, -0.5 * gravity * fall**2)
        bodies.velocity = kick(flown, freedom, gravity * fall)

    def _correct(self, problem: ImpactProblem, impact: RigidImpact, solution: ImpactSolution) -> None:
        """Move bodies apart that overlap by more than the slop after the step."""
        before, after = impact.closing, self.settings.step - impact.closing
        overlap = -(impact.contacts.gap + before * problem.u_pre + after * (problem.J @ solution.v_post))
        self.overlap = float(overlap.max(initial=0.0))
        if self.overlap <= self._slop:
            return
        beyond = overlap - self._slop
        wanted = np.where(beyond > 0.0, self.settings.correction * beyond, beyond)
        rows = np.ascontiguousarray(impact.rows.block[:, 0])
        shift = push_apart(impact.contacts.body, rows, wanted, impact.inverse_mass, CORRECTION_SWEEPS)
        displace(self.position, self.orientation, shift)

    def _keep(self, impact: RigidImpact, solution: ImpactSolution, last: LastContacts) -> None:
        """Remember what the contacts carried."""
        self._touched = impact.contacts.body
        impulse = np.zeros(impact.contacts.m) if solution.impulse is None else solution.impulse
        self._normal_impulse = impulse
        self._last = replace(last, impulse=impact.in_space(impulse, solution.friction_impulse))

    def _fire(self) -> None:
        """Let triggers fire, one after the other."""
        for k, trigger in enumerate(self._triggers):
            if np.isfinite(self._fired[k]):
                continue
            if not trigger.when(self):
                return
            self._fired[k] = self.time
            for name in trigger.release:
                self.release(name)

    def _in_space(self, vector: Floats) -> Floats:
        """Vectors along principal axes, shape (b, 3), along the axes of the world."""
        turned: Floats = np.einsum("bij,bj->bi", rotation_matrix(self.orientation), vector)
        return turned

    def _kinetic(self, velocity: Floats) -> float:
        return float(0.5 * (self._bodies.mass * velocity**2).sum())

    def _energies(self) -> tuple[float, float]:
        return self.kinetic_energy(), self.potential_energy()

    def _speeds(self, velocity: Floats) -> Floats:
        """Speed of the fastest point of each body [m/s], shape (b,), or a bound on it."""
        spin = velocity[:, 3:]
        turning = np.minimum(self._reach * np.linalg.norm(spin, axis=1), (self._arms * np.abs(spin)).sum(axis=1))
        speed: Floats = np.linalg.norm(velocity[:, :3], axis=1) + turning
        return speed

    def _check_move(self, velocity: Floats) -> float:
        """Fastest point of all bodies [m/s]; an error where one moves too far in a step."""
        speed = self._speeds(velocity)
        lost = np.flatnonzero(~np.isfinite(speed))
        if lost.size:
            raise ProblemError(f"body {self.names[lost[0]]}: its velocity is not finite after step {self.steps + 1}")
        share = speed * self.settings.step / self._thickness
        worst = int(share.argmax())
        if share[worst] > self.settings.largest_move:
            raise ProblemError(
                f"body {self.names[worst]}: it moves {speed[worst] * self.settings.step:.3g} m in step "
                f"{self.steps + 1}, more than {self.settings.largest_move:g} of its half thickness "
                f"{self._thickness[worst]:.3g} m; a shorter step than {self.settings.step:g} s is needed"
            )
        return float(speed.max())

    def _check_held(self, name: str) -> None:
        k = self.index(name)
        if k >= self._bodies.movable:
            raise ProblemError(f"body {name}: a fixed body cannot be released")

    def _check_start(self) -> None:
        """Bodies may touch at the start but not overlap."""
        contacts = self._collider.contacts(self.position, self.orientation, 0.0)
        shapes = [shape.thickness for shape in self._bodies.shapes] + [np.inf] * len(self._obstacles)
        thin = np.array(shapes)[contacts.body].min(axis=1)
        deep = np.flatnonzero(-contacts.gap > LARGEST_OVERLAP * thin)
        if deep.size:
            one, other = (self._bodies.names[k] for k in contacts.body[deep[0]])
            raise ProblemError(
                f"bodies {one} and {other} overlap at the start by {-contacts.gap[deep[0]]:.3g} m, more than "
                f"{LARGEST_OVERLAP:g} of the thinner one's half thickness"
            )


def _arms(shape: Shape) -> Floats:
    """Distance of the farthest point from each principal axis [m], shape (3,), or a bound on it."""
    if shape.is_ball:
        # Its spin moves no point of it anywhere else.
        return np.zeros(3)
    square = shape.vertices**2
    across: Floats = np.sqrt((square.sum(axis=1, keepdims=True) - square).max(axis=0))
    # Pictures of round parts have their corners on the surface or a little inside.
    return np.minimum(across * ROUNDNESS, shape.radius)


def _turned_back(change: Floats, before: Floats, after: Floats, mass: Floats, inverse_mass: Floats) -> Floats:
    """A change of (v, ω) in a frame that has turned since: the same momentum and angular momentum in space."""
    momentum = np.einsum("bij,bj->bi", before, mass[:, 3:] * change[:, 3:])
    turned: Floats = np.einsum("bji,bj->bi", after, momentum) * inverse_mass[:, 3:]
    return np.concatenate([change[:, :3], turned], axis=1)


def _time_to_close(
    contacts: RigidContacts, island: Ints, u: Floats, *, step: float, touching: float, rest: float
) -> Floats:
    """When the first contact of the island of each closes [s], shape (m,); 0 where bodies touch and rest."""
    closing = np.full(contacts.m, step)
    nearing = u < 0.0
    closing[nearing] = np.clip(-contacts.gap[nearing] / u[nearing], 0.0, step)
    closing[nearing & (contacts.gap <= touching) & (u > -rest)] = 0.0
    return -largest_of_island(island, -closing)


def _flight(contacts: RigidContacts, closing: Floats, bodies: RigidBodies, obstacles: int, step: float) -> Floats:
    """When each body's impact comes [s], shape (b,): at the end of the step where it has none."""
    flight = np.full(bodies.count + obstacles, step)
    np.minimum.at(flight, contacts.body.ravel(), np.repeat(closing, 2))
    return flight[: bodies.movable]


def _geometric_mean(coefficient: Floats, contacts: RigidContacts) -> Floats:
    """Coefficient of each contact from those of its bodies, shape (m,)."""
    mean: Floats = np.sqrt(coefficient[contacts.body[:, 0]] * coefficient[contacts.body[:, 1]])
    return mean


def _normal_work(problem: ImpactProblem, solution: ImpactSolution, borne: Floats, work: float) -> float:
    """Work of the normal impulses [J]; all of the work where there is no friction, or the solver does not tell."""
    if solution.impulse is None or not problem.has_friction:
        return work
    return float(0.5 * solution.impulse @ (problem.J @ (borne.ravel() + solution.v_post)))

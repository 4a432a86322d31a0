"""A scene of few bodies from impact to impact: free flight to the exact time of the next, then one multi-impact.

Nothing is rounded to a step: impacts that are simultaneous in a symmetric scene stay so, and the order of close ones is
theirs. All contacts that touch at the time of an impact belong to it, whether or not they approach.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from scenarios.world.checkpoint import Arrays, CheckpointError
from scenarios.world.container import Container
from scenarios.world.grid import find_contacts
from scenarios.world.impact import ByProblem, Constant, Impact, Resolver
from scenarios.world.spheres import Spheres
from scenarios.world.stepping import Ledger, StepReport, relative_gain
from solvers import ImpactProblem, ProblemError
from solvers.solution import Floats

# Bodies that touch and approach one another more slowly than this share of the largest speed are left by the last
# impact: solvers end at such a residual, and an impact that takes no time would follow for ever.
LEFT_OVER = 1e-9


class Flight(Protocol):
    """Bodies between two impacts."""

    @property
    def spheres(self) -> Spheres:
        """Where the bodies are and how they move."""
        ...

    @property
    def container(self) -> Container:
        """Walls around the bodies."""
        ...

    def time_to_impact(self) -> float:
        """Time until two bodies that approach one another touch [s]; inf if none will."""
        ...

    def advance(self, duration: float) -> None:
        """Fly freely for a time [s] that no impact interrupts."""
        ...

    def problem(self, restitution: float, friction: float) -> ImpactProblem:
        """The impact of all that touches now."""
        ...

    def take(self, v_post: Floats) -> None:
        """Go on with the velocity after that impact, shape (n,)."""
        ...

    def energies(self) -> tuple[float, float]:
        """Kinetic and potential energy [J]."""
        ...

    def state(self) -> Arrays:
        """All that changes."""
        ...

    def restore(self, state: Arrays) -> None:
        """Go on from such a state; other entries are ignored."""
        ...


class EventWorld:
    """A scene of few bodies in motion; one step is one multi-impact, and the flight before it.

    Args:
        identity: what scene this is, with all that its trajectory depends on.
        flight: the bodies.
        resolver: the law of the impacts, through an `ImpactProblem`.
        restitution: of all contacts, in [0, 1].
        friction: coefficient of all contacts, ≥ 0.
        period: time after which the scene would repeat in the ideal case [s]; inf if none.

    Raises:
        ProblemError: the resolver is one for scenes of many spheres.
    """

    def __init__(
        self, identity: str, flight: Flight, resolver: Resolver, *, restitution: float = 1.0, friction: float = 0.0,
        period: float = np.inf,
    ) -> None:  # fmt: skip
        if not isinstance(resolver, ByProblem):
            raise ProblemError("solver must be one of SOLVERS: the packed ones are for scenes of many spheres")
        self.identity = identity
        self.flight = flight
        self.solver = resolver.solver
        self.restitution = restitution
        self.friction = friction
        self.period = period
        self.steps = 0
        self.time = 0.0

    @property
    def spheres(self) -> Spheres:
        """Where the bodies are and how they move."""
        return self.flight.spheres

    @property
    def container(self) -> Container:
        """Walls around the bodies."""
        return self.flight.container

    @property
    def over(self) -> bool:
        """True where no further impact will come."""
        return self.flight.time_to_impact() == np.inf

    def step(self) -> StepReport:
        """Fly to the next impact and solve it.

        Raises:
            ProblemError: no further impact will come (see `over`).
            UnsupportedProblem: the solver refuses the impact.
        """
        self.time += self._fly()
        problem = self._touching()
        solution = self.solver.solve(problem)
        before, _ = self.flight.energies()
        normal = np.nan
        if solution.impulse is not None and problem.has_friction:
            normal = float(0.5 * solution.impulse @ (problem.u_pre + problem.J @ solution.v_post))
        self.flight.take(solution.v_post)
        kinetic, potential = self.flight.energies()
        impact = kinetic - before if np.isnan(normal) else normal
        self.steps += 1
        return StepReport(
            self.steps,
            self.time,
            problem.m,
            solution.status,
            solution.iterations,
            0,
            solution.residual,
            0.0,
            float(np.sqrt((self.spheres.velocity**2).sum(axis=1).max())),
            relative_gain(before, kinetic),
            Ledger(kinetic, potential, impact, kinetic - before - impact, 0.0, 0.0, 0.0),
        )

    def problem(self) -> ImpactProblem:
        """The impact that the next step will solve.

        Raises:
            ProblemError: no further impact will come (see `over`).
        """
        here = {name: array.copy() for name, array in self.flight.state().items()}
        self._fly()
        problem = self._touching()
        self.flight.restore(here)
        return problem

    def _fly(self) -> float:
        """Fly to the next impact; returns how long that took [s]."""
        wait = self.flight.time_to_impact()
        if not np.isfinite(wait):
            raise ProblemError("no further impact will come: the bodies fly apart")
        self.flight.advance(wait)
        return wait

    def _touching(self) -> ImpactProblem:
        return self.flight.problem(self.restitution, self.friction)

    def state(self) -> Arrays:
        """All that changes from impact to impact."""
        return {"steps": np.array(self.steps), "time": np.array(self.time), **self.flight.state()}

    def restore(self, state: Arrays) -> None:
        """Go on from a state of the same scene.

        Raises:
            CheckpointError: an array is missing or has another shape.
        """
        own = self.state()
        for name, array in own.items():
            if name not in state or state[name].shape != array.shape:
                raise CheckpointError(f"the checkpoint's {name} is missing or has another shape than this scene's")
        self.steps, self.time = int(state["steps"]), float(state["time"])
        self.flight.restore(state)


class FreeFlight:
    """Spheres without gravity: straight lines between impacts, with one another and with the walls."""

    def __init__(self, spheres: Spheres, container: Container) -> None:
        self._spheres = spheres
        self._container = container
        self._first, self._second = np.triu_indices(spheres.count, 1)
        self._reach = spheres.radius[self._first] + spheres.radius[self._second]

    @property
    def spheres(self) -> Spheres:
        """Where the bodies are and how they move."""
        return self._spheres

    @property
    def container(self) -> Container:
        """Walls around the spheres."""
        return self._container

    def time_to_impact(self) -> float:
        """Earliest time at which two spheres, or a sphere and a wall, that approach one another touch [s]."""
        x, v, radius = self._spheres.position, self._spheres.velocity, self._spheres.radius
        slow = LEFT_OVER * float(np.abs(v).max())
        offset, closing = x[self._second] - x[self._first], v[self._second] - v[self._first]
        times = [_time_to_touch(offset, closing, self._reach, slow)]
        for plane in self._container.planes:
            height, speed = x @ plane[:3] - plane[3] - radius, v @ plane[:3]
            falling = speed < -slow
            times.append(np.maximum(height[falling], 0.0) / -speed[falling])
        for cx, cy, wide in self._container.drums:
            times.append(_time_to_drum(x[:, :2] - (cx, cy), v[:, :2], wide - radius, slow))
        return float(np.concatenate(times).min(initial=np.inf))

    def advance(self, duration: float) -> None:
        """Fly along straight lines for a time [s]."""
        self._spheres.position[:] += duration * self._spheres.velocity

    def problem(self, restitution: float, friction: float) -> ImpactProblem:
        """The impact of all that touches now."""
        contacts = find_contacts(self._spheres.place, self._container)
        return Impact(contacts, self._spheres.motion, Constant(restitution), friction, self._spheres.label).problem()

    def take(self, v_post: Floats) -> None:
        """Go on with the velocity after an impact: three a sphere, six with spin."""
        blocks = v_post.reshape(self._spheres.count, -1)
        self._spheres.velocity[:] = blocks[:, :3]
        if blocks.shape[1] == 6:
            self._spheres.spin[:] = blocks[:, 3:]

    def energies(self) -> tuple[float, float]:
        """Kinetic energy [J]; no potential one."""
        return self._spheres.kinetic_energy(), 0.0

    def state(self) -> Arrays:
        """All that changes."""
        return {"place": self._spheres.place, "motion": self._spheres.motion}

    def restore(self, state: Arrays) -> None:
        """Go on from such a state; other entries are ignored."""
        self._spheres.place[:] = state["place"]
        self._spheres.motion[:] = state["motion"]


def _time_to_touch(offset: Floats, closing: Floats, reach: Floats, slow: float) -> Floats:
    """First root of |offset + closing t| = reach for pairs that approach; the others are left out."""
    a, b = (closing**2).sum(axis=1), (offset * closing).sum(axis=1)
    c = (offset**2).sum(axis=1) - reach**2
    square = b * b - a * c
    near = (b < -slow * reach) & (square > 0.0)
    # c over a sum of positive numbers: no cancellation for bodies that nearly touch. Below zero is rounding.
    times: Floats = np.maximum(c[near], 0.0) / (-b[near] + np.sqrt(square[near]))
    return times


def _time_to_drum(offset: Floats, velocity: Floats, room: Floats, slow: float) -> Floats:
    """Root of |offset + velocity t| = room for bodies inside that move outward, or will."""
    a, b = (velocity**2).sum(axis=1), (offset * velocity).sum(axis=1)
    c = np.minimum((offset**2).sum(axis=1) - room**2, 0.0)
    moving = a > slow * slow
    a, b, c = a[moving], b[moving], c[moving]
    root = np.sqrt(b * b - a * c)
    outward = b > slow * room[moving]
    times: Floats = np.where(outward, -c / np.where(outward, b + root, 1.0), (root - b) / a)
    return times

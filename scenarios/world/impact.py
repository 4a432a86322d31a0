"""The impact of one step: what touches, how fast, and the law's answer to it.

    u = n · (v_b - v_a),   t_k · (v_b - v_a - (s_a + s_b) × n)       rows of J and D; s = r ω

The same impact goes to any solver as an `ImpactProblem` (`ByProblem`), or, for many spheres, straight from the arrays
into QCE and the LCP with friction (`Streamed`): no sparse matrix, no copy of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from scenarios.contacts import tangents_of
from scenarios.world.grid import Contacts, Indices
from scenarios.world.spheres import INVERSE_INERTIA, Ints
from scenarios.world.warm_start import NO_IMPULSES, LastImpulses, labels_of
from solvers import ImpactProblem, Solver, Status
from solvers._jit import kernel
from solvers.buffers import Buffers
from solvers.qce_stream import solve_spheres
from solvers.solution import Floats
from solvers.sphere_rows import SphereRows
from solvers.spinning_spheres import SpinningRows, sweep_spheres


class Restitution(Protocol):
    """Coefficient of restitution as a function of the speed of an impact."""

    def of(self, speed: Floats) -> Floats:
        """c_r in [0, 1], shape (m,), for speeds ≥ 0 [m/s], shape (m,)."""
        ...


@dataclass(frozen=True)
class Constant:
    """The same for all impacts but the slowest."""

    value: float
    """c_r in [0, 1]."""

    resting: float = 0.0
    """Speed below which an impact is none and takes nothing back [m/s]: gravity's in a step, for what lies."""

    def of(self, speed: Floats) -> Floats:
        """c_r for speeds ≥ 0 [m/s], shape (m,)."""
        return np.where(speed < self.resting, 0.0, self.value)


@dataclass(frozen=True)
class SlowingRestitution:
    """e = max(1 - B v^(3/4), floor) (Bizon 1998)."""

    loss: float = 0.3
    """B, for speeds in units of √(gD)."""

    floor: float = 0.7
    """e from the speed on at which the curve reaches it."""

    def of(self, speed: Floats) -> Floats:
        """c_r for speeds ≥ 0 [m/s], shape (m,)."""
        root = np.sqrt(speed)
        return np.maximum(1.0 - self.loss * root * np.sqrt(root), self.floor)


@dataclass(frozen=True)
class Impact:
    """One step's impact."""

    contacts: Contacts
    motion: Floats
    """As `Spheres.motion`, shape (bodies + 1, 8): before the impact, and after it once it is resolved."""
    restitution: Restitution
    friction: float
    """Coefficient of friction of all contacts."""
    label: Ints
    """As `Spheres.label`, shape (bodies,)."""
    last: LastImpulses = NO_IMPULSES
    """Impulses of the step before."""
    buffers: Buffers = field(default_factory=Buffers)
    """Memory for what is formed of the contacts: one impact of its owner at a time."""

    @cached_property
    def u_pre(self) -> Floats:
        """Normal relative velocity before the impact [m/s], shape (m,)."""
        u = self.buffers.array("u_pre", (self.contacts.m,))
        _relative_velocity(self.contacts.normal, self.contacts.body, self.motion, u)
        return u

    def problem(self) -> ImpactProblem:
        """The impact for any solver: blocks v of three a sphere, with friction blocks (v, s) of six."""
        restitution = self.restitution.of(np.maximum(-self.u_pre, 0.0))
        normal = self.contacts.normal
        if self.friction == 0.0:
            inverse_mass = np.repeat(self.motion[:-1, 3], 3)
            return ImpactProblem(inverse_mass, self._rows(normal, normal), self.motion[:-1, :3].ravel(), restitution)
        along, across = tangents_of(normal)
        still = np.zeros_like(normal)
        J = self._rows(np.hstack([normal, still]), np.hstack([normal, still]))
        # -(s_a + s_b) × n along t is s · (t × n) for both bodies: -s · t₂ along t₁, s · t₁ along t₂.
        D = sp.vstack(
            [
                self._rows(np.hstack([along, -across]), np.hstack([along, across])),
                self._rows(np.hstack([across, along]), np.hstack([across, -along])),
            ],
            format="csr",
        )
        in_pairs = np.arange(2 * self.contacts.m).reshape(2, -1).T.ravel()
        weight = np.array([1.0, 1.0, 1.0, *[INVERSE_INERTIA] * 3])
        velocity = np.hstack([self.motion[:-1, :3], self.motion[:-1, 4:7]])
        inverse = (self.motion[:-1, 3, None] * weight).ravel()
        return ImpactProblem(inverse, J, velocity.ravel(), restitution, self.friction, D[in_pairs])

    def _rows(self, on_second: Floats, on_first: Floats) -> sp.csr_array:
        """Sparse rows from the blocks of the second body and, with a minus, of the first where that is movable."""
        m, block = on_second.shape
        bodies = len(self.motion) - 1
        first, second = self.contacts.body.astype(np.intp).T
        movable = np.flatnonzero(first < bodies)
        row = np.concatenate([np.arange(m), movable])
        body = np.concatenate([second, first[movable]])
        values = np.concatenate([on_second, -on_first[movable]])
        columns = body[:, None] * block + np.arange(block)
        return sp.csr_array((values.ravel(), (np.repeat(row, block), columns.ravel())), shape=(m, bodies * block))


@dataclass(frozen=True)
class Outcome:
    """What the law made of an impact, and what it cost."""

    status: Status
    iterations: int
    """Outer iterations of QCE, or those that the solver reports."""
    sweeps: int
    """Sweeps of the LCP with friction; 0 where the solver does not tell them apart."""
    residual: float
    """The law's own residual, relative to the largest |u_pre|."""
    normal_work: float
    """Work of the normal impulses [J], ≤ 0 but for rounding; NaN where the solver gives no impulses."""
    impulses: LastImpulses = NO_IMPULSES
    """What the next step may start from; none where the solver starts anew each time."""


class Resolver(Protocol):
    """A way to solve a step's impact."""

    def resolve(self, impact: Impact) -> Outcome:
        """Solve one impact; `impact.motion` becomes the velocities after it."""
        ...


@dataclass(frozen=True)
class ByProblem:
    """Any solver, through an `ImpactProblem`."""

    solver: Solver

    def resolve(self, impact: Impact) -> Outcome:
        """Solve one impact; `impact.motion` becomes the velocities after it.

        Raises:
            UnsupportedProblem: the solver's law does not apply.
        """
        problem = impact.problem()
        solution = self.solver.solve(problem)
        motion = impact.motion
        if impact.friction == 0.0:
            motion[:-1, :3] = solution.v_post.reshape(-1, 3)
        else:
            motion[:-1, :3], motion[:-1, 4:7] = np.hsplit(solution.v_post.reshape(-1, 6), 2)
        work = np.nan
        if solution.impulse is not None:
            work = float(0.5 * solution.impulse @ (problem.u_pre + problem.J @ solution.v_post))
        return Outcome(solution.status, solution.iterations, 0, solution.residual, work)


@dataclass(frozen=True)
class Streamed:
    """QCE-LCP with friction for many spheres, straight from the arrays (Zhang 2015, Eq. 19-21)."""

    max_sweeps: int = 10
    """Bound on sweeps of the LCP. Ten are the fast setting: not converged at impacts (see `residual`)."""

    tolerance: float = 1e-6
    """Natural-map residual of the LCP at which to stop, relative to the largest |u_pre|."""

    qce_tolerance: float = 1e-10
    """A contact approaches in the QCE step when u < -qce_tolerance times the largest |u_pre|."""

    max_iterations: int = 10_000
    """Bound on QCE's outer iterations."""

    def resolve(self, impact: Impact) -> Outcome:
        """Solve one impact; `impact.motion` becomes the velocities after it."""
        contacts, buffers = impact.contacts, impact.buffers
        speed = float(np.abs(impact.u_pre).max(initial=0.0))
        restitution = impact.restitution.of(np.maximum(-impact.u_pre, 0.0))
        start = buffers.array("start", (contacts.m, 3))
        # What lies: its impulses are those of the step before.
        lies = restitution == 0.0
        pair = labels_of(contacts, impact.label) if lies.any() else None
        start[:] = 0.0 if pair is None else impact.last.at(pair)
        prediction = _NO_PREDICTION
        if restitution.any():
            prediction = self._predict(impact, restitution, speed)
            # Exact for one contact without friction.
            elastic = 0.5 * (1.0 + restitution) * prediction.impulse
            np.copyto(start[:, 0], elastic, where=~lies)
            start[~lies, 1:] = 0.0
        result = sweep_spheres(
            SpinningRows(contacts.normal, contacts.body, impact.motion, contacts.stripe),
            restitution * prediction.u, start, friction=impact.friction, inertia=INVERSE_INERTIA,
            tolerance=self.tolerance * speed, max_sweeps=self.max_sweeps, buffers=buffers,
        )  # fmt: skip
        residual = result.residual / (speed or 1.0)
        status = prediction.status
        if status is Status.CONVERGED and residual > self.tolerance:
            status = Status.ITERATION_LIMIT
        impulses = NO_IMPULSES if pair is None else LastImpulses(pair, result.impulse)
        return Outcome(status, prediction.iterations, result.sweeps, residual, result.normal_work, impulses)

    def _predict(self, impact: Impact, restitution: Floats, speed: float) -> _Prediction:
        """QCE's answer. It has no part in an inelastic impact."""
        contacts, buffers = impact.contacts, impact.buffers
        threshold = self.qce_tolerance * speed
        V = buffers.array("V", (len(impact.motion), 4))
        V[:] = impact.motion[:, :4]
        rows = SphereRows(contacts.normal, contacts.body, V, _NO_CONTACTS, strip=contacts.stripe)
        impulse, iterations, _, flag = solve_spheres(
            rows, threshold=threshold, defer=0.0, max_iterations=self.max_iterations
        )
        u = buffers.array("u elastic", (contacts.m,))
        _relative_velocity(contacts.normal, contacts.body, V, u)
        status = Status.ITERATION_LIMIT if u.min(initial=0.0) < -threshold else Status.CONVERGED
        return _Prediction(impulse, u, iterations, Status.STALLED if flag else status)


@dataclass(frozen=True)
class _Prediction:
    """What QCE makes of an impact."""

    impulse: Floats | float
    """[N s], shape (m,)."""
    u: Floats | float
    """Normal relative velocity after it [m/s], shape (m,)."""
    iterations: int
    """Outer iterations."""
    status: Status


_NO_PREDICTION = _Prediction(0.0, 0.0, 0, Status.CONVERGED)
_NO_CONTACTS = np.zeros(0, dtype=np.int32)


@kernel
def _relative_velocity(normal: Floats, body: Indices, motion: Floats, u: Floats) -> None:
    """Normal relative velocity of each contact."""
    for i in range(normal.shape[0]):
        a = body[i, 0]
        b = body[i, 1]
        u[i] = (
            normal[i, 0] * (motion[b, 0] - motion[a, 0])
            + normal[i, 1] * (motion[b, 1] - motion[a, 1])
            + normal[i, 2] * (motion[b, 2] - motion[a, 2])
        )

"""The impact of one step: what touches, how fast, and the law's answer to it.

    u = n · (v_b - v_a),   t_k · (v_b - v_a - (s_a + s_b) × n)       rows of J and D; s = r ω

The same impact goes to any solver as an `ImpactProblem` (`ByProblem`), or, for many spheres, straight from the arrays
into QCE and the LCP with friction (`Streamed`): no sparse matrix, no copy of the scene.

A restitution e(v) that depends on the speed is known of collisions of two bodies. Where many contacts collide at once,
one whose bodies move alike beforehand has u_pre = 0 and is struck all the same as the wave goes by, more than once
where it bounces to and fro. QCE, in which nothing is lost, tells of each contact i

    b_i = ½ W_ii λ_i       its blow: the approach speed of the one collision of its two bodies with this impulse
    n_i = max(b_i / u_i, 1)    how many collisions in a row that takes, if each of them parts with u_i
    c_i = e(b_i / n_i)^n_i min(b_i / u_i, 1)

and c_i is the coefficient of restitution that the laws are given; u_i is QCE's velocity afterwards, 0 < u_i. A contact
that neighbors draw apart faster than it was struck gives back what it was struck with. Of one collision b = u = -u_pre,
so that c = e(-u_pre). `pytest -m long -s tests/test_landing.py` prints how layers land beside soft spheres: with
e(-u_pre) for all contacts the inner ones of a layer that lands lose too little unless the steps are so short that the
contacts collide one after the other; and waves stand on a layer that Bizon 1998 saw flat (where contacts that stick
give nothing back).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np
import scipy.sparse as sp

from scenarios.contacts import tangents_of
from scenarios.world.grid import Contacts, Indices
from scenarios.world.spheres import INVERSE_INERTIA, PARTS, Ints
from scenarios.world.warm_start import NO_IMPULSES, LastImpulses, labels_of
from solvers import ImpactProblem, Solver, Status
from solvers._jit import kernel, parallel_kernel, prange
from solvers.buffers import Buffers
from solvers.qce_stream import solve_spheres
from solvers.solution import Floats, ImpactSolution
from solvers.sphere_rows import SphereRows
from solvers.spinning_spheres import SpinningRows, sweep_spheres

# Factor of every other sweep's changes; relaxation by 2 and more never settles.
OVERSHOOT = 1.7
# A contact approaches in the QCE step when u < -QCE_TOLERANCE times the largest |u_pre|.
QCE_TOLERANCE = 1e-10
# Bound on QCE's outer iterations.
QCE_ITERATIONS = 10_000


class Restitution(Protocol):
    """Coefficient of restitution as a function of the speed of an impact."""

    by_blow: ClassVar[bool]
    """Whether the speed is that of the blow that a contact takes in the impact, or of the approach before it."""

    def of(self, speed: Floats) -> Floats:
        """c_r in [0, 1], shape (m,), for speeds ≥ 0 [m/s], shape (m,)."""
        ...


@dataclass(frozen=True)
class Constant:
    """The same for all impacts but the slowest."""

    by_blow: ClassVar[bool] = False
    value: float
    """c_r in [0, 1]."""

    resting: float = 0.0
    """Speed below which an impact is none and takes nothing back [m/s]: gravity's in a step, for what lies."""

    def of(self, speed: Floats) -> Floats:
        """c_r for speeds ≥ 0 [m/s], shape (m,)."""
        return np.where(speed < self.resting, 0.0, self.value)


@dataclass(frozen=True)
class SlowingRestitution:
    """e = max(1 - B v^(3/4), floor) of a collision of two bodies (Bizon 1998)."""

    by_blow: ClassVar[bool] = True
    loss: float = 0.3
    """B, for speeds in units of √(gD)."""

    floor: float = 0.7
    """e from the speed on at which the curve reaches it."""

    def of(self, speed: Floats) -> Floats:
        """c_r for speeds ≥ 0 [m/s], shape (m,)."""
        root = np.sqrt(speed)
        return np.maximum(1.0 - self.loss * root * np.sqrt(root), self.floor)


@dataclass(frozen=True)
class Elastic:
    """QCE's answer to an impact in which nothing is lost (Zhang 2015, Sec. 4)."""

    impulse: Floats
    """λ [N s], shape (m,)."""
    parting: Floats
    """Normal relative velocity after it [m/s], shape (m,)."""
    iterations: int
    stalled: bool


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
    tangential_restitution: float = 0.0
    """β₀ of all contacts that stick, in [0, 1] (see `solvers.spinning_spheres`)."""
    last: LastImpulses = NO_IMPULSES
    """Impulses of the step before."""
    buffers: Buffers = field(default_factory=Buffers)
    """Memory for what is formed of the contacts: one impact of its owner at a time."""

    @cached_property
    def u_pre(self) -> Floats:
        """Normal relative velocity before the impact [m/s], shape (m,)."""
        u = self.buffers.array("u_pre", (self.contacts.m,))
        _relative_velocity(self.contacts.normal, self.contacts.body, self.contacts.stripe, self.motion, u)
        return u

    @property
    def speed(self) -> float:
        """Largest |u_pre| [m/s]."""
        return float(max(self.u_pre.max(initial=0.0), -self.u_pre.min(initial=0.0)))

    @cached_property
    def elastic(self) -> Elastic:
        """QCE's answer, for velocities before the impact."""
        contacts = self.contacts
        V = self.buffers.array("V", (len(self.motion), 4))
        _without_spin(self.motion, V)
        rows = SphereRows(contacts.normal, contacts.body, V, _NO_CONTACTS, strip=contacts.stripe)
        impulse, iterations, _, flag = solve_spheres(
            rows, threshold=QCE_TOLERANCE * self.speed, defer=0.0, max_iterations=QCE_ITERATIONS
        )
        parting = self.buffers.array("parting", (contacts.m,))
        _relative_velocity(contacts.normal, contacts.body, contacts.stripe, V, parting)
        return Elastic(impulse, parting, iterations, bool(flag))

    @cached_property
    def coefficient(self) -> Floats:
        """Coefficient of restitution of each contact, shape (m,)."""
        contacts = self.contacts
        speed = self.buffers.array("speed", (contacts.m,))
        if not self.restitution.by_blow:
            np.negative(self.u_pre, out=speed)
            return self.restitution.of(np.maximum(speed, 0.0, out=speed))
        elastic, blow = self.elastic, self.buffers.array("blow", (contacts.m,))
        _blows(contacts.body, contacts.stripe, self.motion, elastic.impulse, elastic.parting, blow, speed)
        coefficient = self.restitution.of(speed)
        _repeat(contacts.stripe, blow, elastic.parting, coefficient)
        return coefficient

    @cached_property
    def pair(self) -> Ints | None:
        """Labels of the two bodies of each contact, shape (m, 2); None where nothing lies."""
        # A coefficient of a blow is zero where nothing parts, which is not to lie.
        lies = not self.restitution.by_blow and (self.coefficient == 0.0).any()
        return labels_of(self.contacts, self.label) if lies else None

    def guess(self) -> Floats | None:
        """First guess of λ, λ₁ and λ₂ [N s], shape (m, 3): what lies has the last step's impulses, the rest none.

        None where nothing lies.
        """
        if self.pair is None:
            return None
        return np.where(self.coefficient[:, None] == 0.0, self.last.at(self.pair), 0.0)

    def starts(self) -> dict[str, Floats]:
        """The guess by the names under which solvers take it: with it, a saved problem gives the step's bits again."""
        guess = self.guess()
        return {} if guess is None else {"start": guess[:, 0].copy(), "friction_start": guess[:, 1:].ravel()}

    def problem(self) -> ImpactProblem:
        """The impact for any solver: blocks v of three a sphere, with friction blocks (v, s) of six."""
        restitution = self.coefficient
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
        return ImpactProblem(
            inverse, J, velocity.ravel(), restitution, self.friction, D[in_pairs],
            tangential_restitution=self.tangential_restitution,
        )  # fmt: skip

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
        solve: Callable[..., ImpactSolution] = self.solver.solve
        takes = inspect.signature(solve).parameters
        solution = solve(problem, **{name: guess for name, guess in impact.starts().items() if name in takes})
        motion = impact.motion
        if impact.friction == 0.0:
            motion[:-1, :3] = solution.v_post.reshape(-1, 3)
        else:
            motion[:-1, :3], motion[:-1, 4:7] = np.hsplit(solution.v_post.reshape(-1, 6), 2)
        if solution.impulse is None:
            return Outcome(solution.status, solution.iterations, 0, solution.residual, np.nan)
        work = float(0.5 * solution.impulse @ (problem.u_pre + problem.J @ solution.v_post))
        impulses = NO_IMPULSES
        if impact.pair is not None:
            rub = np.zeros(2 * problem.m) if solution.friction_impulse is None else solution.friction_impulse
            impulses = LastImpulses(impact.pair, np.column_stack([solution.impulse, rub.reshape(-1, 2)]))
        return Outcome(solution.status, solution.iterations, 0, solution.residual, work, impulses)


@dataclass(frozen=True)
class Streamed:
    """QCE-LCP with friction for many spheres, straight from the arrays (Zhang 2015, Eq. 19-21)."""

    max_sweeps: int = 6
    """Bound on sweeps of the LCP, twice as many where something lies: those do not overshoot, as contacts that they
    part would be none in the next step. Six are the fast setting: not converged at impacts (see `residual`)."""

    tolerance: float = 1e-6
    """Natural-map residual of the LCP at which to stop, relative to the largest |u_pre|."""

    least_visits: int = 50_000
    """Contact visits before the bound on sweeps counts: few contacts are swept to the tolerance in no time."""

    def resolve(self, impact: Impact) -> Outcome:
        """Solve one impact; `impact.motion` becomes the velocities after it."""
        contacts, buffers = impact.contacts, impact.buffers
        speed, restitution, pair = impact.speed, impact.coefficient, impact.pair
        overshoot, max_sweeps = (OVERSHOOT, self.max_sweeps) if pair is None else (1.0, 2 * self.max_sweeps)
        max_sweeps = max(max_sweeps, self.least_visits // max(contacts.m, 1))
        start, target = buffers.array("start", (contacts.m,)), buffers.array("target", (contacts.m,))
        if restitution.any():
            iterations, status = _predict(impact, start, target)
        else:
            # QCE has no part in an inelastic impact.
            iterations, status = 0, Status.CONVERGED
            start[:], target[:] = 0.0, 0.0
        rub_start, guess = None, impact.guess()
        if guess is not None:
            start += guess[:, 0]
            rub_start = guess[:, 1:].copy()
        result = sweep_spheres(
            SpinningRows(contacts.normal, contacts.body, impact.motion, contacts.stripe),
            target, start, rub_start, friction=impact.friction, inertia=INVERSE_INERTIA,
            tolerance=self.tolerance * speed, max_sweeps=max_sweeps, overshoot=overshoot,
            tangential_restitution=impact.tangential_restitution, buffers=buffers,
        )  # fmt: skip
        residual = result.residual / (speed or 1.0)
        if status is Status.CONVERGED and residual > self.tolerance:
            status = Status.ITERATION_LIMIT
        impulses = NO_IMPULSES if pair is None else LastImpulses(pair, result.impulse)
        return Outcome(status, iterations, result.sweeps, residual, result.normal_work, impulses)


def _predict(impact: Impact, start: Floats, target: Floats) -> tuple[int, Status]:
    """Fill a first guess of λ and the velocity to reach with what QCE's answer says; returns its iterations."""
    elastic = impact.elastic
    _aim(impact.contacts.stripe, impact.coefficient, elastic.impulse, elastic.parting, start, target)
    if elastic.stalled:
        return elastic.iterations, Status.STALLED
    approaches = elastic.parting.min(initial=0.0) < -QCE_TOLERANCE * impact.speed
    return elastic.iterations, Status.ITERATION_LIMIT if approaches else Status.CONVERGED


_NO_CONTACTS = np.zeros(0, dtype=np.int32)


@kernel
def _relative_velocities(normal: Floats, body: Indices, motion: Floats, begin: int, end: int, u: Floats) -> None:
    """Normal relative velocity of some contacts."""
    # Unsigned: with a signed index these gathers are not vectorized, and cost several times as much.
    for i in range(np.uint64(begin), np.uint64(end)):
        a = body[i, 0]
        b = body[i, 1]
        u[i] = (
            normal[i, 0] * (motion[b, 0] - motion[a, 0])
            + normal[i, 1] * (motion[b, 1] - motion[a, 1])
            + normal[i, 2] * (motion[b, 2] - motion[a, 2])
        )


@parallel_kernel
def _relative_velocity(normal: Floats, body: Indices, stripe: Ints, motion: Floats, u: Floats) -> None:
    """Normal relative velocity of each contact."""
    for k in prange(stripe.size - 1):
        _relative_velocities(normal, body, motion, stripe[k], stripe[k + 1], u)


@parallel_kernel
def _without_spin(motion: Floats, V: Floats) -> None:
    """Velocity and inverse mass of each body."""
    bodies = motion.shape[0]
    for part in prange(PARTS):
        for b in range(bodies * part // PARTS, bodies * (part + 1) // PARTS):
            for column in range(4):
                V[b, column] = motion[b, column]


@parallel_kernel
def _blows(
    body: Indices, stripe: Ints, motion: Floats, impulse: Floats, parting: Floats, blow: Floats, speed: Floats
) -> None:
    """Fill b_i = ½ W_ii λ_i and the speed b_i / n_i of each collision of a blow [m/s], shape (m,)."""
    for k in prange(stripe.size - 1):
        for i in range(stripe[k], stripe[k + 1]):
            blow[i] = 0.5 * (motion[body[i, 0], 3] + motion[body[i, 1], 3]) * impulse[i]
            speed[i] = max(min(blow[i], parting[i]), 0.0)


@parallel_kernel
def _repeat(stripe: Ints, blow: Floats, parting: Floats, coefficient: Floats) -> None:
    """Make c_i of e(b_i / n_i), in place; 0 where nothing parts."""
    for k in prange(stripe.size - 1):
        for i in range(stripe[k], stripe[k + 1]):
            b = blow[i]
            u = parting[i]
            if b <= u:
                coefficient[i] *= b / u if u > 0.0 else 0.0
            else:
                coefficient[i] = coefficient[i] ** (b / u) if u > 0.0 else 0.0


@parallel_kernel
def _aim(stripe: Ints, coefficient: Floats, impulse: Floats, parting: Floats, start: Floats, target: Floats) -> None:
    """Fill the velocity to reach after QCE's answer, and a guess of λ."""
    for k in prange(stripe.size - 1):
        for i in range(stripe[k], stripe[k + 1]):
            e = coefficient[i]
            target[i] = e * parting[i]
            # (1 + e) / 2 is exact for one contact without friction; what lies has a guess of its own.
            start[i] = 0.5 * (1.0 + e) * impulse[i] if e > 0.0 else 0.0

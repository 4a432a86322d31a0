"""Rounds of explicit Hertz impulses on packed spheres: elastic, without friction, one step for all, any threads.

The law and its step are those of `solvers.explicit_hertz`. While gaps are remembered, or much presses, a step sweeps
over all contacts, lists those that press, and goes over the list once more for Rowlands' shift. Its length follows what
is left: a contact of approach speed V lasts V^((1-η)/(1+η)), and speeds fall with the root of the energy of approach
and of compression. The chunks of a parity (see `sphere_chunks`) run at the same time. Once gaps are forgotten and
little presses, only contacts of bodies that were pushed are looked at, on one thread.

Stiffness is taken out: with rows k^(1/(η+1)) n in place of n, compressions and impulses by contact are those of k = 1,
and the velocities of the bodies stay as they are. u, P and δ below are along these rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from solvers import _jit
from solvers._jit import alone, kernel, parallel_kernel, prange
from solvers.buffers import on_lines
from solvers.problem import ImpactProblem
from solvers.solution import Floats
from solvers.sphere_chunks import FOUR, ONE, THREE, TWO, Indices, Offsets, SphereChunks
from solvers.sphere_rows import Ints, SphereRows

# From this many contacts on, packing spheres costs less than it saves: a third of the time of the general rows on a
# pack of 364 contacts, a quarter on 3,030.
PACKED_CONTACTS = 300
# Contacts a body from which on they are a layer. In a chain few contacts press at a time, and a packed step looks at
# all: the general rows take a quarter of the time there.
LAYERED = 2
# Packed spheres share one step: the longest may be this many times the shortest.
PACKED_SPREAD = 4.0
# Blocks of chunks that threads share out; the same for any number of threads. They keep two threads busy. More would
# serve more, but a chunk at the end of a block is read twice a step.
BLOCKS = 4
# A pressing contact pushes two bodies, which take part in five others each: with fewer pressing than one in so many,
# contacts of pushed bodies are fewer than half of all.
SPARSE = 24
# What approach and compression hold, summed over contacts, in kinetic energies of bodies that all are the fastest: a
# sphere has twelve contacts at most, and moves at twice that speed beside a floor that moves. Beyond is no impact.
RUNAWAY = 100.0
NO_FRICTION = np.zeros(0)
# A gap that closes after a wait is zero to the rounding of that wait.
CLOSED = 1e-14


class Room(NamedTuple):
    """Memory of a round."""

    v: Floats
    """Velocity, and inverse mass of each body; shape of `Spheres.v_pre`."""

    dv: Floats
    """What the pushes of a step add to the velocities, beside the inverse masses; shape of `Spheres.v_pre`."""

    P: Floats
    """Impulse, shape (m,)."""

    compression: Floats
    """δ, shape (m,)."""

    pressing: Indices
    """Contacts that press, shape (m,)."""

    u_end: Floats
    """Relative velocity after the round, shape (m,)."""


@dataclass(frozen=True)
class Spheres:
    """Elastic contacts of spheres without spin, in units of velocity V and inverse mass w; kernels see flat arrays."""

    rows: SphereRows
    """The problem packed."""

    chunks: SphereChunks
    """Its contacts in chunks; the normals are not those of the kernels."""

    v_pre: Floats
    """Velocity, then inverse mass of each body; one immovable body a chunk at the end; shape (4 (bodies + chunks),)."""

    normal: Floats
    """k^(1/(η+1)) n, shape (3m,)."""

    scale: Floats | None
    """k^(1/(η+1)), shape (m,), 1 at the softest contact; None where all are 1."""

    highest_rate: float
    """Largest (W K W)_ii / W_ii."""

    inertia: float
    """Mass by which approach counts as energy: 1 over the mean rate."""

    @property
    def friction_rows(self) -> int:
        """Number of friction directions: there is no friction."""
        return 0

    def relative_velocity(self, v: Floats) -> Floats:
        """Relative velocities along the rows at a velocity of the bodies, shape (m,)."""
        run = _powers if self.chunks.is_shared else _powers_alone
        u = np.zeros(self.rows.contact.size)
        # Without impulses there is no energy to ask for.
        run(self.chunks.begin, self.normal, self.chunks.body, v, u, u, u)
        return u

    def outcome(self, v: Floats, v_end: Floats, u: Floats, P: Floats, P_t: Floats) -> tuple[Floats, float, float]:
        """Relative velocities after impulses that take u to them, and the energy of αP: α a + ½ α² b.

        Returns:
            Relative velocities, shape (m,), valid until the next call; a, b.
        """
        run = _powers if self.chunks.is_shared else _powers_alone
        u_end = self.room.u_end
        power = run(self.chunks.begin, self.normal, self.chunks.body, v_end, P, u, u_end)
        return u_end, float(power[:, 0].sum()), float(power[:, 1].sum())

    def in_problem_order(self, v: Floats, P: Floats, *, n: int, V: float, w: float) -> tuple[Floats, Floats]:
        """Velocity, shape (n,), and impulse, shape (m,), in the problem's order and units."""
        run = _in_problem_order if self.chunks.is_shared else _in_problem_order_alone
        P = P if self.scale is None else P * self.scale
        return run(v, P, self.rows.owner, self.rows.contact, n, V, V / w)

    @cached_property
    def room(self) -> Room:
        """Memory of a round, which the next one takes again: fresh memory costs more than what is written to it."""
        m = self.rows.contact.size
        v, dv = on_lines(self.v_pre.shape), on_lines(self.v_pre.shape)
        dv[:] = self.v_pre
        return Room(v, dv, np.empty(m), np.empty(m), np.empty(m, np.uint32), np.empty(m))

    def integrate(
        self, v: Floats, u: Floats, *, exponent: float, h: float, gap_memory: float, threshold: float, slowest: float,
        max_steps: int, max_visits: int,
    ) -> tuple[Floats, Floats, Floats, float, int, int, bool]:  # fmt: skip
        """One round from v, where the relative velocities are u; gap_memory = 1 remembers nothing.

        Returns:
            Velocity, impulse, friction impulse (none), energy that friction took (0), steps, contact visits, finished;
            the arrays are valid until the next round.
        """
        v_end, dv, P, compression, pressing = self.room[:5]
        v_end[:] = v
        P[:] = 0.0
        compression[:] = 0.0
        steps, visits, finished = 0, u.size, False
        if gap_memory < 1.0:
            _clear(0, dv.size // 4, dv)
            run = _sweep if self.chunks.is_shared else _sweep_alone
            steps, visits, finished, n_pressing, h = run(
                self.chunks.begin, self.chunks.bodies_of_chunk, self.normal, self.chunks.body, self.inertia, exponent,
                h, gap_memory, threshold, slowest, max_steps, max_visits, v_end, dv, P, compression, pressing,
            )  # fmt: skip
        else:
            n_pressing = _approaching(u, slowest, pressing)
        if not finished and n_pressing > 0:
            more, seen, finished = _follow(
                *self.chunks.contacts_of_body, self.normal, self.chunks.body, exponent, h, slowest, max_steps - steps,
                max_visits - visits, n_pressing, v_end, dv, P, compression, pressing,
            )  # fmt: skip
            steps += more
            visits += seen
        return v_end, P, NO_FRICTION, 0.0, steps, visits, finished


def spheres(problem: ImpactProblem, *, exponent: float, V: float, w: float) -> Spheres | None:
    """Pack an elastic problem in units of velocity V and inverse mass w; None where it has another form."""
    rows = problem.spheres_at_rest if problem.m >= PACKED_CONTACTS else None
    if rows is None or problem.m < LAYERED * (rows.owner.size - 1):
        return None
    chunks = rows.chunks
    pack = _in_packed_order if chunks.is_shared else _in_packed_order_alone
    v_pre = pack(problem.v_pre, rows.owner, chunks.at_rest, 1.0 / V, 1.0 / w)
    softest = float(problem.stiffness.min())
    # In units of the softest: no row is shorter than its normal, so that none approaches faster than its row says.
    if softest == problem.stiffness.max():
        scale, rates = None, chunks.rates_of_equals
    else:
        stiffness = problem.stiffness[rows.contact] / softest
        scale, rates = stiffness ** (1.0 / (exponent + 1.0)), chunks.rates(stiffness)
    if (rates.highest / rates.lowest) ** (1.0 / (exponent + 1.0)) > PACKED_SPREAD:
        return None
    normal = chunks.normal if scale is None else (rows.normal * scale[:, None]).reshape(-1)
    # A kernel is compiled for one kind of array.
    normal.flags.writeable = False
    return Spheres(rows, chunks, v_pre, normal, scale, rates.highest / w, w / rates.mean)


@parallel_kernel
def _in_packed_order(v: Floats, owner: Ints, at_rest: Floats, slowness: float, mass: float) -> Floats:
    """Velocities and inverse masses of packed bodies, times a slowness and a mass, laid out as the bodies at rest."""
    bodies = np.uint64(owner.size - 1)
    width = np.uint64(v.size) // bodies
    packed = np.zeros(at_rest.size)
    for k in prange(bodies):
        for axis in range(width):
            packed[FOUR * k + axis] = v[np.uint64(owner[k]) * width + axis] * slowness
        packed[FOUR * k + THREE] = at_rest[FOUR * k + THREE] * mass
    return packed


_in_packed_order_alone = alone(_in_packed_order)


@parallel_kernel
def _in_problem_order(
    v: Floats, P: Floats, owner: Ints, contact: Ints, n: int, speed: float, momentum: float
) -> tuple[Floats, Floats]:
    """Velocities times a speed, and impulses times a momentum, as the problem orders them."""
    bodies = np.uint64(owner.size - 1)
    width = np.uint64(n) // bodies
    velocity = np.empty(n)
    for k in prange(bodies):
        for axis in range(width):
            velocity[np.uint64(owner[k]) * width + axis] = speed * v[FOUR * k + axis]
    impulse = np.empty(P.size)
    for i in prange(np.uint64(P.size)):
        impulse[np.uint64(contact[i])] = momentum * P[i]
    return velocity, impulse


_in_problem_order_alone = alone(_in_problem_order)


@kernel
def _speed(normal: Floats, body: Indices, i: int | np.uint64, V: Floats) -> float:
    """Relative velocity n · (v_b - v_a) along row i."""
    return float(_jit.along(normal, THREE * i, V, body[TWO * i], body[TWO * i + ONE]))


@kernel
def _push(normal: Floats, body: Indices, i: np.uint64, kick: float, V: Floats) -> None:
    """Add what an impulse of contact i does to the velocities of its two bodies; their inverse masses stand in V."""
    _jit.move(normal, THREE * i, kick, V, body[TWO * i], body[TWO * i + ONE])


@parallel_kernel
def _powers(
    chunk: Offsets, normal: Floats, body: Indices, V: Floats, P: Floats, u: Floats, u_end: Floats
) -> Floats:  # fmt: skip
    """Fill in relative velocities at V; returns first and second order of the energy of P, shape (chunks, 2)."""
    power = np.empty((chunk.size - 1, 2))
    for c in prange(chunk.size - 1):
        power[c, 0], power[c, 1] = _powers_of_chunk(chunk[c], chunk[c + 1], normal, body, V, P, u, u_end)
    return power


_powers_alone = alone(_powers)


@kernel
def _powers_of_chunk(
    begin: np.uint64, end: np.uint64, normal: Floats, body: Indices, V: Floats, P: Floats, u: Floats, u_end: Floats
) -> tuple[float, float]:
    """Fill in a chunk's relative velocities, and sum.

    The sums keep the compiler from gathering by vectors, which processors guard against leaks at a cost.
    """
    a = 0.0
    b = 0.0
    for i in range(begin, end):
        u_end[i] = _speed(normal, body, i, V)
        a += P[i] * u[i]
        b += P[i] * (u_end[i] - u[i])
    return a, b


@kernel
def _force(compression: float, exponent: float) -> float:
    """Contact force δ^η of a δ ≥ 0; the two usual exponents go without the general power."""
    if exponent == 1.5:
        return float(compression * np.sqrt(compression))
    if exponent == 1.0:
        return compression
    return float(compression**exponent)


@kernel
def _shifted(
    normal: Floats, body: Indices, i: np.uint64, compression: float, h: float, exponent: float, dv: Floats
) -> float:
    """Impulse of a step by Rowlands' shift, where all impulses of the unshifted force add dv."""
    return h * _force(max(compression - h / 12.0 * _speed(normal, body, i, dv), 0.0), exponent)


@kernel
def _press(
    begin: np.uint64, end: np.uint64, normal: Floats, body: Indices, inertia: float,
    exponent: float, h: float, remembers: bool, slowest: float, V: Floats, compression: Floats, pressing: Indices,
    dv: Floats,
) -> tuple[float, np.uint64]:  # fmt: skip
    """Drift and unshifted push of a chunk; lists who presses. Returns the energy left there and the end of the list."""
    approach = 0.0
    count = np.uint64(begin)
    for i in range(begin, end):
        u = _speed(normal, body, i, V)
        deep = compression[i]
        if remembers:
            deep -= h * u
        else:
            # No branch: where gaps are forgotten, which contacts press is anybody's guess.
            deep = max(max(deep, 0.0) - h * u, 0.0) * ((deep > 0.0) | (u < -slowest))
        compression[i] = deep
        closing = min(u, 0.0)
        approach += closing * closing
        # No branch: which of them press is anybody's guess.
        pressing[count] = i
        count += np.uint64(deep > 0.0)
    stored = 0.0
    for c in range(begin, count):
        j = np.uint64(pressing[c])
        force = _force(compression[j], exponent)
        stored += force * compression[j]
        _push(normal, body, j, h * force, dv)
    return 0.5 * approach * inertia + stored / (exponent + 1.0), count


@kernel
def _shift(
    begin: np.uint64, end: np.uint64, normal: Floats, body: Indices, exponent: float, h: float,
    compression: Floats, pressing: Indices, dv: Floats, V: Floats, P: Floats,
) -> None:  # fmt: skip
    """Shifted pushes of the listed contacts."""
    for c in range(begin, end):
        i = np.uint64(pressing[c])
        kick = _shifted(normal, body, i, compression[i], h, exponent, dv)
        _push(normal, body, i, kick, V)
        P[i] += kick


@kernel
def _clear(begin: int | np.uint64, end: int | np.uint64, dv: Floats) -> None:
    """Zero the velocities of bodies begin to end; their inverse masses stay."""
    for k in range(np.uint64(4 * begin), np.uint64(min(4 * end, dv.size)), np.uint64(4)):
        dv[k] = 0.0
        dv[k + ONE] = 0.0
        dv[k + TWO] = 0.0


@kernel
def _close_next_gap(normal: Floats, body: Indices, V: Floats, threshold: float, compression: Floats) -> bool:
    """Nothing presses: let the time pass until the next gap closes; false where none does."""
    wait = np.inf
    for i in range(np.uint64(compression.size)):
        u = _speed(normal, body, i, V)
        if u < -threshold:
            wait = min(wait, max(compression[i] / u, 0.0))
    if wait == np.inf:
        return False
    for i in range(np.uint64(compression.size)):
        u = _speed(normal, body, i, V)
        compression[i] -= u * wait
        if abs(compression[i]) <= CLOSED * abs(u) * wait:
            compression[i] = 0.0
    return True


@parallel_kernel
def _sweep(
    chunk: Offsets, size: int, normal: Floats, body: Indices, inertia: float,
    exponent: float, shortest: float, gap_memory: float, threshold: float, slowest: float, max_steps: int,
    max_visits: int, V: Floats, dv: Floats, P: Floats, compression: Floats, pressing: Indices,
) -> tuple[int, int, bool, int, float]:  # fmt: skip
    """Steps over all contacts until gaps are forgotten and little presses; changes V, P, compression and pressing.

    Returns:
        Steps, contact visits, finished; how many contacts press and are listed, and the length of the next step.
    """
    m = P.size
    chunks = chunk.size - 1
    bodies = np.uint64(size)
    # Threads share blocks of chunks out. Of each, the last chunk presses first: it reaches into the next block. The
    # others follow in their order, and one pushes as soon as the next has pressed, while both are in the cache.
    blocks = min(BLOCKS, max(chunks // 2, 1))
    block = np.empty(blocks + 1, np.uint64)
    for b in range(blocks + 1):
        block[b] = b * chunks // blocks
    # Where the lists of the chunks end.
    end = chunk.copy()
    left_in = np.zeros(chunks)
    energy = _energy_at_most(V)
    growth = 0.5 * (exponent - 1.0) / (exponent + 1.0)
    h = shortest
    remembers = True
    peak = 0.0
    steps = 0
    visits = 0
    while steps < max_steps and visits < max_visits:
        steps += 1
        for b in prange(blocks):
            c = block[b + 1] - ONE
            left_in[c], end[c] = _press(
                chunk[c], chunk[c + ONE], normal, body, inertia, exponent, h, remembers, slowest,
                V, compression, pressing, dv,
            )  # fmt: skip
        for b in prange(blocks):
            for c in range(block[b], block[b + 1]):
                if c + ONE < block[b + 1]:
                    left_in[c], end[c] = _press(
                        chunk[c], chunk[c + ONE], normal, body, inertia, exponent, h, remembers, slowest,
                        V, compression, pressing, dv,
                    )  # fmt: skip
                if c > block[b]:
                    _shift(chunk[c - ONE], end[c - ONE], normal, body, exponent, h, compression, pressing, dv, V, P)
                    # The bodies that a block begins with are read by the last chunk before it.
                    if c - ONE > block[b] or b == 0:
                        _clear((c - ONE) * bodies, c * bodies, dv)
        for b in prange(blocks):
            c = block[b + 1] - ONE
            _shift(chunk[c], end[c], normal, body, exponent, h, compression, pressing, dv, V, P)
            _clear(c * bodies, (c + TWO) * bodies, dv)
        left = 0.0
        n_pressing = 0
        for c in range(chunks):
            left += left_in[c]
            n_pressing += int(end[c] - chunk[c])
        visits += m + n_pressing
        if not left <= RUNAWAY * energy:
            break
        if n_pressing == 0:
            if not remembers or not _close_next_gap(normal, body, V, threshold, compression):
                return steps, visits, True, 0, h
            visits += m
            continue
        if not remembers and SPARSE * n_pressing < m:
            n_pressing = 0
            for c in range(chunks):
                for q in range(chunk[c], end[c]):
                    pressing[n_pressing] = pressing[q]
                    n_pressing += 1
            return steps, visits, False, n_pressing, h
        peak = max(peak, left)
        h = shortest * (peak / left) ** growth
        remembers = remembers and left >= gap_memory * gap_memory * peak
    return steps, visits, False, 0, h


_sweep_alone = alone(_sweep)


@kernel
def _energy_at_most(V: Floats) -> float:
    """Kinetic energy if all movable bodies had the speed of the fastest body, whether that can be moved or not."""
    fastest = 0.0
    mass = 0.0
    for k in range(0, V.size, 4):
        fastest = max(fastest, V[k] * V[k] + V[k + 1] * V[k + 1] + V[k + 2] * V[k + 2])
        if V[k + 3] > 0.0:
            mass += 1.0 / V[k + 3]
    return 0.5 * mass * fastest


@kernel
def _approaching(u: Floats, slowest: float, contacts: Indices) -> int:
    """List contacts that approach faster than the slowest; returns how many."""
    count = 0
    for i in range(u.size):
        contacts[count] = i
        count += u[i] < -slowest
    return count


@kernel
def _follow(
    first: Indices, contact: Indices, normal: Floats, body: Indices,
    exponent: float, h: float, slowest: float, max_steps: int, max_visits: int, n_pressing: int,
    V: Floats, dv: Floats, P: Floats, compression: Floats, pressing: Indices,
) -> tuple[int, int, bool]:  # fmt: skip
    """Steps without gaps over the contacts of pushed bodies, until none presses; changes V, P and compression.

    Returns:
        Steps, contact visits, finished.
    """
    # Contacts to look at, and the bodies that those which press push; both are marked while they are listed.
    watched = np.empty(P.size, np.uint32)
    pushed = np.empty(first.size, np.uint32)
    seen = np.zeros(P.size, np.bool_)
    moved = np.zeros(first.size, np.bool_)
    bodies = np.uint64(first.size - 1)
    visits = 0
    for step in range(max_steps):
        if visits >= max_visits:
            return step, visits, False
        n_pushed = np.uint64(0)
        for c in range(np.uint64(n_pressing)):
            j = np.uint64(pressing[c])
            for side in range(np.uint64(2)):
                k = np.uint64(body[TWO * j + side]) >> TWO
                if k < bodies and not moved[k]:
                    moved[k] = True
                    pushed[n_pushed] = k
                    n_pushed += ONE
        n_watched = np.uint64(0)
        for c in range(n_pushed):
            k = np.uint64(pushed[c])
            moved[k] = False
            _clear(k, k + ONE, dv)
            for q in range(np.uint64(first[k]), np.uint64(first[k + ONE])):
                i = np.uint64(contact[q])
                if not seen[i]:
                    seen[i] = True
                    watched[n_watched] = i
                    n_watched += ONE
        n_pressing = 0
        for c in range(n_watched):
            j = np.uint64(watched[c])
            seen[j] = False
            u = _speed(normal, body, j, V)
            starts = (compression[j] > 0.0) | (u < -slowest)
            compression[j] = max(max(compression[j], 0.0) - h * u, 0.0) if starts else 0.0
            if compression[j] > 0.0:
                pressing[n_pressing] = j
                n_pressing += 1
                _push(normal, body, j, h * _force(compression[j], exponent), dv)
        visits += int(n_watched) + n_pressing
        if n_pressing == 0:
            return step + 1, visits, True
        for c in range(np.uint64(n_pressing)):
            j = np.uint64(pressing[c])
            kick = _shifted(normal, body, j, compression[j], h, exponent, dv)
            P[j] += kick
            _push(normal, body, j, kick, V)
    return max_steps, visits, False

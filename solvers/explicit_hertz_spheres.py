"""Rounds of explicit Hertz impulses on packed spheres: elastic, without friction, one step for all, any threads.

The law and its step are those of `solvers.explicit_hertz`. While gaps are remembered, or much presses, a step sweeps
over all contacts, lists those that press, and goes over the list once more for Rowlands' shift. Contacts are cut into
chunks such that those of one parity share no body: the chunks of a parity run at the same time, and what a body sums
up has one order whoever does it. Once gaps are forgotten and little presses, only contacts of bodies that were pushed
are looked at, on one thread.

Stiffness is taken out: with rows k^(1/(η+1)) n in place of n, compressions and impulses by contact are those of k = 1,
and the velocities of the bodies stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from solvers._jit import alone, kernel, parallel_kernel, prange
from solvers.problem import ImpactProblem
from solvers.solution import Floats
from solvers.sphere_rows import Indices, SphereRows, sphere_rows

# Unsigned as the indices of `sphere_rows`: no test for negative ones.
Offsets = npt.NDArray[np.uint64]

# From this many contacts on, packing spheres costs less than it saves: a third of the time of the general rows on a
# pack of 364 contacts, a quarter on 3,030.
PACKED_CONTACTS = 300
# Contacts a body from which on they are a layer. In a chain few contacts press at a time, and a packed step looks at
# all: the general rows take a quarter of the time there.
LAYERED = 2
# From this many contacts on sharing the work out pays: below it threads wait for one another most of the time.
SHARED_CONTACTS = 30_000
# Packed spheres share one step: the longest may be this many times the shortest.
PACKED_SPREAD = 4.0
# Chunks of contacts that threads share out; the same for any number of threads.
MOST_CHUNKS = 64
# A pressing contact pushes two bodies, which take part in five others each: with fewer pressing than one in so many,
# contacts of pushed bodies are fewer than half of all.
SPARSE = 24
# Numba makes a signed index of an unsigned one and a plain number, and tests it for being negative at every access.
ONE, TWO, THREE = np.uint64(1), np.uint64(2), np.uint64(3)
# A gap that closes after a wait is zero to the rounding of that wait.
CLOSED = 1e-14


@dataclass(frozen=True)
class Spheres:
    """Elastic contacts of spheres without spin, in units of the problem's own; kernels see flat, read-only arrays."""

    rows: SphereRows
    """The problem packed; its normals and bodies are not those of the kernels."""

    n: int
    """Velocities of the problem."""

    v_pre: Floats
    """Velocity of the bodies, then their inverse mass; one immovable body a chunk at the end; (bodies + chunks, 4)."""

    normal: Floats
    """k^(1/(η+1)) n, shape (3m,)."""

    body: Indices
    """Where the rows of bodies a and b begin in flat velocities, shape (2m,)."""

    scale: Floats
    """k^(1/(η+1)), shape (m,)."""

    rate: Floats
    """(W K W)_ii / W_ii, shape (m,)."""

    chunk: Offsets
    """Where the chunks of contacts begin, shape (chunks + 1,)."""

    bodies_of_chunk: int
    """Bodies whose contacts a chunk takes."""

    def relative_velocity(self, v: Floats) -> Floats:
        """Normal relative velocities at a velocity of the bodies, shape (m,)."""
        return _relative_velocity(self.normal, self.body, v.reshape(-1)) / self.scale

    def slip(self, v: Floats) -> Floats:
        """Nothing slips: there is no friction."""
        return np.zeros(0)

    def in_problem_order(self, v: Floats, P: Floats) -> tuple[Floats, Floats]:
        """Velocity, shape (n,), and impulse, shape (m,), as the problem orders them."""
        velocity = self.rows.velocity_in_problem_order(v[: self.rows.V.shape[0]], self.n)
        return velocity, self.rows.in_problem_order(P)

    @cached_property
    def contacts_of_body(self) -> tuple[Indices, Indices]:
        """Where the contacts of each movable body begin, shape (bodies + 1,), and these contacts."""
        return _contacts_of_body(self.body, self.v_pre.shape[0] - self.chunk.size + 1)

    def integrate(
        self, v: Floats, *, exponent: float, h: float, gap_memory: float, threshold: float, slowest: float,
        max_steps: int, max_visits: int,
    ) -> tuple[Floats, Floats, Floats, float, int, int, bool]:  # fmt: skip
        """One round from v; gap_memory = 1 remembers nothing.

        Returns:
            Velocity, impulse, friction impulse (none), energy that friction took (0), steps, contact visits, finished.
        """
        v = v.copy()
        V = v.reshape(-1)
        P = np.zeros(self.rate.size)
        compression = np.zeros(self.rate.size)
        steps, visits, finished = 0, 0, False
        if gap_memory < 1.0:
            sweep = _sweep if P.size >= SHARED_CONTACTS else _sweep_alone
            steps, visits, finished = sweep(
                self.chunk, self.bodies_of_chunk, self.normal, self.body, 1.0 / self.rate.mean(), exponent, h,
                gap_memory, threshold, slowest, max_steps, max_visits, V, P, compression,
            )  # fmt: skip
        if not finished:
            more, seen, finished = _follow(
                *self.contacts_of_body, self.normal, self.body, exponent, h, slowest, max_steps - steps,
                max_visits - visits, V, P, compression,
            )  # fmt: skip
            steps += more
            visits += seen
        return v, P * self.scale, np.zeros(0), 0.0, steps, visits, finished


def spheres(problem: ImpactProblem, stiffness: Floats, *, exponent: float, V: float, w: float) -> Spheres | None:
    """Pack an elastic problem in units of velocity V and inverse mass w; None where it has another form."""
    rows = sphere_rows(problem) if problem.m >= PACKED_CONTACTS else None
    if rows is None or problem.m < LAYERED * (rows.V.shape[0] - 1):
        return None
    bodies = rows.V.shape[0] - 1
    chunk, bodies_of_chunk = _chunks(rows.body, bodies)
    v_pre = np.zeros((bodies + chunk.size - 1, 4))
    v_pre[:bodies, :3] = rows.V[:-1, :3] / V
    v_pre[:bodies, 3] = rows.V[:-1, 3] / w
    # All are 1 where all are alike; a power costs as much as a sweep.
    alike = bool((stiffness == 1.0).all())
    stiffness = stiffness if alike else stiffness[rows.contact]
    scale = stiffness if alike else stiffness ** (1.0 / (exponent + 1.0))
    rate = _rates(rows.normal, rows.body, v_pre, stiffness)
    if (rate.max() / rate.min()) ** (1.0 / (exponent + 1.0)) > PACKED_SPREAD:
        return None
    # Threads must not push the floor together: it gets a number for each chunk.
    number = np.repeat(np.arange(bodies, bodies + chunk.size - 1, dtype=np.uint32), np.diff(chunk).astype(np.int64))
    body = np.uint32(4) * np.where(rows.body == bodies, number[:, None], rows.body)
    normal = rows.normal.view() if alike else rows.normal * scale[:, None]
    return Spheres(rows, problem.n, v_pre, _read_only(normal), _read_only(body), scale, rate, chunk, bodies_of_chunk)


Entry = TypeVar("Entry", np.float64, np.uint32)


def _read_only(array: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Flatten an array of this file and freeze it: a kernel is compiled for one kind of array."""
    flat = array.reshape(-1)
    flat.flags.writeable = False
    return flat


def _chunks(body: Indices, bodies: int) -> tuple[Offsets, int]:
    """Cut contacts, sorted by their lower-numbered body, so that a chunk reaches into the next one's bodies at most."""
    low = np.minimum(body[:, 0], body[:, 1])
    high = np.maximum(body[:, 0], body[:, 1])
    reach = int((high - low)[high < bodies].max(initial=1))
    if (low[1:] < low[:-1]).any():
        reach = bodies
    size = max(reach, -(-bodies // MOST_CHUNKS))
    count = -(-bodies // size)
    return np.searchsorted(low, size * np.arange(count + 1)).astype(np.uint64), size


@kernel
def _contacts_of_body(body: Indices, bodies: int) -> tuple[Indices, Indices]:
    """Where the contacts of each body begin, shape (bodies + 1,), and these contacts; others have none."""
    first = np.zeros(bodies + 2, np.uint32)
    for b in body:
        if b < 4 * bodies:
            first[(b >> 2) + 2] += 1
    for k in range(bodies):
        first[k + 2] += first[k + 1]
    contact = np.empty(first[bodies + 1], np.uint32)
    for q in range(body.size):
        k = body[q] >> 2
        if k < bodies:
            contact[first[k + 1]] = q >> 1
            first[k + 1] += 1
    return first[:-1], contact


@kernel
def _relative_velocity(normal: Floats, body: Indices, V: Floats) -> Floats:
    """Relative velocities n · (v_b - v_a) along the rows, shape (m,)."""
    u = np.empty(body.size // 2)
    for i in range(u.size):
        a, b = body[TWO * i], body[TWO * i + ONE]
        u[i] = (
            normal[THREE * i] * (V[b] - V[a]) + normal[THREE * i + ONE] * (V[b + ONE] - V[a + ONE])
            + normal[THREE * i + TWO] * (V[b + TWO] - V[a + TWO])
        )  # fmt: skip
    return u


@kernel
def _rates(normal: Floats, body: Indices, V: Floats, stiffness: Floats) -> Floats:
    """(W K W)_ii / W_ii by one tensor Σ k n nᵀ a body; between two bodies that meet once."""
    tensor = np.zeros((V.shape[0], 6))
    for i in range(body.shape[0]):
        n0, n1, n2, k = normal[i, 0], normal[i, 1], normal[i, 2], stiffness[i]
        for side in range(2):
            c = body[i, side]
            tensor[c, 0] += k * n0 * n0
            tensor[c, 1] += k * n1 * n1
            tensor[c, 2] += k * n2 * n2
            tensor[c, 3] += 2.0 * k * n0 * n1
            tensor[c, 4] += 2.0 * k * n0 * n2
            tensor[c, 5] += 2.0 * k * n1 * n2
    rate = np.empty(body.shape[0])
    for i in range(body.shape[0]):
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        square = n0 * n0 + n1 * n1 + n2 * n2
        total = 2.0 * V[body[i, 0], 3] * V[body[i, 1], 3] * stiffness[i] * square * square
        for side in range(2):
            c = body[i, side]
            inverse_mass = V[c, 3]
            total += inverse_mass * inverse_mass * (
                tensor[c, 0] * n0 * n0 + tensor[c, 1] * n1 * n1 + tensor[c, 2] * n2 * n2
                + tensor[c, 3] * n0 * n1 + tensor[c, 4] * n0 * n2 + tensor[c, 5] * n1 * n2
            )  # fmt: skip
        rate[i] = total / ((V[body[i, 0], 3] + V[body[i, 1], 3]) * square)
    return rate


@kernel
def _force(compression: float, exponent: float) -> float:
    """Contact force δ^η of a δ ≥ 0; the two usual exponents go without the general power."""
    if exponent == 1.5:
        return float(compression * np.sqrt(compression))
    if exponent == 1.0:
        return compression
    return float(compression**exponent)


@kernel
def _push(normal: Floats, body: Indices, i: np.uint64, kick: float, V: Floats) -> None:
    """Add what an impulse of contact i does to the velocities of its two bodies; their inverse masses stand in V."""
    a, b = body[TWO * i], body[TWO * i + ONE]
    n0, n1, n2 = normal[THREE * i], normal[THREE * i + ONE], normal[THREE * i + TWO]
    for_a = kick * V[a + THREE]
    for_b = kick * V[b + THREE]
    V[b] += for_b * n0
    V[b + ONE] += for_b * n1
    V[b + TWO] += for_b * n2
    V[a] -= for_a * n0
    V[a + ONE] -= for_a * n1
    V[a + TWO] -= for_a * n2


@kernel
def _shifted(
    normal: Floats, body: Indices, i: np.uint64, compression: float, h: float, exponent: float, dv: Floats
) -> float:
    """Impulse of a step by Rowlands' shift, where all impulses of the unshifted force add dv."""
    a, b = body[TWO * i], body[TWO * i + ONE]
    w = (
        normal[THREE * i] * (dv[b] - dv[a]) + normal[THREE * i + ONE] * (dv[b + ONE] - dv[a + ONE])
        + normal[THREE * i + TWO] * (dv[b + TWO] - dv[a + TWO])
    )  # fmt: skip
    return h * _force(max(compression - h / 12.0 * w, 0.0), exponent)


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
        a, b = body[TWO * i], body[TWO * i + ONE]
        u = (
            normal[THREE * i] * (V[b] - V[a]) + normal[THREE * i + ONE] * (V[b + ONE] - V[a + ONE])
            + normal[THREE * i + TWO] * (V[b + TWO] - V[a + TWO])
        )  # fmt: skip
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
        P[i] += kick
        _push(normal, body, i, kick, V)


@kernel
def _clear(begin: int, end: int, dv: Floats) -> None:
    """Zero the velocities of bodies begin to end; their inverse masses stay."""
    for k in range(np.uint64(4 * begin), np.uint64(min(4 * end, dv.size)), np.uint64(4)):
        dv[k] = 0.0
        dv[k + ONE] = 0.0
        dv[k + TWO] = 0.0


@kernel
def _close_next_gap(normal: Floats, body: Indices, V: Floats, threshold: float, compression: Floats) -> bool:
    """Nothing presses: let the time pass until the next gap closes; false where none does."""
    u = _relative_velocity(normal, body, V)
    wait = np.inf
    for i in range(u.size):
        if u[i] < -threshold:
            wait = min(wait, max(compression[i] / u[i], 0.0))
    if wait == np.inf:
        return False
    for i in range(u.size):
        compression[i] -= u[i] * wait
        if abs(compression[i]) <= CLOSED * abs(u[i]) * wait:
            compression[i] = 0.0
    return True


@parallel_kernel
def _sweep(
    chunk: Offsets, size: int, normal: Floats, body: Indices, inertia: float,
    exponent: float, h: float, gap_memory: float, threshold: float, slowest: float, max_steps: int, max_visits: int,
    V: Floats, P: Floats, compression: Floats,
) -> tuple[int, int, bool]:  # fmt: skip
    """Steps over all contacts until gaps are forgotten and little presses; changes V, P and compression.

    Returns:
        Steps, contact visits, finished.
    """
    m = P.size
    chunks = chunk.size - 1
    pressing = np.zeros(m, np.uint32)
    # What the unshifted pushes of a step add to V.
    dv = V.copy()
    _clear(0, dv.size // 4, dv)
    # Where the lists of the chunks end.
    end = chunk.copy()
    left_in = np.zeros(chunks)
    remembers = True
    peak = 0.0
    steps = 0
    visits = 0
    while steps < max_steps and visits < max_visits:
        steps += 1
        for parity in range(2):
            for half in prange((chunks + 1 - parity) // 2):
                c = 2 * half + parity
                left_in[c], end[c] = _press(
                    chunk[c], chunk[c + 1], normal, body, inertia, exponent, h, remembers, slowest,
                    V, compression, pressing, dv,
                )  # fmt: skip
        left = 0.0
        n_pressing = 0
        for c in range(chunks):
            left += left_in[c]
            n_pressing += int(end[c] - chunk[c])
        visits += m + n_pressing
        if n_pressing == 0 and remembers:
            if not _close_next_gap(normal, body, V, threshold, compression):
                return steps, visits, True
            visits += m
            continue
        for parity in range(2):
            for half in prange((chunks + 1 - parity) // 2):
                c = 2 * half + parity
                _shift(chunk[c], end[c], normal, body, exponent, h, compression, pressing, dv, V, P)
                # Chunks read the bodies of their own and of the next: the odd ones are the last to.
                if parity == 1:
                    _clear(c * size, (c + 2) * size, dv)
                elif c == 0:
                    _clear(0, size, dv)
        peak = max(peak, left)
        remembers = remembers and left >= gap_memory * gap_memory * peak
        if not remembers and SPARSE * n_pressing < m:
            break
    return steps, visits, False


_sweep_alone = alone(_sweep)


@kernel
def _follow(
    first: Indices, contact: Indices, normal: Floats, body: Indices,
    exponent: float, h: float, slowest: float, max_steps: int, max_visits: int,
    V: Floats, P: Floats, compression: Floats,
) -> tuple[int, int, bool]:  # fmt: skip
    """Steps without gaps over the contacts of pushed bodies, until none presses; changes V, P and compression.

    Returns:
        Steps, contact visits, finished.
    """
    m = P.size
    dv = V.copy()
    _clear(0, dv.size // 4, dv)
    # Contacts to look at, those of them that press, and the bodies that these push.
    watched = np.empty(m, np.uint32)
    pressing = np.empty(m, np.uint32)
    pushed = np.empty(first.size, np.uint32)
    seen = np.zeros(m, np.int32)
    moved = np.zeros(first.size, np.int32)
    u = _relative_velocity(normal, body, V)
    n_watched = 0
    for i in range(m):
        watched[n_watched] = i
        n_watched += (compression[i] > 0.0) | (u[i] < -slowest)
    visits = m
    for step in range(1, max_steps + 1):
        if visits >= max_visits:
            return step - 1, visits, False
        n_pressing = 0
        n_pushed = 0
        for c in range(n_watched):
            j = np.uint64(watched[c])
            a, b = body[TWO * j], body[TWO * j + ONE]
            u_i = (
                normal[THREE * j] * (V[b] - V[a]) + normal[THREE * j + ONE] * (V[b + ONE] - V[a + ONE])
                + normal[THREE * j + TWO] * (V[b + TWO] - V[a + TWO])
            )  # fmt: skip
            starts = (compression[j] > 0.0) | (u_i < -slowest)
            compression[j] = max(max(compression[j], 0.0) - h * u_i, 0.0) if starts else 0.0
            if compression[j] > 0.0:
                pressing[n_pressing] = j
                n_pressing += 1
                _push(normal, body, j, h * _force(compression[j], exponent), dv)
                for side in range(2):
                    k = body[TWO * j + np.uint64(side)] >> 2
                    if k + 1 < first.size and moved[k] != step:
                        moved[k] = step
                        pushed[n_pushed] = k
                        n_pushed += 1
        visits += n_watched + n_pressing
        if n_pressing == 0:
            return step, visits, True
        for c in range(n_pressing):
            j = np.uint64(pressing[c])
            kick = _shifted(normal, body, j, compression[j], h, exponent, dv)
            P[j] += kick
            _push(normal, body, j, kick, V)
        n_watched = 0
        for c in range(n_pushed):
            k = pushed[c]
            _clear(k, k + 1, dv)
            for q in range(first[k], first[k + 1]):
                i = contact[q]
                if seen[i] != step:
                    seen[i] = step
                    watched[n_watched] = i
                    n_watched += 1
    return max_steps, visits, False

"""Rounds of explicit Hertz impulses on packed spheres: elastic, without friction, one step for all, any threads.

The law and its step are those of `solvers.explicit_hertz`. A step sweeps over all contacts once, listing those that
press, and over the list twice (force, Rowlands' shift). Contacts are cut into chunks such that those of one parity
share no body: the chunks of a parity run at the same time, and what a body sums up has one order whoever does it.
"""

from __future__ import annotations

from dataclasses import dataclass

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
# A gap that closes after a wait is zero to the rounding of that wait.
CLOSED = 1e-14


@dataclass(frozen=True)
class Spheres:
    """Elastic contacts of spheres without spin, in units of the problem's own."""

    rows: SphereRows
    """Normals, bodies and velocities; every chunk of contacts has an immovable body of its own, at the end."""

    stiffness: Floats
    """Relative stiffness, shape (m,)."""

    rate: Floats
    """(W K W)_ii / W_ii, shape (m,)."""

    chunk: Offsets
    """Where the chunks of contacts begin, shape (chunks + 1,)."""

    bodies_of_chunk: int
    """Bodies whose contacts a chunk takes."""

    @property
    def v_pre(self) -> Floats:
        """Velocity of the bodies [m/s], and in the last column their inverse mass; shape (bodies + chunks, 4)."""
        return self.rows.V

    def relative_velocity(self, v: Floats) -> Floats:
        """Normal relative velocities at a velocity of the bodies, shape (m,)."""
        return _relative_velocity(self.rows.normal, self.rows.body, v)

    def slip(self, v: Floats) -> Floats:
        """Nothing slips: there is no friction."""
        return np.zeros(0)

    def integrate(
        self, v: Floats, *, exponent: float, h: float, gap_memory: float, threshold: float, slowest: float,
        max_steps: int, max_visits: int,
    ) -> tuple[Floats, Floats, Floats, float, int, int, bool]:  # fmt: skip
        """One round from v; gap_memory = 1 remembers nothing.

        Returns:
            Velocity, impulse, friction impulse (none), energy that friction took (0), steps, contact visits, finished.
        """
        v = v.copy()
        P = np.zeros(self.rate.size)
        run = _round if P.size >= SHARED_CONTACTS else _round_alone
        steps, visits, finished = run(
            self.chunk, self.bodies_of_chunk, self.rows.normal, self.rows.body, self.stiffness,
            self.stiffness / self.rate, exponent, h, gap_memory, threshold, slowest, max_steps, max_visits, v, P,
        )  # fmt: skip
        return v, P, np.zeros(0), 0.0, steps, visits, finished


def spheres(problem: ImpactProblem, stiffness: Floats, *, exponent: float, V: float, w: float) -> Spheres | None:
    """Pack an elastic problem in units of velocity V and inverse mass w; None where it has another form."""
    rows = sphere_rows(problem) if problem.m >= PACKED_CONTACTS else None
    if rows is None or problem.m < LAYERED * (rows.V.shape[0] - 1):
        return None
    rows.V[:, :3] /= V
    rows.V[:, 3] /= w
    stiffness = stiffness[rows.contact]
    rate = _rates(rows.normal, rows.body, rows.V, stiffness)
    if (rate.max() / rate.min()) ** (1.0 / (exponent + 1.0)) > PACKED_SPREAD:
        return None
    bodies = rows.V.shape[0] - 1
    chunk, bodies_of_chunk = _chunks(rows.body, bodies)
    # Threads must not push the floor together: it gets a number for each chunk.
    number = np.repeat(np.arange(bodies, bodies + chunk.size - 1, dtype=np.uint32), np.diff(chunk).astype(np.int64))
    body = np.where(rows.body == bodies, number[:, None], rows.body)
    floors = np.zeros((chunk.size - 2, 4))
    rows = SphereRows(rows.normal, body, np.vstack([rows.V, floors]), rows.contact)
    return Spheres(rows, stiffness, rate, chunk, bodies_of_chunk)


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
def _relative_velocity(normal: Floats, body: Indices, V: Floats) -> Floats:
    """Normal relative velocities n · (v_b - v_a), shape (m,)."""
    u = np.empty(body.shape[0])
    for i in range(u.size):
        a, b = body[i, 0], body[i, 1]
        u[i] = (
            normal[i, 0] * (V[b, 0] - V[a, 0]) + normal[i, 1] * (V[b, 1] - V[a, 1]) + normal[i, 2] * (V[b, 2] - V[a, 2])
        )
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
def _force(stiffness: float, compression: float, exponent: float) -> float:
    """Contact force k δ^η of a δ ≥ 0; the two usual exponents go without the general power."""
    if exponent == 1.5:
        return float(stiffness * compression * np.sqrt(compression))
    if exponent == 1.0:
        return stiffness * compression
    return float(stiffness * compression**exponent)


@kernel
def _scatter(body: Indices, normal: Floats, i: int, kick: float, push: Floats) -> None:
    """Add an impulse of contact i to what its two bodies are pushed with."""
    a, b = body[i, 0], body[i, 1]
    push[b, 0] += kick * normal[i, 0]
    push[b, 1] += kick * normal[i, 1]
    push[b, 2] += kick * normal[i, 2]
    push[a, 0] -= kick * normal[i, 0]
    push[a, 1] -= kick * normal[i, 1]
    push[a, 2] -= kick * normal[i, 2]


@kernel
def _press(
    begin: np.uint64, end: np.uint64, normal: Floats, body: Indices, stiffness: Floats, inertia: Floats,
    exponent: float, h: float, remembers: bool, slowest: float, V: Floats, compression: Floats, pressing: Indices,
    kick: Floats, push: Floats,
) -> tuple[float, np.uint64]:  # fmt: skip
    """Drift, force and push of a chunk; lists who presses. Returns the energy left there and the end of the list."""
    approach = 0.0
    count = np.uint64(begin)
    for i in range(begin, end):
        a, b = body[i, 0], body[i, 1]
        u = normal[i, 0] * (V[b, 0] - V[a, 0]) + normal[i, 1] * (V[b, 1] - V[a, 1]) + normal[i, 2] * (V[b, 2] - V[a, 2])
        deep = compression[i] - h * u
        if not remembers:
            deep = max(max(compression[i], 0.0) - h * u, 0.0) if (compression[i] > 0.0) | (u < -slowest) else 0.0
        compression[i] = deep
        closing = min(u, 0.0)
        approach += closing * closing * inertia[i]
        # No branch: which of them press is anybody's guess.
        pressing[count] = i
        count += np.uint64(deep > 0.0)
    stored = 0.0
    for c in range(begin, count):
        i = pressing[c]
        force = _force(stiffness[i], compression[i], exponent)
        stored += force * compression[i]
        kick[c] = h * force
        _scatter(body, normal, i, kick[c], push)
    return 0.5 * approach + stored / (exponent + 1.0), count


@kernel
def _shift(
    begin: np.uint64, end: np.uint64, normal: Floats, body: Indices, stiffness: Floats, exponent: float, h: float,
    V: Floats, compression: Floats, pressing: Indices, push: Floats, kick: Floats, P: Floats,
) -> None:  # fmt: skip
    """Rowlands' shift of the listed contacts: what is still to be added to their kicks."""
    for c in range(begin, end):
        i = pressing[c]
        a, b = body[i, 0], body[i, 1]
        w = (
            normal[i, 0] * (V[b, 3] * push[b, 0] - V[a, 3] * push[a, 0])
            + normal[i, 1] * (V[b, 3] * push[b, 1] - V[a, 3] * push[a, 1])
            + normal[i, 2] * (V[b, 3] * push[b, 2] - V[a, 3] * push[a, 2])
        )
        shifted = h * _force(stiffness[i], max(compression[i] - h / 12.0 * w, 0.0), exponent)
        P[i] += shifted
        kick[c] = shifted - kick[c]


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
def _round(
    chunk: Offsets, size: int, normal: Floats, body: Indices, stiffness: Floats, inertia: Floats,
    exponent: float, h: float, gap_memory: float, threshold: float, slowest: float, max_steps: int, max_visits: int,
    V: Floats, P: Floats,
) -> tuple[int, int, bool]:  # fmt: skip
    """One round; changes V and P. Returns steps, contact visits, finished."""
    m = body.shape[0]
    chunks = chunk.size - 1
    bodies = V.shape[0] - chunks
    compression = np.zeros(m)
    pressing = np.zeros(m, np.uint32)
    kick = np.zeros(m)
    push = np.zeros((V.shape[0], 4))
    # Where the lists of the chunks end.
    end = chunk.copy()
    # One chunk more at either side, without contacts, saves questions.
    pushes = np.zeros(chunks + 2, np.bool_)
    awake = np.ones(chunks, np.bool_)
    left_in = np.zeros(chunks)
    remembers = gap_memory < 1.0
    peak = 0.0
    steps = 0
    visits = 0
    while steps < max_steps and visits < max_visits:
        steps += 1
        for parity in range(2):
            for half in prange((chunks + 1 - parity) // 2):
                c = 2 * half + parity
                if awake[c]:
                    left_in[c], end[c] = _press(
                        chunk[c], chunk[c + 1], normal, body, stiffness, inertia, exponent, h, remembers, slowest,
                        V, compression, pressing, kick, push,
                    )  # fmt: skip
                    pushes[c + 1] = end[c] > chunk[c]
        left = 0.0
        n_pressing = 0
        for c in range(chunks):
            left += left_in[c]
            n_pressing += int(end[c] - chunk[c])
            if awake[c]:
                visits += int(chunk[c + 1] - chunk[c])
        visits += n_pressing
        if n_pressing == 0:
            if not (remembers and _close_next_gap(normal, body, V, threshold, compression)):
                return steps, visits, True
            visits += m
            continue
        for c in prange(chunks):
            _shift(
                chunk[c], end[c], normal, body, stiffness, exponent, h, V, compression, pressing, push, kick, P
            )  # fmt: skip
        for parity in range(2):
            for half in prange((chunks + 1 - parity) // 2):
                c = 2 * half + parity
                for place in range(chunk[c], end[c]):
                    _scatter(body, normal, pressing[place], kick[place], push)
        for c in prange(chunks):
            # The bodies of a chunk are pushed by its contacts and by those of the chunk before.
            if pushes[c] or pushes[c + 1]:
                for k in range(c * size, min((c + 1) * size, bodies)):
                    for axis in range(3):
                        V[k, axis] += V[k, 3] * push[k, axis]
                        push[k, axis] = 0.0
        if remembers:
            peak = max(peak, left)
            remembers = left >= gap_memory * gap_memory * peak
        else:
            # Without gaps, what nobody pushes stays as it is.
            for c in range(chunks):
                awake[c] = pushes[c] or pushes[c + 1] or pushes[c + 2]
    return steps, visits, False


_round_alone = alone(_round)

"""Rounds of explicit Hertz impulses on any sparse rows: local steps, restitution, friction.

The law is that of `solvers.explicit_hertz`. A contact i looks at its compression every 2^level steps, by the places x
that the velocities have reached; a velocity moves with the shortest step of the contacts that it takes part in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from solvers._jit import kernel
from solvers.problem import ImpactProblem, Matrix
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]

# A quotient of durations that is a power of two to rounding counts as that power.
LEVEL_ROUNDING = 1e-9
# Longest step in units of the shortest: 2^30 covers mass ratios to 1e18 for η = 1.
COARSEST = 30
# A gap that closes after a wait is zero to the rounding of that wait.
CLOSED = 1e-14
# What a contact owes of its energy of compression, relative to it, when its rounding is reached.
OWED = 1e-14
# A kick of friction comes in so many parts: each sees what the one before has done to the neighbors. On 128 spheres
# with friction 1/2 the rms velocity is 0.17, 0.10, 0.07 off with 2, 4, 8 parts, at 8 steps a contact.
RUBS = 4
# A sweep of settling pushes by so much of what brings a contact to rest at least; below 2 it contracts.
RELAXATION = 1.9


@dataclass(frozen=True)
class Rows:
    """A problem's contacts as sparse rows, in units of velocity V and inverse mass w."""

    problem: ImpactProblem
    """The impact."""

    w: float
    """Unit of inverse mass [1/kg]."""

    JM: Floats
    """Values of J M⁻¹ over w, shape (nonzeros,)."""

    DM: Floats
    """Values of D M⁻¹ over w, shape (nonzeros,)."""

    D: Matrix
    """Friction directions, shape (2m, n); zero rows without friction."""

    v_pre: Floats
    """Velocity before the impact over V, shape (n,)."""

    stiffness: Floats
    """Relative stiffness, shape (m,)."""

    rate: Floats
    """(W K W)_ii / W_ii over w, shape (m,)."""

    slip_bound: Floats
    """Σ_j ‖D_i M⁻¹ D_jᵀ‖ over w, shape (m,): no turn of the tangents or of the axes changes it."""

    @property
    def highest_rate(self) -> float:
        """Largest (W K W)_ii / W_ii over w."""
        return float(self.rate.max())

    @property
    def friction_rows(self) -> int:
        """Number of friction directions."""
        return int(self.D.shape[0])

    def relative_velocity(self, v: Floats) -> Floats:
        """Normal relative velocities at a velocity, shape (m,)."""
        J = self.problem.J
        return _product(J.indptr, J.indices, J.data, v)

    def outcome(self, v: Floats, v_end: Floats, u: Floats, P: Floats, P_t: Floats) -> tuple[Floats, float, float]:
        """Relative velocities after impulses that take v to v_end, and the energy of αP, αP_t: α a + ½ α² b.

        Returns:
            Relative velocities, shape (m,), a, b.
        """
        D = self.D
        slip, slip_end = (_product(D.indptr, D.indices, D.data, velocity) for velocity in (v, v_end))
        u_end = self.relative_velocity(v_end)
        return u_end, *_powers(P, u, u_end, P_t, slip, slip_end)

    def integrate(
        self, v: Floats, u: Floats, *, exponent: float, h: float, gap_memory: float, threshold: float, slowest: float,
        max_steps: int, max_visits: int,
    ) -> tuple[Floats, Floats, Floats, float, int, int, bool]:  # fmt: skip
        """One round from v, where the relative velocities are u, with the shortest step h; gap_memory = 1 has none.

        Returns:
            Velocity, impulse, friction impulse, energy that friction took, steps, contact visits, finished.
        """
        problem, J, D = self.problem, self.problem.J, self.D
        v = v.copy()
        P = np.zeros(u.size)
        P_t = np.zeros(self.friction_rows)
        rubbed, steps, visits, finished = _round(
            J.indptr, J.indices, J.data, problem.JM.indptr, problem.JM.indices, self.JM,
            D.indptr, D.indices, D.data, problem.DM.indptr, problem.DM.indices, self.DM,
            *_levels(J.indptr, J.indices, problem.JM.indptr, problem.JM.indices, problem.n, self.rate, exponent),
            self.stiffness, self.stiffness / self.rate,
            problem.restitution, problem.friction, self.slip_bound,
            exponent, h, gap_memory, threshold, slowest, max_steps, max_visits, v, P, P_t,
        )  # fmt: skip
        return v, P, P_t, rubbed, steps, visits, finished

    def settle(self, v: Floats, *, threshold: float, max_steps: int) -> tuple[Floats, Floats, int, bool]:
        """Bring every approach to rest without rebound: all contacts push at once against their own, again and again.

        A push is at most what W_i· allows, so that a sweep brings no two velocities further apart in the norm of M:
        rounding is not amplified, and no energy is gained.

        Returns:
            Velocity, impulse, sweeps, finished.
        """
        problem, J, JM = self.problem, self.problem.J, self.problem.JM
        v = v.copy()
        P = np.zeros(problem.m)
        push = RELAXATION * self.w / np.asarray(abs(problem.W).sum(axis=1))
        steps, finished = _settle(
            J.indptr, J.indices, J.data, JM.indptr, JM.indices, self.JM, push, threshold, max_steps, v, P
        )
        return v, P, steps, finished


def rows(problem: ImpactProblem, stiffness: Floats, *, V: float, w: float) -> Rows:
    """Take a problem's rows in units of velocity V and inverse mass w."""
    D = problem.DM if problem.D is None else problem.D
    # Sparse products take milliseconds: what nobody reads is not formed.
    slip_bound = _slip_bound(problem, D) if problem.has_friction else np.zeros(problem.m)
    rate = _rates(problem.W.indptr, problem.W.indices, problem.W.data, problem.W_diagonal, stiffness)
    return Rows(
        problem, w, problem.JM.data / w, problem.DM.data / w, D, problem.v_pre / V, stiffness, rate / w, slip_bound / w
    )


def _slip_bound(problem: ImpactProblem, D: Matrix) -> Floats:
    """Σ_j ‖D_i M⁻¹ D_jᵀ‖, shape (m,): the blocks of 2 × 2 by their norm."""
    blocks = sp.csr_array(problem.DM @ D.T).power(2)
    fold = sp.csr_array(sp.kron(sp.eye_array(problem.m), np.ones((1, 2))))
    return np.asarray(sp.csr_array(fold @ blocks @ fold.T).sqrt().sum(axis=1), dtype=np.float64)


@kernel
def _rates(W_start: Ints, W_index: Ints, W: Floats, W_diagonal: Floats, stiffness: Floats) -> Floats:
    """(W K W)_ii / W_ii, shape (m,)."""
    rate = np.empty(W_diagonal.size)
    for i in range(rate.size):
        total = 0.0
        for q in range(W_start[i], W_start[i + 1]):
            total += W[q] * W[q] * stiffness[W_index[q]]
        rate[i] = total / W_diagonal[i]
    return rate


@kernel
def _levels(
    J_start: Ints, J_index: Ints, JM_start: Ints, JM_index: Ints, n: int, rate: Floats, exponent: float
) -> tuple[Ints, Ints, Ints, Ints, Ints, Ints]:  # fmt: skip
    """Steps in powers of two: contacts and velocities sorted by level, 0 = shortest step; with counts up to a level."""
    fastest = rate.max()
    level = np.empty(rate.size, np.int32)
    for i in range(rate.size):
        octaves = np.floor(np.log2(fastest / rate[i]) / (exponent + 1.0) + LEVEL_ROUNDING)
        level[i] = min(octaves, COARSEST)
    top = level.max()
    of_velocity = np.full(n, top, np.int32)
    for i in range(rate.size):
        for q in range(J_start[i], J_start[i + 1]):
            of_velocity[J_index[q]] = min(of_velocity[J_index[q]], level[i])
        for q in range(JM_start[i], JM_start[i + 1]):
            of_velocity[JM_index[q]] = min(of_velocity[JM_index[q]], level[i])
    order, reached = _sorted(level, top)
    v_order, v_reached = _sorted(of_velocity, top)
    return level, order, reached, of_velocity, v_order, v_reached


@kernel
def _sorted(level: Ints, top: int) -> tuple[Ints, Ints]:
    """Indices in order of their level, and how many lie at each level or below."""
    reached = np.zeros(top + 2, np.int32)
    for k in level:
        reached[k + 1] += 1
    for k in range(top + 1):
        reached[k + 1] += reached[k]
    order = np.empty(level.size, np.int32)
    for i in range(level.size):
        order[reached[level[i]]] = i
        reached[level[i]] += 1
    return order, reached[:-1]


@kernel
def _product(start: Ints, index: Ints, value: Floats, v: Floats) -> Floats:
    """A sparse matrix times v; the library's own product takes ten times as long on a few rows."""
    product = np.empty(start.size - 1)
    for i in range(product.size):
        product[i] = _row_times(start, index, value, i, v)
    return product


@kernel
def _powers(P: Floats, u: Floats, u_end: Floats, P_t: Floats, slip: Floats, slip_end: Floats) -> tuple[float, float]:
    """First and second order of the energy of impulses αP, αP_t that take u to u_end at α = 1: α a + ½ α² b.

    On one thread: a library that shares out a sum of products sums differently on another machine.
    """
    a = 0.0
    b = 0.0
    for i in range(P.size):
        a += P[i] * u[i]
        b += P[i] * (u_end[i] - u[i])
    for i in range(P_t.size):
        a += P_t[i] * slip[i]
        b += P_t[i] * (slip_end[i] - slip[i])
    return a, b


@kernel
def _row_times(start: Ints, index: Ints, value: Floats, i: int, v: Floats) -> float:
    """Row i of a sparse matrix times v."""
    total = 0.0
    for q in range(start[i], start[i + 1]):
        total += value[q] * v[index[q]]
    return total


@kernel
def _add_row(start: Ints, index: Ints, value: Floats, i: int, p: float, v: Floats) -> None:
    """Add p times row i of a sparse matrix to v."""
    for q in range(start[i], start[i + 1]):
        v[index[q]] += p * value[q]


@kernel
def _force(stiffness: float, compression: float, exponent: float) -> float:
    """Contact force k max(δ, 0)^η; the two usual exponents go without the general power."""
    if compression <= 0.0:
        return 0.0
    if exponent == 1.5:
        return float(stiffness * compression * np.sqrt(compression))
    if exponent == 1.0:
        return stiffness * compression
    return float(stiffness * compression**exponent)


@kernel
def _drifted(deep: float, moved: float, square: float, slow: float, remembers: bool) -> float:
    """Compression after a drift; in expansion it is used up 1/e² times as fast, square = e²."""
    if deep > 0.0 and moved < 0.0:
        deep = deep + moved / square if square * deep > -moved else square * deep + moved
    elif deep > 0.0 and square == 0.0 and moved <= slow:
        # Nothing would come back, and a force of rounding size would push for ever.
        deep = 0.0
    elif deep > 0.0 or moved > slow:
        deep = deep + moved if remembers else max(deep, 0.0) + moved
    elif remembers:
        deep = min(deep + moved, 0.0)
    return deep if remembers else max(deep, 0.0)


@kernel
def _share_given_back(p: float, u: float, u_new: float, available: float) -> float:
    """Part of a kick p, which takes u to u_new linearly, at which the work given back in expansion is `available`."""
    rise = u_new - u
    if u_new <= 0.0 or p <= 0.0:
        return 1.0
    if u < 0.0:
        if p * u_new * u_new <= 2.0 * rise * available:
            return 1.0
        return float((-u + np.sqrt(2.0 * rise * max(available, 0.0) / p)) / rise)
    if p * (u + u_new) <= 2.0 * available:
        return 1.0
    if available <= 0.0:
        return 0.0
    return float(2.0 * available / p / (u + np.sqrt(max(u * u + 2.0 * rise * available / p, 0.0))))


@kernel
def _works(p: float, u: float, u_new: float) -> tuple[float, float]:
    """Work of compression and work given back of a kick p that takes u to u_new linearly; both ≥ 0."""
    if u <= 0.0 and u_new <= 0.0:
        return -0.5 * p * (u + u_new), 0.0
    if u >= 0.0 and u_new >= 0.0:
        return 0.0, 0.5 * p * (u + u_new)
    low, high = min(u, u_new), max(u, u_new)
    return 0.5 * p * low * low / (high - low), 0.5 * p * high * high / (high - low)


@kernel
def _rub(
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats,
    friction: Floats, slip_bound: Floats, pressing: Ints, n_pressing: int, kick: Floats, parts: int,
    slide: Floats, P_t: Floats, v: Floats,
) -> float:  # fmt: skip
    """So many parts of a kick of friction against the slip; returns the energy that they took.

    In each part all contacts see one velocity. The bound keeps them together from overshooting: λ_max of D M⁻¹ Dᵀ is at
    most the largest slip bound of what it couples, so that no part gains energy.
    """
    work = 0.0
    for part in range(parts + 1):
        for c in range(n_pressing):
            i = pressing[c]
            limit = friction[i] * kick[i] / RUBS
            if limit > 0.0 and slip_bound[i] > 0.0:
                s0 = _row_times(D_start, D_index, D, 2 * i, v)
                s1 = _row_times(D_start, D_index, D, 2 * i + 1, v)
                # The work of a push is the mean of what it meets before and after.
                if part > 0:
                    work -= 0.5 * (slide[2 * i] * s0 + slide[2 * i + 1] * s1)
                size = np.sqrt(s0 * s0 + s1 * s1)
                share = 1.0 / slip_bound[i] if size <= limit * slip_bound[i] else limit / size
                slide[2 * i] = -share * s0
                slide[2 * i + 1] = -share * s1
                if part < parts:
                    work -= 0.5 * (slide[2 * i] * s0 + slide[2 * i + 1] * s1)
        for c in range(n_pressing if part < parts else 0):
            i = pressing[c]
            if friction[i] * kick[i] > 0.0 and slip_bound[i] > 0.0:
                for r in (2 * i, 2 * i + 1):
                    _add_row(DM_start, DM_index, DM, r, slide[r], v)
                    P_t[r] += slide[r]
    return work


@kernel
def _next_closing(
    J_start: Ints, J_index: Ints, J: Floats, threshold: float, slowest: float, remembers: bool, v: Floats,
    compression: Floats, u: Floats,
) -> float:  # fmt: skip
    """Time until a contact presses, at this velocity; infinite where none will. Fills u."""
    wait = np.inf
    for i in range(u.size):
        u[i] = _row_times(J_start, J_index, J, i, v)
        if remembers and u[i] < -threshold:
            wait = min(wait, max(compression[i] / u[i], 0.0))
        elif not remembers and u[i] < -slowest:
            wait = 0.0
    return wait


@kernel
def _keep_ledger(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats, restitution: Floats,
    slowest: float, pressing: Ints, n_pressing: int, u: Floats, kick: Floats, back: Floats,
    v: Floats, compression: Floats, compressed: Floats, returned: Floats,
) -> None:  # fmt: skip
    """After the kicks that took u to v: no contact gives back more than its share of the work of compression."""
    for c in range(n_pressing):
        i = pressing[c]
        back[i] = 0.0
        if restitution[i] < 1.0:
            u_new = _row_times(J_start, J_index, J, i, v)
            gained, _ = _works(kick[i], u[i], u_new)
            available = restitution[i] * restitution[i] * (compressed[i] + gained) - returned[i]
            if available <= OWED * compressed[i]:
                # A speed of its rounding's root must not come of it.
                available = 0.0
            back[i] = (1.0 - _share_given_back(kick[i], u[i], u_new, available)) * kick[i]
    for c in range(n_pressing):
        i = pressing[c]
        if back[i] > 0.0:
            kick[i] -= back[i]
            _add_row(JM_start, JM_index, JM, i, -back[i], v)
    for c in range(n_pressing):
        i = pressing[c]
        u_new = _row_times(J_start, J_index, J, i, v)
        gained, given = _works(kick[i], u[i], u_new)
        compressed[i] += gained
        returned[i] += given
        # A contact that others still hold together keeps its compression, and pushes again at once.
        if back[i] > 0.0 and u_new >= -slowest:
            compression[i] = min(compression[i], 0.0)


@kernel
def _round(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats,
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats,
    level: Ints, order: Ints, reached: Ints, v_level: Ints, v_order: Ints, v_reached: Ints,
    stiffness: Floats, inertia: Floats, restitution: Floats, friction: Floats, slip_bound: Floats,
    exponent: float, h: float, gap_memory: float, threshold: float, slowest: float, max_steps: int, max_visits: int,
    v: Floats, P: Floats, P_t: Floats,
) -> tuple[float, int, int, bool]:  # fmt: skip
    """One round; changes v, P, P_t. Returns the energy that friction took, steps, contact visits, finished."""
    m = P.size
    top = reached.size - 1
    x = np.zeros(v.size)
    dv = np.zeros(v.size)
    place = np.zeros(m)
    compression = np.zeros(m)
    compressed = np.zeros(m)
    returned = np.zeros(m)
    u = np.zeros(m)
    kick = np.zeros(m)
    back = np.zeros(m)
    slide = np.zeros(2 * m)
    pressing = np.zeros(m, np.int32)
    lossy = False
    rubs = False
    for i in range(m):
        lossy = lossy or restitution[i] < 1.0
        rubs = rubs or friction[i] > 0.0
    # Half of the friction before the kicks and half after them leave an error of the energy of second order, not first.
    # Where a ledger may still cut the kicks, friction must wait for it.
    rubs_before = 0 if lossy or not rubs else RUBS // 2
    rubs_after = RUBS - rubs_before if rubs else 0
    remembers = gap_memory < 1.0
    fresh = True
    peak = 0.0
    rubbed = 0.0
    tick = 0
    steps = 0
    visits = 0
    while steps < max_steps and visits < max_visits:
        steps += 1
        reach = 0
        while reach < top and (tick >> reach) & 1 == 0:
            reach += 1
        # Where the contacts of this tick stand, and the force there.
        n_pressing = 0
        left = 0.0
        for c in range(reached[reach]):
            i = order[c]
            h_i = h * (1 << level[i])
            place_i = _row_times(J_start, J_index, J, i, x)
            moved = place[i] - place_i
            place[i] = place_i
            slow = h_i * (threshold if remembers else slowest)
            compression[i] = _drifted(compression[i], moved, restitution[i] * restitution[i], slow, remembers)
            if moved > 0.0:
                left += 0.5 * (moved / h_i) ** 2 * inertia[i]
            if compression[i] > 0.0:
                force = _force(stiffness[i], compression[i], exponent)
                left += force * compression[i] / (exponent + 1.0)
                kick[i] = h_i * force
                pressing[n_pressing] = i
                n_pressing += 1
                _add_row(JM_start, JM_index, JM, i, kick[i], dv)
        visits += reached[reach] + n_pressing
        # Rowlands' shift.
        for c in range(n_pressing):
            i = pressing[c]
            h_i = h * (1 << level[i])
            shift = _row_times(J_start, J_index, J, i, dv)
            kick[i] = h_i * _force(stiffness[i], compression[i] - h_i / 12.0 * shift, exponent)
        for c in range(n_pressing):
            for q in range(JM_start[pressing[c]], JM_start[pressing[c] + 1]):
                dv[JM_index[q]] = 0.0
        if lossy:
            # What an ended contact still owes.
            for c in range(reached[reach]):
                i = order[c]
                owed = restitution[i] * restitution[i] * compressed[i] - returned[i]
                if compression[i] <= 0.0 and owed > OWED * compressed[i]:
                    u_i = _row_times(J_start, J_index, J, i, v)
                    if u_i > 0.0:
                        kick[i] = 2.0 * owed / (u_i + np.sqrt(u_i * u_i + 2.0 / inertia[i] * owed))
                        pressing[n_pressing] = i
                        n_pressing += 1
        if reach == top and not fresh:
            if n_pressing == 0:
                wait = _next_closing(J_start, J_index, J, threshold, slowest, remembers, v, compression, u)
                visits += m
                if wait == np.inf:
                    return rubbed, steps, visits, True
                if remembers:
                    for i in range(m):
                        compression[i] -= u[i] * wait
                        if abs(compression[i]) <= CLOSED * abs(u[i]) * wait:
                            compression[i] = 0.0
                tick = 0
            if not np.isfinite(left):
                return rubbed, steps, visits, False
            peak = max(peak, left)
            remembers = remembers and left >= gap_memory * gap_memory * peak
        fresh = fresh and reach != top
        if rubs_before > 0:
            rubbed += _rub(
                D_start, D_index, D, DM_start, DM_index, DM, friction, slip_bound, pressing, n_pressing, kick,
                rubs_before, slide, P_t, v,
            )  # fmt: skip
        if lossy:
            for c in range(n_pressing):
                u[pressing[c]] = _row_times(J_start, J_index, J, pressing[c], v)
        for c in range(n_pressing):
            _add_row(JM_start, JM_index, JM, pressing[c], kick[pressing[c]], v)
        if lossy:
            _keep_ledger(
                J_start, J_index, J, JM_start, JM_index, JM, restitution, slowest, pressing, n_pressing,
                u, kick, back, v, compression, compressed, returned,
            )  # fmt: skip
            visits += 3 * n_pressing
        for c in range(n_pressing):
            P[pressing[c]] += kick[pressing[c]]
        if rubs_after > 0:
            rubbed += _rub(
                D_start, D_index, D, DM_start, DM_index, DM, friction, slip_bound, pressing, n_pressing, kick,
                rubs_after, slide, P_t, v,
            )  # fmt: skip
        for c in range(v_reached[reach]):
            d = v_order[c]
            x[d] += h * (1 << v_level[d]) * v[d]
        tick += 1
    return rubbed, steps, visits, False


@kernel
def _settle(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats, push: Floats,
    threshold: float, max_steps: int, v: Floats, P: Floats,
) -> tuple[int, bool]:  # fmt: skip
    """Sweeps of pushes against what approaches until none does; changes v and P. Returns sweeps, finished."""
    kick = np.zeros(P.size)
    for sweep in range(max_steps):
        fastest = 0.0
        for i in range(P.size):
            u = _row_times(J_start, J_index, J, i, v)
            kick[i] = push[i] * max(-u, 0.0)
            fastest = max(fastest, -u)
        if fastest <= threshold:
            return sweep, True
        for i in range(P.size):
            if kick[i] > 0.0:
                P[i] += kick[i]
                _add_row(JM_start, JM_index, JM, i, kick[i], v)
    return max_steps, False

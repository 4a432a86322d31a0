"""Explicit Hertz impulses (EHI): the compression of all contacts at once, in frozen geometry, in the impact's own time.

    dv/dt = M⁻¹ Jᵀ F,    F_i = k_i max(δ_i, 0)^η,    dδ_i/dt = -u_i,    λ_i = ∫ F_i dt

This is the law of Liu 2008 (LZB) with time instead of impulse as its clock: E_i = k_i δ_i^(η+1)/(η+1) is the energy
stored, dE_i = -u_i dλ_i, and dλ_i/dt = F_i gives dλ_j/dλ_i = (k_j/k_i)^(1/(η+1)) (E_j/E_i)^(η/(η+1)), LZB's ratio. In
time a contact that starts needs no special rule, and a gap can be remembered. Only ratios of stiffness matter.

Step. δ drifts with the velocities, all contacts push from the same δ. Leapfrog pushes with h F(δ); here the force is
taken a little further along (Rowlands 1991), a second pass over the pressing contacts alone:

    w = J M⁻¹ Jᵀ h F(δ),    P = h F(δ - h w/12),    v += M⁻¹ Jᵀ P,    δ -= h u

That removes leapfrog's error of order h² where the motion is smooth, as an impact starts and ends free of forces; what
is left comes from the starts and ends of contacts, where δ^η is not smooth. h is a part 1/steps_per_contact of the
contact of a pair of approach speed V = max(-u), duration c δ_max/V, δ_max = ((η+1) V²/(2 r))^(1/(η+1)), with r_i =
(W K W)_ii / W_ii in place of k_i W_ii: for one pair the same, for N equal contacts on one body N times as much.
Steps are local, in powers of two: a contact pushes at the rate that its own r_i asks for, a body moves at the rate of
its fastest contact (impulse multiple time stepping, Tuckerman 1992).

Gaps. An opened contact must close its gap before it presses again; time in which nothing presses is skipped. When the
energy of approach and of compression has fallen to gap_memory² of its peak, the gaps are forgotten: open contacts
count as touching, and only contacts that press or approach are visited further. The measure knows no clock, no unit
and no moving frame. gap_memory = 0 remembers to the end.

Energy (c_r = 1). λ = αP, α = -2 P·u⁻ / P·(u - u⁻), restores K exactly; α is one number ≥ 0, so it keeps λ ≥ 0, the
momenta and every symmetry. It may leave contacts approaching by |α - 1| of their speed, and the slowest were left out:
the law is then applied again, without gap memory, to what it left, a round on a clock set by the new V, until
min u ≥ -tolerance. Each round conserves K, and leaves at most a thousandth of its V or |α - 1| of it.

Restitution (c_r < 1): energetic, bi-stiffness (Stronge 1990): in expansion δ is used up 1/c_r² times as fast. A ledger
of the work of compression C_i and the work given back R_i, exact for every push, ends each contact at R_i = c_r² C_i,
within the push or by one more. Friction: P_t opposes the slip with |P_t| ≤ μ P over both directions (Coulomb's cone,
which lies within the pyramid), and never reverses it: P_t is at most slip / Σ_j ‖D_i M⁻¹ D_jᵀ‖, half of it before the
push and half after. Both use one step for all contacts.

Limits. Frozen geometry, no tangential compliance; sticking takes several pushes, so that it is softer on bodies with
many contacts. α spreads an energy error over all contacts of a round. Switching the gaps off moves with the data by a
whole step: with gap_memory > 0 the answer can jump by about gap_memory times what is left. Where contacts squeeze a
body from both sides nothing need end (Gordan), and max_steps does. Many contacts with c_r = 0 settle slowly.

Tried and left: leapfrog (dense layers, kick, 12 sweeps a contact: rms error 0.021, Rowlands 0.004), two unequal drifts
(McLachlan: worse at equal cost), explicit multistep (Störmer of order 3 and 4: α - 1 up to 4e-2), a shift by the own
W_ii F_i alone (no better than leapfrog).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel, parallel_kernel, prange
from solvers.compression import pair_duration
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status

Ints = npt.NDArray[np.int32]

# δ - h²/12 W F: the one coefficient that removes the h² error of leapfrog (Rowlands 1991); any other does worse.
SHIFT = 1.0 / 12.0
# Without gap memory, an approach slower than this part of the round's fastest waits for the next round, whose clock
# is set by what is left: a contact lasts u^(-1/5) for η = 3/2, and the last ones would take most of the steps.
WAIT = 1e-3
# The energy correction is a small one, 1e-3 at the default step; a round that needs more is run again at half the step.
LARGEST_CORRECTION = 0.05
# So far at most is the step refined.
FINEST = 2.0**-4
# A quotient of durations that is a power of two to rounding counts as that power.
LEVEL_ROUNDING = 1e-9
# Longest step in units of the shortest: 2^30 covers mass ratios to 1e18 for η = 1.
COARSEST = 30
# A gap that closes after a wait is zero to the rounding of that wait.
CLOSED = 1e-14
# What a contact owes of its energy of compression, relative to it, when its rounding is reached.
OWED = 1e-14
# From this many contacts on, packing spheres and starting threads costs less than it saves.
PACKED_CONTACTS = 10_000
# Packed spheres share one step: the longest may be this many times the shortest.
PACKED_SPREAD = 4.0
# The kernel stops at this part of the tolerance, so that the rounding of the recomputed velocity stays within it.
MARGIN = 0.5
# Chunks of contacts that threads share out; the same for any number of threads.
MOST_CHUNKS = 64
# Below this share of pressing contacts, visiting those next to pushed bodies alone is faster than sweeping over all.
FEW = 0.02


@dataclass(frozen=True)
class ExplicitHertz:
    """Hertz contacts in frozen geometry, integrated explicitly in the units of one impact."""

    steps_per_contact: float = 8.0
    """Steps within the contact of a pair, or of the stiffest contact together with what it touches; > 2."""

    exponent: float = 1.5
    """η of the contact force k δ^η, ≥ 1: 3/2 is Hertz, 1 a linear spring. Dimensionless."""

    gap_memory: float = 0.01
    """Gaps are forgotten when the speeds of approach that are left fall to this part of their peak; 0 = never."""

    tolerance: float = 1e-10
    """A contact approaches when u < -tolerance times the largest |u_pre|; dimensionless."""

    max_steps: int = 1_000_000
    """Bound on the shortest steps."""

    def __post_init__(self) -> None:
        if not self.steps_per_contact >= 2.0:
            raise ValueError(f"steps_per_contact must be ≥ 2, not {self.steps_per_contact}")
        if not self.exponent >= 1.0:
            raise ValueError(f"exponent must be ≥ 1, not {self.exponent}")
        if not 0.0 <= self.gap_memory < 1.0:
            raise ValueError(f"gap_memory must lie in [0, 1), not {self.gap_memory}")

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact of any restitution and friction."""
        V = -float(problem.u_pre.min(initial=0.0))
        if self.tolerance * problem.speed >= V:
            return _solution(problem, self.tolerance, np.zeros(problem.m), None, 0, problem.m, True)
        # Out with the units: speeds by the fastest approach, W by its largest diagonal entry, k by its mean.
        w = float(problem.W_diagonal.max())
        stiffness = problem.stiffness / math.exp(float(np.log(problem.stiffness).mean()))
        threshold = MARGIN * self.tolerance * problem.speed / V
        elastic = bool(problem.restitution.min() == 1.0)
        if not elastic or problem.has_friction:
            return self._solve_dissipative(problem, V, w, stiffness, threshold, elastic)
        if problem.m >= PACKED_CONTACTS:
            solution = self._solve_spheres(problem, V, w, stiffness, threshold)
            if solution is not None:
                return solution
        J, JM = problem.J, problem.JM
        impulse, steps, visits, finished = _elastic(
            J.indptr, J.indices, J.data, JM.indptr, JM.indices, JM.data / w, problem.v_pre / V, stiffness,
            self.exponent, self._duration(), self.gap_memory, threshold, self.max_steps,
        )  # fmt: skip
        return _solution(problem, self.tolerance, impulse * (V / w), None, steps, visits, finished)

    def _duration(self) -> float:
        """Step of a contact of rate 1 at unit speed."""
        a = 1.0 / (self.exponent + 1.0)
        duration: float = pair_duration(self.exponent) * (0.5 * (self.exponent + 1.0)) ** a / self.steps_per_contact
        return duration

    def _solve_dissipative(
        self, problem: ImpactProblem, V: float, w: float, stiffness: Floats, threshold: float, elastic: bool
    ) -> ImpactSolution:
        """Restitution below 1, or friction."""
        J, JM, DM = problem.J, problem.JM, problem.DM
        D = DM if problem.D is None else problem.D
        impulse, friction_impulse, steps, visits, finished = _dissipative(
            J.indptr, J.indices, J.data, JM.indptr, JM.indices, JM.data / w,
            D.indptr, D.indices, D.data, DM.indptr, DM.indices, DM.data / w,
            problem.v_pre / V, stiffness, problem.restitution, problem.friction, elastic,
            self.exponent, self._duration(), self.gap_memory, threshold, self.max_steps,
        )  # fmt: skip
        rubbing = friction_impulse * (V / w) if problem.has_friction else None
        return _solution(problem, self.tolerance, impulse * (V / w), rubbing, steps, visits, finished)

    def _solve_spheres(
        self, problem: ImpactProblem, V: float, w: float, stiffness: Floats, threshold: float
    ) -> ImpactSolution | None:
        """Many elastic contacts of spheres without spin, on several threads; None where they are something else."""
        J, M = problem.J, problem.inverse_mass
        fits, first, second, normal, inverse_mass, start, entry, order, body_order = _spheres(
            J.indptr, J.indices, J.data, M.indptr, M.indices, M.data
        )
        if not fits:
            return None
        inverse_mass /= w
        stiffness = stiffness[order]
        rate = _sphere_rates(first, second, normal, inverse_mass, start, entry, stiffness)
        if (rate.max() / rate.min()) ** (1.0 / (self.exponent + 1.0)) > PACKED_SPREAD:
            return None
        sorted_impulse, steps, visits, finished = _elastic_spheres(
            first, second, normal, inverse_mass, start, entry, stiffness, stiffness / rate,
            problem.v_pre / V, body_order,
            float(rate.max()), self.exponent, self._duration(), self.gap_memory, threshold, self.max_steps,
        )  # fmt: skip
        impulse = np.empty(problem.m)
        impulse[order] = sorted_impulse * (V / w)
        return _solution(problem, self.tolerance, impulse, None, steps, visits, finished)


def _solution(
    problem: ImpactProblem, tolerance: float, impulse: Floats, friction_impulse: Floats | None,
    steps: int, visits: int, finished: bool,
) -> ImpactSolution:  # fmt: skip
    """Judge a run by the velocity that its impulse gives."""
    v = problem.v_after(impulse, friction_impulse)
    u_min = float((problem.J @ v).min(initial=0.0))
    if not np.isfinite(v).all():
        status = Status.NOT_FINITE
    elif not finished:
        status = Status.ITERATION_LIMIT
    elif u_min < -tolerance * problem.speed:
        # The kernel's velocity passed the test; impulses that cancel (large mass ratios) leave their rounding here.
        status = Status.STALLED
    else:
        status = Status.CONVERGED
    residual = -u_min / (problem.speed or 1.0)
    return ImpactSolution(impulse, v, status, steps, visits, residual, friction_impulse)


@kernel
def _force(stiffness: float, compression: float, exponent: float) -> float:
    """Force k max(δ, 0)^η; square roots where they do, a power costs ten times as much."""
    deep = max(compression, 0.0)
    if exponent == 1.5:
        return float(stiffness * deep * np.sqrt(deep))
    if exponent == 1.0:
        return stiffness * deep
    return float(stiffness * deep**exponent)


@kernel
def _rates(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats, stiffness: Floats, n: int
) -> Floats:
    """(W K W)_ii / W_ii: what all contacts together add to the stiffness that contact i feels; needs no W."""
    m = J_start.size - 1
    # Jᵀ by counting.
    start = np.zeros(n + 1, np.int32)
    for q in range(J_start[m]):
        start[J_index[q] + 1] += 1
    for d in range(n):
        start[d + 1] += start[d]
    contact = np.zeros(J_start[m], np.int32)
    value = np.zeros(J_start[m])
    place = start[:n].copy()
    for i in range(m):
        for q in range(J_start[i], J_start[i + 1]):
            d = J_index[q]
            contact[place[d]] = i
            value[place[d]] = J[q]
            place[d] += 1
    rate = np.zeros(m)
    row = np.zeros(m)
    mark = np.full(m, -1, np.int32)
    touched = np.zeros(m, np.int32)
    for i in range(m):
        count = 0
        for p in range(JM_start[i], JM_start[i + 1]):
            d = JM_index[p]
            for q in range(start[d], start[d + 1]):
                j = contact[q]
                if mark[j] != i:
                    mark[j] = i
                    row[j] = 0.0
                    touched[count] = j
                    count += 1
                row[j] += JM[p] * value[q]
        total = 0.0
        for c in range(count):
            total += stiffness[touched[c]] * row[touched[c]] ** 2
        rate[i] = total / row[i]
    return rate


@kernel
def _levels(
    J_start: Ints, J_index: Ints, JM_start: Ints, JM_index: Ints, rate: Floats, exponent: float, n: int
) -> tuple[Ints, Ints, Ints, Ints, Ints, Ints]:
    """Steps in powers of two: contacts and velocities sorted by level, 0 = shortest step; with counts up to a level.

    A velocity moves with the shortest step of the contacts that it takes part in.
    """
    m = J_start.size - 1
    rate_max = 0.0
    for i in range(m):
        rate_max = max(rate_max, rate[i])
    level = np.zeros(m, np.int32)
    top = 0
    for i in range(m):
        octaves = np.log2(rate_max / rate[i]) / (exponent + 1.0)
        level[i] = min(int(np.floor(octaves + LEVEL_ROUNDING)), COARSEST)
        top = max(top, level[i])
    velocity_level = np.full(n, top, np.int32)
    for i in range(m):
        for q in range(J_start[i], J_start[i + 1]):
            velocity_level[J_index[q]] = min(velocity_level[J_index[q]], level[i])
        for q in range(JM_start[i], JM_start[i + 1]):
            velocity_level[JM_index[q]] = min(velocity_level[JM_index[q]], level[i])
    order, count = _sorted(level, top)
    velocity_order, velocity_count = _sorted(velocity_level, top)
    return level, order, count, velocity_level, velocity_order, velocity_count


@kernel
def _sorted(level: Ints, top: int) -> tuple[Ints, Ints]:
    """Indices in order of their level, and how many lie at each level or below."""
    count = np.zeros(top + 1, np.int32)
    for i in range(level.size):
        count[level[i]] += 1
    for c in range(top):
        count[c + 1] += count[c]
    place = np.zeros(top + 1, np.int32)
    for c in range(top):
        place[c + 1] = count[c]
    order = np.zeros(level.size, np.int32)
    for i in range(level.size):
        order[place[level[i]]] = i
        place[level[i]] += 1
    return order, count


@kernel
def _work(P: Floats, u_begin: Floats, u: Floats) -> tuple[float, float]:
    """P·u⁻ and P·(u - u⁻): impulses αP change the kinetic energy by α times the first and α²/2 times the second."""
    work = 0.0
    square = 0.0
    for i in range(P.size):
        work += P[i] * u_begin[i]
        square += P[i] * (u[i] - u_begin[i])
    return work, square


@kernel
def _elastic(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats,
    v_pre: Floats, stiffness: Floats, exponent: float,
    duration: float, gap_memory: float, threshold: float, max_steps: int,
) -> tuple[Floats, int, int, bool]:  # fmt: skip
    """Rounds of the law with local steps; returns impulse, steps, contact visits, finished.

    `duration`: step of a contact with rate 1 at unit speed.
    """
    m = J_start.size - 1
    n = v_pre.size
    rate = _rates(J_start, J_index, J, JM_start, JM_index, JM, stiffness, n)
    level, order, count, v_level, v_order, v_count = _levels(J_start, J_index, JM_start, JM_index, rate, exponent, n)
    top = count.size - 1
    rate_max = 0.0
    for i in range(m):
        rate_max = max(rate_max, rate[i])
    v = v_pre.copy()
    v_begin = v_pre.copy()
    u_begin = np.zeros(m)
    x = np.zeros(n)
    dv = np.zeros(n)
    place = np.zeros(m)
    compression = np.zeros(m)
    impulse = np.zeros(m)
    P = np.zeros(m)
    pressing = np.zeros(m, np.int32)
    P_quiet = np.zeros(m)
    v_quiet = np.zeros(n)
    kick = np.zeros(m)
    refinement = 1.0
    first = True
    steps = 0
    visits = 0
    while True:
        # A round: everything touches, the fastest approach sets the clock.
        V = 0.0
        for i in range(m):
            u_i = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                u_i += J[q] * v[J_index[q]]
            u_begin[i] = u_i
            V = max(V, -u_i)
            compression[i] = 0.0
            place[i] = 0.0
            P[i] = 0.0
        visits += m
        if threshold >= V:
            return impulse, steps, visits, True
        for d in range(n):
            v_begin[d] = v[d]
            x[d] = 0.0
        slowest = max(WAIT * V, threshold)
        h = refinement * duration * rate_max ** (-1.0 / (exponent + 1.0)) * V ** ((1.0 - exponent) / (1.0 + exponent))
        initial = first
        remembers = first
        first = False
        fresh = True
        peak = 0.0
        tick = 0
        finished = False
        quiet = False
        while steps < max_steps:
            reach = 0
            while reach < top and (tick >> reach) & 1 == 0:
                reach += 1
            steps += 1
            # Where the contacts of this tick stand, and the force there.
            n_pressing = 0
            left = 0.0
            for c in range(count[reach]):
                i = order[c]
                h_i = h * (1 << level[i])
                place_i = 0.0
                for q in range(J_start[i], J_start[i + 1]):
                    place_i += J[q] * x[J_index[q]]
                moved = place[i] - place_i
                place[i] = place_i
                if remembers:
                    touched = compression[i] <= 0.0 and moved <= threshold * h_i
                    compression[i] = min(compression[i] + moved, 0.0) if touched else compression[i] + moved
                elif compression[i] > 0.0 or moved > slowest * h_i:
                    compression[i] = max(compression[i] + moved, 0.0)
                if moved > 0.0:
                    left += 0.5 * (moved / h_i) ** 2 * stiffness[i] / rate[i]
                if compression[i] > 0.0:
                    kick[i] = h_i * _force(stiffness[i], compression[i], exponent)
                    left += kick[i] * compression[i] / (h_i * (exponent + 1.0))
                    pressing[n_pressing] = i
                    n_pressing += 1
                    for q in range(JM_start[i], JM_start[i + 1]):
                        dv[JM_index[q]] += JM[q] * kick[i]
            visits += count[reach] + n_pressing
            if reach == top:
                if n_pressing == 0 and not fresh:
                    # Nothing presses: the round ends, or goes on at once with the next gap that closes.
                    wait = np.inf
                    for i in range(m):
                        u_i = 0.0
                        for q in range(J_start[i], J_start[i + 1]):
                            u_i += J[q] * v[J_index[q]]
                        kick[i] = u_i
                        if remembers:
                            if u_i < -threshold:
                                wait = min(wait, max(compression[i] / u_i, 0.0))
                        elif u_i < -slowest:
                            wait = 0.0
                    visits += m
                    if wait == np.inf:
                        finished = True
                        break
                    if remembers and steps > max_steps // 2:
                        # What to return if the bound comes first: a moment at which no energy is stored.
                        work, square = _work(P, u_begin, kick)
                        if abs(work + 0.5 * square) <= 0.5 * LARGEST_CORRECTION * square:
                            P_quiet[:] = P
                            v_quiet[:] = v
                            quiet = True
                    if remembers:
                        for i in range(m):
                            compression[i] -= kick[i] * wait
                            if abs(compression[i]) <= CLOSED * abs(kick[i]) * wait:
                                compression[i] = 0.0
                    tick = 0
                peak = max(peak, left)
                if remembers and left < gap_memory * gap_memory * peak and not fresh:
                    remembers = False
                    for i in range(m):
                        compression[i] = max(compression[i], 0.0)
                fresh = False
            # Rowlands' shift, then the kick.
            for c in range(n_pressing):
                i = pressing[c]
                shift = 0.0
                for q in range(J_start[i], J_start[i + 1]):
                    shift += J[q] * dv[J_index[q]]
                h_i = h * (1 << level[i])
                kick[i] = h_i * _force(stiffness[i], compression[i] - SHIFT * h_i * shift, exponent)
                P[i] += kick[i]
            for c in range(n_pressing):
                i = pressing[c]
                for q in range(JM_start[i], JM_start[i + 1]):
                    dv[JM_index[q]] = 0.0
                    v[JM_index[q]] += JM[q] * kick[i]
            for c in range(v_count[reach]):
                d = v_order[c]
                x[d] += h * (1 << v_level[d]) * v[d]
            tick += 1
        if not finished and quiet:
            P[:] = P_quiet
            v[:] = v_quiet
        # The energy of the round, exactly.
        for i in range(m):
            kick[i] = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                kick[i] += J[q] * v[J_index[q]]
        work, square = _work(P, u_begin, kick)
        scale = 1.0
        if square > 0.0:
            scale = -2.0 * work / square
        if not abs(scale - 1.0) <= LARGEST_CORRECTION and finished and refinement > FINEST:
            refinement *= 0.5
            first = initial
            for d in range(n):
                v[d] = v_begin[d]
            continue
        if not (finished or abs(scale - 1.0) <= LARGEST_CORRECTION):
            # Stopped in mid-contact: this round is not applied.
            scale = 0.0
        scale = max(scale, 0.0)
        for i in range(m):
            impulse[i] += scale * P[i]
        for d in range(n):
            v[d] = v_begin[d] + scale * (v[d] - v_begin[d])
        if not finished:
            return impulse, steps, visits, False


@kernel
def _spheres(
    J_start: Ints, J_index: Ints, J: Floats, M_start: Ints, M_index: Ints, M: Floats
) -> tuple[bool, Ints, Ints, Floats, Floats, Ints, Ints, Ints, Ints]:
    """Read spheres without spin off the sparse rows: bodies, normals, inverse masses, contacts by body.

    Returns false first where a contact has another form, or where two bodies meet twice. The body of number `bodies`
    stands for everything immovable.
    """
    m = J_start.size - 1
    bodies = (M_start.size - 1) // 3
    inverse_mass = np.zeros(bodies + 1)
    start = np.zeros(1, np.int32)
    first = np.full(m, bodies, np.int32)
    second = np.full(m, bodies, np.int32)
    normal = np.zeros((m, 3))
    fits = 3 * bodies == M_start.size - 1
    for d in range(3 * bodies):
        for q in range(M_start[d], M_start[d + 1]):
            fits = fits and M_index[q] == d
            inverse_mass[d // 3] = M[q]
    for d in range(3 * bodies):
        held = 0.0
        for q in range(M_start[d], M_start[d + 1]):
            held = M[q]
        fits = fits and held == inverse_mass[d // 3]
    if not fits:
        return False, first, second, normal, inverse_mass, start, start, start, start
    opposite = np.zeros(3)
    for i in range(m):
        opposite[:] = 0.0
        for q in range(J_start[i + 1] - 1, J_start[i] - 1, -1):
            body = J_index[q] // 3
            axis = J_index[q] % 3
            if second[i] == bodies or second[i] == body:
                second[i] = body
                normal[i, axis] = J[q]
            elif first[i] == bodies or first[i] == body:
                first[i] = body
                opposite[axis] = J[q]
            else:
                fits = False
        if first[i] < bodies:
            for axis in range(3):
                fits = fits and opposite[axis] == -normal[i, axis]
    start, entry = _contacts_of(first, second, bodies)
    for i in range(m):
        if first[i] < bodies:
            for q in range(start[first[i]], start[first[i] + 1]):
                j = entry[q] >> 1
                fits = fits and (j == i or (second[j] != second[i] and first[j] != second[i]))
        else:
            for q in range(start[second[i]], start[second[i] + 1]):
                j = entry[q] >> 1
                fits = fits and (j == i or first[j] < bodies or not _parallel(normal, i, j))
    if not fits:
        return False, first, second, normal, inverse_mass, start, entry, start, entry
    # Neighbors side by side in memory: most of the time of a sweep is waiting for the velocity of the other body.
    body_order = _breadth_first(first, second, start, entry)
    rank = np.zeros(bodies + 1, np.int32)
    rank[bodies] = bodies
    for c in range(bodies):
        rank[body_order[c]] = c
    order = np.zeros(m, np.int32)
    placed = np.zeros(m, np.bool_)
    count = 0
    for c in range(bodies):
        for q in range(start[body_order[c]], start[body_order[c] + 1]):
            i = entry[q] >> 1
            if not placed[i]:
                placed[i] = True
                order[count] = i
                count += 1
    first_sorted = np.zeros(m, np.int32)
    second_sorted = np.zeros(m, np.int32)
    normal_sorted = np.zeros((m, 3))
    mass_sorted = np.zeros(bodies + 1)
    for c in range(bodies):
        mass_sorted[c] = inverse_mass[body_order[c]]
    for c in range(m):
        first_sorted[c] = rank[first[order[c]]]
        second_sorted[c] = rank[second[order[c]]]
        for axis in range(3):
            normal_sorted[c, axis] = normal[order[c], axis]
    start, entry = _contacts_of(first_sorted, second_sorted, bodies)
    return True, first_sorted, second_sorted, normal_sorted, mass_sorted, start, entry, order, body_order


@kernel
def _parallel(normal: Floats, i: int, j: int) -> bool:
    """True where two normals are the same."""
    return bool(normal[i, 0] == normal[j, 0] and normal[i, 1] == normal[j, 1] and normal[i, 2] == normal[j, 2])


@kernel
def _contacts_of(first: Ints, second: Ints, bodies: int) -> tuple[Ints, Ints]:
    """Contacts of each body: 2i where the normal of contact i points to it, 2i + 1 where it points away."""
    m = first.size
    start = np.zeros(bodies + 2, np.int32)
    for i in range(m):
        start[first[i] + 1] += 1
        start[second[i] + 1] += 1
    for body in range(bodies + 1):
        start[body + 1] += start[body]
    entry = np.zeros(2 * m, np.int32)
    place = start[: bodies + 1].copy()
    for i in range(m):
        entry[place[first[i]]] = 2 * i + 1
        place[first[i]] += 1
        entry[place[second[i]]] = 2 * i
        place[second[i]] += 1
    return start, entry


@kernel
def _breadth_first(first: Ints, second: Ints, start: Ints, entry: Ints) -> Ints:
    """Bodies in order of their distance in contacts from body 0, then from the next that is left."""
    bodies = start.size - 2
    order = np.zeros(bodies, np.int32)
    seen = np.zeros(bodies + 1, np.bool_)
    seen[bodies] = True
    tail = 0
    head = 0
    for seed in range(bodies):
        if seen[seed]:
            continue
        seen[seed] = True
        order[tail] = seed
        tail += 1
        while head < tail:
            body = order[head]
            head += 1
            for q in range(start[body], start[body + 1]):
                other = second[entry[q] >> 1] if entry[q] & 1 else first[entry[q] >> 1]
                if not seen[other]:
                    seen[other] = True
                    order[tail] = other
                    tail += 1
    return order


@parallel_kernel
def _sphere_rates(
    first: Ints, second: Ints, normal: Floats, inverse_mass: Floats, start: Ints, entry: Ints, stiffness: Floats
) -> Floats:
    """(W K W)_ii / W_ii as `_rates`, by one tensor Σ k n nᵀ a body."""
    m = first.size
    bodies = inverse_mass.size - 1
    tensor = np.zeros((bodies + 1, 6))
    for body in prange(bodies):
        for q in range(start[body], start[body + 1]):
            i = entry[q] >> 1
            n0, n1, n2, k = normal[i, 0], normal[i, 1], normal[i, 2], stiffness[i]
            tensor[body, 0] += k * n0 * n0
            tensor[body, 1] += k * n1 * n1
            tensor[body, 2] += k * n2 * n2
            tensor[body, 3] += 2.0 * k * n0 * n1
            tensor[body, 4] += 2.0 * k * n0 * n2
            tensor[body, 5] += 2.0 * k * n1 * n2
    rate = np.zeros(m)
    for i in prange(m):
        a, b = first[i], second[i]
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        square = n0 * n0 + n1 * n1 + n2 * n2
        total = 2.0 * inverse_mass[a] * inverse_mass[b] * stiffness[i] * square * square
        for body in (a, b):
            c = inverse_mass[body]
            total += c * c * (
                tensor[body, 0] * n0 * n0 + tensor[body, 1] * n1 * n1 + tensor[body, 2] * n2 * n2
                + tensor[body, 3] * n0 * n1 + tensor[body, 4] * n0 * n2 + tensor[body, 5] * n1 * n2
            )  # fmt: skip
        rate[i] = total / ((inverse_mass[a] + inverse_mass[b]) * square)
    return rate


@kernel
def _chunks(first: Ints, second: Ints, bodies: int) -> Ints:
    """Cut the contacts, sorted by their first-ranked body, into chunks that reach into the next one at most.

    Every second chunk can then be swept at the same time, and what a body sums up has one order whoever does it.
    """
    m = first.size
    low = np.zeros(m, np.int32)
    for i in range(m):
        low[i] = min(first[i], second[i])
    count = MOST_CHUNKS
    while count > 1:
        size = bodies // count + 1
        fits = True
        for i in range(m):
            high = second[i] if first[i] == bodies else max(first[i], second[i])
            fits = fits and high // size <= low[i] // size + 1
        if fits:
            break
        count //= 2
    size = bodies // count + 1
    start = np.zeros(count + 1, np.int32)
    for i in range(m):
        start[low[i] // size + 1] += 1
    for chunk in range(count):
        start[chunk + 1] += start[chunk]
    return start


@kernel
def _push_chunk(
    begin: int, end: int, first: Ints, second: Ints, normal: Floats, inverse_mass: Floats, stiffness: Floats,
    inertia: Floats, exponent: float, h: float, remembers: bool, slowest: float,
    v: Floats, compression: Floats, dv: Floats,
) -> tuple[float, int]:  # fmt: skip
    """Drift, force and push of some contacts; returns the energy left in them and how many press."""
    left = 0.0
    pressing = 0
    for i in range(begin, end):
        a, b = first[i], second[i]
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        u = n0 * (v[b, 0] - v[a, 0]) + n1 * (v[b, 1] - v[a, 1]) + n2 * (v[b, 2] - v[a, 2])
        deep = compression[i] - h * u
        if not remembers:
            deep = max(deep, 0.0) if compression[i] > 0.0 or u < -slowest else 0.0
        compression[i] = deep
        closing = min(u, 0.0)
        left += closing * closing * inertia[i]
        if deep > 0.0:
            pressing += 1
            force = _force(stiffness[i], deep, exponent)
            left += 2.0 * force * deep / (exponent + 1.0)
            kick = h * force
            dv[b, 0] += kick * n0
            dv[b, 1] += kick * n1
            dv[b, 2] += kick * n2
            # The floor belongs to every chunk: nobody may write there.
            if inverse_mass[a] > 0.0:
                dv[a, 0] -= kick * n0
                dv[a, 1] -= kick * n1
                dv[a, 2] -= kick * n2
    return 0.5 * left, pressing


@kernel
def _shift_chunk(
    begin: int, end: int, first: Ints, second: Ints, normal: Floats, inverse_mass: Floats, stiffness: Floats,
    exponent: float, h: float, compression: Floats, dv: Floats, shifted: Floats, P: Floats,
) -> None:  # fmt: skip
    """Rowlands' shift of some contacts, and the push from there."""
    for i in range(begin, end):
        if compression[i] > 0.0:
            a, b = first[i], second[i]
            c_a, c_b = inverse_mass[a], inverse_mass[b]
            n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
            shift = (
                n0 * (c_b * dv[b, 0] - c_a * dv[a, 0])
                + n1 * (c_b * dv[b, 1] - c_a * dv[a, 1])
                + n2 * (c_b * dv[b, 2] - c_a * dv[a, 2])
            )
            kick = h * _force(stiffness[i], compression[i] - SHIFT * h * shift, exponent)
            P[i] += kick
            shifted[b, 0] += kick * n0
            shifted[b, 1] += kick * n1
            shifted[b, 2] += kick * n2
            if c_a > 0.0:
                shifted[a, 0] -= kick * n0
                shifted[a, 1] -= kick * n1
                shifted[a, 2] -= kick * n2


@parallel_kernel
def _sweep(
    first: Ints, second: Ints, normal: Floats, inverse_mass: Floats, stiffness: Floats, inertia: Floats,
    exponent: float, h: float, gap_memory: float, threshold: float, slowest: float, max_steps: int,
    v: Floats, compression: Floats, P: Floats,
) -> tuple[int, int, bool]:  # fmt: skip
    """The first round, all contacts at once, until gaps are forgotten and few press; changes v, compression, P.

    Returns steps, contact visits, and whether all was over.
    """
    m = first.size
    bodies = inverse_mass.size - 1
    start = _chunks(first, second, bodies)
    chunks = start.size - 1
    chunk_left = np.zeros(chunks)
    chunk_pressing = np.zeros(chunks, np.int64)
    dv = np.zeros((bodies + 1, 3))
    shifted = np.zeros((bodies + 1, 3))
    steps = 0
    visits = 0
    peak = 0.0
    remembers = True
    while steps < max_steps:
        steps += 1
        for parity in range(2):
            for half in prange((chunks + 1 - parity) // 2):
                chunk = 2 * half + parity
                chunk_left[chunk], chunk_pressing[chunk] = _push_chunk(
                    start[chunk], start[chunk + 1], first, second, normal, inverse_mass, stiffness, inertia,
                    exponent, h, remembers, slowest, v, compression, dv,
                )  # fmt: skip
        left = 0.0
        pressing = 0
        for chunk in range(chunks):
            left += chunk_left[chunk]
            pressing += chunk_pressing[chunk]
        visits += m + pressing
        if pressing == 0:
            if not remembers:
                return steps, visits, False
            wait = np.inf
            u = np.zeros(m)
            for i in range(m):
                a, b = first[i], second[i]
                u[i] = (
                    normal[i, 0] * (v[b, 0] - v[a, 0])
                    + normal[i, 1] * (v[b, 1] - v[a, 1])
                    + normal[i, 2] * (v[b, 2] - v[a, 2])
                )
                if u[i] < -threshold:
                    wait = min(wait, max(compression[i] / u[i], 0.0))
            visits += m
            if wait == np.inf:
                return steps, visits, True
            for i in range(m):
                compression[i] -= u[i] * wait
                if abs(compression[i]) <= CLOSED * abs(u[i]) * wait:
                    compression[i] = 0.0
            continue
        for parity in range(2):
            for half in prange((chunks + 1 - parity) // 2):
                chunk = 2 * half + parity
                _shift_chunk(
                    start[chunk], start[chunk + 1], first, second, normal, inverse_mass, stiffness,
                    exponent, h, compression, dv, shifted, P,
                )  # fmt: skip
        for body in prange(bodies):
            for axis in range(3):
                v[body, axis] += inverse_mass[body] * shifted[body, axis]
                shifted[body, axis] = 0.0
                dv[body, axis] = 0.0
        if remembers:
            peak = max(peak, left)
            if left < gap_memory * gap_memory * peak:
                remembers = False
                for i in range(m):
                    compression[i] = max(compression[i], 0.0)
        elif pressing < FEW * m:
            return steps, visits, False
    return steps, visits, False


@kernel
def _settle(
    first: Ints, second: Ints, normal: Floats, inverse_mass: Floats, start: Ints, entry: Ints, stiffness: Floats,
    exponent: float, h: float, slowest: float, max_steps: int,
    v: Floats, compression: Floats, P: Floats, live: Ints, lives: int, kick: Floats, dv: Floats,
    contact_mark: Ints, body_mark: Ints, mark: int, bodies_hit: Ints,
) -> tuple[int, int, int, bool]:  # fmt: skip
    """Go on without gap memory until nothing presses, visiting only contacts of bodies that are being pushed.

    `live`: contacts that press or approach faster than `slowest`. Returns steps, contact visits, the last mark used,
    finished.
    """
    steps = 0
    visits = 0
    while lives > 0 and steps < max_steps:
        steps += 1
        mark += 1
        hits = 0
        for c in range(lives):
            i = live[c]
            a, b = first[i], second[i]
            u = (
                normal[i, 0] * (v[b, 0] - v[a, 0])
                + normal[i, 1] * (v[b, 1] - v[a, 1])
                + normal[i, 2] * (v[b, 2] - v[a, 2])
            )
            compression[i] = max(compression[i] - h * u, 0.0)
            kick[i] = h * _force(stiffness[i], compression[i], exponent)
            for body in (a, b):
                if body_mark[body] != mark and inverse_mass[body] > 0.0:
                    body_mark[body] = mark
                    bodies_hit[hits] = body
                    hits += 1
        visits += 2 * lives
        for c in range(hits):
            body = bodies_hit[c]
            p0, p1, p2 = _push(body, start, entry, normal, kick)
            dv[body, 0] = p0 * inverse_mass[body]
            dv[body, 1] = p1 * inverse_mass[body]
            dv[body, 2] = p2 * inverse_mass[body]
        for c in range(lives):
            i = live[c]
            a, b = first[i], second[i]
            shift = (
                normal[i, 0] * (dv[b, 0] - dv[a, 0])
                + normal[i, 1] * (dv[b, 1] - dv[a, 1])
                + normal[i, 2] * (dv[b, 2] - dv[a, 2])
            )
            kick[i] = h * _force(stiffness[i], compression[i] - SHIFT * h * shift, exponent)
            P[i] += kick[i]
        for c in range(hits):
            body = bodies_hit[c]
            p0, p1, p2 = _push(body, start, entry, normal, kick)
            v[body, 0] += p0 * inverse_mass[body]
            v[body, 1] += p1 * inverse_mass[body]
            v[body, 2] += p2 * inverse_mass[body]
        for c in range(lives):
            kick[live[c]] = 0.0
        for c in range(hits):
            dv[bodies_hit[c]] = 0.0
        # Who presses or approaches now touches a body that was pushed.
        lives = 0
        for c in range(hits):
            body = bodies_hit[c]
            for q in range(start[body], start[body + 1]):
                i = entry[q] >> 1
                if contact_mark[i] == mark:
                    continue
                contact_mark[i] = mark
                visits += 1
                lives_on = compression[i] > 0.0
                if not lives_on:
                    a, b = first[i], second[i]
                    u = (
                        normal[i, 0] * (v[b, 0] - v[a, 0])
                        + normal[i, 1] * (v[b, 1] - v[a, 1])
                        + normal[i, 2] * (v[b, 2] - v[a, 2])
                    )
                    lives_on = u < -slowest
                if lives_on:
                    live[lives] = i
                    lives += 1
    return steps, visits, mark, lives == 0


@kernel
def _push(body: int, start: Ints, entry: Ints, normal: Floats, kick: Floats) -> tuple[float, float, float]:
    """What a body's contacts push it with, summed in a fixed order."""
    p0, p1, p2 = 0.0, 0.0, 0.0
    for q in range(start[body], start[body + 1]):
        i = entry[q] >> 1
        p = kick[i] if entry[q] & 1 == 0 else -kick[i]
        p0 += p * normal[i, 0]
        p1 += p * normal[i, 1]
        p2 += p * normal[i, 2]
    return p0, p1, p2


@kernel
def _elastic_spheres(
    first: Ints, second: Ints, normal: Floats, inverse_mass: Floats, start: Ints, entry: Ints, stiffness: Floats,
    inertia: Floats, v_pre: Floats, body_order: Ints, rate_max: float, exponent: float, duration: float,
    gap_memory: float, threshold: float, max_steps: int,
) -> tuple[Floats, int, int, bool]:  # fmt: skip
    """Rounds of the law for packed spheres with one step for all; returns impulse, steps, contact visits, finished."""
    m = first.size
    bodies = inverse_mass.size - 1
    v = np.zeros((bodies + 1, 3))
    for body in range(bodies):
        for axis in range(3):
            v[body, axis] = v_pre[3 * body_order[body] + axis]
    impulse = np.zeros(m)
    P = np.zeros(m)
    compression = np.zeros(m)
    u_begin = np.zeros(m)
    kick = np.zeros(m)
    dv = np.zeros((bodies + 1, 3))
    live = np.zeros(m, np.int32)
    contact_mark = np.zeros(m, np.int32)
    body_mark = np.zeros(bodies + 1, np.int32)
    bodies_hit = np.zeros(bodies + 1, np.int32)
    mark = 0
    steps = 0
    visits = 0
    refinement = 1.0
    initial = True
    while True:
        V = 0.0
        for i in range(m):
            a, b = first[i], second[i]
            u_begin[i] = (
                normal[i, 0] * (v[b, 0] - v[a, 0])
                + normal[i, 1] * (v[b, 1] - v[a, 1])
                + normal[i, 2] * (v[b, 2] - v[a, 2])
            )
            V = max(V, -u_begin[i])
            compression[i] = 0.0
            P[i] = 0.0
        visits += m
        if threshold >= V:
            return impulse, steps, visits, True
        v_begin = v.copy()
        slowest = max(WAIT * V, threshold)
        h = refinement * duration * rate_max ** (-1.0 / (exponent + 1.0)) * V ** ((1.0 - exponent) / (1.0 + exponent))
        over = False
        if initial:
            taken, seen, over = _sweep(
                first, second, normal, inverse_mass, stiffness, inertia,
                exponent, h, gap_memory, threshold, slowest, max_steps, v, compression, P,
            )  # fmt: skip
            steps += taken
            visits += seen
        finished = over
        if not over:
            lives = 0
            for i in range(m):
                a, b = first[i], second[i]
                u = (
                    normal[i, 0] * (v[b, 0] - v[a, 0])
                    + normal[i, 1] * (v[b, 1] - v[a, 1])
                    + normal[i, 2] * (v[b, 2] - v[a, 2])
                )
                if compression[i] > 0.0 or u < -slowest:
                    live[lives] = i
                    lives += 1
            visits += m
            taken, seen, mark, finished = _settle(
                first, second, normal, inverse_mass, start, entry, stiffness,
                exponent, h, slowest, max_steps - steps, v, compression, P,
                live, lives, kick, dv, contact_mark, body_mark, mark, bodies_hit,
            )  # fmt: skip
            steps += taken
            visits += seen
        # The energy of the round, exactly.
        work = 0.0
        square = 0.0
        for i in range(m):
            if P[i] > 0.0:
                a, b = first[i], second[i]
                u = (
                    normal[i, 0] * (v[b, 0] - v[a, 0])
                    + normal[i, 1] * (v[b, 1] - v[a, 1])
                    + normal[i, 2] * (v[b, 2] - v[a, 2])
                )
                work += P[i] * u_begin[i]
                square += P[i] * (u - u_begin[i])
        scale = 1.0
        if square > 0.0:
            scale = -2.0 * work / square
        if not abs(scale - 1.0) <= LARGEST_CORRECTION and finished and refinement > FINEST:
            refinement *= 0.5
            v[:] = v_begin
            continue
        initial = False
        if not (finished or abs(scale - 1.0) <= LARGEST_CORRECTION):
            scale = 0.0
        scale = max(scale, 0.0)
        for i in range(m):
            impulse[i] += scale * P[i]
        for body in range(bodies):
            for axis in range(3):
                v[body, axis] = v_begin[body, axis] + scale * (v[body, axis] - v_begin[body, axis])
        if not finished:
            return impulse, steps, visits, False


@kernel
def _slip_bounds(
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats, m: int, n: int
) -> Floats:
    """Σ_j ‖D_i M⁻¹ D_jᵀ‖ over the 2 × 2 blocks (Frobenius): no turn of the tangents or of the axes changes it."""
    start = np.zeros(n + 1, np.int32)
    for q in range(D_start[2 * m]):
        start[D_index[q] + 1] += 1
    for d in range(n):
        start[d + 1] += start[d]
    row = np.zeros(D_start[2 * m], np.int32)
    value = np.zeros(D_start[2 * m])
    place = start[:n].copy()
    for r in range(2 * m):
        for q in range(D_start[r], D_start[r + 1]):
            row[place[D_index[q]]] = r
            value[place[D_index[q]]] = D[q]
            place[D_index[q]] += 1
    bound = np.zeros(m)
    block = np.zeros((m, 4))
    mark = np.full(m, -1, np.int32)
    touched = np.zeros(m, np.int32)
    for i in range(m):
        count = 0
        for side in range(2):
            for p in range(DM_start[2 * i + side], DM_start[2 * i + side + 1]):
                for q in range(start[DM_index[p]], start[DM_index[p] + 1]):
                    j = row[q] >> 1
                    if mark[j] != i:
                        mark[j] = i
                        block[j] = 0.0
                        touched[count] = j
                        count += 1
                    block[j, 2 * side + (row[q] & 1)] += DM[p] * value[q]
        for c in range(count):
            j = touched[c]
            bound[i] += np.sqrt(block[j, 0] ** 2 + block[j, 1] ** 2 + block[j, 2] ** 2 + block[j, 3] ** 2)
    return bound


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
    friction: Floats, slip_bound: Floats, pressing: Ints, n_pressing: int, kick: Floats,
    slide: Floats, P_t: Floats, v: Floats,
) -> float:  # fmt: skip
    """Half a kick of friction against the slip, all contacts from one velocity; returns the energy that it took.

    The bound keeps all of them together from overshooting: λ_max of D M⁻¹ Dᵀ is at most the largest slip bound of
    what it couples, so that no step gains energy.
    """
    work = 0.0
    for c in range(n_pressing):
        i = pressing[c]
        limit = 0.5 * friction[i] * kick[i]
        slide[2 * i] = 0.0
        slide[2 * i + 1] = 0.0
        if limit > 0.0 and slip_bound[i] > 0.0:
            s0 = _row_times(D_start, D_index, D, 2 * i, v) / slip_bound[i]
            s1 = _row_times(D_start, D_index, D, 2 * i + 1, v) / slip_bound[i]
            size = np.sqrt(s0 * s0 + s1 * s1)
            part = 1.0 if size <= limit else limit / size
            slide[2 * i] = -part * s0
            slide[2 * i + 1] = -part * s1
            work -= slip_bound[i] * 0.5 * (slide[2 * i] * s0 + slide[2 * i + 1] * s1)
    for c in range(n_pressing):
        for r in (2 * pressing[c], 2 * pressing[c] + 1):
            if slide[r] != 0.0:
                _add_row(DM_start, DM_index, DM, r, slide[r], v)
                P_t[r] += slide[r]
    for c in range(n_pressing):
        for r in (2 * pressing[c], 2 * pressing[c] + 1):
            if slide[r] != 0.0:
                work -= 0.5 * slide[r] * _row_times(D_start, D_index, D, r, v)
    return work


@kernel
def _dissipative(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats,
    D_start: Ints, D_index: Ints, D: Floats, DM_start: Ints, DM_index: Ints, DM: Floats,
    v_pre: Floats, stiffness: Floats, restitution: Floats, friction: Floats, elastic: bool,
    exponent: float, duration: float, gap_memory: float, threshold: float, max_steps: int,
) -> tuple[Floats, Floats, int, int, bool]:  # fmt: skip
    """Rounds of the law with restitution and friction, one step for all.

    Returns impulse, friction impulse, steps, contact visits, finished.
    """
    m = J_start.size - 1
    n = v_pre.size
    rate = _rates(J_start, J_index, J, JM_start, JM_index, JM, stiffness, n)
    slip_bound = _slip_bounds(D_start, D_index, D, DM_start, DM_index, DM, m, n)
    rate_max = 0.0
    for i in range(m):
        rate_max = max(rate_max, rate[i])
    v = v_pre.copy()
    v_begin = v_pre.copy()
    v_trial = v_pre.copy()
    dv = np.zeros(n)
    u = np.zeros(m)
    u_begin = np.zeros(m)
    compression = np.zeros(m)
    compressed = np.zeros(m)
    returned = np.zeros(m)
    impulse = np.zeros(m)
    P = np.zeros(m)
    kick = np.zeros(m)
    pressing = np.zeros(m, np.int32)
    friction_impulse = np.zeros(2 * m)
    P_t = np.zeros(2 * m)
    slide = np.zeros(2 * m)
    spent = np.zeros(m, np.bool_)
    refinement = 1.0
    first = True
    steps = 0
    visits = 0
    while True:
        V = 0.0
        for i in range(m):
            u[i] = _row_times(J_start, J_index, J, i, v)
            V = max(V, -u[i])
            u_begin[i] = u[i]
            compression[i] = 0.0
            compressed[i] = 0.0
            returned[i] = 0.0
            P[i] = 0.0
            P_t[2 * i] = 0.0
            P_t[2 * i + 1] = 0.0
        visits += m
        if threshold >= V:
            return impulse, friction_impulse, steps, visits, True
        v_begin[:] = v
        slowest = max(WAIT * V, threshold)
        h = refinement * duration * rate_max ** (-1.0 / (exponent + 1.0)) * V ** ((1.0 - exponent) / (1.0 + exponent))
        remembers = first
        fresh = True
        peak = 0.0
        rubbed = 0.0
        finished = False
        while steps < max_steps:
            steps += 1
            n_pressing = 0
            left = 0.0
            for i in range(m):
                # Drift; in expansion the compression is used up 1/e² times as fast.
                moved = -h * u[i] if not fresh else 0.0
                square = restitution[i] * restitution[i]
                deep = compression[i]
                slow = threshold * h if remembers else slowest * h
                if deep > 0.0 and moved < 0.0:
                    deep = deep + moved / square if square * deep > -moved else square * deep + moved
                elif deep > 0.0 and square == 0.0 and moved <= slow:
                    # Nothing would come back, and a force of rounding size would push for ever.
                    deep = 0.0
                elif deep > 0.0 or moved > slow:
                    deep += moved
                elif remembers:
                    deep = min(deep + moved, 0.0)
                if not remembers:
                    deep = max(deep, 0.0)
                compression[i] = deep
                if u[i] < 0.0:
                    left += 0.5 * u[i] * u[i] * stiffness[i] / rate[i]
                kick[i] = 0.0
                if deep > 0.0:
                    kick[i] = h * _force(stiffness[i], deep, exponent)
                    left += kick[i] * deep / (h * (exponent + 1.0))
                    pressing[n_pressing] = i
                    n_pressing += 1
                    _add_row(JM_start, JM_index, JM, i, kick[i], dv)
            visits += m + n_pressing
            for c in range(n_pressing):
                i = pressing[c]
                shift = _row_times(J_start, J_index, J, i, dv)
                kick[i] = h * _force(stiffness[i], compression[i] - SHIFT * h * shift, exponent)
            dv[:] = 0.0
            # What an ended contact still owes.
            for i in range(m):
                owed = restitution[i] * restitution[i] * compressed[i] - returned[i]
                if compression[i] <= 0.0 and u[i] > 0.0 and owed > OWED * compressed[i]:
                    kick[i] = 2.0 * owed / (u[i] + np.sqrt(u[i] * u[i] + 2.0 * rate[i] / stiffness[i] * owed))
                    pressing[n_pressing] = i
                    n_pressing += 1
            if n_pressing == 0 and not fresh:
                wait = np.inf
                for i in range(m):
                    if remembers:
                        if u[i] < -threshold:
                            wait = min(wait, max(compression[i] / u[i], 0.0))
                    elif u[i] < -slowest:
                        wait = 0.0
                if wait == np.inf:
                    finished = True
                    break
                if remembers:
                    for i in range(m):
                        compression[i] -= u[i] * wait
                        if abs(compression[i]) <= CLOSED * abs(u[i]) * wait:
                            compression[i] = 0.0
            peak = max(peak, left)
            if remembers and left < gap_memory * gap_memory * peak and not fresh:
                remembers = False
                for i in range(m):
                    compression[i] = max(compression[i], 0.0)
            fresh = False
            if n_pressing == 0:
                continue
            # No contact gives back more than its share of the work of compression.
            v_trial[:] = v
            for c in range(n_pressing):
                _add_row(JM_start, JM_index, JM, pressing[c], kick[pressing[c]], v_trial)
            for c in range(n_pressing):
                i = pressing[c]
                u_new = _row_times(J_start, J_index, J, i, v_trial)
                gained, _ = _works(kick[i], u[i], u_new)
                available = restitution[i] * restitution[i] * (compressed[i] + gained) - returned[i]
                if restitution[i] < 1.0:
                    share = _share_given_back(kick[i], u[i], u_new, available)
                    if share < 1.0:
                        kick[i] *= share
                        spent[i] = True
            # Half of the friction, the push, the other half: symmetric in time.
            rubbed += _rub(
                D_start, D_index, D, DM_start, DM_index, DM, friction, slip_bound, pressing, n_pressing, kick,
                slide, P_t, v,
            )  # fmt: skip
            for c in range(n_pressing):
                u[pressing[c]] = _row_times(J_start, J_index, J, pressing[c], v)
            for c in range(n_pressing):
                _add_row(JM_start, JM_index, JM, pressing[c], kick[pressing[c]], v)
            for c in range(n_pressing):
                i = pressing[c]
                u_new = _row_times(J_start, J_index, J, i, v)
                gained, given = _works(kick[i], u[i], u_new)
                compressed[i] += gained
                returned[i] += given
                P[i] += kick[i]
                # A contact that others still hold together keeps its compression, and pushes again at once.
                if spent[i] and u_new >= -slowest:
                    compression[i] = min(compression[i], 0.0)
                spent[i] = False
            visits += 2 * n_pressing
            rubbed += _rub(
                D_start, D_index, D, DM_start, DM_index, DM, friction, slip_bound, pressing, n_pressing, kick,
                slide, P_t, v,
            )  # fmt: skip
            for i in range(m):
                u[i] = _row_times(J_start, J_index, J, i, v)
            visits += m
        # Energy of the round: exact where nothing but friction takes it, never gained elsewhere.
        work = 0.0
        square = 0.0
        for i in range(m):
            work += P[i] * u_begin[i]
            square += P[i] * (u[i] - u_begin[i])
            for r in (2 * i, 2 * i + 1):
                if P_t[r] != 0.0:
                    slip = _row_times(D_start, D_index, D, r, v_begin)
                    work += P_t[r] * slip
                    square += P_t[r] * (_row_times(D_start, D_index, D, r, v) - slip)
        scale = 1.0
        if elastic and square > 0.0:
            # Two strengths lose as much as friction took; the right one is next to 1.
            root = np.sqrt(max(work * work - 2.0 * square * rubbed, 0.0))
            if work + square < 0.0:
                root = -root
            scale = (-work + root) / square
            if abs(scale - 1.0) > LARGEST_CORRECTION and refinement <= FINEST:
                scale = 1.0 if work + 0.5 * square <= 0.0 else -2.0 * work / square
        elif square > 0.0 and work + 0.5 * square > 0.0:
            scale = -2.0 * work / square
        if not abs(scale - 1.0) <= LARGEST_CORRECTION and finished and refinement > FINEST:
            refinement *= 0.5
            v[:] = v_begin
            continue
        first = False
        scale = max(scale, 0.0)
        for i in range(m):
            impulse[i] += scale * P[i]
            friction_impulse[2 * i] += scale * P_t[2 * i]
            friction_impulse[2 * i + 1] += scale * P_t[2 * i + 1]
        for d in range(n):
            v[d] = v_begin[d] + scale * (v[d] - v_begin[d])
        if not finished:
            return impulse, friction_impulse, steps, visits, False

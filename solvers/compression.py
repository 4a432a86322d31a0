"""Compression of elastic contacts in frozen geometry: the integrator below the laws `hertz` and `lzb`.

    dλ_i/dt = k_i max(δ_i, 0)^η,    u = u_pre + W λ,    dδ_i/dt = -u_i r_i,    r_i = 1/e_i² where u_i > 0, else 1

δ is the compression of a contact, and where it is negative the gap that must close before the contact presses again.
With e < 1 the stored energy k δ^(η+1)/(η+1) is used up 1/e² times as fast in expansion as it does work: the energetic
restitution of Stronge 1990, bi-stiffness. Two functions differ in what an ended contact remembers:
`integrate_with_gaps` (Hertz: its gap) and `integrate_without_gaps` (Liu, Zhao and Brogliato: nothing).

Units are taken out first: u in units of the largest approach V, W in units of its largest diagonal entry w, k of its
geometric mean k', compressions in L = (V²/(w k'))^(1/(η+1)), time in L/V. Stiffness, mass and speed scales cancel.

Small problems: DOP853 (Hairer, Nørsett and Wanner 1993), with an independent variable chosen step by step. The force
δ^η has a branch point where a contact starts or ends, which spoils any high-order method in t; in √(t - start) and in
√δ of the contact that ends, the solution is smooth again for η = 3/2. Taking a contact's own δ or u as the
variable also lands a step exactly on its event (Hénon 1982). On cradles of 3 to 10 balls the default tolerance gives
velocities to 4e-11 and energy to 1e-10. Large problems: leapfrog with a fixed step, matrix-free; 50 steps a contact
leave an energy error of 1e-6 on a pack of 1,000 spheres, and halving the step moves single velocities by 0.02 to 0.05.
Where all restitutions are 1 the energy of either is put right: impulses αλ with α = -2 λ·u⁻/(λᵀWλ) conserve it, one
number next to 1 that keeps signs, momenta and symmetries; what approaches then by |α - 1| of its speed is integrated
again. |α - 1| is the part of the method's error that shows in the energy, and is reported as the residual.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.integrate import DOP853

from solvers._jit import kernel
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status

Ints = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]

# Up to this many contacts the adaptive method runs; every event anywhere costs a step of all contacts, so its work
# grows with the square of m, and a rack of 55 balls (135 contacts) should still have the accurate answer.
ADAPTIVE_CONTACTS = 200
# Contact evaluations that every contact adds to the bound: a dense pack of 1,000 spheres takes 1,200 to 3,900 each.
VISITS_PER_CONTACT = 5_000
# A contact compressed by less than this part of its largest compression does not press: its energy is 1e-30 of it.
TOUCH = 1e-12
# A contact may still approach with this part of the largest |u_pre|; the kernels stop at half of it, so that the
# rounding of the impulses does not decide.
APPROACH = 1e-10
# An opening within this many step lengths is headed for: the step is then taken in √δ of that contact.
REACH = 4.0
# So often may one step change its target to a contact that crosses earlier; afterwards it ignores events.
RETARGETS = 4

# Independent variables of a step, and what ends at its full length.
CLOCK = 0
"""√(t - t_event): regular where contacts start."""
OPENING = 1
"""√δ of one contact, down to 0: regular where it ends."""
CLOSING = 2
"""The gap of one contact, down to 0."""
TURNING = 3
"""|u| of one contact, down to 0: from compression to expansion, or back."""

# (problem, deepest gap, velocity, its largest approach, bound on visits, settings) to what `_adaptively` returns.
Method: TypeAlias = Callable[
    ["ImpactProblem", float, Floats, float, int, "Compliance"], tuple[Floats, Floats, int, int, bool]
]

_A = np.ascontiguousarray(DOP853.A, dtype=np.float64)
_B = np.ascontiguousarray(DOP853.B, dtype=np.float64)
_C = np.ascontiguousarray(DOP853.C, dtype=np.float64)
_E3 = np.ascontiguousarray(DOP853.E3, dtype=np.float64)
_E5 = np.ascontiguousarray(DOP853.E5, dtype=np.float64)


@dataclass(frozen=True)
class Compliance:
    """How the compliant laws are integrated: the settings that they share."""

    exponent: float = 1.5
    """η of the contact force k δ^η, ≥ 1: 3/2 is Hertz, 1 a linear spring. Dimensionless."""

    tolerance: float = 1e-12
    """Error of one step of the adaptive method, relative to the largest speed and compression (small problems)."""

    steps_per_contact: float = 50.0
    """Leapfrog steps within the shortest contact, all neighbors pressing with it (large problems)."""

    adaptive_contacts: int = ADAPTIVE_CONTACTS
    """Problems of up to so many contacts are small."""

    max_visits: int = 4_000_000
    """Bound on contact evaluations, besides 5,000 for each contact."""

    def __post_init__(self) -> None:
        if not 1.0 <= self.exponent < math.inf:
            raise ValueError(f"exponent must be finite and ≥ 1, not {self.exponent}")
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"tolerance must lie in (0, 1), not {self.tolerance}")
        if not 0.0 < self.steps_per_contact < math.inf:
            raise ValueError(f"steps_per_contact must be finite and > 0, not {self.steps_per_contact}")


def integrate_with_gaps(problem: ImpactProblem, settings: Compliance) -> ImpactSolution:
    """Integrate until nothing presses and no gap closes; an opened contact presses again once its gap is closed.

    Args:
        problem: the impact; its restitution is read as energetic, its friction is not read.
        settings: exponent and accuracy.

    Returns:
        The solution; `iterations` are steps, `visits` contact evaluations, `residual` the largest |α - 1|
        where all restitutions are 1, else the energy defect |½ λ·(u_pre + u_post) + Σ (1 - e²) C| / Σ C of the
        integration, where C is the work of compression of a contact.
    """
    return _integrate(problem, -math.inf, settings)


def integrate_without_gaps(problem: ImpactProblem, settings: Compliance) -> ImpactSolution:
    """Integrate until nothing presses or approaches; a contact that approaches presses at once.

    Arguments and result are those of `integrate_with_gaps`.
    """
    return _integrate(problem, 0.0, settings)


def pair_duration(exponent: float) -> float:
    """Duration of the contact of a pair in units of (largest compression)/(approach speed).

    2 ∫₀¹ dx/√(1 - x^(η+1)) = 2 √π Γ(1 + a)/Γ(½ + a) with a = 1/(η+1): π for η = 1, 2.943 for η = 3/2.
    """
    a = 1.0 / (exponent + 1.0)
    return 2.0 * math.sqrt(math.pi) * math.gamma(1.0 + a) / math.gamma(0.5 + a)


def _integrate(problem: ImpactProblem, deepest_gap: float, settings: Compliance) -> ImpactSolution:
    """Run the method that fits the size, as often as it takes."""
    V = float(-problem.u_pre.min(initial=0.0))
    if V <= 0.0:
        return ImpactSolution(np.zeros(problem.m), problem.v_pre.copy(), Status.CONVERGED, 0, 0, 0.0)
    max_visits = settings.max_visits + VISITS_PER_CONTACT * problem.m
    method = _adaptively if problem.m <= settings.adaptive_contacts else _by_leapfrog
    if (problem.restitution == 1.0).all():
        return _elastic_rounds(problem, method, deepest_gap, V, max_visits, settings)
    impulse, compressed, steps, visits, finished = method(problem, deepest_gap, problem.v_pre, V, max_visits, settings)
    v = problem.v_after(impulse)
    work = 0.5 * float(impulse @ (problem.u_pre + problem.J @ v))
    lost = float(((1.0 - problem.restitution**2) * compressed).sum())
    total = float(compressed.sum())
    return _solution(problem, impulse, steps, visits, finished, abs(work + lost) / total if total > 0 else 0.0)


def _elastic_rounds(
    problem: ImpactProblem, method: Method, deepest_gap: float, V: float, max_visits: int, settings: Compliance
) -> ImpactSolution:
    """A method with its energy put right: α P, α = -2 P·u⁻/(PᵀWP), and again for what that leaves approaching."""
    impulse = np.zeros(problem.m)
    v, u = problem.v_pre, problem.u_pre
    steps, visits, finished, correction = 0, 0, True, 0.0
    while finished and APPROACH * problem.speed < V:
        P, _, taken, seen, finished = method(problem, deepest_gap, v, V, max_visits - visits, settings)
        steps += taken
        visits += seen
        rise = float(P @ (problem.J @ (problem.MJT @ P)))
        scale = -2.0 * float(P @ u) / rise if finished and rise > 0.0 else 1.0
        correction = max(correction, abs(scale - 1.0))
        impulse += scale * P
        v = problem.v_after(impulse)
        u = problem.J @ v
        V = float(-u.min())
    return _solution(problem, impulse, steps, visits, finished, correction)


def _adaptively(
    problem: ImpactProblem, deepest_gap: float, v: Floats, V: float, max_visits: int, settings: Compliance
) -> tuple[Floats, Floats, int, int, bool]:
    """Impulse and work of compression of the adaptive method, steps, contact evaluations, finished.

    From a velocity v with the largest approach V.
    """
    W = problem.W
    w, stiffness, recovery, deepest, duration = _units(problem, settings.exponent)
    impulse, compressed, steps, visits, finished = _adaptive(
        W.indptr, W.indices, W.data / w, problem.J @ v / V, problem.W_diagonal / w,
        stiffness, recovery, deepest, settings.exponent, deepest_gap,
        settings.tolerance, 0.5 * APPROACH * problem.speed / V, 0.05 * duration, max_visits, _A, _B, _C, _E3, _E5,
    )  # fmt: skip
    return impulse * (V / w), compressed * (V * V / w), steps, visits, finished


def _by_leapfrog(
    problem: ImpactProblem, deepest_gap: float, v: Floats, V: float, max_visits: int, settings: Compliance
) -> tuple[Floats, Floats, int, int, bool]:
    """As `_adaptively`, by leapfrog."""
    J, JM, JT = problem.J, problem.JM, problem.JT
    w, stiffness, recovery, deepest, duration = _units(problem, settings.exponent)
    # Contacts that press together on a body are as stiff as the sum of them: on a box with 1,000 points a contact
    # lasts a sixteenth of a pair's. The row sums of |W| bound it, computed without W.
    together = abs(J) @ (abs(JM).T @ np.ones(problem.m))
    duration *= float((problem.W_diagonal / together).min()) ** (1.0 / (settings.exponent + 1.0))
    impulse, compressed, steps, visits, finished = _leapfrog(
        J.indptr, J.indices, J.data, JM.indptr, JM.indices, JM.data / w, JT.indptr, JT.indices, v / V,
        stiffness, recovery, deepest, settings.exponent, deepest_gap, 0.5 * APPROACH * problem.speed / V,
        duration / settings.steps_per_contact, max_visits,
    )  # fmt: skip
    return impulse * (V / w), compressed * (V * V / w), steps, visits, finished


def _units(problem: ImpactProblem, exponent: float) -> tuple[float, Floats, Floats, Floats, float]:
    """Unit of W, stiffness without its unit, 1/e², largest compression of each contact, duration of the shortest.

    As if each contact were that of a pair which approaches at unit speed.
    """
    w = float(problem.W_diagonal.max())
    stiffness = problem.stiffness / np.exp(np.log(problem.stiffness).mean())
    deepest = ((exponent + 1.0) * w / (2.0 * stiffness * problem.W_diagonal)) ** (1.0 / (exponent + 1.0))
    return w, stiffness, 1.0 / problem.restitution**2, deepest, pair_duration(exponent) * float(deepest.min())


def _solution(
    problem: ImpactProblem, impulse: Floats, steps: int, visits: int, finished: bool, residual: float
) -> ImpactSolution:
    """Judge a run by the velocity that its impulse gives."""
    v = problem.v_after(impulse)
    u = problem.J @ v
    if not np.isfinite(v).all():
        status = Status.NOT_FINITE
    elif not finished:
        status = Status.ITERATION_LIMIT
    elif u.min() < -APPROACH * problem.speed:
        # The kernel carries u by increments; impulses that cancel in u (large mass ratios) leave their rounding here.
        status = Status.STALLED
    else:
        status = Status.CONVERGED
    return ImpactSolution(impulse, v, status, steps, visits, residual)


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
def _attempt(
    W_start: Ints, W_index: Ints, W: Floats, stiffness: Floats, recovery: Floats, exponent: float,
    deepest_gap: float, u: Floats, compression: Floats, pressing: Flags, P_scale: Floats, compression_scale: Floats,
    kind: int, target: int, since: float, h: float,
    A: Floats, B: Floats, C: Floats, E3: Floats, E5: Floats,
    force: Floats, rate: Floats, P: Floats, compressed: Floats, pace: Floats, u_new: Floats, compression_new: Floats,
) -> tuple[float, float]:  # fmt: skip
    """One step of length h in the variable `kind`; fills P, u_new, compression_new, and force and rate by stage.

    Returns the error estimate in units of the tolerance, NaN where the variable does not run forward, and the time.
    """
    m = u.size
    stages = B.size
    for stage in range(stages):
        for i in range(m):
            P[i] = 0.0
            compression_new[i] = compression[i]
        for before in range(stage):
            a = A[stage, before] * h
            if a != 0.0:
                a *= pace[before]
                for i in range(m):
                    P[i] += a * force[before, i]
                    compression_new[i] += a * rate[before, i]
        if kind == OPENING:
            # Known exactly, whatever the stages before it gave.
            compression_new[target] = (np.sqrt(compression[target]) - C[stage] * h) ** 2
        for i in range(m):
            u_new[i] = u[i]
        for j in range(m):
            if P[j] != 0.0:
                for q in range(W_start[j], W_start[j + 1]):
                    u_new[W_index[q]] += W[q] * P[j]
        for i in range(m):
            force[stage, i] = _force(stiffness[i], compression_new[i], exponent)
            u_i = u_new[i]
            if u_i <= 0.0:
                rate[stage, i] = -u_i
            elif pressing[i] or deepest_gap < 0.0:
                rate[stage, i] = -u_i * recovery[i]
            else:
                rate[stage, i] = 0.0
            compressed[stage, i] = max(-u_i, 0.0) * force[stage, i]
        # Time per unit of the variable.
        x = C[stage] * h
        if kind == CLOCK:
            pace[stage] = 2.0 * (since + x)
        elif kind == OPENING:
            if not u_new[target] > 0.0:
                return np.nan, 0.0
            root = max(np.sqrt(compression[target]) - x, 0.0)
            pace[stage] = 2.0 * root / (u_new[target] * recovery[target])
        elif kind == CLOSING:
            if not u_new[target] < 0.0:
                return np.nan, 0.0
            pace[stage] = -1.0 / u_new[target]
        else:
            acceleration = 0.0
            for q in range(W_start[target], W_start[target + 1]):
                acceleration += W[q] * force[stage, W_index[q]]
            if not acceleration * u[target] < 0.0:
                return np.nan, 0.0
            pace[stage] = 1.0 / abs(acceleration)
    # The step, its error by the embedded formulas of order 5 and 3, and its duration.
    square3 = 0.0
    square5 = 0.0
    for i in range(m):
        P_i = 0.0
        rise = 0.0
        P3 = 0.0
        P5 = 0.0
        rise3 = 0.0
        rise5 = 0.0
        for stage in range(stages):
            F = force[stage, i] * pace[stage]
            r = rate[stage, i] * pace[stage]
            P_i += B[stage] * F
            P3 += E3[stage] * F
            P5 += E5[stage] * F
            rise += B[stage] * r
            rise3 += E3[stage] * r
            rise5 += E5[stage] * r
        # Some weights are negative: a contact that only just presses could come out as pulling, by rounding's size.
        P[i] = max(h * P_i, 0.0)
        compression_new[i] = compression[i] + h * rise
        square3 += (P3 / P_scale[i]) ** 2 + (rise3 / compression_scale[i]) ** 2
        square5 += (P5 / P_scale[i]) ** 2 + (rise5 / compression_scale[i]) ** 2
    elapsed = 0.0
    for stage in range(stages):
        elapsed += B[stage] * pace[stage]
    for i in range(m):
        u_new[i] = u[i]
    for j in range(m):
        if P[j] != 0.0:
            for q in range(W_start[j], W_start[j + 1]):
                u_new[W_index[q]] += W[q] * P[j]
    error = 0.0
    if square5 > 0.0:
        error = h * square5 / np.sqrt(square5 + 0.01 * square3)
    return error, elapsed * h


@kernel
def _adaptive(
    W_start: Ints, W_index: Ints, W: Floats, u_pre: Floats, W_diagonal: Floats,
    stiffness: Floats, recovery: Floats, deepest: Floats, exponent: float, deepest_gap: float,
    tolerance: float, threshold: float, first_step: float, max_visits: int,
    A: Floats, B: Floats, C: Floats, E3: Floats, E5: Floats,
) -> tuple[Floats, Floats, int, int, bool]:  # fmt: skip
    """Adaptive method; returns impulse, work of compression, steps, contact evaluations, finished."""
    m = u_pre.size
    stages = B.size
    u = u_pre.copy()
    impulse = np.zeros(m)
    compression = np.zeros(m)
    work = np.zeros(m)
    pressing = np.zeros(m, np.bool_)
    P = np.zeros(m)
    u_new = np.zeros(m)
    compression_new = np.zeros(m)
    P_scale = np.zeros(m)
    compression_scale = np.zeros(m)
    touch = TOUCH * deepest
    force = np.zeros((stages, m))
    rate = np.zeros((stages, m))
    compressed = np.zeros((stages, m))
    pace = np.zeros(stages)
    planned = first_step
    since = 0.0
    steps = 0
    visits = 0
    growth = 2.0 / (exponent + 1.0)
    while True:
        u_min = 0.0
        speed = 1.0
        still = True
        for i in range(m):
            pressing[i] = compression[i] > touch[i]
            still = still and not pressing[i]
            u_min = min(u_min, u[i])
            if pressing[i] or u[i] < 0.0:
                # What has parted for good sets no scale.
                speed = max(speed, abs(u[i]))
        if still and u_min >= -threshold:
            return impulse, work, steps, visits, True
        if visits >= max_visits:
            return impulse, work, steps, visits, False
        # Quiet time: go to the next closing at once.
        if still and deepest_gap < 0.0:
            wait = np.inf
            for i in range(m):
                if u[i] < -threshold:
                    wait = min(wait, max(compression[i] / u[i], 0.0))
            if wait > 0.0:
                for i in range(m):
                    compression[i] -= u[i] * wait
                    if abs(compression[i]) <= touch[i]:
                        compression[i] = 0.0
                since = 0.0
                visits += m
        for i in range(m):
            P_scale[i] = tolerance * speed / W_diagonal[i]
            compression_scale[i] = tolerance * deepest[i] * speed**growth
        # The variable: the next opening or closing within reach, else the clock.
        kind = CLOCK
        target = -1
        nearest = np.inf
        for i in range(m):
            if pressing[i] and u[i] > 0.0:
                wait = compression[i] / (u[i] * recovery[i])
                if wait < nearest and wait <= REACH * planned:
                    kind, target, nearest = OPENING, i, wait
            elif compression[i] < -touch[i] and u[i] < 0.0:
                wait = compression[i] / u[i]
                if wait < nearest and wait <= planned:
                    kind, target, nearest = CLOSING, i, wait
        h = np.sqrt(since * since + planned) - since
        full = h
        if kind == OPENING:
            # As much of the way to the opening as the planned time covers at the present speed.
            full = np.sqrt(compression[target])
            h = full - np.sqrt(max(compression[target] * (1.0 - planned / nearest), 0.0))
        elif kind == CLOSING:
            full = -compression[target]
            h = full
        retargets = 0
        error = 0.0
        elapsed = 0.0
        while visits < max_visits:
            error, elapsed = _attempt(
                W_start, W_index, W, stiffness, recovery, exponent, deepest_gap, u, compression, pressing, P_scale,
                compression_scale, kind, target, since, h, A, B, C, E3, E5,
                force, rate, P, compressed, pace, u_new, compression_new,
            )  # fmt: skip
            visits += stages * m
            if kind != CLOCK and not np.isfinite(error):
                # The target does not come to its event: back to the clock, without events for this step.
                kind, target, retargets = CLOCK, -1, RETARGETS
                full = np.sqrt(since * since + planned) - since
                h = full
                continue
            # Who crosses an event within the step? Head for the first one instead.
            if retargets < RETARGETS and np.isfinite(error):
                earliest = 1.0
                crossing = CLOCK
                crosser = -1
                for i in range(m):
                    if i == target:
                        continue
                    if compression[i] > touch[i]:
                        if compression_new[i] < -touch[i]:
                            share = compression[i] / (compression[i] - compression_new[i])
                            if share < earliest:
                                crossing, crosser, earliest = OPENING, i, share
                    elif compression[i] < -touch[i] and compression_new[i] > touch[i]:
                        share = compression[i] / (compression[i] - compression_new[i])
                        if share < earliest:
                            crossing, crosser, earliest = CLOSING, i, share
                    # Only where δ has a kink at u = 0: restitution below 1, or an ended contact without a gap.
                    bends = deepest_gap == 0.0 and (recovery[i] != 1.0 or not pressing[i])
                    if bends and u[i] * u_new[i] < 0.0 and min(abs(u[i]), abs(u_new[i])) > TOUCH * speed:
                        share = u[i] / (u[i] - u_new[i])
                        if share < earliest:
                            crossing, crosser, earliest = TURNING, i, share
                if crosser >= 0:
                    retargets += 1
                    kind = crossing
                    target = crosser
                    if kind == OPENING:
                        full = np.sqrt(compression[target])
                    elif kind == CLOSING:
                        full = -compression[target]
                    else:
                        full = abs(u[target])
                    h = full
                    continue
            if error <= 1.0:
                break
            h *= max(0.2, 0.9 * error**-0.125) if np.isfinite(error) else 0.2
        if visits >= max_visits:
            return impulse, work, steps, visits, False
        steps += 1
        for i in range(m):
            done = 0.0
            for stage in range(stages):
                done += B[stage] * pace[stage] * compressed[stage, i]
            work[i] += h * done
            impulse[i] += P[i]
            u[i] = u_new[i]
            compression[i] = compression_new[i]
            if deepest_gap == 0.0 and (compression[i] < 0.0 or (compression[i] <= touch[i] and u[i] > 0.0)):
                compression[i] = 0.0
        factor = 4.0 if error == 0.0 else min(4.0, max(0.2, 0.9 * error**-0.125))
        if kind != CLOCK and h == full:
            if kind != TURNING:
                compression[target] = 0.0
            planned = max(planned, elapsed * factor)
        else:
            planned = elapsed * factor
        # A contact starts: its force has a branch point here.
        starts = h == full and (kind == CLOSING or (kind == TURNING and not pressing[target]))
        since = 0.0 if starts else np.sqrt(since * since + elapsed)


@kernel
def _leapfrog(
    J_start: Ints, J_index: Ints, J: Floats, JM_start: Ints, JM_index: Ints, JM: Floats, JT_start: Ints, JT_index: Ints,
    v_pre: Floats, stiffness: Floats, recovery: Floats, deepest: Floats, exponent: float, deepest_gap: float,
    threshold: float, dt: float, max_visits: int,
) -> tuple[Floats, Floats, int, int, bool]:  # fmt: skip
    """Leapfrog with a fixed step; returns impulse, work of compression, steps, contact evaluations, finished.

    A contact that does not press and whose bodies nobody pushes keeps its u: it sleeps until its gap is closed or a
    neighbor pushes one of its bodies. When all sleep, the clock goes to the next that wakes.
    """
    m = J_start.size - 1
    v = v_pre.copy()
    impulse = np.zeros(m)
    work = np.zeros(m)
    compression = np.zeros(m)
    u = np.zeros(m)
    P = np.zeros(m)
    awake = np.arange(m).astype(np.int32)
    awake_count = m
    asleep = np.zeros(m, np.bool_)
    slept = np.zeros(m, np.int64)
    due = np.full(m, np.inf)
    next_due = np.inf
    pushed = np.full(v.size, -2, np.int64)
    steps = 0
    visits = m
    clock = 0
    for i in range(m):
        u_i = 0.0
        for q in range(J_start[i], J_start[i + 1]):
            u_i += J[q] * v[J_index[q]]
        u[i] = u_i
        compression[i] = max(-0.5 * dt * u_i, deepest_gap)
    while visits < max_visits:
        # Wake those whose gap closes now.
        if next_due <= clock:
            next_due = np.inf
            visits += m
            for i in range(m):
                if asleep[i]:
                    if due[i] <= clock:
                        asleep[i] = False
                        compression[i] -= u[i] * dt * (clock - slept[i])
                        awake[awake_count] = i
                        awake_count += 1
                    else:
                        next_due = min(next_due, due[i])
        # Kick: forces do not depend on v, so the order of contacts does not matter.
        pressing_count = awake_count
        for position in range(pressing_count):
            i = awake[position]
            P[i] = dt * _force(stiffness[i], compression[i], exponent)
            if P[i] > 0.0:
                impulse[i] += P[i]
                for q in range(JM_start[i], JM_start[i + 1]):
                    d = JM_index[q]
                    v[d] += JM[q] * P[i]
                    if pushed[d] < clock - 1:
                        # Pushed for the first time after a rest: its sleeping contacts wake, brought to this time.
                        for r in range(JT_start[d], JT_start[d + 1]):
                            j = JT_index[r]
                            if asleep[j]:
                                asleep[j] = False
                                if deepest_gap < 0.0:
                                    compression[j] -= u[j] * dt * (clock - slept[j])
                                P[j] = 0.0
                                awake[awake_count] = j
                                awake_count += 1
                    pushed[d] = clock
        # Drift.
        steps += 1
        visits += awake_count
        kept = 0
        for position in range(awake_count):
            i = awake[position]
            u_i = 0.0
            quiet = True
            for q in range(J_start[i], J_start[i + 1]):
                d = J_index[q]
                u_i += J[q] * v[d]
                quiet = quiet and pushed[d] < clock
            if P[i] > 0.0:
                # The work of a kick is exactly its impulse times the mean of u before and after.
                work[i] += max(-0.5 * (u[i] + u_i), 0.0) * P[i]
            u[i] = u_i
            compression[i] = max(compression[i] - u_i * dt * (recovery[i] if u_i > 0.0 else 1.0), deepest_gap)
            if quiet and compression[i] <= TOUCH * deepest[i]:
                wait = np.inf
                if u_i < -threshold:
                    wait = np.floor(max(compression[i] / (u_i * dt), 0.0))
                if wait >= 1.0:
                    asleep[i] = True
                    slept[i] = clock + 1
                    due[i] = clock + 1 + wait
                    next_due = min(next_due, due[i])
                    continue
            awake[kept] = i
            kept += 1
        awake_count = kept
        clock += 1
        if awake_count == 0:
            if next_due == np.inf:
                return impulse, work, steps, visits, True
            clock = int(next_due)
    return impulse, work, steps, visits, False

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
within the push or by one more. One round; when it forgets its gaps, at 0.03 of the peak at the latest, contacts that
press end as c_r says, no other starts, and what still approaches is brought to rest without rebound (`Rows.settle`),
by sweeps that contract in the norm of M. Bounces that lose energy get slower and shorter without end, and following
them amplified the rounding of a renumbering to 2e-4 of the velocity (300 spheres, hot, c_r = 0; now 5e-11). Its price:
rms distance 0.016 instead of 0.013 from 32 steps a contact and gap_memory 0.01 (the same spheres, c_r = 0.3).

Friction: P_t opposes the slip with |P_t| ≤ μ P over both directions (Coulomb's cone, which lies within the pyramid),
and never reverses it: P_t is at most slip / Σ_j ‖D_i M⁻¹ D_jᵀ‖, a part of it at a time. Where c_r = 1 half of the parts
come before the normal pushes and half after them, as in any symmetric splitting; all of them afterwards left an error
of the energy of first order, and rounds were run again at finer and finer steps.

Two layouts run the same rounds: `explicit_hertz_rows` any rows, with local steps; `explicit_hertz_spheres` many elastic
contacts of spheres, with one step for all, which grows as speeds fall, and several threads.

Limits. Frozen geometry, no tangential compliance; sticking takes several pushes, so that it is softer on bodies with
many contacts, and converges slowly with the step. α spreads an energy error over all contacts of a round. Switching
the gaps off moves with the data by a whole step: with gap_memory > 0 the answer can jump by about gap_memory times what
is left. Contacts with c_r = 1 beside others with less also settle without rebound. Where contacts squeeze a body from
both sides nothing need end (Gordan), and max_steps does. Settling is slow on long rows of balls with c_r = 0: 1,000 of
them are left at an approach of 6e-8 after a million sweeps, and the bound is told as such.

Measured on the dense layer, kick, rms velocity error (4,000 spheres, `tests/benchmarks/test_bench_ehi.py`): 0.091 with
1.75 steps a contact and gap_memory 0.3, 0.035 with 2.5 and 0.1, 0.019 with 3 and 0.05. Below 1.75 steps the method is
unstable. Packed spheres let their step grow as the speeds fall; growing it by the fastest contact alone, in place of
the sum over contacts, saves no visits, as single contacts get faster than any was at the start.

Tried and left, each by a prototype that lost: implicit midpoint, its force at the middle or as the mean over the step
(several times the visits at the same error, and no solution in large steps); the energy of each contact as its state
in place of δ (every kick that overdraws an account ends its contact); leapfrog (one more pass over the pressing
contacts costs less); two unequal drifts (McLachlan); explicit multistep (Störmer of order 3 and 4: large α - 1); a
shift by the own W_ii F_i alone (a shift with 1/13 in place of 1/12 has less error at coarse steps and more at
fine ones); normals and compressions of spheres in single precision; signed indices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from solvers._jit import alone, parallel_kernel, prange
from solvers.boxed_lcp import MAX_VISITS
from solvers.compression import pair_duration
from solvers.explicit_hertz_rows import Rows, rows
from solvers.explicit_hertz_spheres import Spheres, spheres
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem
from solvers.sphere_chunks import SHARED_CONTACTS

# Without gap memory, an approach slower than this part of the round's fastest waits for the next round, whose clock
# is set by what is left: a contact lasts u^(-1/5) for η = 3/2, and the last ones would take most of the steps.
WAIT = 1e-3
# Where c_r < 1 gaps are forgotten from here on at the latest: what bounces on amplifies rounding tenfold in 100 steps.
SETTLING = 0.03
# Sweeps of settling at most: a row of balls that come to rest together takes the square of their number.
MOST_SWEEPS = 50_000
# The energy correction is a small one, 1e-3 at the default step; a round that needs more is run again at half the step.
LARGEST_CORRECTION = 0.05
# So far at most is the step refined.
FINEST = 2.0**-4
# The run stops at this part of the tolerance, so that the rounding of the recomputed velocity stays within it.
MARGIN = 0.5


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

    max_visits: int = MAX_VISITS
    """Bound on contact visits, looked at once a step."""

    def __post_init__(self) -> None:
        if not self.steps_per_contact >= 1.75:
            raise ValueError(f"steps_per_contact must be ≥ 1.75, not {self.steps_per_contact}")
        if not self.exponent >= 1.0:
            raise ValueError(f"exponent must be ≥ 1, not {self.exponent}")
        if not 0.0 <= self.gap_memory < 1.0:
            raise ValueError(f"gap_memory must lie in [0, 1), not {self.gap_memory}")

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact of any restitution and friction.

        Raises:
            UnsupportedProblem: contacts with friction have a tangential restitution.
        """
        if problem.has_friction and problem.tangential_restitution.any():
            raise UnsupportedProblem("ehi's friction gives nothing back: tangential_restitution must be 0")
        V = -float(problem.u_pre.min(initial=0.0))
        if self.tolerance * problem.speed >= V:
            run = _Run(problem.v_pre, -V, np.zeros(problem.m), np.zeros(0), 0, problem.m, True)
            return _solution(problem, self.tolerance, problem.v_pre.copy(), run.u_min, run.P, None, run)
        # Out with the units: speeds by the fastest approach, W by its largest diagonal entry, k by its mean.
        w = float(problem.W_diagonal.max())
        threshold = MARGIN * self.tolerance * problem.speed / V
        elastic = bool(problem.restitution.min() == 1.0)
        if elastic and not problem.has_friction:
            packed = spheres(problem, exponent=self.exponent, V=V, w=w)
            if packed is not None:
                run = self._bounce(packed, threshold)
                v, impulse = packed.in_problem_order(run.v, run.P, n=problem.n, V=V, w=w)
                return _solution(problem, self.tolerance, v, V * run.u_min, impulse, None, run)
        contacts = rows(problem, _relative(problem.stiffness), V=V, w=w)
        run = self._bounce(contacts, threshold) if elastic else self._bounce_and_settle(contacts, threshold)
        impulse = run.P * (V / w)
        friction_impulse = run.P_t * (V / w) if problem.has_friction else None
        # Anew from the impulses: large mass ratios cancel most of them, and the sum of many small pushes differs.
        v = problem.v_after(impulse, friction_impulse)
        return _solution(problem, self.tolerance, v, float((problem.J @ v).min()), impulse, friction_impulse, run)

    def _bounce(self, contacts: Rows | Spheres, threshold: float) -> _Run:
        """Elastic rounds until nothing approaches."""
        v = contacts.v_pre.copy()
        u = contacts.relative_velocity(v)
        impulse = np.zeros(u.size)
        friction_impulse = np.zeros(contacts.friction_rows)
        u_min = float(u.min())
        gap_memory = self.gap_memory
        refinement = 1.0
        steps = 0
        visits = u.size
        finished = True
        while finished and (V := -u_min) > threshold:
            v_end, P, P_t, rubbed, taken, seen, finished = contacts.integrate(
                v, u, exponent=self.exponent, h=refinement * self._step(contacts, V), gap_memory=gap_memory,
                threshold=threshold, slowest=max(WAIT * V, threshold), max_steps=self.max_steps - steps,
                max_visits=self.max_visits - visits,
            )  # fmt: skip
            u_end, a, b = contacts.outcome(v, v_end, u, P, P_t)
            steps += taken
            visits += seen + u.size
            # Two strengths lose as much as friction took; the right one is next to 1.
            root = math.copysign(math.sqrt(max(a * a - 2.0 * b * rubbed, 0.0)), a + b)
            scale = 1.0 if b <= 0.0 else max((root - a) / b, 0.0)
            small = abs(scale - 1.0) <= LARGEST_CORRECTION
            if not small and refinement > FINEST and steps < self.max_steps and visits < self.max_visits:
                refinement *= 0.5
                finished = True
                continue
            finished = finished and math.isfinite(scale)
            if finished or small:
                # Else it was stopped in mid-contact, and is not applied.
                apply = _apply if u.size >= SHARED_CONTACTS else _apply_alone
                u_min = apply(scale, P, P_t, v_end, u_end, impulse, friction_impulse, v, u)
            gap_memory = 1.0
        return _Run(v, u_min, impulse, friction_impulse, steps, visits, finished)

    def _bounce_and_settle(self, contacts: Rows, threshold: float) -> _Run:
        """One round with restitution below 1, then rest."""
        v = contacts.v_pre
        u = contacts.relative_velocity(v)
        gap_memory = max(self.gap_memory, SETTLING) if self.gap_memory > 0.0 else 0.0
        # Once gaps are forgotten no contact starts any more: what presses ends as its restitution says.
        v_end, P, P_t, _, steps, visits, finished = contacts.integrate(
            v, u, exponent=self.exponent, h=self._step(contacts, 1.0), gap_memory=gap_memory,
            threshold=threshold, slowest=math.inf, max_steps=self.max_steps,
            max_visits=self.max_visits,
        )  # fmt: skip
        _, a, b = contacts.outcome(v, v_end, u, P, P_t)
        scale = min(-2.0 * a / b, 1.0) if b > 0.0 else 1.0
        v = v + scale * (v_end - v)
        most = min(MOST_SWEEPS, self.max_steps - steps, max(self.max_visits - visits, 0) // u.size)
        v, rest, sweeps, settled = contacts.settle(v, threshold=threshold, max_steps=most)
        visits += sweeps * rest.size
        u_min = float(contacts.relative_velocity(v).min())
        return _Run(v, u_min, scale * P + rest, scale * P_t, steps + sweeps, visits, finished and settled)

    def _step(self, contacts: Rows | Spheres, V: float) -> float:
        """Shortest step of a round whose fastest approach is V."""
        a = 1.0 / (self.exponent + 1.0)
        pair = pair_duration(self.exponent) * (0.5 * (self.exponent + 1.0)) ** a / self.steps_per_contact
        return float(pair * contacts.highest_rate**-a * V ** (1.0 - 2.0 * self.exponent * a))


class _Run(NamedTuple):
    """What rounds come to, in their own units and order."""

    v: Floats
    u_min: float
    P: Floats
    P_t: Floats
    steps: int
    visits: int
    finished: bool


def _relative(stiffness: Floats) -> Floats:
    """Stiffness over its geometric mean; exactly 1 where all are alike."""
    if stiffness.min() == stiffness.max():
        return np.ones(stiffness.size)
    return stiffness / math.exp(float(np.log(stiffness).mean()))


@parallel_kernel
def _apply(
    scale: float, P: Floats, P_t: Floats, v_end: Floats, u_end: Floats,
    impulse: Floats, friction_impulse: Floats, v: Floats, u: Floats,
) -> float:  # fmt: skip
    """Add a part of a round's impulses, and take the velocities as far; returns the least relative velocity."""
    u_min = np.inf
    for i in prange(P.size):
        impulse[i] += scale * P[i]
        u[i] += scale * (u_end[i] - u[i])
        u_min = min(u_min, u[i])
    for i in range(P_t.size):
        friction_impulse[i] += scale * P_t[i]
    for k in prange(v.size):
        v[k] += scale * (v_end[k] - v[k])
    return u_min


_apply_alone = alone(_apply)


def _solution(
    problem: ImpactProblem, tolerance: float, v: Floats, u_min: float, impulse: Floats, friction_impulse: Floats | None,
    run: _Run,
) -> ImpactSolution:  # fmt: skip
    """Judge a run by its velocity v, and the least relative velocity u_min there."""
    if not np.isfinite(v).all():
        status = Status.NOT_FINITE
    elif not run.finished:
        status = Status.ITERATION_LIMIT
    elif u_min < -tolerance * problem.speed:
        # The kernel's velocity passed the test; impulses that cancel (large mass ratios) leave their rounding here.
        status = Status.STALLED
    else:
        status = Status.CONVERGED
    residual = max(-u_min, 0.0) / (problem.speed or 1.0)
    return ImpactSolution(impulse, v, status, run.steps, run.visits, residual, friction_impulse)

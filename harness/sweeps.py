"""Sweeps: one solver over a family of scenes that only tell something together.

    wave           WAV: locality on chains, skill over the three-ball chain (va, 0, -1) and over Newton's cradles
    disturbance    Fig. 12 of Zhang 2015: the cradle whose relative velocities are disturbed by small random numbers

All scenes are free chains of equal balls on a line. Equal balls pass their velocities on, so the ideal exchange sorts
them (Payr 2008); the compliant reference is Hertz contact, integrated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from harness.checked import Tally
from harness.desiderata import skill, wav_locality, wav_skill
from harness.measurement import Measurement, Score, Series, shown
from harness.robustness import response
from scenarios.contacts import line_of_contacts
from solvers import ImpactProblem, Solver, Status
from solvers.hertz import hertz_reference
from solvers.solution import Floats

# Step of the difference quotient, relative to speeds of order 1: a solver's noise of 1e-11 then shows as 1e-8.
SLOPE_STEP = 1e-3
# Speeds of approach of the generic chains lie between this and 1, so that a step never ends an approach.
SLOWEST = 0.2
# Chains on which the slopes are taken, and random velocities on each.
SLOPE_CHAINS = (3, 4, 5)
SLOPE_DRAWS = 2
# Cradles of the skill score, with one to all but one ball moving.
CRADLES = (3, 4, 5, 6, 7)


def chain(v_pre: Floats) -> ImpactProblem:
    """Free chain of equal touching balls of unit mass; v_pre of shape (balls,), positive to the right."""
    return ImpactProblem(np.ones(v_pre.size), line_of_contacts(v_pre.size), v_pre)


def ideal_exchange(v_pre: Floats) -> Floats:
    """Ideal outcome of equal balls on a line, shape (balls,): they pass their velocities on (Payr 2008)."""
    return np.sort(v_pre)


def newton_lcp_of_chain(problem: ImpactProblem) -> Floats:
    """Exact outcome of the elastic Newton LCP on a free chain with no contact separating before, shape (n,).

    W of a chain is an M-matrix, W⁻¹ ≥ 0: the impulses -2 W⁻¹ u⁻ of all contacts push where u⁻ ≤ 0, so that this
    linear system is the whole LCP and needs no solver under test.
    """
    impulse = np.linalg.solve(problem.W.toarray(), -2.0 * problem.u_pre)
    return problem.v_after(impulse)


def closed(solve: Tally, scores: Sequence[Score], series: Sequence[Series]) -> Measurement:
    """Close a sweep; its status is the most frequent one that is not "converged", if there is any."""
    status = max(solve.unfinished, key=lambda label: solve.unfinished[label], default=Status.CONVERGED.label)
    return Measurement(status, solve.iterations, solve.visits, tuple(scores), tuple(series))


def largest_slope(solve: Tally, u_pre: Floats) -> float:
    """Largest |∂u_i⁺/∂u_j⁻|, j ≠ i, on the chain with these relative velocities, shape (m,); central differences."""
    problem = chain(np.concatenate([[0.0], np.cumsum(u_pre)]))
    slopes = np.empty((u_pre.size, u_pre.size))
    for j in range(u_pre.size):
        step = np.where(np.arange(u_pre.size + 1) > j, SLOPE_STEP, 0.0)
        ahead = solve(problem.replace(v_pre=problem.v_pre + step)).v_post
        behind = solve(problem.replace(v_pre=problem.v_pre - step)).v_post
        slopes[:, j] = problem.J @ (ahead - behind) / (2.0 * SLOPE_STEP)
    np.fill_diagonal(slopes, 0.0)
    return float(np.abs(slopes).max())


def wave(solver: Solver, *, seed: int, values: int = 41) -> Measurement:
    """WAV: does the law send waves along chains, and do they come closer to the truth than the Newton LCP does.

    Args:
        solver: the law.
        seed: of the random velocities of the locality score.
        values: number of va in [0, 1].
    """
    solve = Tally(solver)
    scores = [_locality(solve, seed)]
    speeds = np.linspace(0.0, 1.0, values)
    bounce = _Outcomes(solve, [np.array([va, 0.0, -1.0]) for va in speeds])
    scores += bounce.skills("three-ball sweep")
    bounce_series = Series(
        "three-ball sweep",
        {
            "va": speeds.tolist(),
            "v_post": _lists(bounce.outcomes),
            "ideal": _lists(bounce.ideal),
            "hertz": _lists(bounce.hertz),
            "lcp": _lists(bounce.newton),
        },
    )
    cases = [(balls, moving) for balls in CRADLES for moving in range(1, balls)]
    cradles = _Outcomes(solve, [(np.arange(balls) < moving).astype(np.float64) for balls, moving in cases])
    scores += cradles.skills("cradles")
    cradle_series = Series(
        "cradles",
        {
            "balls": [balls for balls, _ in cases],
            "moving": [moving for _, moving in cases],
            "v_post": _lists(cradles.outcomes),
            "ideal": _lists(cradles.ideal),
            "hertz": _lists(cradles.hertz),
        },
    )
    return closed(solve, scores, [bounce_series, cradle_series])


def _locality(solve: Tally, seed: int) -> Score:
    """WAV (a) over random chains on which all contacts approach."""
    rng = np.random.default_rng(seed)
    slopes = {}
    for balls in SLOPE_CHAINS:
        draws = [-rng.uniform(SLOWEST, 1.0, size=balls - 1) for _ in range(SLOPE_DRAWS)]
        slopes[f"{balls} balls"] = max(largest_slope(solve, u_pre) for u_pre in draws)
    return wav_locality(max(slopes.values()), detail=dict(slopes))


class _Outcomes:
    """Outcomes of one solver on some chains, beside the Newton LCP's and both references; each shape (balls,)."""

    def __init__(self, solve: Tally, cases: list[Floats]) -> None:
        problems = [chain(v_pre) for v_pre in cases]
        self.outcomes = [solve(problem).v_post for problem in problems]
        self.newton = [newton_lcp_of_chain(problem) for problem in problems]
        self.ideal = [ideal_exchange(v_pre) for v_pre in cases]
        references = [hertz_reference(problem) for problem in problems]
        self.hertz = [velocity for velocity, _ in references]
        self.uncertainty = max(uncertainty for _, uncertainty in references)

    def skills(self, sweep: str) -> Iterator[Score]:
        """Skill against each reference."""
        cases = len(self.outcomes)
        value = skill(self.outcomes, self.newton, self.ideal)
        yield wav_skill(value, sweep=sweep, reference="ideal exchange", detail={"cases": cases, "uncertainty": 0.0})
        value = skill(self.outcomes, self.newton, self.hertz)
        detail: dict[str, object] = {"cases": cases, "uncertainty": self.uncertainty}
        yield wav_skill(value, sweep=sweep, reference="Hertz", detail=detail)


def disturbance(
    solver: Solver,
    *,
    seed: int,
    balls: Sequence[int] = (3, 4, 5),
    sizes: Sequence[float] = (1e-12, 1e-8, 1e-4, 1e-2),
    draws: int = 100,
) -> Measurement:
    """Fig. 12 of Zhang 2015: the cradle with one ball moving, all relative velocities disturbed.

    Every relative velocity gets its own random number, uniform in ± size times the impact velocity: contacts at rest
    come to approach or to separate.

    Args:
        solver: the law.
        seed: of the disturbances; all sizes share the same ones.
        balls: lengths of the cradles.
        sizes: sizes of the disturbances, relative to the impact velocity.
        draws: disturbances of each size.
    """
    solve = Tally(solver)
    rng = np.random.default_rng(seed)
    largest: dict[float, float] = dict.fromkeys(sizes, 0.0)
    series = []
    for count in balls:
        problem = chain((np.arange(count) < 1).astype(np.float64))
        undisturbed = solve(problem).v_post
        hertz, _ = hertz_reference(problem)
        noise = rng.uniform(-1.0, 1.0, size=(draws, count - 1))
        # u → v: the smallest change of the balls' velocities that changes the relative ones so.
        directions = noise @ np.linalg.pinv(problem.J.toarray()).T
        for size in sizes:
            outcomes = [solve(problem.replace(v_pre=problem.v_pre + size * xi)).v_post for xi in directions]
            largest[size] = max(largest[size], *(response(problem, v, undisturbed) for v in outcomes))
            columns = {
                "balls": count,
                "size": size,
                "v_post": _lists(outcomes),
                "undisturbed": undisturbed.tolist(),
                "hertz": hertz.tolist(),
            }
            series.append(Series("disturbed cradle", columns))
    metric = "largest response, disturbed cradle"
    scores = [shown("robustness", metric, max(largest.values()), detail={"draws": draws, "balls": list(balls)})]
    scores += [shown("robustness", f"{metric}, size {size:g}", value) for size, value in largest.items()]
    return closed(solve, scores, series)


def _lists(rows: list[Floats]) -> list[list[float]]:
    """Vectors as JSON-able lists."""
    return [row.tolist() for row in rows]


SWEEPS: dict[str, Callable[..., Measurement]] = {
    "disturbance": disturbance,
    "wave": wave,
}
"""Name → sweep."""

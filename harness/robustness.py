"""How far a small disturbance of the velocities before the impact moves the outcome.

    response(ε) = ‖v⁺(v⁻ + ε ξ) - v⁺(v⁻)‖∞ / max|u⁻|,   ξ random with max|Jξ| = max|u⁻|

A law with bounded slopes L answers ε with at most L ε. A law that jumps answers 1e-12 with a finite change, and no
measured scene is reproducible there. The jump finder bisects along a disturbance until the interval is as short as
rounding allows: a change that does not shrink with it is a jump.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.checked import Solve, ratio
from harness.measurement import Score, Series, shown
from solvers import ImpactProblem
from solvers.solution import Floats

# Sizes of the disturbances, relative to the largest |u_pre|.
SIZES = (1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1e-1)
# Below this size a response is the solver's own tolerance (1e-12 … 1e-10), not a slope of the law.
SMALLEST_SLOPE = 1e-8
# Size at which many directions are tried: a law that jumps does so along a few directions in a hundred only.
PROBE = 1e-6
# How far along a disturbance a jump is looked for, relative to the largest |u_pre|.
JUMP_REACH = 0.1
# The interval at which bisection ends: 2^-37 of the reach, some thousand roundings wide.
JUMP_WIDTH = 1e-12
# A change below this over any interval is not followed further: slopes up to 1e8 would hide at JUMP_WIDTH.
JUMP_SIZE = 1e-4


@dataclass(frozen=True)
class Jump:
    """A discontinuity of the outcome along a disturbance; size 0 where none was found."""

    size: float
    """Change of v_post over the last interval, over the largest |u_pre|; dimensionless."""

    place: float
    """Distance along the disturbance, relative to the largest |u_pre|."""

    width: float
    """Length of the last interval, in the same unit."""


def response(problem: ImpactProblem, v: Floats, w: Floats) -> float:
    """Return ‖v - w‖∞ over the largest |u_pre|, dimensionless; v, w of shape (n,)."""
    return ratio(float(np.abs(v - w).max(initial=0.0)), problem.speed)


def random_disturbance(problem: ImpactProblem, rng: np.random.Generator) -> Floats:
    """Draw a direction ξ [m/s, rad/s] with max|Jξ| = max|u_pre|, shape (n,).

    Random impulses at the contacts give it, so that it respects units, mass ratios and immovable bodies.
    """
    direction: Floats = problem.JM.T @ (rng.normal(size=problem.m) / problem.W_diagonal)
    fastest = float(np.abs(problem.J @ direction).max(initial=0.0))
    return direction * (problem.speed / fastest if fastest > 0.0 else 0.0)


@dataclass(frozen=True)
class Responses:
    """Responses to disturbances: size → one number for each direction tried at that size."""

    by_size: dict[float, list[float]]

    steepest: Floats
    """The direction that answers PROBE with the largest change [m/s, rad/s], shape (n,)."""


def disturbances(problem: ImpactProblem, rng: np.random.Generator, *, pairs: int) -> list[Floats]:
    """Draw directions and their opposites: a contact at rest approaches along one of each pair."""
    drawn = [random_disturbance(problem, rng) for _ in range(pairs)]
    return [sign * direction for direction in drawn for sign in (1.0, -1.0)]


def responses(
    solve: Solve,
    problem: ImpactProblem,
    v_post: Floats,
    directions: list[Floats],
    *,
    sizes: tuple[float, ...],
    along: int,
) -> Responses:
    """Disturb the scene along every direction by PROBE, and along the first few by every size.

    Args:
        solve: the law.
        problem: the scene.
        v_post: its undisturbed outcome, shape (n,).
        directions: disturbances, each of shape (n,).
        sizes: sizes of the disturbances; PROBE is added.
        along: number of directions that are tried at every size.
    """

    def answer(size: float, direction: Floats) -> float:
        disturbed = solve(problem.replace(v_pre=problem.v_pre + size * direction))
        return response(problem, disturbed.v_post, v_post)

    found = {
        size: [answer(size, direction) for direction in (directions if size == PROBE else directions[:along])]
        for size in sorted({*sizes, PROBE})
    }
    return Responses(found, directions[int(np.argmax(found[PROBE]))])


def find_jump(solve: Solve, problem: ImpactProblem, v_post: Floats, direction: Floats) -> Jump:
    """Bisect along one disturbance for a discontinuity, always into the half that changes more.

    Args:
        solve: the law.
        problem: the scene.
        v_post: its outcome, shape (n,).
        direction: the disturbance, shape (n,), with max|J direction| = max|u_pre|.
    """

    def outcome(place: float) -> Floats:
        return solve(problem.replace(v_pre=problem.v_pre + place * direction)).v_post

    left, right = 0.0, JUMP_REACH
    v_left, v_right = v_post, outcome(JUMP_REACH)
    while right - left > JUMP_WIDTH:
        if response(problem, v_left, v_right) < JUMP_SIZE:
            return Jump(0.0, right, right - left)
        middle = 0.5 * (left + right)
        v_middle = outcome(middle)
        if response(problem, v_left, v_middle) >= response(problem, v_middle, v_right):
            right, v_right = middle, v_middle
        else:
            left, v_left = middle, v_middle
    size = response(problem, v_left, v_right)
    return Jump(size if size >= JUMP_SIZE else 0.0, right, right - left)


def largest_response(found: Responses) -> Score:
    """Robustness: the largest response over all sizes, with the largest of every size in the detail."""
    worst = {size: max(values) for size, values in found.by_size.items()}
    detail: dict[str, object] = {f"{size:.0e}": value for size, value in worst.items()}
    detail["directions"] = max(len(values) for values in found.by_size.values())
    return shown("robustness", "largest response", max(worst.values()), detail=detail)


def lipschitz(found: Responses) -> Score:
    """Robustness: the largest response per size of the disturbance, an estimate of the law's Lipschitz constant."""
    slopes = {size: max(values) / size for size, values in found.by_size.items() if size >= SMALLEST_SLOPE}
    steepest = max(slopes, key=lambda size: slopes[size])
    return shown("robustness", "Lipschitz estimate", slopes[steepest], detail={"size": steepest})


def largest_jump(jumps: list[Jump]) -> Score:
    """Robustness: the largest jump found along some disturbances; 0 where none was found."""
    largest = max(jumps, key=lambda jump: jump.size)
    detail = {
        "place": largest.place,
        "interval": largest.width,
        "directions": len(jumps),
        "found": sum(jump.size > 0 for jump in jumps),
    }
    return shown("robustness", "jump", largest.size, detail=detail)


def response_series(found: Responses) -> Series:
    """Return the responses of every size for a figure."""
    return Series("responses", {"size": list(found.by_size), "response": list(found.by_size.values())})

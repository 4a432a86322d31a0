"""Bodies squeezed from all sides: no motion opens every contact, and an elastic iteration may go on for ever.

    interior:  max t  with  J c ≥ t, |c| ≤ 1        t > 0: the impulses of every elastic law are bounded (Zhang 2015's
    open question of termination); t = 0: Gordan's alternative gives λ ≥ 0, λ ≠ 0 with Jᵀ λ = 0

Source: Vouga 2017 on termination; Gordan's theorem.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from scenarios.contacts import (
    Contacts,
    fixed_contacts,
    map_of_bodies,
    normal_rows,
    plane_angular_momentum,
)
from scenarios.parameters import check_choice, check_count, check_number, given
from scenarios.scenario import Scenario, Symmetry
from solvers import ImpactProblem
from solvers.solution import Floats

# HiGHS solves the linear program to a feasibility of 1e-7; ten times that is no interior.
INTERIOR_TOLERANCE = 1e-6


def interior_margin(problem: ImpactProblem) -> float:
    """How far one motion can open all contacts at once: max t with J c ≥ t and |c| ≤ 1, for rows of J of unit length.

    At most `INTERIOR_TOLERANCE`: the scene is jammed. Without contacts the bound is infinite.
    """
    # SciPy's optimizers are loaded only where somebody asks.
    from scipy.optimize import linprog

    if problem.m == 0:
        return float("inf")
    length = np.sqrt(np.asarray(problem.J.multiply(problem.J).sum(axis=1)).ravel())
    rows = sp.diags_array(1.0 / length) @ problem.J
    answer = linprog(
        np.concatenate([np.zeros(problem.n), [-1.0]]),
        A_ub=sp.csr_array(sp.hstack([-rows, np.ones((problem.m, 1))])),
        b_ub=np.zeros(problem.m),
        bounds=[(-1.0, 1.0)] * problem.n + [(0.0, None)],
        method="highs-ipm",
    )
    if not answer.success:
        raise ArithmeticError(f"the linear program of the interior was not solved: {answer.message}")
    return float(-answer.fun)


def ball_between_walls(*, balls: int = 1, restitution: float = 1.0) -> Scenario:
    """Touching balls in a row between two walls without play, all moving to the right with speed 1.

    Args:
        balls: in the row, ≥ 1.
        restitution: of all contacts, in [0, 1].

    Source: chosen here; the simplest scene without an elastic end.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("balls", balls, 1)
    check_number("restitution", restitution, low=0.0, high=1.0)
    # Contact 0 is the left wall, contact `balls` the right one.
    J = sp.diags_array([np.ones(balls), -np.ones(balls)], offsets=[0, -1], shape=(balls + 1, balls))
    problem = ImpactProblem(np.ones(balls), J, np.ones(balls), restitution)
    return Scenario(
        "ball-between-walls",
        given(ball_between_walls, locals()),
        problem,
        "chosen here",
        symmetries=(Symmetry("mirror", sp.csr_array(-np.eye(balls)[::-1])),),
        tags=frozenset({"chain", "wall", "jammed"}),
    )


def ball_ring(*, balls: int = 8, start: str = "one", restitution: float = 1.0) -> Scenario:
    """A closed ring of balls of radius 0.5 that fills a round drum: each touches two others and the drum.

    Args:
        balls: in the ring, ≥ 3.
        start: "one": ball 0 moves along the ring with speed 1; "all": all move outward with speed 1, against the drum.
        restitution: of all contacts, in [0, 1].

    Source: chosen here.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("balls", balls, 3)
    check_choice("start", start, ("one", "all"))
    check_number("restitution", restitution, low=0.0, high=1.0)
    angle = 2.0 * np.pi * np.arange(balls) / balls
    outward = np.column_stack([np.cos(angle), np.sin(angle)])
    along = np.column_stack([-np.sin(angle), np.cos(angle)])
    # From each ball to the next: along the ring at the angle halfway between them.
    between = angle + np.pi / balls
    to_next = np.column_stack([-np.sin(between), np.cos(between)])
    ring = Contacts(np.arange(balls), np.roll(np.arange(balls), -1), to_next)
    contacts = ring + fixed_contacts(np.arange(balls), -outward)
    velocity = outward.copy() if start == "all" else np.where(np.arange(balls)[:, None] == 0, along, 0.0)
    problem = ImpactProblem(np.ones(2 * balls), normal_rows(contacts, balls), velocity.ravel(), restitution)
    centers = outward * (0.5 / np.sin(np.pi / balls))
    return Scenario(
        "ball-ring",
        given(ball_ring, locals()),
        problem,
        "chosen here",
        symmetries=_ring_group(centers),
        invariants=(plane_angular_momentum(centers),),
        tags=frozenset({"billiards", "ring", "jammed"}),
        dofs_per_body=2,
        positions=centers,
    )


def _ring_group(centers: Floats) -> tuple[Symmetry, ...]:
    """All turns and mirrors of a regular polygon but the identity."""
    balls = len(centers)
    found = []
    for step in range(balls):
        angle = 2.0 * np.pi * step / balls
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        if step:
            found.append(map_of_bodies(f"turn by {step}/{balls}", turn, centers))
        found.append(map_of_bodies(f"mirror {step}/{balls}", turn @ np.diag([1.0, -1.0]), centers))
    return tuple(found)

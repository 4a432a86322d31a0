"""Chains of touching balls on a line, one velocity a ball; contact i lies between balls i and i + 1.

u_i = v_{i+1} - v_i      the wave has to run from contact to contact: what LCP cannot do and QCE is made for
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import scipy.sparse as sp

from scenarios.contacts import line_of_contacts, linear_momenta
from scenarios.parameters import check_count, check_masses, check_number, given
from scenarios.references import (
    hertz,
    ideal_exchange,
    lcp_three_balls,
    qce_three_balls,
    reflection_count,
    reflections_three_balls_at_rest,
    reversed_velocity,
    single_contact,
)
from scenarios.scenario import Reference, ReferenceKind, Scenario, Symmetry
from solvers import ImpactProblem
from solvers.solution import Floats


def three_ball_chain(*, va: float = 0.5, masses: Sequence[float] | None = None, restitution: float = 1.0) -> Scenario:
    """Three touching balls A, B, C with velocities (va, 0, -1): the wave test of the paper.

    Args:
        va: velocity of A [m/s], in [0, 1]; C comes with -1.
        masses: of the three balls [kg]; None: 1 each.
        restitution: of both contacts, in [0, 1].

    Source: Zhang 2015, Fig. 2 and 4.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_number("va", va, low=0.0, high=1.0)
    m = check_masses(masses, 3)
    problem = _chain(m, np.array([va, 0.0, -1.0]), restitution)
    builders: list[Callable[[], Reference]] = []
    if masses is None:
        builders.append(partial(lcp_three_balls, va, restitution))
        if va == 0:
            builders.append(partial(reflections_three_balls_at_rest, restitution))
        if restitution == 1.0:
            builders.append(partial(qce_three_balls, va))
    return Scenario(
        "three-ball-chain",
        given(three_ball_chain, locals()),
        problem,
        "Zhang 2015, Fig. 2 and 4",
        reference_builders=(*_chain_references(problem), *builders),
        symmetries=_mirror(m),
        invariants=linear_momenta(3, 1, "x"),
        tags=frozenset({"chain"}),
    )


def newtons_cradle(
    *, balls: int = 5, moving: int = 1, masses: Sequence[float] | None = None, restitution: float = 1.0
) -> Scenario:
    """Newton's cradle: the first `moving` balls come with velocity 1, the others hang at rest.

    Args:
        balls: number of balls, ≥ 2.
        moving: how many of them move, in [1, balls - 1].
        masses: of the balls [kg]; None: 1 each.
        restitution: of all contacts, in [0, 1].

    Source: Smith 2012 (released scenes), Zhang 2015, Fig. 6.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("balls", balls, 2)
    check_count("moving", moving, 1)
    check_number("moving", moving, low=1, high=balls - 1)
    m = check_masses(masses, balls)
    problem = _chain(m, np.where(np.arange(balls) < moving, 1.0, 0.0), restitution)
    builders: list[Callable[[], Reference]] = []
    if masses is None and moving == 1 and restitution == 1.0:
        builders.append(partial(_one_at_a_time, balls))
    return Scenario(
        "newtons-cradle",
        given(newtons_cradle, locals()),
        problem,
        "Smith 2012, released scenes; Zhang 2015, Fig. 6",
        reference_builders=(*_chain_references(problem), *builders),
        symmetries=_mirror(m),
        invariants=linear_momenta(balls, 1, "x"),
        tags=frozenset({"chain", "cradle"}),
    )


def disturbed_cradle(*, balls: int = 5, size: float = 1e-8, seed: int = 0) -> Scenario:
    """Newton's cradle, the first ball moving, with a random disturbance of every relative velocity.

    Each u_pre gets an independent uniform disturbance in [-size, size]; the total momentum stays that of the cradle.
    "This disturbance should have little effect on the result" (Zhang 2015, Section 5.5).

    Args:
        balls: number of balls, ≥ 2.
        size: largest disturbance [m/s], ≥ 0, beside an impact velocity of 1.
        seed: of the random numbers, ≥ 0.

    Source: Zhang 2015, Section 5.5 and Fig. 12.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("balls", balls, 2)
    check_number("size", size, low=0.0)
    check_count("seed", seed, 0)
    disturbance = size * np.random.default_rng(seed).uniform(-1.0, 1.0, balls - 1)
    added = np.concatenate([[0.0], np.cumsum(disturbance)])
    v_pre = np.where(np.arange(balls) < 1, 1.0, 0.0) + added - added.mean()
    m = np.ones(balls)
    problem = _chain(m, v_pre, 1.0)
    return Scenario(
        "disturbed-cradle",
        given(disturbed_cradle, locals()),
        problem,
        "Zhang 2015, Section 5.5 and Fig. 12",
        reference_builders=_chain_references(problem),
        symmetries=_mirror(m),
        invariants=linear_momenta(balls, 1, "x"),
        tags=frozenset({"chain", "cradle", "disturbed"}),
    )


def three_ball_bounce(*, speed: float = 2.0, restitution: float = 1.0) -> Scenario:
    """Three balls, the outer ones meeting the middle one at the same speed and instant: it must stay where it is.

    Args:
        speed: of the outer balls [m/s], ≥ 0.
        restitution: of both contacts, in [0, 1].

    Source: Smith 2012, released scenes: x = -2, 0, 2 and v = 2, 0, -2 with radius 0.5; here at the instant of impact.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_number("speed", speed, low=0.0)
    m = np.ones(3)
    problem = _chain(m, np.array([speed, 0.0, -speed]), restitution)
    symmetric = partial(reversed_velocity, problem, "mirror symmetry: both contacts rebound alike, u_post = -e u_pre")
    return Scenario(
        "three-ball-bounce",
        given(three_ball_bounce, locals()),
        problem,
        "Smith 2012, released scenes",
        reference_builders=(symmetric, *_chain_references(problem)),
        symmetries=_mirror(m),
        invariants=linear_momenta(3, 1, "x"),
        tags=frozenset({"chain"}),
    )


def _chain(masses: Floats, v_pre: Floats, restitution: float) -> ImpactProblem:
    check_number("restitution", restitution, low=0.0, high=1.0)
    return ImpactProblem(1.0 / masses, line_of_contacts(masses.size), v_pre, restitution)


def _chain_references(problem: ImpactProblem) -> tuple[Callable[[], Reference], ...]:
    """What is known of any free chain: Hertz where it is elastic, the exchange where the balls are equal too."""
    if problem.m == 1:
        return (partial(single_contact, problem),)
    if (problem.restitution < 1.0).any():
        return ()
    mass = problem.inverse_mass.diagonal()
    if (mass == mass[0]).all():
        return (partial(ideal_exchange, problem), partial(hertz, problem))
    return (partial(hertz, problem),)


def _mirror(masses: Floats) -> tuple[Symmetry, ...]:
    """The chain seen from its other side, where its masses are the same from there."""
    if not (masses == masses[::-1]).all():
        return ()
    return (Symmetry("mirror", sp.csr_array(-np.eye(masses.size)[::-1])),)


def _one_at_a_time(balls: int) -> Reference:
    """In a cradle of equal balls with one moving, one contact approaches at a time, and each only once."""
    return reflection_count(
        balls - 1,
        "one contact after the other; n - 1 by Smith 2012's released code",
        ("qce", "gr"),
        ReferenceKind.CLOSED_FORM,
    )

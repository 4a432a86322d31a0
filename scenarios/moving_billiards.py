"""Billiards in motion, from impact to impact: four balls in a drum, and the break of a rack."""

from __future__ import annotations

from functools import partial

import numpy as np

from scenarios.billiards import DRUM_RADIUS, RADIUS, pool_break
from scenarios.parameters import check_choice, check_number
from scenarios.world.container import Container, drum
from scenarios.world.events import EventWorld, FreeFlight
from scenarios.world.impact import Resolver
from scenarios.world.moving_scene import MovingScene, MovingWorld
from scenarios.world.spheres import Spheres, spheres
from solvers.solution import Floats

STARTS = {
    "top": [[0.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]],
    "inward": [[0.0, -1.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]],
    "outward": [[0.0, 1.0], [0.0, -1.0], [-1.0, 0.0], [1.0, 0.0]],
}
"""Start → velocities of the top, bottom, left and right ball [m/s].

In this order the sums of mirror images are formed alike, so that rounding itself is symmetric: a billiard of balls
multiplies any difference by a factor at each impact, and 1e-16 would be everything after some hundred of them.
"""


ASYMMETRY = "asymmetry [radii]"
"""Measure: largest distance of a ball from where symmetry would have it."""
# Time that the balls of a broken rack fly on, and between two frames [s].
AFTERWARDS = 10.0
FRAME_TIME = 0.1
# Share of the cue ball's speed above which a ball is said to move.
MOVING_SHARE = 0.01


def four_balls_in_motion(*, start: str = "top", restitution: float = 1.0) -> MovingScene:
    """Four balls of radius 1 in a fixed drum of radius 4, for as many impacts as you like.

    They start in a touching ring at (0, √2), (0, -√2), (-√2, 0), (√2, 0).

    Args:
        start: "top": the top ball moves up with speed 1, as in the released scene; "inward" and "outward": all four.
        restitution: of all contacts, in [0, 1].

    Source: Smith 2012, released scenes; Zhang 2015, Fig. 7.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_choice("start", start, tuple(STARTS))
    check_number("restitution", restitution, low=0.0, high=1.0)
    return MovingScene(
        "four-ball-circle",
        {"start": start, "restitution": restitution},
        "four balls in a drum, which symmetry keeps in step",
        "Smith 2012, released scenes; Zhang 2015, Fig. 7",
        partial(_four_balls, start, restitution),
        default_solver="qce",
        default_steps=10_000,
        frame_time=0.5,
        measure=partial(circle_measures, start),
        judged={"SYM": ASYMMETRY},
        trace="xy",
    )


def _four_balls(start: str, restitution: float, identity: str, resolver: Resolver, seed: int) -> EventWorld:
    ring = np.sqrt(2.0) * np.array([[0.0, 1.0], [0.0, -1.0], [-1.0, 0.0], [1.0, 0.0]])
    balls = _on_table(ring, np.array(STARTS[start]), 1.0)
    return EventWorld(identity, FreeFlight(balls, drum(DRUM_RADIUS)), resolver, restitution=restitution)


def circle_measures(start: str, world: MovingWorld) -> dict[str, float]:
    """How far four balls are from symmetric."""
    return {ASYMMETRY: asymmetry(world.spheres, start)}


def asymmetry(balls: Spheres, start: str) -> float:
    """How far four balls are from the mirror image of themselves [m].

    "top" is symmetric about the y axis: left and right change places, top and bottom stay. The other starts are
    symmetric by quarter turns: there all four are compared, turned back to the top.

    Args:
        balls: of `four_balls_in_motion`.
        start: its start.
    """
    x = balls.by_label(balls.position)[:, :2]
    if start == "top":
        mirrored = x[[0, 1, 3, 2]] * (-1.0, 1.0)
        return float(np.abs(x - mirrored).max())
    turned = np.array([x[0], -x[1], (x[2, 1], -x[2, 0]), (-x[3, 1], x[3, 0])])
    return float(np.abs(turned - turned[0]).max())


def rack_measures(world: MovingWorld) -> dict[str, float]:
    """How far a rack is from its mirror image about the x axis, and how many of its balls move."""
    x = world.spheres.position
    distance = np.linalg.norm(x[:, None] - x * (1.0, -1.0, 1.0), axis=2).min(axis=1)
    speed = np.linalg.norm(world.spheres.velocity, axis=1)
    return {ASYMMETRY: float(distance.max() / RADIUS), "balls that move": float((speed > MOVING_SHARE).sum())}


def pool_break_in_motion(
    *, rack: str = "triangle", balls: int | None = None, struck: str = "one", restitution: float = 1.0,
    friction: float = 0.0, approach: float = 4.0,
) -> MovingScene:  # fmt: skip
    """Break of a rack on an endless table: the cue ball comes with speed 1, and the balls fly apart.

    Args:
        rack: "triangle" or "nine-ball".
        balls: in the rack; None: 15 in a triangle, 9 in the diamond.
        struck: "one" or "both", as in the impact of this name.
        restitution: of all contacts, in [0, 1].
        friction: coefficient of all contacts, ≥ 0.
        approach: distance of a cue ball from where it meets the rack, ≥ 0 [m].

    Source: Smith 2012 (released scenes), Zhang 2015, Fig. 5.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_number("approach", approach, low=0.0)
    impact = pool_break(rack=rack, balls=balls, struck=struck, restitution=restitution, friction=friction)
    assert impact.positions is not None
    velocity = np.zeros_like(impact.positions)
    velocity[0, 0] = 1.0
    if struck == "both":
        velocity[-1, 0] = -1.0
    return MovingScene(
        "pool-break",
        {
            "rack": rack,
            "balls": balls,
            "struck": struck,
            "restitution": restitution,
            "friction": friction,
            "approach": approach,
        },
        "the break of a rack, mirror-symmetric about its axis",
        impact.source,
        partial(_pool_break, impact.positions - approach * velocity, velocity, restitution, friction),
        default_solver="qce" if restitution == 1.0 and friction == 0.0 else "qce-lcp",
        frame_time=FRAME_TIME,
        duration=approach + AFTERWARDS,
        measure=rack_measures,
        judged={"SYM": ASYMMETRY},
        color="speed [m/s]",
        trace="xy",
    )


def _pool_break(
    positions: Floats,
    velocity: Floats,
    restitution: float,
    friction: float,
    identity: str,
    resolver: Resolver,
    seed: int,
) -> EventWorld:
    flight = FreeFlight(_on_table(positions, velocity, RADIUS), Container())
    return EventWorld(identity, flight, resolver, restitution=restitution, friction=friction)


def _on_table(positions: Floats, velocity: Floats, radius: float) -> Spheres:
    """Equal balls of mass 1 in the plane z = 0."""
    level = np.zeros(len(positions))
    return spheres(np.column_stack([positions, level]), radius, 1.0, np.column_stack([velocity, level]))

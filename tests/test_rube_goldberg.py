"""The machine's stages one by one, and the whole chain: with the wave it works, without it breaks at the gap."""

from __future__ import annotations

import numpy as np
import pytest

from reports.simulation import solids_of, stages_markdown
from scenarios import CATALOG
from scenarios.rube_goldberg import (
    BALL,
    CATCH,
    CORNER,
    GAP_END,
    RACK_AT,
    STAGES,
    TABLE,
    TRACK_END,
    TRACK_HEIGHT,
    WIDE,
    first_track,
    oblique_track,
    rack,
    rube_goldberg,
    second_track,
)
from scenarios.world.moving_scene import STAGES_FIRED
from scenarios.world.rigid_world import RigidWorld
from solvers import SOLVERS, Solver, Status
from solvers.newton_lcp import NewtonLcp
from solvers.qce_lcp import QceLcp

LAWS: dict[str, Solver] = {
    "qce-lcp": QceLcp(tolerance=1e-9, max_sweeps=1000),
    "lcp-pgs": NewtonLcp(tolerance=1e-9, max_iterations=1000),
}
SPEED = 2.5


def machine(law: str) -> RigidWorld:
    world = rube_goldberg().world(solver=LAWS[law])
    assert isinstance(world, RigidWorld)
    return world


def set_rolling(world: RigidWorld, name: str, place: tuple[float, float, float], speed: float) -> None:
    """Put a ball somewhere, rolling along x: the stages before it need not be waited for."""
    state = {key: array.copy() for key, array in world.state().items()}
    k = world.index(name)
    state["position"][k] = place
    state["orientation"][k] = (1.0, 0.0, 0.0, 0.0)
    state["velocity"][k] = (speed, 0.0, 0.0, 0.0, speed / BALL, 0.0)
    world.restore(state)


def run(world: RigidWorld, seconds: float) -> None:
    for _ in range(round(seconds / world.settings.step)):
        world.step()


def after_the_three_balls(law: str) -> RigidWorld:
    """The machine shortly after the first ball has met the three others."""
    world = machine(law)
    set_rolling(world, "first ball", (TRACK_END - 0.05 - 6.0 * BALL - 0.05, 0.0, TRACK_HEIGHT), SPEED)
    run(world, 0.05)
    return world


def speeds_of_the_four(world: RigidWorld) -> np.ndarray:
    names = ["first ball", "ball 1", "ball 2", "ball 3"]
    return np.array([world.velocity[world.index(name), 0] for name in names])


# Newton's law in a chain of four: W λ = 2 u gives λ = (3/2, 1, 1/2) v.
@pytest.mark.parametrize(
    ("law", "share", "flies"), [("qce-lcp", [0.0, 0.0, 0.0, 1.0], True), ("lcp-pgs", [-0.5, 0.5, 0.5, 0.5], False)]
)
def test_the_last_ball_takes_all_velocity_and_flies_over_the_gap_with_the_wave_alone(
    law: str, share: list[float], flies: bool
) -> None:
    world = after_the_three_balls(law)
    # The balls have friction 0.05 among themselves, and the first one rolls on: some hundredths are lost.
    assert speeds_of_the_four(world) / SPEED == pytest.approx(share, abs=0.06)
    last = world.index("ball 3")
    while world.position[last, 0] < GAP_END and world.position[last, 2] > TABLE:
        world.step()
    assert bool(world.position[last, 0] >= GAP_END) is flies


def test_the_corner_ball_leaves_the_rack_along_the_line_of_the_second_track() -> None:
    world = machine("qce-lcp")
    set_rolling(world, "waiting ball", (RACK_AT - 2.0 * BALL - 0.02, 0.0, rack()[0, 2]), SPEED)
    run(world, 0.03)
    left, right = (world.velocity[world.index(f"rack ball {k}")] for k in (6, 9))
    # The track is wider than the ball; friction by a pyramid bends the way on the table by some degrees.
    assert np.arctan2(right[1], right[0]) == pytest.approx(CORNER, abs=(WIDE - BALL) / CATCH)
    # Mirror images, but for friction's sweeps from contact to contact, which leave 1e-4.
    assert left == pytest.approx(right * (1.0, -1.0, 1.0), abs=1e-3)


@pytest.mark.parametrize(("law", "share"), [("qce", 0.56), ("lcp-pgs", 0.25)])
def test_the_corner_ball_of_a_rack_of_ten_is_twice_as_fast_with_the_wave(law: str, share: float) -> None:
    solution = SOLVERS[law]().solve(CATALOG["pool-break"](balls=10).problem)
    assert np.linalg.norm(solution.v_post[-2:]) == pytest.approx(share, abs=0.005)


def test_tracks_begin_and_end_where_stages_meet() -> None:
    first, oblique, second = first_track(), oblique_track(), second_track()
    assert first.rest(first.length, BALL) == pytest.approx([TRACK_END, 0.0, TRACK_HEIGHT], abs=1e-9)
    assert oblique.rest(oblique.length, BALL)[:2] == pytest.approx([6.65, 0.0], abs=1e-4)
    towards = second.rest(0.0, BALL)[:2] - rack()[-1][:2]
    assert np.arctan2(towards[1], towards[0]) == pytest.approx(CORNER, abs=1e-6)
    assert second.direction(second.length)[:2] == pytest.approx([np.cos(CORNER), np.sin(CORNER)], abs=1e-4)


def test_nothing_moves_before_the_first_ball_comes() -> None:
    world = machine("qce-lcp")
    start = world.position.copy()
    run(world, 0.1)
    moved = np.linalg.norm(world.position - start, axis=1)
    moved[world.index("first ball")] = 0.0
    # Cards and dominos settle by the starting gaps between them.
    assert moved.max() < 1e-4


def test_stages_are_looked_at_in_their_order() -> None:
    world = machine("qce-lcp")
    # The last stage's ball is moved to its end: without the stages before it, none fires.
    set_rolling(world, "rack ball 9", (20.0, 0.0, BALL), 0.0)
    world.step()
    assert not world.fired


def test_the_page_says_when_each_stage_fired_and_where_the_chain_breaks() -> None:
    scene = rube_goldberg()
    time = np.array([0.0, 1.0, 2.0, 3.0])
    names = list(STAGES)
    page = stages_markdown(scene, {"time": time, STAGES_FIRED: np.array([0.0, 1.0, 1.0, 1.0])})
    assert f"| 1 | {names[0]} | 1 |" in page
    assert f"| 2 | {names[1]} | did not fire |" in page
    assert f"The chain breaks before: {names[1]}." in page
    whole = stages_markdown(scene, {"time": time, STAGES_FIRED: np.array([0.0, 3.0, 3.0, 9.0])})
    assert f"| 9 | {names[8]} | 3 |" in whole
    assert "All stages fired in their order." in whole


def test_every_body_is_drawn_and_each_kind_has_its_color() -> None:
    solids = solids_of(rube_goldberg())
    color = {solid.color for solid in solids if solid.body >= 0}
    assert sorted(solid.body for solid in solids if solid.body >= 0) == list(range(len(machine("qce-lcp").names)))
    # first ball, ball, card, domino, seesaw, waiting ball, rack ball, pillar: the colors begin anew at the eighth.
    assert len(color) == 7
    # The ground, two tables, the stop and three tracks.
    assert sum(solid.body < 0 for solid in solids) == 7


@pytest.mark.long
def test_with_the_wave_all_stages_fire_in_order() -> None:
    scene = rube_goldberg()
    world = machine("qce-lcp")
    unsolved = 0
    while len(world.fired) < len(STAGES) and world.steps < scene.default_steps:
        unsolved += world.step().status is not Status.CONVERGED
    print(f"\n{unsolved} of {world.steps} steps not converged", end="")
    for name, time in world.fired.items():
        print(f"\n{time:7.3f} s  {name}", end="")
    assert list(world.fired) == list(STAGES)
    assert sorted(world.fired.values()) == list(world.fired.values())
    # Friction has impacts whose solutions iterations turn away from.
    assert unsolved <= 0.01 * world.steps


@pytest.mark.long
def test_without_the_wave_the_chain_breaks_at_the_gap() -> None:
    world = machine("lcp-pgs")
    run(world, 6.0)
    print(f"\n{world.fired}")
    assert list(world.fired) == list(STAGES)[:1]
    # It lies on the ground.
    assert world.position[world.index("ball 3"), 2] < 2.0 * BALL

"""Gutters for balls: gaps and normals against closed forms and against a search over the whole sheet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.world.impact import ByProblem
from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.rigid_world import RigidSettings, RigidWorld
from scenarios.world.shapes import ball
from scenarios.world.track import Gutter, helix, joined, ramp, straight
from solvers import ProblemError
from solvers.qce_lcp import QceLcp

# A straight axis is its own spline; what remains is rounding.
ROUNDING = 1e-13
# A spline through points h apart leaves a circle of radius R by less than R (h / R)⁴ / 384 (de Boor 1978, for cubics
# that match slopes at both ends; three times as much near free ends).
RADIUS, SPACING = 0.5, 0.02
SPLINE = 3.0 * RADIUS * (SPACING / RADIUS) ** 4 / 384.0
A, BALL = 0.13, 0.1
GRAVITY = 9.81


def flat(half_opening: float = 1.4) -> Gutter:
    return Gutter(straight((0.0, 0.0, 1.0), (2.0, 0.0, 1.0), spacing=0.1), A, half_opening)


def spiral(half_opening: float = 1.4) -> Gutter:
    return Gutter(helix((0.0, 0.0), RADIUS, angles=(0.0, 9.0), heights=(2.0, 1.0), spacing=SPACING), A, half_opening)


def in_helix(angle: float, across: float) -> tuple[np.ndarray, np.ndarray]:
    """Point of the axis of `spiral`, and the unit vector across it at an angle from its bottom."""
    fall = -1.0 / 9.0
    axis = np.array([RADIUS * np.cos(angle), RADIUS * np.sin(angle), 2.0 + fall * angle])
    tangent = np.array([-RADIUS * np.sin(angle), RADIUS * np.cos(angle), fall])
    tangent /= np.linalg.norm(tangent)
    down = tangent[2] * tangent - np.array([0.0, 0.0, 1.0])
    down /= np.linalg.norm(down)
    return axis, np.cos(across) * down + np.sin(across) * np.cross(tangent, down)


SEARCHED = spiral(np.pi).mesh()


@pytest.mark.parametrize("height", [-0.02, 0.0, 0.01])
def test_a_ball_at_the_bottom_of_a_straight_gutter_has_the_gap_of_its_height(height: float) -> None:
    center = np.array([[0.77, 0.0, 1.0 - (A - BALL) + height]])
    index, point, normal, gap = flat().contacts(center, np.array([BALL]), 0.05)
    assert index.tolist() == [0]
    assert gap == pytest.approx([height], abs=ROUNDING)
    assert normal == pytest.approx(np.array([[0.0, 0.0, 1.0]]), abs=ROUNDING)
    assert point == pytest.approx(np.array([[0.77, 0.0, 1.0 - A]]), abs=ROUNDING)


@given(angle=st.floats(-1.3, 1.3), depth=st.floats(-0.02, 0.02), along=st.floats(0.1, 1.9))
@settings(max_examples=25, deadline=None)
def test_inside_a_straight_gutter_the_normal_points_to_the_axis(angle: float, depth: float, along: float) -> None:
    outward = np.array([0.0, np.sin(angle), -np.cos(angle)])
    center = np.array([along, 0.0, 1.0]) + (A - BALL + depth) * outward
    _, _, normal, gap = flat().contacts(center[None], np.array([BALL]), 0.1)
    assert gap == pytest.approx([-depth], abs=ROUNDING)
    assert normal[0] == pytest.approx(-outward, abs=1e-10)


def test_the_sheet_holds_from_below_too() -> None:
    center = np.array([[1.0, 0.0, 1.0 - A - BALL - 0.001]])
    _, _, normal, gap = flat().contacts(center, np.array([BALL]), 0.01)
    assert gap == pytest.approx([0.001], abs=ROUNDING)
    assert normal == pytest.approx(np.array([[0.0, 0.0, -1.0]]), abs=ROUNDING)


def test_past_the_end_a_ball_touches_the_edge() -> None:
    edge = np.array([2.0, 0.0, 1.0 - A])
    away = np.array([0.6, 0.0, 0.8])
    _, point, normal, gap = flat().contacts((edge + (BALL + 0.003) * away)[None], np.array([BALL]), 0.01)
    assert point[0] == pytest.approx(edge, abs=ROUNDING)
    assert normal[0] == pytest.approx(away, abs=1e-10)
    assert gap == pytest.approx([0.003], abs=ROUNDING)


def test_over_a_rim_a_ball_touches_the_rim() -> None:
    gutter = flat(half_opening=0.7)
    rim = np.array([1.0, A * np.sin(0.7), 1.0 - A * np.cos(0.7)])
    for away in (np.array([0.0, 0.6, 0.8]), np.array([0.0, -0.6, 0.8])):
        # Both sides of the gutter: the sign of `side` must not matter.
        mirrored = rim * (1.0, np.sign(away[1]), 1.0)
        _, point, normal, gap = gutter.contacts((mirrored + BALL * away)[None], np.array([BALL]), 0.01)
        assert point[0] == pytest.approx(mirrored, abs=ROUNDING)
        assert normal[0] == pytest.approx(away, abs=1e-10)
        assert gap == pytest.approx([0.0], abs=ROUNDING)


@given(angle=st.floats(0.3, 8.7), across=st.floats(-1.2, 1.2), gap=st.floats(-0.01, 0.01))
@settings(max_examples=25, deadline=None)
def test_in_a_helix_gap_and_normal_are_those_of_the_tube(angle: float, across: float, gap: float) -> None:
    # The tube of radius a about a helix is the set of points at distance a from it, in the plane across it.
    axis, outward = in_helix(angle, across)
    _, _, normal, found = spiral().contacts((axis + (A - BALL - gap) * outward)[None], np.array([BALL]), 0.1)
    assert found == pytest.approx([gap], abs=SPLINE)
    # A shift of the axis turns the normal by as much over the distance to it.
    assert normal[0] == pytest.approx(-outward, abs=30.0 * SPLINE / (A - BALL - 0.01))


def test_normals_are_continuous_along_a_track_of_several_pieces() -> None:
    turn = helix((0.0, 0.0), RADIUS, angles=(0.0, 1.5 * np.pi), heights=(1.5, 1.0), spacing=SPACING)
    run = straight((0.0, -RADIUS, 1.0), (1.0, -RADIUS, 1.0), spacing=SPACING)
    gutter = Gutter(joined(turn, run), A)
    along = np.linspace(0.0, gutter.length, 8_001)
    centers = np.array([gutter.rest(t, BALL) for t in along])
    index, _, normal, gap = gutter.contacts(centers, np.full(along.size, BALL), 1e-6)
    assert index.size == along.size
    assert np.abs(gap).max() < 1e-12
    # The bottom's normal turns by the change of slope, 0.2 at the foot of the helix, over a spacing or two, which
    # are forty samples each. A facet would turn it by all at once.
    assert np.linalg.norm(np.diff(normal, axis=0), axis=1).max() < 0.0125


@given(angle=st.floats(0.5, 8.5), across=st.floats(-3.1, 3.1), distance=st.floats(0.0, 0.3))
@settings(max_examples=25, deadline=None)
def test_the_nearest_point_is_the_nearest_of_a_search_over_the_sheet(
    angle: float, across: float, distance: float
) -> None:
    # Closed all around: on a bent rim the nearest point is an approximation.
    gutter = spiral(np.pi)
    axis, outward = in_helix(angle, across)
    center = (axis + distance * outward)[None]
    points, _ = SEARCHED
    nearest = float(np.linalg.norm(points - center, axis=1).min())
    _, point, normal, gap = gutter.contacts(center, np.array([BALL]), 10.0)
    # No point of the sheet is farther than 0.04 from one of the search.
    assert nearest - 0.04 < gap[0] + BALL <= nearest + SPLINE
    assert np.linalg.norm(point[0] - center[0]) == pytest.approx(gap[0] + BALL, abs=ROUNDING)
    assert np.linalg.norm(normal[0]) == pytest.approx(1.0, abs=ROUNDING)


def test_a_ramp_is_level_at_both_ends() -> None:
    points = ramp((0.0, 0.0, 1.0), (2.0, 1.0, 0.4), spacing=0.01)
    gutter = Gutter(points, A)
    for end in (0.0, gutter.length):
        # The chord of the last interval is as steep as the cosine is after half of it.
        assert abs(gutter.direction(end)[2]) < 0.01
    assert gutter.direction(0.5 * gutter.length)[2] < -0.3


def test_how_far_a_ball_has_come_is_the_parameter_of_its_place() -> None:
    gutter = spiral()
    for along in (0.0, 0.7, 2.0, gutter.length):
        assert gutter.passed(gutter.rest(along, BALL)) == pytest.approx(along, abs=1e-9)


def rolling(gutter: Gutter, friction: float, seconds: float, start: float) -> RigidWorld:
    """A ball that is let go in a gutter; friction is that of the contact."""
    thrown = RigidBody("ball", ball(BALL), gutter.rest(start, BALL), friction=friction)
    law = ByProblem(QceLcp(tolerance=1e-9))
    world = RigidWorld("test", [thrown], RigidSettings(gravity=GRAVITY), law, obstacles=[gutter])
    for _ in range(round(seconds / world.settings.step)):
        world.step()
    return world


def test_a_ball_rolls_down_a_straight_gutter_with_five_sevenths_of_the_slope() -> None:
    angle = 0.3
    down = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    points = straight((0.0, 0.0, 2.0), tuple(np.array([0.0, 0.0, 2.0]) + 3.0 * down), spacing=0.1)
    world = rolling(Gutter(points, A, friction=1.0), 1.0, 0.5, 0.1)
    assert world.velocity[0] @ down == pytest.approx(5.0 / 7.0 * GRAVITY * np.sin(angle) * 0.5, rel=1e-6)


def test_a_smooth_ball_comes_down_a_helix_with_all_of_its_energy() -> None:
    gutter = Gutter(helix((0.0, 0.0), RADIUS, angles=(0.0, 9.0), heights=(2.0, 1.0), spacing=SPACING), A, friction=0.0)
    world = rolling(gutter, 0.0, 1.0, 0.1)
    fallen = gutter.rest(0.1, BALL)[2] - world.position[0, 2]
    assert fallen > 0.1
    # A step turns the velocity by v Δt / R, and the law takes the square of that: 0.2 % over 1 rad at 1 m/s.
    assert (world.velocity[0] ** 2).sum() == pytest.approx(2.0 * GRAVITY * fallen, rel=0.01)


def test_only_balls_within_reach_are_found() -> None:
    low = 1.0 - (A - BALL)
    centers = np.array([[0.5, 0.0, low + 0.01], [0.9, 0.0, low + 0.002], [1.5, 3.0, low]])
    index, *_ = flat().contacts(centers, np.full(3, BALL), 0.005)
    assert index.tolist() == [1]


@pytest.mark.parametrize(
    ("points", "half_opening", "rule"),
    [
        (np.zeros((3, 3)), 1.0, "at least 4"),
        (np.full((5, 3), np.nan), 1.0, "finite"),
        (np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), 1.0, "point 0 is twice"),
        (straight((0, 0, 1), (0, 0, 0), spacing=0.1), 1.0, "straight up or down"),
        (straight((0, 0, 1), (1, 0, 0), spacing=0.1), 4.0, "half_opening"),
    ],
)
def test_what_is_no_gutter_is_refused_by_the_rule(points: np.ndarray, half_opening: float, rule: str) -> None:
    with pytest.raises(ProblemError, match=rule):
        Gutter(points, A, half_opening)

"""Moving scenes of few bodies: exact times of impact, symmetry, energy, what the scenes are known for."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from scenarios.granular import DEPTH, DRIVING, falling_gas, layer_displacement, vibration
from scenarios.moving import MOVING
from scenarios.moving_billiards import asymmetry
from scenarios.pendulums import Pendulums
from scenarios.world.checkpoint import CheckpointError, checkpoint, resume
from scenarios.world.container import Container, Still, box, drum
from scenarios.world.events import EventWorld, FreeFlight
from scenarios.world.impact import ByProblem, Streamed
from scenarios.world.spheres import spheres
from solvers import SOLVERS, ProblemError, Status, UnsupportedProblem

QCE = ByProblem(SOLVERS["qce"]())
# Some products and roots.
ROUNDING = 1e-13


def event_world(name: str, *, solver: str = "qce", **parameters: object) -> EventWorld:
    world = MOVING[name](**parameters).world(solver=solver)
    assert isinstance(world, EventWorld)
    return world


def test_two_balls_meet_at_the_exact_time_and_exchange_velocities() -> None:
    balls = spheres([[0.0, 0.0, 0.0], [3.0, 0.6, 0.0]], 0.5, 1.0, [[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    world = EventWorld("two", FreeFlight(balls, Container()), QCE)
    report = world.step()
    # The centers are 1 apart: 0.6 across, 0.8 along.
    assert report.time == pytest.approx((3.0 - 0.8) / 2.0, rel=ROUNDING)
    normal = np.array([0.8, 0.6, 0.0])
    assert balls.velocity[1] == pytest.approx(2.0 * 0.8 * normal, abs=ROUNDING)
    assert report.energy.kinetic == pytest.approx(2.0, rel=ROUNDING)
    assert world.over
    with pytest.raises(ProblemError, match="no further impact"):
        world.step()


def test_a_ball_in_a_box_and_one_in_a_drum_return_on_time() -> None:
    ball = spheres([[2.0, 3.0, 2.0]], 0.5, 1.0, [[0.5, 0.0, 0.0]])
    world = EventWorld("box", FreeFlight(ball, box(5.0, 6.0, Still())), QCE)
    assert [world.step().time for _ in range(3)] == pytest.approx([5.0, 13.0, 21.0], rel=ROUNDING)
    ball = spheres([[0.0, 0.0, 0.0]], 1.0, 1.0, [[0.0, 2.0, 0.0]])
    world = EventWorld("drum", FreeFlight(ball, drum(4.0)), QCE)
    assert [world.step().time for _ in range(3)] == pytest.approx([1.5, 4.5, 7.5], rel=ROUNDING)


@pytest.mark.parametrize("start", ["top", "inward", "outward"])
def test_four_balls_stay_symmetric_to_the_last_bit(start: str) -> None:
    world = event_world("four-ball-circle", start=start)
    energy = world.spheres.kinetic_energy()
    for _ in range(300):
        assert world.step().status is Status.CONVERGED
        assert asymmetry(world.spheres, start) == 0.0
    assert world.spheres.kinetic_energy() == pytest.approx(energy, rel=300 * ROUNDING)


@pytest.mark.long
def test_four_balls_stay_symmetric_for_ten_thousand_impacts() -> None:
    world = event_world("four-ball-circle")
    for _ in range(10_000):
        world.step()
        assert asymmetry(world.spheres, "top") == 0.0


def test_pairwise_impacts_break_the_symmetry_of_four_balls() -> None:
    world = event_world("four-ball-circle", solver="gauss-seidel")
    for _ in range(10):
        world.step()
    assert asymmetry(world.spheres, "top") > 0.1


@pytest.mark.parametrize("name", ["qce", "gr", "lcp-pgs"])
def test_a_break_flies_apart_in_a_mirror_symmetric_pattern(name: str) -> None:
    world = event_world("pool-break", solver=name)
    impacts = 0
    while not world.over:
        impacts += 1
        assert world.step().status is Status.CONVERGED
    world.flight.advance(10.0)
    x = world.spheres.position
    distance = np.linalg.norm(x[:, None] - x * (1.0, -1.0, 1.0), axis=2).min(axis=1)
    # The solvers' own tolerance, 1e-9 of the speed, times the time of flight.
    assert distance.max() <= 1e-7
    assert impacts >= 1
    assert world.spheres.kinetic_energy() == pytest.approx(0.5, rel=1e-9)


@pytest.mark.parametrize(("balls", "raised"), [(5, 1), (5, 2), (7, 3)])
@pytest.mark.parametrize("name", ["qce", "gr"])
def test_as_many_balls_fly_from_the_cradle_as_were_raised(balls: int, raised: int, name: str) -> None:
    world = event_world("cradle-3d", balls=balls, raised=raised, solver=name)
    energy = sum(world.flight.energies())
    for swing in range(1, 7):
        world.step()
        assert sum(world.flight.energies()) == pytest.approx(energy, rel=1e-9)
        flying = np.abs(world.spheres.velocity[:, 0]) > 1e-6
        assert flying.sum() == raised
        assert flying[-raised:].all() if swing % 2 else flying[:raised].all()
        # A quarter, then every half of a period.
        assert world.time == pytest.approx((swing / 2.0 - 0.25) * world.period, rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(("balls", "raised"), [(5, 1), (5, 2), (5, 3), (7, 1), (7, 2), (7, 3)])
def test_the_cradle_keeps_swinging_for_twenty_periods(balls: int, raised: int) -> None:
    world = event_world("cradle-3d", balls=balls, raised=raised)
    energy = sum(world.flight.energies())
    while world.time < 20.0 * world.period:
        world.step()
    assert (np.abs(world.spheres.velocity[:, 0]) > 1e-6).sum() == raised
    assert sum(world.flight.energies()) == pytest.approx(energy, rel=1e-12)


def test_a_pendulum_swings_as_fine_steps_do() -> None:
    swing = Pendulums(np.array([-1.2, 0.3]), length=2.0, gravity=9.81, period=3.0)
    swing.velocity[:] = (0.4, -0.7)
    angle, v = swing.angle.copy(), swing.velocity.copy()
    step, steps = 1e-4, 12_345
    for _ in range(steps):
        # Velocity Verlet; its error is (ω Δt)² / 24 a radian.
        v += 0.5 * step * -9.81 * np.sin(angle)
        angle += step * v / 2.0
        v += 0.5 * step * -9.81 * np.sin(angle)
    swing.advance(step * steps)
    assert swing.angle == pytest.approx(angle, abs=1e-7)
    assert swing.velocity == pytest.approx(v, abs=1e-6)


def test_a_cradle_with_friction_is_refused() -> None:
    world = event_world("cradle-3d")
    world.friction = 0.1
    with pytest.raises(UnsupportedProblem, match="friction"):
        world.step()


def test_a_packed_solver_is_refused_for_few_bodies() -> None:
    with pytest.raises(ProblemError, match="solver must be one of SOLVERS"):
        MOVING["pool-break"]().world(solver=Streamed())


@pytest.mark.parametrize("name", ["four-ball-circle", "cradle-3d"])
def test_a_run_from_impact_to_impact_is_resumed_bit_for_bit(name: str) -> None:
    whole, resumed = event_world(name), event_world(name)
    for _ in range(7):
        whole.step()
    resume(resumed, checkpoint(whole))
    for _ in range(6):
        assert resumed.step() == whole.step()
    assert checkpoint(resumed) == checkpoint(whole)
    with pytest.raises(CheckpointError, match="and not of"):
        resume(event_world("four-ball-circle", start="inward"), checkpoint(whole))


@pytest.mark.parametrize("name", ["four-ball-circle", "cradle-3d", "pool-break"])
def test_the_problem_ahead_is_the_one_that_the_next_step_solves(name: str) -> None:
    world = event_world(name)
    problem = world.problem()
    assert world.time == 0.0
    world.step()
    v_post = SOLVERS["qce"]().solve(problem).v_post
    if name == "cradle-3d":
        assert np.array_equal(np.abs(v_post), np.linalg.norm(world.spheres.velocity, axis=1))
    else:
        assert np.array_equal(v_post, world.spheres.velocity.ravel())


def test_drivings_are_those_of_the_source() -> None:
    # Bizon 1998: amplitude and period in units of D and √(D/g).
    expected = {
        "squares": (5.650, 8.623),
        "stripes": (2.127, 5.291),
        "hexagons": (3.803, 6.127),
        "flat": (3.546, 5.291),
    }
    assert set(expected) == set(DRIVING)
    for pattern, (amplitude, period) in expected.items():
        motion = vibration(pattern)
        assert motion.amplitude == pytest.approx(amplitude, rel=5e-4)
        assert motion.period == pytest.approx(period, rel=5e-4)
    assert DEPTH == 5.42


def test_grains_start_apart() -> None:
    grains = falling_gas(1000, 8.0, np.random.default_rng(0))
    x, r = grains.position, grains.radius
    apart = np.linalg.norm(x[:, None] - x, axis=2) - (r[:, None] + r)
    assert apart[~np.eye(1000, dtype=bool)].min() > 0.0
    assert (x[:, :2] > r[:, None]).all()
    assert (x[:, :2] < 8.0 - r[:, None]).all()
    assert 2.0 * r.mean() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.long
def test_a_shaken_layer_settles_before_and_after_its_shake() -> None:
    scene = MOVING["granular-shake"](grains=1000, side=8)
    world = scene.world()
    kinetic = [world.step().energy.kinetic for _ in range(scene.default_steps)]
    begin = round(30.0 / 0.02)
    assert kinetic[begin - 1] < 0.01 * 1000
    assert max(kinetic[begin:]) > 0.1 * 1000
    assert kinetic[-1] < 0.01 * 1000


def test_layers_rise_by_what_their_grains_rise() -> None:
    random = np.random.default_rng(0)
    before = random.uniform(0.0, 10.0, (4000, 3))
    after = before.copy()
    inner = np.abs(before[:, :2] - 5.0).max(axis=1) < 5.0 / np.sqrt(2.0)
    after[:, 2] += np.where(inner, 0.3, -0.2) * before[:, 2]
    rise = layer_displacement(before, after, layers=5)
    assert rise[:, 0] == pytest.approx(0.3 * np.array([1.0, 3.0, 5.0, 7.0, 9.0]), abs=0.05)
    assert rise[:, 1] == pytest.approx(-0.2 * np.array([1.0, 3.0, 5.0, 7.0, 9.0]), abs=0.05)


@pytest.mark.parametrize("name", MOVING)
def test_every_moving_scene_says_what_it_is(name: str) -> None:
    scene = MOVING[name]()
    assert scene.name == name
    assert set(scene.parameters) == set(inspect.signature(MOVING[name]).parameters)
    assert scene.description
    assert scene.source
    assert MOVING[name](**scene.parameters).label == scene.label
    assert "Source:" in (inspect.getdoc(MOVING[name]) or "")


def test_moving_scenes_are_in_alphabetical_order() -> None:
    assert list(MOVING) == sorted(MOVING)


@pytest.mark.parametrize(
    ("name", "parameters", "words"),
    [
        ("extended-pattern", {"pattern": "dots"}, "pattern must be one of"),
        ("extended-pattern", {"side": 3}, "side must be a whole number ≥ 4"),
        ("extended-pattern", {"restitution": 1.5}, r"restitution must lie in \[0, 1\]"),
        ("extended-pattern", {"friction": -1.0}, "friction must be a finite number ≥ 0"),
        ("granular-shake", {"step": 0.0}, "step must be a finite number > 0"),
        ("cradle-3d", {"raised": 5}, r"raised must be less than balls \(5\)"),
        ("cradle-3d", {"angle": 2.0}, r"angle must lie in \[0.01, 1.5\]"),
        ("four-ball-circle", {"start": "left"}, "start must be one of"),
        ("pool-break", {"balls": 7}, "balls must fill a triangle"),
        ("pool-break", {"approach": -1.0}, "approach must be a finite number ≥ 0"),
    ],
)
def test_bad_parameters_are_refused_by_name(name: str, parameters: dict[str, object], words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        MOVING[name](**parameters)


def test_a_bad_seed_is_refused() -> None:
    with pytest.raises(ProblemError, match="seed must be a whole number ≥ 0"):
        MOVING["pool-break"]().world(seed=-1)

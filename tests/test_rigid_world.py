"""Worlds of rigid bodies: contacts, energy, going on, what is held, errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import coal
import numpy as np
import pytest

from scenarios.world.checkpoint import CheckpointError, checkpoint, resume
from scenarios.world.collision import Collider, RigidContacts
from scenarios.world.impact import ByProblem, Streamed
from scenarios.world.obstacle import Obstacle, ObstacleContacts
from scenarios.world.persistent_contacts import NOTHING_TOUCHED
from scenarios.world.rigid_bodies import RigidBody, assemble
from scenarios.world.rigid_world import RigidSettings, RigidWorld, Trigger
from scenarios.world.rotation import about, rotation_matrix
from scenarios.world.shapes import Faces, Kind, Part, Shape, ball, box, capsule, cylinder, half_space, hull, union
from solvers import ImpactProblem, ProblemError
from solvers.qce_lcp import QceLcp
from solvers.quadratic_contact_energy import QuadraticContactEnergy
from solvers.solution import Floats
from tests.rigid_scenes import CUBE, GRAVITY, SOLVERS_WITH_FRICTION, TOLERANCE, floor, run, world

ROUNDING = 1e-12
# MuJoCo keeps the corners of hulls in single precision; both find closest points by iteration.
SINGLE_PRECISION = 1e-6
# Where a normal is this near to that of a face [rad], MuJoCo takes the face's: its contacts stay the same four.
SNAPPED = 0.1
ROUND = {"ball"}
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def contacts_of(bodies: list[RigidBody], reach: float) -> RigidContacts:
    arrays = assemble(bodies)
    count = arrays.movable
    return Collider(arrays).contacts(arrays.position[:count], arrays.orientation[:count], reach)


def as_coal(part: Part) -> Any:
    """The same part in the other library."""
    if part.kind is Kind.BALL:
        return coal.Sphere(part.size[0])
    if part.kind is Kind.BOX:
        return coal.Box(*(2.0 * s for s in part.size))
    if part.kind is Kind.CAPSULE:
        return coal.Capsule(part.size[0], 2.0 * part.size[1])
    if part.kind is Kind.CYLINDER:
        return coal.Cylinder(part.size[0], 2.0 * part.size[1])
    points = coal.StdVec_Vec3s()
    points.extend([np.asarray(point) for point in part.points])
    convex = coal.Convex.convexHull(points, True, "")
    return convex


def distance_by_coal(one: RigidBody, other: RigidBody) -> tuple[float, Floats]:
    """Signed distance of two bodies of one part, and the unit vector from the first to the second."""
    placed = []
    for body in (one, other):
        where, turn = body.place()
        placed += [as_coal(body.shape.parts[0]), coal.Transform3s(rotation_matrix(turn), where)]
    result = coal.DistanceResult()
    found = coal.distance(*placed, coal.DistanceRequest(), result)
    return found, np.asarray(result.normal)


SHAPES: dict[str, Shape] = {
    "ball": ball(0.4), "box": box((0.3, 0.5, 0.2)), "capsule": capsule(0.2, 0.4), "cylinder": cylinder(0.3, 0.4),
    "hull": hull(np.random.default_rng(7).normal(size=(12, 3)) * 0.4),
}  # fmt: skip


@pytest.mark.parametrize("second", SHAPES)
@pytest.mark.parametrize("first", SHAPES)
def test_the_nearest_contact_has_the_gap_and_the_normal_that_another_library_finds(first: str, second: str) -> None:
    random = np.random.default_rng(len(first) * 10 + len(second))
    for _ in range(5):
        one = RigidBody("one", SHAPES[first], random.normal(size=3) * 0.1, random.normal(size=4))
        direction = random.normal(size=3)
        away = 2.0 * direction / np.linalg.norm(direction)
        other = RigidBody("other", SHAPES[second], away, random.normal(size=4))
        expected, normal = distance_by_coal(one, other)
        # A little farther than they are, so that the contact is there.
        contacts = contacts_of([one, other], expected + 0.1)
        nearest = int(contacts.gap.argmin())
        exact = bool({first, second} & ROUND)
        snapped = 0.0 if exact else 0.5 * expected * SNAPPED**2
        assert contacts.gap[nearest] == pytest.approx(expected, abs=SINGLE_PRECISION + snapped)
        turned = normal if contacts.body[nearest, 0] == 0 else -normal
        # A distance that is right to ε is that of a direction right to √ε.
        assert contacts.normal[nearest] == pytest.approx(turned, abs=np.sqrt(SINGLE_PRECISION) if exact else SNAPPED)


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("gap", [-1e-5, 0.0, 1e-5])
def test_a_box_on_a_box_has_four_contacts_however_little_it_is_tilted(tilt: float, gap: float) -> None:
    for seed in range(10):
        axis = np.random.default_rng(seed).normal(size=3)
        upper = RigidBody("upper", CUBE, (0.1, 0.2, 1.0 + gap), about(axis, tilt))
        contacts = contacts_of([RigidBody("lower", CUBE), upper], 0.01)
        assert contacts.m == 4
        assert contacts.normal[:, 2] == pytest.approx(np.ones(4), abs=2.0 * tilt**2 + SINGLE_PRECISION)
        assert np.ptp(contacts.point[:, 0]) == pytest.approx(0.9, abs=0.01)
        assert np.ptp(contacts.point[:, 1]) == pytest.approx(0.8, abs=0.01)


def test_a_ball_over_the_seam_of_a_union_has_one_contact() -> None:
    tile = box((0.5, 0.5, 0.1))
    track = union([(tile, (0.0, 0.0, 0.0), IDENTITY), (tile, (1.0, 0.0, 0.0), IDENTITY)])
    for beside in (-5e-3, -1e-4, 0.0, 1e-4, 5e-3):
        rolling = RigidBody("ball", ball(0.2), (0.5 + beside, 0.0, 0.3))
        contacts = contacts_of([rolling, RigidBody("track", track, fixed=True)], 0.01)
        assert contacts.m == 1
        assert np.abs(contacts.normal[0]) == pytest.approx([0.0, 0.0, 1.0], abs=SINGLE_PRECISION)


def test_bodies_of_parts_of_several_kinds_touch_once_where_their_seams_meet() -> None:
    # The same end is a ball's and a capsule's in both: four pairs of parts, of which one is named the other way around.
    # Their bounding boxes do not overlap: a gap is seen all the same.
    pin = union([(capsule(0.1, 0.4), (0.0, 0.0, 0.0), IDENTITY), (ball(0.1), (0.0, 0.0, 0.4), IDENTITY)])
    contacts = contacts_of([RigidBody("one", pin), RigidBody("other", pin, (0.201, 0.0, 0.0))], 0.01)
    ends = np.sort(contacts.point[:, 2])
    assert ends - ends.mean() == pytest.approx([-0.4, 0.4], abs=1e-6)


def test_a_ball_in_a_groove_of_a_union_touches_both_flanks() -> None:
    plank = box((1.0, 0.5, 0.05))
    flanks = [(plank, (0.0, s * 0.5, 0.0), about((1.0, 0.0, 0.0), s * 0.5)) for s in (-1.0, 1.0)]
    resting = [
        RigidBody("ball", ball(0.2), (0.0, 0.0, 0.3)), RigidBody("groove", union(flanks), fixed=True)
    ]  # fmt: skip
    contacts = contacts_of(resting, 0.3)
    assert contacts.m == 2
    assert contacts.normal[:, 1].sum() == pytest.approx(0.0, abs=SINGLE_PRECISION)


LENGTH, THICKNESS = 1.0, 0.02


def leaning(angle: float) -> list[RigidBody]:
    """Two plates on the floor that lean against one another, edge on edge."""
    plate = box((0.5 * LENGTH, 0.3, 0.5 * THICKNESS))
    aside = 0.5 * LENGTH * np.sin(angle) + 0.5 * THICKNESS * np.cos(angle)
    above = 0.5 * LENGTH * np.cos(angle) + 0.5 * THICKNESS * np.sin(angle)
    left, right = (about((0.0, 1.0, 0.0), -0.5 * np.pi + s * angle) for s in (1.0, -1.0))
    return [
        floor(0.8),
        RigidBody("left", plate, (-aside, 0.0, above), left, friction=0.8),
        RigidBody("right", plate, (aside, 0.0, above), right, friction=0.8),
    ]


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.5])
def test_two_plates_that_lean_on_one_another_touch_at_both_ends_of_their_edges_and_stand(angle: float) -> None:
    moving = world(leaning(angle), QceLcp(tolerance=1e-6))
    start = moving.position.copy()
    for _ in range(30):
        contacts = moving.impact().contacts
        top = contacts.point[contacts.point[:, 2] > 0.5 * LENGTH * np.cos(angle)]
        assert np.sort(top[:, 1]) == pytest.approx([-0.3, 0.3], abs=1e-6)
        assert moving.step().iterations <= 2 or moving.steps < 5
    assert np.abs(moving.position - start).max() <= 1e-6


@pytest.mark.kernels
def test_a_few_steps_of_plates_and_a_ball_run_through_all_kernels() -> None:
    struck = [
        *leaning(0.3),
        RigidBody("ball", ball(0.1), (-0.5, 0.0, 0.5), velocity=(20.0, 0.0, 0.0), restitution=0.5),
        RigidBody("sunk", CUBE, (3.0, 0.0, 0.485)),
    ]
    moving = world(struck, QceLcp(tolerance=1e-6, max_sweeps=50))
    reports = run(moving, 0.02)
    assert max(report.contacts for report in reports) >= 10
    assert all(np.isfinite(report.energy.kinetic) for report in reports)
    assert sum(report.energy.correction for report in reports) > 0.0


def tumbling(seed: int = 0, *, restitution: float = 0.3, gravity: float = GRAVITY) -> list[RigidBody]:
    """A few bodies of all kinds that fall on one another."""
    random = np.random.default_rng(seed)
    bodies = [floor(0.4, restitution)]
    for k, (name, shape) in enumerate([*SHAPES.items()] * 2):
        place = (0.3 * random.normal(), 0.3 * random.normal(), 0.8 + 1.2 * k)
        bodies.append(
            RigidBody(
                f"{name} {k}", shape, place, random.normal(size=4), spin=random.normal(size=3), friction=0.4,
                restitution=restitution,
            )
        )  # fmt: skip
    return bodies


@pytest.mark.parametrize("solver", SOLVERS_WITH_FRICTION)
def test_every_joule_is_in_the_ledger(solver: str) -> None:
    law = replace(SOLVERS_WITH_FRICTION[solver], tolerance=1e-6)  # type: ignore[type-var]
    moving = world(tumbling(), law, step=2e-3)
    before = moving.kinetic_energy() + moving.potential_energy()
    touched = 0
    for report in run(moving, 0.6):
        energy = report.energy
        change = energy.impact + energy.friction + energy.correction + energy.integration
        assert energy.kinetic + energy.potential - before == pytest.approx(change, abs=ROUNDING * before)
        # Shapes do not gain from friction, nor from the correction, but for what lifting them costs.
        assert energy.friction <= 1e-6 * before
        before = energy.kinetic + energy.potential
        touched += report.contacts
    assert touched > 30


def test_the_problem_of_a_step_is_the_one_that_is_checked_and_formed_anew() -> None:
    moving = world(tumbling(), step=2e-3)
    seen = 0
    for _ in range(250):
        moving.step()
        problem = moving.problem()
        if problem.m == 0:
            continue
        seen += 1
        assert problem.D is not None
        again = ImpactProblem(
            problem.inverse_mass, problem.J, problem.v_pre, problem.restitution, problem.friction, problem.D
        )
        assert set(vars(again)) <= set(vars(problem))
        for name in ("J", "D", "JM", "DM", "inverse_mass"):
            assert (
                abs(getattr(problem, name) - getattr(again, name)).max() <= ROUNDING * abs(getattr(again, name)).max()
            )
        for name in ("u_pre", "W_diagonal", "stiffness"):
            assert getattr(problem, name) == pytest.approx(getattr(again, name), rel=ROUNDING, abs=ROUNDING)
        assert problem.has_friction == again.has_friction
        assert not problem.u_pre.flags.writeable
    assert seen > 5


def test_linear_and_angular_momentum_change_by_no_contact_of_free_bodies() -> None:
    one = RigidBody("one", box((0.3, 0.2, 0.1)), (-0.6, 0.05, 0.0), velocity=(4.0, 0.0, 0.0), spin=(3.0, 1.0, 0.0))
    other = RigidBody("other", hull(SHAPES["hull"].vertices), (0.6, 0.0, 0.1), mass=2.0)
    moving = world([one, other], gravity=0.0)

    def momenta() -> Floats:
        p = np.array([moving.spheres.inverse_mass]).T ** -1 * moving.velocity
        return np.concatenate([p.sum(axis=0), (np.cross(moving.position, p) + moving.angular_momentum).sum(axis=0)])

    before = momenta()
    assert sum(report.contacts for report in run(moving, 0.3)) > 0
    after = momenta()
    assert after[:3] == pytest.approx(before[:3], abs=ROUNDING)
    # Impulses act at the places of the start of a step, to first order in it.
    assert after[3:] == pytest.approx(before[3:], abs=1e-2 * np.abs(before).max())


def test_a_run_that_goes_on_from_a_checkpoint_makes_the_same_bits() -> None:
    straight, first = world(tumbling(), step=2e-3), world(tumbling(), step=2e-3)
    run(straight, 0.4)
    run(first, 0.25)
    second = world(tumbling(), step=2e-3)
    resume(second, checkpoint(first))
    run(second, 0.15)
    for name, array in straight.state().items():
        assert np.array_equal(array, second.state()[name]), name


def test_a_checkpoint_of_another_scene_is_refused() -> None:
    other = world([floor(), RigidBody("box", CUBE, (0.0, 0.0, 0.5))])
    with pytest.raises(CheckpointError, match="position"):
        resume(other, checkpoint(world(tumbling())))


def test_a_stack_that_rests_needs_no_sweep() -> None:
    boxes = [RigidBody(f"box {k}", CUBE, (0.0, 0.0, 0.5 + k)) for k in range(12)]
    moving = world([floor(), *boxes], QceLcp(tolerance=1e-8))
    reports = run(moving, 0.05)
    assert max(report.iterations for report in reports) <= 2
    assert np.median([report.iterations for report in reports[5:]]) == 0
    assert max(report.residual for report in reports) <= 1e-8


def test_what_rests_contributes_to_no_term_of_the_ledger() -> None:
    moving = world([floor(), *(RigidBody(f"box {k}", CUBE, (0.0, 0.0, 0.5 + k)) for k in range(3))])
    for report in run(moving, 0.02):
        energy = report.energy
        # Beside what gravity gives three boxes in a step.
        scale = 3.0 * 0.5 * (GRAVITY * moving.settings.step) ** 2
        assert max(abs(energy.impact), abs(energy.friction), abs(energy.integration)) <= 1e-6 * scale


def test_contacts_keep_their_numbers_as_long_as_they_last() -> None:
    moving = world([floor(1.0), RigidBody("box", CUBE, (0.0, 0.0, 0.5), velocity=(0.3, 0.0, 0.0), friction=0.1)])
    moving.step()
    before = moving.state()["last_number"].copy()
    run(moving, 0.05)
    assert moving.position[0, 0] > 0.01
    assert np.array_equal(np.sort(moving.state()["last_number"]), np.sort(before))
    assert NOTHING_TOUCHED.next_number == 0


def test_standing_still_is_exact_and_the_correction_leaves_it_alone() -> None:
    moving = world([floor(), *(RigidBody(f"box {k}", CUBE, (0.0, 0.0, 0.5 + k)) for k in range(4))])
    start = moving.position.copy()
    reports = run(moving, 0.1)
    assert np.abs(moving.position - start).max() <= 1e-6
    assert all(report.energy.correction == 0.0 for report in reports)


def test_overlaps_are_taken_away_without_kinetic_energy() -> None:
    sunk = 0.04 * 0.5
    moving = world([floor(), RigidBody("box", CUBE, (0.0, 0.0, 0.5 - sunk))])
    reports = run(moving, 0.2)
    assert moving.overlap <= 1.1 * moving.settings.slop * 0.5
    assert moving.position[0, 2] > 0.5 - sunk
    lifted = sum(report.energy.correction for report in reports)
    assert lifted == pytest.approx(GRAVITY * (moving.position[0, 2] - 0.5 + sunk), rel=1e-6)
    assert max(report.energy.kinetic for report in reports) <= 0.5 * (GRAVITY * 1e-3) ** 2


def test_a_held_body_stays_until_it_is_released() -> None:
    moving = world([floor(), RigidBody("box", CUBE, (0.0, 0.0, 2.0), held=True)])
    run(moving, 0.1)
    assert moving.position[0, 2] == 2.0
    moving.release("box")
    run(moving, 0.1)
    assert moving.velocity[0, 2] == pytest.approx(-0.1 * GRAVITY, rel=ROUNDING)


def test_a_held_body_stops_others() -> None:
    moving = world([RigidBody("shelf", CUBE, held=True), RigidBody("box", CUBE, (0.0, 0.0, 1.0))])
    run(moving, 0.1)
    assert moving.position[1, 2] == pytest.approx(1.0, abs=1e-6)
    # Four contacts share the weight, in any way.
    weight = GRAVITY * 1e-3
    assert 0.25 * weight * (1.0 - TOLERANCE) <= moving.touching("box", "shelf") <= weight
    assert not moving.velocity[0].any()


def test_a_seesaw_on_its_hinge_turns_about_it_alone() -> None:
    plank = RigidBody("plank", box((1.0, 0.2, 0.05)), (0.0, 0.0, 1.0), hinge=(0.0, 1.0, 0.0), mass=1.0)
    weight = RigidBody("weight", ball(0.1), (0.8, 0.0, 1.15), mass=0.5, friction=0.0)
    moving = world([plank, weight])
    moving.step()
    # α = m g l / (I + m l²), the weight being a point on a smooth plank.
    inertia = (1.0 + 0.05**2) / 3.0
    expected = 0.5 * GRAVITY * 0.8 / (inertia + 0.5 * 0.8**2)
    assert moving.spin[0] == pytest.approx([0.0, expected * 1e-3, 0.0], rel=1e-6, abs=ROUNDING)
    run(moving, 0.1)
    assert moving.position[0] == pytest.approx([0.0, 0.0, 1.0], abs=0.0)
    assert moving.spin[0, [0, 2]] == pytest.approx([0.0, 0.0], abs=ROUNDING)
    assert moving.spin[0, 1] > 0.4


def test_triggers_fire_one_after_the_other_and_release_what_is_held() -> None:
    bodies = [floor(), RigidBody("first", CUBE, (0.0, 0.0, 0.6)), RigidBody("second", CUBE, (3.0, 0.0, 2.0), held=True)]
    triggers = [
        Trigger("landed", lambda now: now.touching("first", "floor") > 0.0, ("second",)),
        Trigger("falls", lambda now: bool(now.velocity[1, 2] < -0.5)),
    ]
    solver = SOLVERS_WITH_FRICTION["qce-lcp"]
    moving = RigidWorld("test", bodies, RigidSettings(), ByProblem(solver), triggers=triggers)
    run(moving, 0.1)
    assert moving.fired == {}
    run(moving, 0.2)
    assert list(moving.fired) == ["landed", "falls"]
    assert moving.fired["landed"] == pytest.approx(np.sqrt(0.2 / GRAVITY), abs=2e-3)
    assert moving.fired["falls"] == pytest.approx(moving.fired["landed"] + 0.5 / GRAVITY, abs=2e-3)


class Bowl:
    """The inside of a sphere about the origin, for balls."""

    name = "bowl"
    friction = 0.0
    restitution = 0.0
    radius = 2.0

    def contacts(self, centers: Floats, radii: Floats, reach: float) -> ObstacleContacts:
        away = np.linalg.norm(centers, axis=1)
        gap = self.radius - away - radii
        near = np.flatnonzero(gap <= reach)
        normal = -centers[near] / away[near, None]
        return near.astype(np.int32), -self.radius * normal, normal, gap[near]

    def mesh(self) -> tuple[Floats, Faces]:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)


def test_a_ball_in_a_smooth_bowl_swings_as_a_pendulum() -> None:
    bowl: Obstacle = Bowl()
    arm, angle = 1.8, 0.05
    swinging = RigidBody("ball", ball(0.2), arm * np.array([np.sin(angle), 0.0, -np.cos(angle)]), friction=0.0)
    solver = SOLVERS_WITH_FRICTION["qce-lcp"]
    moving = RigidWorld("test", [swinging], RigidSettings(step=2e-3), ByProblem(solver), obstacles=[bowl])
    period = 2.0 * np.pi * np.sqrt(arm / GRAVITY) * (1.0 + angle**2 / 16.0)
    run(moving, 0.25 * period)
    # Within a step of the bottom, at the speed that its height gives.
    speed = np.sqrt(2.0 * GRAVITY * arm * (1.0 - np.cos(angle)))
    assert moving.position[0, 0] == pytest.approx(0.0, abs=4e-3 * speed)
    assert np.linalg.norm(moving.velocity[0]) == pytest.approx(speed, rel=4e-3)
    assert moving.touching("ball", "bowl") > 0.0


def test_a_wave_goes_through_balls_that_lie_together() -> None:
    balls = [
        RigidBody(f"ball {k}", ball(0.5), (float(k), 0.0, 0.5), friction=0.0, restitution=1.0,
                  velocity=(2.0 * (k == 0), 0.0, 0.0))
        for k in range(4)
    ]  # fmt: skip
    balls[0] = replace(balls[0], position=(-0.01, 0.0, 0.5))
    smooth = floor(0.0)
    qce, lcp = (world([smooth, *balls], SOLVERS_WITH_FRICTION[name]) for name in ("qce-lcp", "lcp-pgs"))
    for moving in (qce, lcp):
        run(moving, 0.02)
    # By QCE the last ball flies faster than by Newton's LCP, which gives half of it to the others.
    assert qce.velocity[3, 0] > 1.5 > 1.2 > lcp.velocity[3, 0]
    assert 0.5 * (qce.velocity**2).sum() == pytest.approx(2.0, rel=1e-2)


def body(**changes: Any) -> RigidBody:
    return replace(RigidBody("brick", CUBE, (0.0, 0.0, 0.5)), **changes)


@pytest.mark.parametrize(
    ("bodies", "rule"),
    [
        ([body(density=0.0)], "body brick: density"),
        ([body(mass=0.0)], "body brick: mass"),
        ([body(mass=np.nan)], "body brick: mass"),
        ([body(shape=half_space())], "body brick: a half space must be fixed"),
        ([body(position=(np.nan, 0.0, 0.0))], "body brick: position"),
        ([body(orientation=(0.0, 0.0, 0.0, 0.0))], "body brick: orientation"),
        ([body(velocity=(np.inf, 0.0, 0.0))], "body brick: velocity"),
        ([body(spin=(0.0, 0.0))], "body brick: spin"),
        ([body(friction=-0.1)], "body brick: friction"),
        ([body(friction=np.nan)], "body brick: friction"),
        ([body(restitution=1.5)], "body brick: restitution"),
        ([body(fixed=True)], "at least one that is not fixed"),
        ([body(), body(fixed=True, velocity=(1.0, 0.0, 0.0))], "body brick: "),
        ([body(held=True, spin=(1.0, 0.0, 0.0))], "body brick: a body that is held"),
        ([body(shape=box((0.5, 0.4, 0.3)), hinge=(1.0, 1.0, 0.0))], "body brick: hinge"),
        ([body(hinge=(1.0, 0.0, 0.0), spin=(0.0, 1.0, 0.0))], "body brick: spin must be about the hinge"),
        ([body(), body()], "names must differ"),
        ([floor(), body(position=(0.0, 0.0, 0.3))], "bodies floor and brick overlap at the start by 0.2 m"),
        ([body(), body(name="other", position=(0.5, 0.0, 0.5))], "bodies brick and other overlap at the start"),
    ],
)
def test_bad_bodies_are_refused_by_name(bodies: list[RigidBody], rule: str) -> None:
    with pytest.raises(ProblemError, match=rule):
        world(bodies)


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: RigidSettings(step=0.0), "step"),
        (lambda: RigidSettings(step=np.nan), "step"),
        (lambda: RigidSettings(gravity=-1.0), "gravity"),
        (lambda: RigidSettings(resting_speed=-1.0), "resting_speed"),
        (lambda: RigidSettings(largest_move=0.0), "largest_move"),
        (lambda: RigidSettings(slop=np.inf), "slop"),
        (lambda: RigidSettings(correction=1.5), "correction"),
        (lambda: world([body()]).release("nobody"), "no body named nobody"),
        (lambda: world([floor(), body()]).release("floor"), "body floor"),
        (lambda: RigidWorld("test", [body()], RigidSettings(), Streamed()), "solver must be one of SOLVERS"),
    ],
)
def test_bad_settings_are_refused(make: Callable[[], object], rule: str) -> None:
    with pytest.raises(ProblemError, match=rule):
        make()


def test_a_step_that_is_too_large_names_the_body_and_leaves_the_scene_as_it_was() -> None:
    moving = world([body(velocity=(600.0, 0.0, 0.0))])
    before = {name: array.copy() for name, array in moving.state().items()}
    with pytest.raises(ProblemError, match=r"body brick: it moves 0\.6 m in step 1"):
        moving.step()
    for name, array in moving.state().items():
        assert np.array_equal(array, before[name]), name


def test_an_elastic_law_works_where_there_is_no_friction_and_nothing_rests() -> None:
    moving = world([floor(0.0, 1.0), body(position=(0.0, 0.0, 0.6), restitution=1.0)], QuadraticContactEnergy(),
                   resting_speed=0.0)  # fmt: skip
    before = moving.kinetic_energy() + moving.potential_energy()
    assert sum(report.contacts for report in run(moving, 0.3)) > 0
    assert moving.kinetic_energy() + moving.potential_energy() == pytest.approx(before, rel=TOLERANCE)


def test_all_that_moves_can_be_drawn() -> None:
    moving = world(tumbling())
    drawn = moving.meshes()
    assert [index for *_, index in drawn] == [*range(10), -1]
    assert [name for name, *_ in drawn] == [*moving.names, "floor"]
    for _, vertices, faces, _ in drawn:
        assert faces.max() < len(vertices)
    assert moving.spheres.count == 10
    where, turn = moving.given_pose("hull 4")
    shape, center = SHAPES["hull"], moving.position[moving.index("hull 4")]
    assert where + rotation_matrix(turn) @ shape.center == pytest.approx(center, abs=ROUNDING)


def test_a_plank_on_a_hinge_comes_to_lie_on_what_is_fixed() -> None:
    """Along the hinge's axis no impulse moves the plank: a row of W that is zero, and nothing to divide by."""
    tilt = about((0.0, 1.0, 0.0), 0.3)
    where = np.array([0.0, 0.0, 0.2]) + rotation_matrix(tilt) @ (0.35, 0.0, 0.07)
    plank = RigidBody("plank", box((0.45, 0.12, 0.015)), (0.0, 0.0, 0.2), tilt, hinge=(0.0, 1.0, 0.0))
    weight = RigidBody("weight", box((0.05, 0.05, 0.05)), where, tilt)
    moving = world([floor(), plank, weight], step=2e-3)
    run(moving, 1.5)
    assert np.isfinite(moving.velocity).all()
    assert np.isfinite(moving.spin).all()
    assert moving.touching("plank", "floor") > 0.0

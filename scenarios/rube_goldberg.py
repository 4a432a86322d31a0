"""A machine in which one thing sets off the next, simulated as a whole: each stage must work for the next to begin.

    spiral → three balls on a straight track → card house → dominos → seesaw → oblique track → pool break
           → second spiral → pillars

Each stage has a detector (`STAGES`), which is looked at once the one before it has fired; the machine has worked when
all have. Two stages need the wave that goes through bodies in touch. A ball that hits three balls at rest hands its
velocity to the last one, which flies over the gap to the table of the cards; Newton's law for all contacts at once
gives half of it to each of the three, and the last one falls into the gap. And the corner ball of the rack leaves with
0.56 of the cue ball's velocity, against 0.25.

Source: Zhang 2015, Section 5.4 and Fig. 11, for the order of the stages; sizes and places are chosen here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import numpy.typing as npt

from scenarios.card_house import house
from scenarios.parameters import check_positive
from scenarios.world.impact import Resolver
from scenarios.world.moving_scene import STAGES_FIRED, MovingScene, MovingWorld
from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.rigid_world import RigidSettings, RigidWorld, Trigger
from scenarios.world.rotation import about, rotation_matrix
from scenarios.world.shapes import ball, box, half_space
from scenarios.world.track import Gutter, helix, joined, ramp, straight
from solvers.solution import Floats

GRAVITY = 9.81
BALL = 0.1
"""Radius of all balls [m]."""
# Balls are smooth and elastic among themselves, and roll on what is rough: a contact has the mean √(μ_a μ_b).
SMOOTH, ROUGH, PLAIN = 0.05, 2.0, 0.6
# Density of balls and dominos, over that of cards, plank and pillars.
HEAVY = 3.0
SPACING = 0.05
"""Between points of a track's axis [m]."""
NARROW, WIDE = 0.105, 0.16
"""Radii of gutters that guide a ball, and of the one that catches it [m]."""

# First track: a spiral about (0, SPIRAL), and a straight piece along x from x = 0 to TRACK_END; heights of a ball's
# center.
SPIRAL, TURNS = 0.6, 1.0
SPIRAL_TOP, TRACK_HEIGHT, TRACK_END = 3.6, 2.75, 1.4
# Last of the three balls at rest: it leaves the track at once.
LAST_BALL = TRACK_END - 0.05

# Table of cards and dominos: x from GAP_END to TABLE_END, top at TABLE.
GAP_END, TABLE_END, TABLE = 2.02, 3.98, 2.1
CARD = (0.15, 0.07, 0.01)
CARD_PAIRS, CARD_STOREYS = 3, 3
HOUSE_AT = 2.55
DOMINOS, DOMINO = 7, (0.02, 0.075, 0.15)
DOMINO_PITCH = 0.13
# The last domino stands so near to the edge that it tips over it.
LAST_DOMINO = TABLE_END - 0.025

# Seesaw: its left arm is up, under the edge of the table; its right end will swing up and push the waiting ball.
HINGE, PLANK, TILT = (4.5, 1.6), (0.45, 0.12, 0.015), np.radians(25.0)

# Oblique track: a shallow dip where the ball waits, then down to the pool table.
WAITING = (5.035, 1.58)
DIP = 0.003
OBLIQUE_END = 6.5
POOL, POOL_FROM, POOL_TO = 1.0, 6.45, 8.05
RACK_AT = 7.0

# Second spiral: starts at the pool table's edge where the corner ball comes to, along its line of 30°.
CORNER = np.radians(30.0)
CATCH = 0.58
"""Distance from the corner ball to the beginning of the track [m]."""
SECOND_SPIRAL = 0.7
# It ends over the ground, so that the ball meets the pillars above their middle and they fall forward.
SECOND_END = 0.38

PILLARS, PILLAR, PILLAR_PITCH = 5, (0.06, 0.06, 0.3), 0.32
PILLARS_FROM = 0.25
"""Distance of the first pillar from the end of the second track [m]."""
# A card that tumbles down from the table moves by more than half its thickness in a step; contacts are seen two steps
# ahead, so that it still passes through nothing.
LARGEST_MOVE = 1.8
SOLVER = "qce-lcp:tolerance=1e-9,max_sweeps=1000"


def rube_goldberg(*, step: float = 0.001) -> MovingScene:
    """The whole machine; one scene for every law.

    Args:
        step: > 0 [s].

    Source: Zhang 2015, Section 5.4 and Fig. 11; sizes and places are chosen here.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_positive("step", step)
    return MovingScene(
        "rube-goldberg",
        {"step": step},
        "a spiral, three balls, cards, dominos, a seesaw, a pool break, a second spiral and pillars in one chain",
        "Zhang 2015, Fig. 11",
        partial(_build, step),
        default_solver=SOLVER,
        default_steps=round(12.0 / step),
        frame_every=max(round(0.02 / step), 1),
        measure=_measures,
        stages=tuple(STAGES),
        reached=_worked,
        color="kind",
    )


def first_track() -> Gutter:
    """Spiral and straight piece that the first ball rolls down."""
    height = TRACK_HEIGHT + NARROW - BALL
    below = -0.5 * np.pi
    spiral = helix(
        (0.0, SPIRAL), SPIRAL, angles=(below - 2.0 * np.pi * TURNS, below),
        heights=(height + SPIRAL_TOP - TRACK_HEIGHT, height), spacing=SPACING,
    )  # fmt: skip
    level = straight((0.0, 0.0, height), (TRACK_END, 0.0, height), spacing=SPACING)
    return Gutter(joined(spiral, level), NARROW, friction=ROUGH, name="first track")


def oblique_track() -> Gutter:
    """A dip where the ball waits, then down to the pool table."""
    high, low = WAITING[1] + NARROW - BALL, POOL + NARROW + 0.003
    brim = high + DIP
    behind = ramp((WAITING[0] - 0.1, 0.0, brim), (WAITING[0], 0.0, high), spacing=SPACING)
    before = ramp((WAITING[0], 0.0, high), (WAITING[0] + 0.1, 0.0, brim), spacing=SPACING)
    down = ramp((WAITING[0] + 0.1, 0.0, brim), (OBLIQUE_END, 0.0, low), spacing=SPACING)
    end = straight((OBLIQUE_END, 0.0, low), (OBLIQUE_END + 0.15, 0.0, low), spacing=SPACING)
    return Gutter(joined(behind, before, down, end), NARROW, friction=ROUGH, name="oblique track")


def second_track() -> Gutter:
    """From the edge of the pool table down one turn to the ground, along the corner ball's line."""
    along = np.array([np.cos(CORNER), np.sin(CORNER)])
    begin = rack()[-1][:2] + CATCH * along
    turn = begin + 0.3 * along
    center = turn + SECOND_SPIRAL * np.array([-along[1], along[0]])
    # A little below the table's top.
    high, low = POOL + WIDE - 0.02, SECOND_END + WIDE - BALL
    middle = high - 0.05
    entry = ramp((*begin, high), (*turn, middle), spacing=SPACING)
    angle = CORNER - 0.5 * np.pi
    spiral = helix(
        (center[0], center[1]), SECOND_SPIRAL, angles=(angle, angle + 2.0 * np.pi), heights=(middle, low),
        spacing=SPACING,
    )  # fmt: skip
    end = turn + 0.3 * along
    level = straight((*turn, low), (*end, low), spacing=SPACING)
    return Gutter(joined(entry, spiral, level), WIDE, half_opening=1.6, friction=ROUGH, name="second track")


def rack() -> Floats:
    """Centers of ten balls in a triangle, the apex first and the two corners last but two and last [m]."""
    places = [
        (RACK_AT + row * np.sqrt(3.0) * BALL, (2 * column - row) * BALL, POOL + BALL)
        for row in range(4) for column in range(row + 1)
    ]  # fmt: skip
    return np.array(places)


def _build(step: float, identity: str, resolver: Resolver, seed: int) -> RigidWorld:
    """All bodies and tracks; nothing is held, the first ball starts to roll at once."""
    first, oblique, second = first_track(), oblique_track(), second_track()
    shape = ball(BALL)

    def put_ball(name: str, place: npt.ArrayLike) -> RigidBody:
        return RigidBody(name, shape, place, density=HEAVY, friction=SMOOTH, restitution=1.0)

    def put_table(name: str, low: npt.ArrayLike, high: npt.ArrayLike, friction: float) -> RigidBody:
        half_sizes = 0.5 * np.subtract(high, low)
        return RigidBody(name, box(half_sizes.tolist()), np.add(low, half_sizes), friction=friction, fixed=True)

    bodies = [
        RigidBody("ground", half_space(), friction=PLAIN, fixed=True),
        put_table("table of cards", (GAP_END, -0.5, TABLE - 0.1), (TABLE_END, 0.5, TABLE), PLAIN),
        put_table("pool table", (POOL_FROM, -1.0, POOL - 0.1), (POOL_TO, 1.0, POOL), ROUGH),
        put_ball("first ball", first.rest(0.0, BALL)),
        *(put_ball(f"ball {k + 1}", (LAST_BALL - 2.0 * BALL * (2 - k), 0.0, TRACK_HEIGHT)) for k in range(3)),
        *house(
            CARD_PAIRS, CARD_STOREYS, half_sizes=CARD, lean=np.radians(25.0), foot=(HOUSE_AT, 0.0, TABLE),
            friction=0.8,
        ),
        *_dominos(),
        *_seesaw(),
        put_ball("waiting ball", (WAITING[0], 0.0, WAITING[1])),
        *(put_ball(f"rack ball {k}", place) for k, place in enumerate(rack())),
        *_pillars(second),
    ]  # fmt: skip
    settings = RigidSettings(step=step, gravity=GRAVITY, largest_move=LARGEST_MOVE)
    triggers = [Trigger(name, detector) for name, detector in STAGES.items()]
    return RigidWorld(identity, bodies, settings, resolver, obstacles=(first, oblique, second), triggers=triggers)


def _dominos() -> list[RigidBody]:
    """A row along x that ends at the edge of the table."""
    domino = box(DOMINO)
    return [
        RigidBody(
            f"domino {k}", domino, (LAST_DOMINO - DOMINO_PITCH * (DOMINOS - 1 - k), 0.0, TABLE + DOMINO[2]),
            density=HEAVY, friction=PLAIN,
        )
        for k in range(DOMINOS)
    ]  # fmt: skip


def _seesaw() -> list[RigidBody]:
    """A plank on a hinge, its left end up, and a block that stops the left end below."""
    x, z = HINGE
    plank = RigidBody(
        "seesaw", box(PLANK), (x, 0.0, z), about((0.0, 1.0, 0.0), TILT), hinge=(0.0, 1.0, 0.0), density=0.5,
        friction=PLAIN,
    )  # fmt: skip
    low = z - PLANK[0] * np.sin(TILT) - 0.1
    stop = RigidBody("stop", box((0.05, 0.15, 0.05)), (x - 0.4, 0.0, low), friction=PLAIN, fixed=True)
    return [plank, stop]


def _pillars(track: Gutter) -> list[RigidBody]:
    """A row on the ground, in line with the end of the second track."""
    along = track.direction(track.length)
    end = track.rest(track.length, BALL)
    pillar = box(PILLAR)
    return [
        RigidBody(
            f"pillar {k}", pillar, (*(end + (PILLARS_FROM + PILLAR_PITCH * k) * along)[:2], PILLAR[2]),
            about((0.0, 0.0, 1.0), CORNER), friction=PLAIN,
        )
        for k in range(PILLARS)
    ]  # fmt: skip


def _where(world: RigidWorld, name: str) -> Floats:
    place: Floats = world.position[world.index(name)]
    return place


def _tilt(world: RigidWorld, name: str) -> float:
    """Angle of a body's own z axis to the vertical [rad]."""
    up = rotation_matrix(world.given_pose(name)[1])[2, 2]
    return float(np.arccos(np.clip(up, -1.0, 1.0)))


def _first_ball_has_rolled_down(world: RigidWorld) -> bool:
    place = _where(world, "first ball")
    return bool(place[0] > 0.0 and place[1] < BALL and place[2] < TRACK_HEIGHT + BALL)


def _last_ball_has_flown_over_the_gap(world: RigidWorld) -> bool:
    place = _where(world, "ball 3")
    return bool(place[0] > GAP_END and place[2] > TABLE + BALL)


def _cards_have_collapsed(world: RigidWorld) -> bool:
    tops = [_where(world, name)[2] for name in world.names if name.startswith("card")]
    return bool(max(tops) < TABLE + 2.0 * CARD[0])


def _last_domino_has_left_the_table(world: RigidWorld) -> bool:
    place = _where(world, f"domino {DOMINOS - 1}")
    return bool(place[0] > TABLE_END and place[2] < TABLE)


def _seesaw_has_turned(world: RigidWorld) -> bool:
    right = rotation_matrix(world.given_pose("seesaw")[1])[2, 0]
    return bool(right > -np.sin(0.5 * TILT))


def _waiting_ball_rolls_down(world: RigidWorld) -> bool:
    place = _where(world, "waiting ball")
    return bool(place[0] > WAITING[0] + 3.0 * BALL and POOL < place[2] < WAITING[1])


def _rack_has_broken(world: RigidWorld) -> bool:
    moved = np.array([_where(world, f"rack ball {k}") for k in range(10)]) - rack()
    return bool((np.linalg.norm(moved[[6, 9]], axis=1) > BALL).all())


def _corner_ball_has_rolled_down(world: RigidWorld) -> bool:
    return bool(_where(world, "rack ball 9")[2] < SECOND_END + BALL)


def _last_pillar_has_fallen(world: RigidWorld) -> bool:
    return _tilt(world, f"pillar {PILLARS - 1}") > 0.25 * np.pi


STAGES: dict[str, Callable[[RigidWorld], bool]] = {
    "the first ball has rolled down the spiral": _first_ball_has_rolled_down,
    "the last of three balls has flown over the gap": _last_ball_has_flown_over_the_gap,
    "the card house has collapsed": _cards_have_collapsed,
    "the last domino has left the table": _last_domino_has_left_the_table,
    "the seesaw has turned": _seesaw_has_turned,
    "the waiting ball rolls down the oblique track": _waiting_ball_rolls_down,
    "the rack has broken": _rack_has_broken,
    "the corner ball has rolled down the second spiral": _corner_ball_has_rolled_down,
    "the last pillar has fallen": _last_pillar_has_fallen,
}
"""What shows that a stage has worked, in the order in which they must; each is looked at after the one before it."""


def _measures(world: MovingWorld) -> dict[str, float]:
    """How many stages have worked."""
    assert isinstance(world, RigidWorld)
    return {
        STAGES_FIRED: float(len(world.fired)),
        "kinetic energy [J]": world.kinetic_energy(),
        "overlap [m]": world.overlap,
    }


def _worked(measures: Mapping[str, float]) -> bool:
    return measures[STAGES_FIRED] == len(STAGES)

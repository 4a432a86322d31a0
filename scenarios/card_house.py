"""The card house: thin plates that lean against one another stand still, until two balls hit them.

    feet at ±2a sin θ of the middle of a pair, top at 2 (a cos θ + t sin θ)       a, t: half length, half thickness
    pairs are 2a + `JOINT` apart, so that the plates on two pairs meet over the edges between them

Nothing sleeps and nothing is glued: that the house stands for thousands of steps is earned by friction alone. Three
storeys on four pairs, each storey with plates on top, make 24 cards: (8 + 3) + (6 + 2) + (4 + 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from scenarios.parameters import check_count, check_number, check_positive
from scenarios.world.impact import Resolver
from scenarios.world.moving_scene import STAGES_FIRED, MovingScene, MovingWorld
from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.rigid_world import RigidSettings, RigidWorld, Trigger
from scenarios.world.rotation import about
from scenarios.world.shapes import ball, box, half_space
from solvers.solution import Floats

HALF_SIZES = (4.3828, 1.8995, 0.05)
"""Half length, width and thickness of a card [m], of the scene that Smith 2012 released."""
GRAVITY = 9.82
"""[m/s²], of the same scene."""
PAIRS, STOREYS = 4, 3
# Angle of a leaning card to the vertical [rad]. Feet must stand inside of what carries the plate below them: half a
# length apart from its middle at most, 30°.
LEAN = np.radians(28.0)
# Gap between two plates that meet, as a share of their length, so that they do not push one another.
JOINT = 0.002
# Gap between the two cards of a pair, and over all that carries, as a share of the length: they start as good as
# touching, and overlap nowhere.
START_GAP = 1e-6
# Radius of a ball as a share of a card's length, the height over the house from which it falls, in lengths, its density
# over that of the cards, and how far to each side of the middle it falls: between the outer pairs of the lowest storey.
BALL, FALL, HEAVY, BESIDE = 0.2, 0.6, 5.0, 1.0
# A card that a ball flings away moves by up to its thickness in a step. Contacts are looked for as far as bodies move,
# so that it passes through nothing; it turns by 0.03 rad at most, which bends the way of its end by 2 mm.
LARGEST_MOVE = 3.0
# A card that has moved by less than this share of its length is in its place.
IN_PLACE = 0.1
# The cards are at rest when this share of the peak of their kinetic energy is left.
AT_REST = 1e-6
STAGES = ("the balls are let go", "the cards are at rest")
SOLVER = "qce-lcp:tolerance=1e-9,max_sweeps=1000"


def card_house(
    *,
    friction: float = 0.8,
    hit_at: float = 10.0,
    pairs: int = PAIRS,
    storeys: int = STOREYS,
    step: float = 0.001,
) -> MovingScene:
    """A house of cards stands still, is hit by two balls and falls.

    Args:
        friction: coefficient of all contacts, ≥ 0.
        hit_at: when the balls are let go, ≥ 0 [s].
        pairs: leaning pairs in the lowest storey, ≥ 2; each storey has one less than the one below.
        storeys: how many, from 1 to pairs.
        step: > 0 [s].

    Source: Zhang 2015, Section 5.4 (24 thin plates); sizes, density 1, g and μ from the card house that Smith 2012
    released; how the cards are put together is chosen here.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_number("friction", friction, low=0.0)
    check_number("hit_at", hit_at, low=0.0)
    check_count("pairs", pairs, 2)
    check_count("storeys", storeys, 1)
    check_number("storeys", storeys, high=pairs)
    check_positive("step", step)
    cards = house(pairs, storeys, friction=friction)
    return MovingScene(
        "card-house",
        {"friction": friction, "hit_at": hit_at, "pairs": pairs, "storeys": storeys, "step": step},
        f"a house of {len(cards)} cards stands, is hit by two balls and falls",
        "Zhang 2015, Section 5.4; Smith 2012, released scenes",
        partial(_build, cards, friction, hit_at, step),
        default_solver=SOLVER,
        default_steps=round((hit_at + 20.0) / step),
        frame_every=max(round(0.04 / step), 1),
        measure=partial(_measures, cards),
        stages=STAGES,
        reached=_at_rest,
        color="kind",
    )


def house(
    pairs: int,
    storeys: int,
    *,
    half_sizes: tuple[float, float, float] = HALF_SIZES,
    lean: float = LEAN,
    foot: Sequence[float] = (0.0, 0.0, 0.0),
    friction: float,
    density: float = 1.0,
) -> list[RigidBody]:
    """The cards of a house, storey by storey; it extends along x.

    Args:
        pairs: leaning pairs in the lowest storey.
        storeys: each with a pair less than the one below, and with plates on top of its pairs.
        half_sizes: half length, width and thickness of a card [m].
        lean: angle of a leaning card to the vertical [rad]; thick cards must stand steeper.
        foot: middle of the ground that it stands on [m], shape (3,).
        friction: coefficient of a card.
        density: of a card [kg/m³].
    """
    card = box(half_sizes)
    length, _, thickness = half_sizes
    gap = START_GAP * 2.0 * length
    pitch = 2.0 * length * (1.0 + JOINT)
    # Center of a leaning card beside the middle of its pair, and over its foot.
    aside = length * np.sin(lean) + thickness * np.cos(lean) + 0.5 * gap
    above = length * np.cos(lean) + thickness * np.sin(lean)
    cards: list[RigidBody] = []

    def put(x: float, z: float, elevation: float) -> None:
        place = np.add(foot, (x, 0.0, z))
        turn = about((0.0, 1.0, 0.0), -elevation)
        name = f"card {len(cards)}"
        cards.append(RigidBody(name, card, place, turn, friction=friction, density=density))

    floor = 0.0
    for storey in range(storeys):
        count = pairs - storey
        middles = pitch * (np.arange(count) - 0.5 * (count - 1))
        for middle in middles:
            put(middle - aside, floor + gap + above, 0.5 * np.pi - lean)
            put(middle + aside, floor + gap + above, 0.5 * np.pi + lean)
        top = floor + gap + 2.0 * above
        for middle in 0.5 * (middles[1:] + middles[:-1]):
            put(middle, top + gap + thickness, 0.0)
        floor = top + gap + 2.0 * thickness
    return cards


def _build(
    cards: list[RigidBody], friction: float, hit_at: float, step: float, identity: str, resolver: Resolver, seed: int
) -> RigidWorld:
    """The house on the ground, and two balls over it that are held until their time."""
    length, width, _ = 2.0 * np.array(HALF_SIZES)
    radius = BALL * length
    top = max(float(np.asarray(card.position)[2]) for card in cards) + FALL * length
    ground = RigidBody("ground", half_space(), friction=friction, fixed=True)
    # On both sides, in front of and behind the middle plane, and one after the other.
    beside = BESIDE * length
    places = [(beside, 0.2 * width, top), (-beside, -0.2 * width, top + 4.0 * radius)]
    balls = [
        RigidBody(f"ball {k}", ball(radius), place, density=HEAVY, friction=friction, held=True)
        for k, place in enumerate(places)
    ]
    # By then both would be on the ground if nothing were in their way.
    hit = hit_at + np.sqrt(2.0 * (top + 4.0 * radius) / GRAVITY)
    # A card that falls by its own length has less energy than 24 of them that come down from three storeys.
    least_peak = GRAVITY * length * cards[0].shape.volume
    triggers = [
        Trigger(STAGES[0], lambda world: world.time >= hit_at, tuple(thrown.name for thrown in balls)),
        Trigger(STAGES[1], lambda world: world.time > hit and cards_energy(cards, world) < AT_REST * least_peak),
    ]
    settings = RigidSettings(step=step, gravity=GRAVITY, largest_move=LARGEST_MOVE)
    return RigidWorld(identity, [ground, *cards, *balls], settings, resolver, triggers=triggers)


def displacements(cards: Sequence[RigidBody], world: RigidWorld) -> Floats:
    """How far each card is from its start [lengths of a card]; cards are the first movable bodies."""
    start = np.array([np.asarray(card.position) for card in cards])
    moved: Floats = np.linalg.norm(world.position[: len(cards)] - start, axis=1)
    return moved / float(np.ptp(cards[0].shape.vertices, axis=0).max())


def displacement(cards: Sequence[RigidBody], world: RigidWorld) -> float:
    """How far the card that moved most is from its start [lengths of a card]."""
    return float(displacements(cards, world).max())


def cards_energy(cards: Sequence[RigidBody], world: RigidWorld) -> float:
    """Kinetic energy of the cards alone [J]: a ball may roll on for ever."""
    moving = slice(len(cards))
    mass = cards[0].density * cards[0].shape.volume
    turning = (world.angular_momentum[moving] * world.spin[moving]).sum()
    return float(0.5 * mass * (world.velocity[moving] ** 2).sum() + 0.5 * turning)


def _measures(cards: Sequence[RigidBody], world: MovingWorld) -> dict[str, float]:
    """Whether the house stands, and whether all is at rest."""
    assert isinstance(world, RigidWorld)
    return {
        STAGES_FIRED: float(len(world.fired)),
        "largest displacement [card lengths]": displacement(cards, world),
        "cards in their place": float((displacements(cards, world) < IN_PLACE).sum()),
        "height of the highest card [m]": float(world.position[: len(cards), 2].max()),
        "kinetic energy of the cards [J]": cards_energy(cards, world),
        "overlap [m]": world.overlap,
    }


def _at_rest(measures: Mapping[str, float]) -> bool:
    return measures[STAGES_FIRED] == len(STAGES)

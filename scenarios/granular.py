"""Granular layers that are shaken: the extended patterns of Bizon et al. 1998, and one shake of a deep layer.

Units are the grains' own: mean diameter D = 1, g = 1, mean mass 1; velocity √(gD), time √(D/g).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import numpy.typing as npt

from scenarios.parameters import check_choice, check_count, check_number, check_positive
from scenarios.patterns import Pattern, faultless_map, height_map, measure_pattern
from scenarios.world.container import Motion, Shake, Vibration, box
from scenarios.world.impact import Constant, Resolver, SlowingRestitution
from scenarios.world.moving_scene import MovingScene, MovingWorld, Units
from scenarios.world.spheres import Spheres, spheres
from scenarios.world.stepping import Settings, World
from solvers.solution import Floats

DEPTH = 5.42
"""Depth H of the layer of `GRAINS_PER_AREA` grains per D² at rest [D] (Bizon 1998)."""
GRAINS_PER_AREA = 6
# Bizon 1998: 1 % polydispersity; the tails are cut so that no grain is much larger than the others.
POLYDISPERSITY = 0.01
TAIL = 3.0
# The grains start as a gas that falls: on a lattice of this spacing [D], each displaced at random by up to JITTER
# along each axis and with a velocity of this standard deviation, so that the layer keeps nothing of the lattice.
SPACING = 1.3
JITTER = 0.1
START_SPEED = 0.5

LONGEST_STEP = 0.0155
"""Time step of the patterns [√(D/g)]: 396 a cycle for hexagons, 557 for squares.

A layer that lands is pressed together, the more the longer the step: `tests/benchmarks/test_bench_world.py` prints the
deepest overlap of a step and of half of it, `tests/test_landing.py` what a quarter of it changes in a landing. Zhang
2015 has 0.0002 s; with grains of 0.165 mm, as in the experiments of Bizon 1998, that were 0.049.
"""
# Cycles between two frames of a pattern, 60,000 grains each; its measures are taken every cycle.
FRAME_CYCLES = 10
GRAINS = Units(length="D", time="√(D/g)", speed="√(gD)", energy="mgD")
"""D, m: mean diameter and mass of the grains."""

SETTLED = 30.0
"""Time of the shake [√(D/g)]: the grains have fallen and lie."""
# Time that they take to come to rest after it.
AFTERWARDS = 12.0
# Friction in a bed of many layers takes more sweeps than in a layer that flies half of the time: with the six of
# `qce-lcp-fast` the top of the bed sinks twice as far as with 600 (the README has the command).
SHAKE_SWEEPS = 60
# Slower approaches than this many times what gravity gives in a step are those of grains that lie.
RESTING = 4.0

DRIVING = {
    "squares": (3.00, 0.27),
    "stripes": (3.00, 0.44),
    "hexagons": (4.00, 0.38),
    "flat": (5.00, 0.44),
}
"""Pattern → Γ = 4π² f² A / g and f* = f √(H/g) (Bizon 1998)."""


def extended_pattern(
    *,
    pattern: str = "hexagons",
    side: int = 100,
    steps_per_cycle: int | None = None,
    restitution: float | None = None,
    friction: float = 0.5,
    tangential_restitution: float = 0.35,
) -> MovingScene:
    """Patterns of a vertically vibrated layer: 60,000 grains, 5.42 D deep, in a box of 100 D × 100 D.

    Args:
        pattern: "squares", "stripes", "hexagons" or "flat": the driving under which it was seen.
        side: of the box [D], ≥ 4; 6 grains stand on each D².
        steps_per_cycle: time steps in a period of the plate, ≥ 50; None: the fewest of at most `LONGEST_STEP`.
        restitution: of all contacts, in [0, 1]; None: e = max(1 - 0.3 v^(3/4), 0.7), v of each contact's blow.
        friction: coefficient of all contacts, ≥ 0.
        tangential_restitution: β₀ of all contacts that stick, in [0, 1]: that of Bizon 1998; Zhang 2015 has none, 0.

    Source: Bizon 1998; Zhang 2015, Fig. 9.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_choice("pattern", pattern, tuple(DRIVING))
    check_count("side", side, 4)
    if steps_per_cycle is None:
        steps_per_cycle = int(np.ceil(vibration(pattern).period / LONGEST_STEP))
    check_count("steps_per_cycle", steps_per_cycle, 50)
    if restitution is not None:
        check_number("restitution", restitution, low=0.0, high=1.0)
    check_number("friction", friction, low=0.0)
    check_number("tangential_restitution", tangential_restitution, low=0.0, high=1.0)
    parameters = {
        "pattern": pattern,
        "side": side,
        "steps_per_cycle": steps_per_cycle,
        "restitution": restitution,
        "friction": friction,
        "tangential_restitution": tangential_restitution,
    }
    settings = Settings(
        step=1.0 / (vibration(pattern).frequency * steps_per_cycle),
        gravity=1.0,
        restitution=SlowingRestitution() if restitution is None else Constant(restitution),
        friction=friction,
        tangential_restitution=tangential_restitution,
    )
    return MovingScene(
        "extended-pattern",
        parameters,
        f"a layer of {GRAINS_PER_AREA * side * side} grains on a vibrating plate",
        "Bizon 1998; Zhang 2015, Fig. 9",
        partial(_start, vibration(pattern), GRAINS_PER_AREA * side * side, side, settings),
        default_solver="qce-lcp-fast",
        steps_per_cycle=steps_per_cycle,
        default_steps=10 * steps_per_cycle,
        frame_every=FRAME_CYCLES * steps_per_cycle,
        measure=partial(pattern_measures, float(side)),
        measure_every=steps_per_cycle,
        color="height [D]",
        units=GRAINS,
        reached=partial(shows, pattern),
    )


def pattern_measures(side: float, world: MovingWorld) -> dict[str, float]:
    """What the surface of a layer shows: see `scenarios.patterns`."""
    return named_measures(measure_pattern(height_map(world.spheres.place, side), side))


def named_measures(found: Pattern) -> dict[str, float]:
    """Measures by their names in files and pages."""
    return {
        "wavelength [D]": found.wavelength, "share": found.share, "roughness [D]": found.roughness,
        "Q2": found.q2, "Q4": found.q4, "Q6": found.q6,
        "skewness": found.skewness, "ψ4": found.psi4, "ψ6": found.psi6,
    }  # fmt: skip


@dataclass(frozen=True)
class Published:
    """What a panel of Bizon 1998 shows, by the recipe of `scenarios.patterns`."""

    q2: float
    q4: float
    q6: float
    wavelength: float | None = None
    """[D]; None where there is no pattern."""
    cycles: int | None = None
    """Cycles after which a run by the first author showed it."""


PUBLISHED = {
    "squares": Published(0.087, 0.833, 0.064, 33.3, 680),
    "stripes": Published(0.851, 0.674, 0.429, 20.0, 2700),
    "hexagons": Published(0.05, 0.30, 0.48, 25.0, 300),
    "flat": Published(0.018, 0.165, 0.120),
}
"""Pattern → its panel; of hexagons there are two, with Q4 0.28 and 0.31, Q6 0.48 and 0.49."""

THRESHOLDS: dict[str, Mapping[str, tuple[float, float]]] = {
    "squares": {"Q4": (0.75, np.inf), "Q2": (-np.inf, 0.1)},
    "stripes": {"Q2": (0.8, np.inf)},
    "hexagons": {"Q6": (0.45, np.inf), "Q2": (-np.inf, 0.1)},
    "flat": {},
}
"""Pattern → measure → between which it lies, as it does on the published panels (see `scenarios.patterns`)."""


DIRECTIONS = {"squares": 2, "stripes": 1, "hexagons": 3}
"""Pattern → directions of the standing waves that it is made of."""
# A faultless pattern is turned and displaced in so many steps, as far as it repeats itself: by 5° for squares, and by
# quarters of a wavelength.
TURNS, SHIFTS = 19, 4


@cache
def faultless_measures(
    pattern: str, side: float, *, turn: float | None = None, wavelength: float | None = None
) -> dict[str, tuple[float, float]]:
    """Least and largest Q2, Q4, Q6 of a pattern without a fault, however it is displaced.

    Few waves, seen through the window of the recipe, do not come to 1.

    Args:
        pattern: of `DIRECTIONS`.
        side: of the box [D].
        turn: of its waves against the walls [rad]; None: any.
        wavelength: of its waves [D]; None: as on the published panel.
    """
    directions, wavelength = DIRECTIONS[pattern], wavelength or PUBLISHED[pattern].wavelength
    assert wavelength is not None
    maps = (
        faultless_map(directions, side / wavelength, angle, shift)
        for angle in (np.linspace(0.0, np.pi / directions, TURNS) if turn is None else [turn])
        for shift in np.arange(SHIFTS) / SHIFTS
    )
    found = [measure_pattern(heights, side) for heights in maps]
    values = {"Q2": [f.q2 for f in found], "Q4": [f.q4 for f in found], "Q6": [f.q6 for f in found]}
    return {name: (min(of_all), max(of_all)) for name, of_all in values.items()}


def shows(pattern: str, found: Mapping[str, float]) -> bool:
    """Whether measures show a pattern; of "flat" nothing says so."""
    inside = [low < found[name] < high for name, (low, high) in THRESHOLDS[pattern].items()]
    return bool(inside) and all(inside)


def vibration(pattern: str) -> Vibration:
    """Motion of the plate for a pattern, in the grains' units."""
    acceleration, reduced_frequency = DRIVING[pattern]
    frequency = reduced_frequency / np.sqrt(DEPTH)
    return Vibration(acceleration / (2.0 * np.pi * frequency) ** 2, frequency)


def granular_shake(
    *, grains: int = 4000, side: int = 16, restitution: float = 0.3, friction: float = 0.2, amplitude: float = 2.0,
    duration: float = 3.0, step: float = 0.02,
) -> MovingScene:  # fmt: skip
    """Grains fall into a container, come to rest, and are shaken once, up and down.

    The shake begins at `SETTLED`; `layer_displacement` measures what it did to the layers, colored by their depth then.

    Args:
        grains: how many, ≥ 1.
        side: of the container [D], ≥ 2.
        restitution: of all contacts, in [0, 1].
        friction: coefficient of all contacts, ≥ 0.
        amplitude: height of the shake, > 0 [D].
        duration: of the shake, > 0 [√(D/g)]: z = ½ amplitude (1 - cos 2πt/duration), a peak of 4.4 g by default.
        step: time step, > 0 [√(D/g)].

    Source: Zhang 2015, Fig. 8, after Jaeger 1996; size of the container and the shake are chosen here.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("grains", grains, 1)
    check_count("side", side, 2)
    check_number("restitution", restitution, low=0.0, high=1.0)
    check_number("friction", friction, low=0.0)
    for name, value in (("amplitude", amplitude), ("duration", duration), ("step", step)):
        check_positive(name, value)
    settings = Settings(step, 1.0, Constant(restitution, resting=RESTING * step), friction)
    return MovingScene(
        "granular-shake",
        {
            "grains": grains,
            "side": side,
            "restitution": restitution,
            "friction": friction,
            "amplitude": amplitude,
            "duration": duration,
            "step": step,
        },
        f"{grains} grains fall into a box, come to rest and are shaken once",
        "Zhang 2015, Fig. 8; Jaeger 1996",
        partial(_start, Shake(amplitude, duration, SETTLED), grains, side, settings),
        default_solver=f"qce-lcp-fast:max_sweeps={SHAKE_SWEEPS}",
        default_steps=round((SETTLED + duration + AFTERWARDS) / step),
        color="depth [D]",
        color_from=SETTLED,
        units=GRAINS,
    )


def layer_displacement(before: Floats, after: Floats, *, layers: int) -> Floats:
    """Mean rise of each layer, deepest first, in the inner and the outer half of the container's floor [D].

    Args:
        before: centers at the start of the shake, in the order of the labels, shape (grains, 3).
        after: centers of the same grains later, shape (grains, 3).
        layers: how many, of equally many grains each.

    Returns:
        Rise in the middle and at the walls, shape (layers, 2); NaN where there is no grain.
    """
    middle = 0.5 * (before[:, :2].min(axis=0) + before[:, :2].max(axis=0))
    away = np.abs(before[:, :2] - middle).max(axis=1)
    # Half of a square floor lies within 1/√2 of the way from its middle to its walls.
    inner = away < away.max() / np.sqrt(2.0)
    rise = after[:, 2] - before[:, 2]
    layer = layer_numbers(before, layers)
    found = np.full((layers, 2), np.nan)
    for k in range(layers):
        for column, place in enumerate((inner, ~inner)):
            chosen = rise[(layer == k) & place]
            if chosen.size:
                found[k, column] = chosen.mean()
    return found


def layer_numbers(before: Floats, layers: int) -> npt.NDArray[np.intp]:
    """Layer of each grain, deepest first, when all have equally many; shape (grains,)."""
    rank = np.argsort(np.argsort(before[:, 2], kind="stable"), kind="stable")
    return np.asarray(rank * layers // len(rank))


def _start(
    motion: Motion, count: int, side: int, settings: Settings, identity: str, resolver: Resolver, seed: int
) -> World:
    grains = falling_gas(count, float(side), np.random.default_rng(seed))
    return World(identity, grains, box(float(side), float(side), motion), settings, resolver)


def falling_gas(count: int, width: float, random: np.random.Generator) -> Spheres:
    """Grains that do not touch, over a floor of `width` × `width` [D]."""
    diameter = 1.0 + POLYDISPERSITY * np.clip(random.standard_normal(count), -TAIL, TAIL)
    columns = max(int(width / SPACING), 1)
    layers = -(-count // columns**2)
    level = (np.arange(columns) + 0.5) * (width / columns)
    height = 0.5 * SPACING + SPACING * np.arange(layers)
    z, y, x = (grid.ravel()[:count] for grid in np.meshgrid(height, level, level, indexing="ij"))
    centers: Floats = np.column_stack([x, y, z]) + random.uniform(-JITTER, JITTER, (count, 3))
    velocity = START_SPEED * random.standard_normal((count, 3))
    return spheres(centers, diameter / 2.0, diameter**3, velocity)

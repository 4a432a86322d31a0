"""How the layers of a settled bed moved: those that are colored by their depth once it lies (Zhang 2015, Fig. 8)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.stats import binned_statistic_2d

from harness import trajectory
from harness.simulation import TIME_ROUNDING
from reports.figures import BLUE, TWO_COLUMNS, VERMILLION
from reports.markdown import markdown_table
from scenarios.granular import layer_displacement, layer_numbers
from scenarios.world.moving_scene import MovingScene
from solvers.solution import Floats

LAYERS = 10
"""Layers of equally many bodies."""
# Parts of the floor from wall to wall over which the height of a layer is averaged.
PARTS = 12


@dataclass(frozen=True)
class Layers:
    """A bed when it lay, and when the run ended."""

    before: Floats
    """Centers when it lay, in the scene's unit of length, shape (bodies, 3)."""
    after: Floats
    """Centers of the same bodies when the run ended, shape (bodies, 3)."""
    times: tuple[float, float]
    """Of the two, in the scene's unit of time."""


def at_or_after(time: float, wanted: float) -> bool:
    """Whether a frame is as late as wanted."""
    return time >= wanted * (1.0 - TIME_ROUNDING)


def read_layers(folder: Path, scene: MovingScene) -> Layers | None:
    """Read the two moments; None for a scene that has no layers, or a run that ended before they lay."""
    if scene.color_from == 0.0:
        return None
    late = (frame for frame in trajectory.read_frames(folder) if at_or_after(frame.time, scene.color_from))
    first = next(late, None)
    # Of the frames after it one at a time is held: all of a long run together would not fit into memory.
    last = next(iter(deque(late, maxlen=1)), None)
    if first is None or last is None:
        return None
    return Layers(
        first.place[:, :3].astype(np.float64), last.place[:, :3].astype(np.float64), (first.time, last.time)
    )  # fmt: skip


def layers_lines(layers: Layers, scene: MovingScene) -> Iterator[str]:
    """The table of the page."""
    units = scene.units
    rise = layer_displacement(layers.before, layers.after, layers=LAYERS)
    depth = _depths(layers)
    yield from (
        "## How the layers moved",
        "",
        f"Mean rise between t = {layers.times[0]:.4g} and {layers.times[1]:.4g} {units.time} of {LAYERS} layers of "
        "equally many bodies, from the top down; middle: the inner half of the floor. Up in the middle and down at the "
        "walls is convection (Jaeger 1996).",
        "",
    )
    yield from markdown_table(
        (f"mean depth [{units.length}]", f"rise in the middle [{units.length}]", f"rise at the walls [{units.length}]"),
        [(f"{depth[k]:.2f}", *map(_signed, rise[k])) for k in reversed(range(LAYERS))],
    )
    yield ""


def layers_figure(layers: Layers, scene: MovingScene) -> Figure:
    """Rise of the layers by depth, and their height from wall to wall before and after."""
    units = scene.units
    rise = layer_displacement(layers.before, layers.after, layers=LAYERS)
    figure = Figure(figsize=(TWO_COLUMNS, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    depth = _depths(layers)
    left.plot(rise[:, 0], depth, color=VERMILLION, marker="o", label="in the middle")
    left.plot(rise[:, 1], depth, color=BLUE, marker="s", linestyle=(0, (4, 2)), label="at the walls")
    left.axvline(0.0, color="0.5", linewidth=0.6)
    left.invert_yaxis()
    left.xaxis.set_major_locator(MaxNLocator(5))
    left.set_xlabel(f"mean rise [{units.length}]")
    left.set_ylabel(f"depth at the start [{units.length}]")
    left.legend()
    shades = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, LAYERS))
    x, before, after = _profiles(layers)
    for k in range(LAYERS):
        right.plot(x, before[k], color=shades[k], linewidth=0.6, linestyle=(0, (4, 2)))
        right.plot(x, after[k], color=shades[k])
    right.set_xlabel(f"x [{units.length}]")
    right.set_ylabel(f"mean height of a layer [{units.length}]")
    right.set_title("dashed: before, solid: after", fontsize=7)
    return figure


def _signed(rise: float) -> str:
    """A rise with its sign; a dash where the layer has nothing on that part of the floor."""
    return "–" if np.isnan(rise) else f"{rise:+.3f}"


def _depths(layers: Layers) -> list[float]:
    """Mean depth of each layer before, under the highest body."""
    number = layer_numbers(layers.before, LAYERS)
    top = layers.before[:, 2].max()
    return [float(top - layers.before[number == k, 2].mean()) for k in range(LAYERS)]


def _profiles(layers: Layers) -> tuple[Floats, Floats, Floats]:
    """Middles of the parts of the floor, and the mean height of each layer over them before and after."""
    x = layers.before[:, 0]
    found = binned_statistic_2d(
        layer_numbers(layers.before, LAYERS), x, [layers.before[:, 2], layers.after[:, 2]],
        bins=[np.arange(LAYERS + 1), np.linspace(x.min(), x.max(), PARTS + 1)],
    )  # fmt: skip
    before, after = found.statistic
    return 0.5 * (found.y_edge[1:] + found.y_edge[:-1]), before, after

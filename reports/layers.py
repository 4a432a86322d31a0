"""How the layers of a settled bed moved: those that are colored by their depth once it lies (Zhang 2015, Fig. 8)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from harness import trajectory
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
    """Centers, shape (bodies, 3)."""
    after: Floats
    """Shape (bodies, 3)."""
    times: tuple[float, float]


def at_or_after(time: float, wanted: float) -> bool:
    """Whether a frame is as late as wanted; times are sums of steps."""
    return time >= wanted * (1.0 - 1e-9)


def read_layers(folder: Path, scene: MovingScene) -> Layers | None:
    """Read the two moments; None for a scene that has no layers, or a run that ended before they lay."""
    if scene.color_from == 0.0:
        return None
    late = [frame for frame in trajectory.read_frames(folder) if at_or_after(frame.time, scene.color_from)]
    if len(late) < 2:
        return None
    first, last = late[0], late[-1]
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
    number, x = layer_numbers(layers.before, LAYERS), layers.before[:, 0]
    edges = np.linspace(x.min(), x.max(), PARTS + 1)
    part = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, PARTS - 1)
    heights = np.full((2, LAYERS, PARTS), np.nan)
    for moment, place in enumerate((layers.before, layers.after)):
        for k in range(LAYERS):
            for p in range(PARTS):
                chosen = place[(number == k) & (part == p), 2]
                if chosen.size:
                    heights[moment, k, p] = chosen.mean()
    return 0.5 * (edges[1:] + edges[:-1]), heights[0], heights[1]

"""One scene run by one solver or by several, in one figure: paths of the bodies, and measures over time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from harness import trajectory
from harness.measurement import Kind
from harness.results import Frames, Results, ResultsError
from harness.simulation import MEASURES
from reports.figures import BLACK, BLUE, GREEN, LOOKS, ONE_COLUMN, ORANGE, PURPLE, SKY, TWO_COLUMNS, VERMILLION
from reports.scorecard import ReportError
from scenarios.world.moving_scene import MovingScene
from solvers.solution import Floats

# Laws without a look of their own take these in turn.
COLORS = (BLACK, SKY, PURPLE, GREEN, ORANGE, BLUE, VERMILLION)
# Errors are drawn on a logarithmic scale; what is exactly zero stands at its lower end.
NO_ERROR = 1e-17
# A curve of fewer points has them marked; one of more is thinned.
MARKED, MOST_POINTS = 60, 2_000
# Frames of a path: a longer one would fill the plane.
LAST_FRAMES = 300
# Panels side by side, and what the labels of one take of its width [in].
ACROSS = 4
MARGIN = 0.5
# Letters of an axis label that fit beside a panel; a longer one is broken into lines.
LABEL_WIDTH = 20


def results_of(store: Frames) -> Results:
    """Read the results of a simulation.

    Raises:
        ReportError: the store lacks what a report needs.
    """
    try:
        return Results(store, kinds=(Kind.SIMULATION,))
    except ResultsError as error:
        raise ReportError(str(error)) from error


def solver_of(store: Frames) -> str:
    """Who solved the impacts of a run."""
    (solver,) = results_of(store).solvers
    return solver


def numbers(path: Path) -> dict[str, Floats]:
    """Columns of a CSV file as numbers; words are left out."""
    table = trajectory.read_table(path)
    return {name: table[name].to_numpy(np.float64) for name in table.columns if name != "status"}


def thinned(columns: Mapping[str, Floats]) -> dict[str, Floats]:
    """Rows evenly spread over all, no more than a figure shows."""
    return {name: values[:: -(-len(values) // MOST_POINTS)] for name, values in columns.items()}


def measured(runs: Mapping[str, Path]) -> list[str]:
    """Names of what the scene measures."""
    (first, *_) = runs.values()
    return [name for name in trajectory.read_table(first / MEASURES).columns if name not in ("step", "time")]


def is_error(name: str) -> bool:
    """Whether a measure is an error, of which its size on a logarithmic scale matters."""
    return any(word in name for word in ("error", "asymmetry"))


def measures_figure(runs: Mapping[str, Path], scene: MovingScene) -> Figure:
    """Every measure of the scene over time, a panel each, a curve a run.

    Args:
        runs: solver, or whatever tells a run from the others → results folder.
        scene: that was run.
    """
    names = measured(runs)
    across, down = min(len(names), 2), -(-len(names) // 2)
    # A scene from impact to impact that has no end of its own is followed over its impacts.
    endless = math.isfinite(scene.frame_time) and math.isinf(scene.duration)
    over, label = ("step", "impacts") if endless else ("time", f"time [{scene.units.time}]")
    figure = Figure(figsize=(ONE_COLUMN * across, 1.8 * down + 0.3), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for (solver, folder), color in zip(runs.items(), _colors(runs), strict=True):
        measures = thinned(numbers(folder / MEASURES))
        few = len(measures["time"]) <= MARKED
        line = LOOKS[solver].line if solver in LOOKS else "-"
        for axes, name in zip(panels, names, strict=False):
            values = np.maximum(measures[name], NO_ERROR) if is_error(name) else measures[name]
            axes.plot(measures[over], values, color=color, linestyle=line, marker="." if few else "", label=solver)
    for axes, name in zip(panels, names, strict=False):
        axes.set_ylabel(fill(name, LABEL_WIDTH))
        axes.set_xlabel(label)
        if name.startswith("balls"):
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        if endless:
            axes.set_xscale("log")
        if is_error(name):
            axes.set_yscale("log")
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    if len(runs) > 1:
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(runs))
    return figure


def trace_figure(runs: Mapping[str, Path], scene: MovingScene) -> Figure:
    """How each body went: its path from above, or its x over time; a panel a run."""
    last = LAST_FRAMES if scene.trace == "xy" else None
    courses = {solver: _course(folder, last) for solver, folder in runs.items()}
    if scene.trace == "xy":
        across = min(len(runs), ACROSS)
        down = -(-len(runs) // across)
        width = min(TWO_COLUMNS / across, ONE_COLUMN)
        x, y = (np.concatenate([place[..., axis].ravel() for _, place in courses.values()]) for axis in range(2))
        height = (width - MARGIN) * float(np.ptp(y) / np.ptp(x)) + 2.0 * MARGIN
        figure = Figure(figsize=(width * across, height * down), layout="constrained")
        panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
    else:
        figure = Figure(figsize=(TWO_COLUMNS, 1.7 * len(runs) + 0.2), layout="constrained")
        panels = figure.subplots(len(runs), 1, squeeze=False, sharex=True).ravel()
    for axes, (solver, course) in zip(panels, courses.items(), strict=False):
        draw = _draw_paths if scene.trace == "xy" else _draw_course
        draw(axes, *course, scene)
        law, times = LOOKS[solver].label if solver in LOOKS else solver, course[0]
        axes.set_title(law if times[0] == 0.0 else f"{law}\nt = {times[0]:.0f} … {times[-1]:.0f} {scene.units.time}")
    for axes in panels[len(runs) :]:
        axes.set_visible(False)
    return figure


def _course(folder: Path, last: int | None) -> tuple[Floats, Floats]:
    """Times of so many last frames (all if None), and centers and radii of all bodies in them."""
    frames = list(deque(trajectory.read_frames(folder), maxlen=last))
    return np.array([frame.time for frame in frames]), np.array([frame.place for frame in frames])


def _draw_paths(axes: Axes, times: Floats, place: Floats, scene: MovingScene) -> None:
    """Paths from above, from the dashed circles to the gray ones."""
    ring = np.linspace(0.0, 2.0 * np.pi, 49)
    around = np.column_stack([np.cos(ring), np.sin(ring)])
    for body in range(place.shape[1]):
        color = BLUE if body else VERMILLION
        axes.plot(place[:, body, 0], place[:, body, 1], linewidth=0.6, color=color)
        start, end = (center[:2] + center[3] * around for center in (place[0, body], place[-1, body]))
        axes.plot(start[:, 0], start[:, 1], color="0.6", linewidth=0.4, linestyle=(0, (2, 2)), zorder=0.5)
        axes.fill(end[:, 0], end[:, 1], facecolor="0.85", edgecolor=color, linewidth=0.6)
    axes.set_aspect("equal")
    axes.set_xlabel(f"x [{scene.units.length}]")
    axes.set_ylabel(f"y [{scene.units.length}]")
    axes.label_outer()


def _draw_course(axes: Axes, times: Floats, place: Floats, scene: MovingScene) -> None:
    """Sideways motion of each body over time, from where it hangs."""
    for body in range(place.shape[1]):
        axes.plot(times, place[:, body, 0], linewidth=0.7, color=BLUE if body % 2 else VERMILLION)
    axes.set_xlabel(f"time [{scene.units.time}]")
    axes.set_ylabel(f"x [{scene.units.length}]")
    axes.label_outer()


def _colors(runs: Mapping[str, Path]) -> list[str]:
    """A color for each solver: its own where the figures of the scorecard have one."""
    spare = [color for color in COLORS if color not in {LOOKS[name].color for name in runs if name in LOOKS}]
    colors = []
    for name in runs:
        colors.append(LOOKS[name].color if name in LOOKS else spare[0])
        if name not in LOOKS and len(spare) > 1:
            spare.pop(0)
    return colors

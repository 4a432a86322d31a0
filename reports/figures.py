"""The figures of the scorecard as PDF, SVG and PNG, fit for a paper: one or two columns wide, legible in gray.

    fig04_three_ball_chain     velocities of the three balls over va (Zhang 2015, Fig. 4)
    fig12_disturbed_cradle     velocities under small disturbances (Zhang 2015, Fig. 12)
    cradle_velocities          Newton's cradle with one to three of five balls moving
    validation_error           distance of each law to both references
    energy_error               relative energy error of each solver over its scenes

Drawn from stored series and rows alone. The same store gives the same bytes with the same matplotlib: no dates, fixed
fonts, a fixed salt for the names inside SVG. Laws differ by color (Okabe and Ito 2008), marker and line style, so that
any one of the three is enough.
"""

from __future__ import annotations

import io
import math
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from harness.claims import PRINT, PRINTED_ENERGY_ERROR, SMALL, is_energy_error
from harness.results import (
    Cradle,
    DisturbedCradle,
    Frames,
    Results,
    ResultsError,
    ThreeBallSweep,
    cradles,
    disturbed_cradles,
    three_ball_sweep,
)
from reports.files import prepare, write_whole
from reports.scorecard import FIRST, ReportError
from solvers.solution import Floats

# Widths of one and two columns of a journal page [in].
ONE_COLUMN, TWO_COLUMNS = 3.3, 7.0
# Dots per inch of the PNG.
RESOLUTION = 300

STYLE: Any = {
    "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "font.size": 7.5,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.4,
    "axes.axisbelow": True,
    "lines.linewidth": 1.0,
    "lines.markersize": 3.6,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "impactbench",
    "path.simplify": False,
}
"""matplotlib settings of every figure; no text is below 7 pt."""

BLACK, ORANGE, SKY, GREEN, BLUE, VERMILLION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip


@dataclass(frozen=True)
class Look:
    """How a law is drawn everywhere."""

    label: str
    color: str
    marker: str
    line: Any
    """matplotlib's line style: a name, or an offset and dashes."""
    filled: bool = True
    size: float = 3.6
    """Marker size [pt]; hollow markers are larger, so that one within them is seen."""


LOOKS: Mapping[str, Look] = {
    "qce": Look("QCE", VERMILLION, "o", "-"),
    "qce-defer": Look("QCE, deferred", PURPLE, "D", (0, (6, 1.5)), filled=False, size=5.4),
    "gr": Look("GR", BLUE, "s", (0, (4, 2)), filled=False, size=5.2),
    "lcp-pgs": Look("LCP", ORANGE, "^", (0, (4, 1.2, 1, 1.2))),
    "lzb": Look("LZB", GREEN, "v", (0, (1, 1.2)), filled=False, size=4.6),
}
"""Laws that the figures compare, in drawing order."""


class _Skipped(Exception):
    """The rows that a figure needs are not there; the text says which."""


def write_figures(
    store: Frames,
    folder: str | os.PathLike[str],
    *,
    jobs: int = 1,
    progress: Callable[[str], None] | None = None,
) -> list[Path]:
    """Draw every figure that the store has rows for.

    Args:
        store: anything with `frame(name)` for "tasks", "scores" and "series".
        folder: where to; made where it is missing.
        jobs: figures at a time, each in a process of its own; the files are the same for any number.
        progress: told what was drawn, and what was skipped and why.

    Returns:
        The files, PDF, SVG and PNG of each figure.

    Raises:
        ReportError: the store cannot be read, has rows for no figure, or the folder cannot be written to.
    """
    say = progress if progress is not None else _silent
    try:
        results = Results(store)
    except ResultsError as error:
        raise ReportError(str(error)) from error
    path = prepare(folder)
    written: list[Path] = []
    skipped: list[str] = []
    for name, (files, reason) in zip(FIGURES, _draw_all(results, path, jobs), strict=True):
        written += files
        if reason:
            skipped.append(f"{name}: {reason}")
        say(f"skipped {name}: {reason}" if reason else f"drew {name}")
    if not written:
        raise ReportError("the store has rows for no figure: " + "; ".join(skipped))
    return written


def _draw_all(results: Results, folder: Path, jobs: int) -> Iterator[tuple[list[Path], str]]:
    """Files of each figure, in order, or the reason why there are none."""
    draw = partial(_draw, results, folder)
    if jobs == 1:
        yield from map(draw, FIGURES)
        return
    # After a run the fork server is there, with most libraries loaded.
    with ProcessPoolExecutor(min(jobs, len(FIGURES)), multiprocessing.get_context("forkserver")) as pool:
        yield from pool.map(draw, FIGURES)


def _draw(results: Results, folder: Path, name: str) -> tuple[list[Path], str]:
    """Draw and write one figure; its files, or none and the reason.

    Raises:
        ReportError: the rows are damaged, or the folder cannot be written to.
    """
    try:
        with mpl.rc_context(STYLE):
            return save(FIGURES[name](results), folder, name), ""
    except _Skipped as reason:
        return [], str(reason)
    except ResultsError as error:
        raise ReportError(f"{name}: {error}") from error


def _silent(text: str) -> None:
    """Tell nobody."""


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write one figure in three formats, without dates."""
    FigureCanvasAgg(figure)
    # The layout is the same in every format and costs as much as the drawing: it is done once.
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    metadata: Mapping[str, dict[str, Any]] = {
        "pdf": {"CreationDate": None, "ModDate": None},
        "svg": {"Date": None},
        "png": {"Software": None},
    }
    written = []
    for kind, about in metadata.items():
        content = io.BytesIO()
        figure.savefig(content, format=kind, dpi=RESOLUTION, metadata=about)
        written.append(write_whole(folder / f"{name}.{kind}", content.getvalue()))
    return written


def marker_of(look: Look) -> Mapping[str, Any]:
    """Marker settings of a law: hollow or filled, edge in its color."""
    return {
        "marker": look.marker,
        "markersize": look.size,
        "markerfacecolor": look.color if look.filled else "none",
        "markeredgecolor": look.color,
        "markeredgewidth": 0.8,
    }


def _legend_below(figure: Figure, handles: Sequence[Line2D], *, columns: int) -> None:
    """One legend for all panels, under them."""
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns, handlelength=3.2, columnspacing=1.4)


def _law_handles(solvers: Sequence[str], *, lines: bool) -> list[Line2D]:
    """Legend entries of some laws, in drawing order."""
    return [
        Line2D(
            [], [], color=LOOKS[name].color, linestyle=LOOKS[name].line if lines else "none", label=LOOKS[name].label,
            **marker_of(LOOKS[name]),
        )
        for name in LOOKS
        if name in solvers
    ]  # fmt: skip


IDEAL_LINE: Mapping[str, Any] = {"color": "0.55", "linestyle": "-", "linewidth": 2.6, "solid_capstyle": "butt"}
HERTZ_LINE: Mapping[str, Any] = {"color": BLACK, "linestyle": "-", "linewidth": 0.9}


# --- Fig. 4 -----------------------------------------------------------------------------------------------------------


def draw_three_ball_chain(results: Results) -> Figure:
    """Post-impact velocities of the three balls over va, one panel a ball."""
    sweeps = _sweeps(results)
    figure = Figure(figsize=(TWO_COLUMNS, 2.75), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True)
    reference = next(iter(sweeps.values()))
    for ball, (panel, letter) in enumerate(zip(panels, "ABC", strict=True)):
        panel.plot(reference.va, reference.ideal[:, ball], **IDEAL_LINE)
        if np.isfinite(reference.hertz).all():
            panel.plot(reference.va, reference.hertz[:, ball], **HERTZ_LINE)
        for k, (name, sweep) in enumerate(sweeps.items()):
            look = LOOKS[name]
            _curve(panel, look, sweep.va, sweep.v_post[:, ball], place=k / len(sweeps))
        panel.set_xlabel(r"$v_A^- / v_0$ [–]")
        panel.set_ylabel(rf"$v_{letter}^+ / v_0$ [–]")
        panel.set_title(f"ball {letter}", loc="left")
        panel.set_xlim(reference.va[0], reference.va[-1])
    handles = [Line2D([], [], **IDEAL_LINE, label="ideal exchange"), Line2D([], [], **HERTZ_LINE, label="Hertz")]
    _legend_below(figure, [*handles, *_law_handles(list(sweeps), lines=True)], columns=7)
    return figure


def _curve(panel: Axes, look: Look, va: Floats, y: Floats, *, place: float) -> None:
    """One law over va, its markers shifted by `place` of their distance so that laws do not hide each other.

    A first value off the line through the next two is a law of its own at va = 0: a lone marker, not a slope.
    """
    alone = va.size > 2 and abs(y[0] - (2 * y[1] - y[2])) > PRINT
    start = 1 if alone else 0
    every = max(1, va.size // 8)
    panel.plot(
        va[start:], y[start:], color=look.color, linestyle=look.line, **marker_of(look),
        markevery=(int(place * every), every), clip_on=False, zorder=3,
    )  # fmt: skip
    if alone:
        panel.plot(va[0], y[0], linestyle="none", **marker_of(look), clip_on=False, zorder=3)


def _sweeps(results: Results) -> Mapping[str, ThreeBallSweep]:
    """The three-ball sweeps of the compared laws, in drawing order; deferred QCE only adds clutter to QCE here."""
    found = {
        name: sweep
        for name in LOOKS
        if name != "qce-defer" and (sweep := three_ball_sweep(results, name)) is not None and sweep.va.size > 1
    }
    if not found:
        raise _Skipped(f"no three-ball sweep of any of {', '.join(LOOKS)}")
    return found


# --- Fig. 12 ----------------------------------------------------------------------------------------------------------


def draw_disturbed_cradle(results: Results) -> Figure:
    """Velocities of every ball over all disturbances of one size; below, the largest response over the size."""
    found = {name: rows for name in LOOKS if name != "lcp-pgs" and (rows := disturbed_cradles(results, name))}
    lengths = sorted({row.balls for rows in found.values() for row in rows})
    if not lengths:
        raise _Skipped("no disturbed cradle of any compared law")
    figure = Figure(figsize=(TWO_COLUMNS, 4.6), layout="constrained")
    grid = figure.subplots(2, len(lengths), squeeze=False, width_ratios=[n + 0.5 for n in lengths])
    size = _shown_size(found)
    for column, balls in enumerate(lengths):
        at_size = {name: row for name, rows in found.items() for row in rows if row.balls == balls and row.size == size}
        _velocity_strips(grid[0, column], at_size, balls)
        _response_curves(grid[1, column], {
            name: [row for row in rows if row.balls == balls] for name, rows in found.items()
        })  # fmt: skip
        grid[0, column].set_title(f"{balls} balls, disturbance {_power(size)}", loc="left")
    grid[0, 0].set_ylabel("v⁺ / v₀ [–]")
    grid[1, 0].set_ylabel("largest |Δv⁺| / v₀ [–]")
    references = [
        Line2D([], [], color="0.55", linestyle="-", linewidth=2.6, label="Hertz, undisturbed"),
        Line2D([], [], color=BLACK, marker="_", linestyle="none", markersize=8, label="same law, undisturbed"),
        Line2D([], [], color="0.4", linestyle=(0, (1, 1)), linewidth=0.8, label="response = disturbance"),
    ]
    _legend_below(figure, [*_law_handles(list(found), lines=True), *references], columns=4)
    return figure


# Raised digits as letters: formulae cost matplotlib a parser run each, and most tick labels would be one.
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _power(value: float) -> str:
    """A positive number as a power of ten, with its factor where it has one."""
    mantissa, exponent = f"{value:.0e}".split("e")
    factor = "" if mantissa == "1" else f"{mantissa}·"
    return f"{factor}10{str(int(exponent)).translate(RAISED)}"


def _shown_size(found: Mapping[str, Sequence[DisturbedCradle]]) -> float:
    """The size whose velocities are shown: SMALL where it was measured, else the smallest."""
    sizes = sorted({row.size for rows in found.values() for row in rows})
    return next((size for size in sizes if math.isclose(size, SMALL, rel_tol=1e-6)), sizes[0])


def _velocity_strips(panel: Axes, rows: Mapping[str, DisturbedCradle], balls: int) -> None:
    """One strip of points a law and ball; draws are spread over the strip in their order."""
    names = [name for name in LOOKS if name in rows]
    pitch = 0.8 / max(len(names), 1)
    for k, name in enumerate(names):
        row, look = rows[name], LOOKS[name]
        for ball in range(balls):
            center = ball + 1 + (k - (len(names) - 1) / 2) * pitch
            v = row.v_post[:, ball]
            spread = np.linspace(-0.32, 0.32, v.size) if v.size > 1 else np.zeros(v.size)
            panel.plot(
                center + pitch * spread, v, color=look.color, linestyle="none", **{**marker_of(look), "markersize": 2.0,
                "markeredgewidth": 0.5}, zorder=3,
            )  # fmt: skip
            panel.hlines(row.undisturbed[ball], center - pitch / 2, center + pitch / 2, color=BLACK, lw=0.9, zorder=4)
    for ball in range(balls):
        hertz = next((row.hertz[ball] for row in rows.values() if np.isfinite(row.hertz[ball])), math.nan)
        panel.hlines(hertz, ball + 0.55, ball + 1.45, color="0.55", linewidth=2.6, zorder=1)
    panel.set_xticks(range(1, balls + 1))
    panel.set_xlim(0.5, balls + 0.5)
    panel.set_xlabel("ball")
    panel.grid(visible=False, axis="x")


# Responses are drawn down to here [of the impact velocity]; smaller ones lie on the axis.
SMALLEST_RESPONSE = 1e-16
RESPONSES = (1e-16, 1e-12, 1e-8, 1e-4, 1.0)


def _response_curves(panel: Axes, rows: Mapping[str, Sequence[DisturbedCradle]]) -> None:
    """Largest response over the size of the disturbance, one curve a law."""
    sizes = sorted({row.size for found in rows.values() for row in found})
    panel.plot(sizes, sizes, color="0.4", linestyle=(0, (1, 1)), linewidth=0.8)
    for name, found in rows.items():
        look = LOOKS[name]
        panel.plot(
            [row.size for row in found], [max(row.response, SMALLEST_RESPONSE) for row in found], color=look.color,
            linestyle=look.line, **marker_of(look),
        )  # fmt: skip
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xticks(sizes, [_power(size) for size in sizes])
    panel.set_yticks(RESPONSES, [_power(value) for value in RESPONSES])
    smallest = min(min(row.size, row.response) for found in rows.values() for row in found)
    panel.set_ylim(0.1 * max(smallest, SMALLEST_RESPONSE), 4.0)
    panel.minorticks_off()
    panel.set_xlabel("disturbance of u⁻ / v₀ [–]")


# --- Cradles ----------------------------------------------------------------------------------------------------------


def draw_cradles(results: Results) -> Figure:
    """Newton's cradle of five balls with one, two and three moving: velocity of every ball."""
    balls, moved = 5, (1, 2, 3)
    found = {
        name: {row.moving: row for row in cradles(results, name) if row.balls == balls and row.moving in moved}
        for name in LOOKS
    }
    shown = {name: rows for name, rows in found.items() if rows and name != "qce-defer"}
    columns = sorted({moving for rows in shown.values() for moving in rows})
    if not columns:
        raise _Skipped(f"no cradle of {balls} balls of any compared law")
    figure = Figure(figsize=(TWO_COLUMNS, 2.6), layout="constrained")
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for panel, moving in zip(panels, columns, strict=True):
        _cradle_panel(panel, {name: rows[moving] for name, rows in shown.items() if moving in rows}, balls)
        panel.set_title(f"{moving} of {balls} moving", loc="left")
    panels[0].set_ylabel("v⁺ / v₀ [–]")
    handles = [
        Line2D([], [], **IDEAL_LINE, label="ideal exchange"),
        Line2D([], [], **HERTZ_LINE, label="Hertz"),
    ]
    _legend_below(figure, [*handles, *_law_handles(list(shown), lines=False)], columns=7)
    return figure


def _cradle_panel(panel: Axes, rows: Mapping[str, Cradle], balls: int) -> None:
    """One cradle: references as bars across each ball's place, laws side by side in it."""
    reference = next(iter(rows.values()))
    places = np.arange(1, balls + 1)
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    panel.hlines(reference.ideal, places - 0.42, places + 0.42, color="0.55", linewidth=2.6, zorder=1)
    panel.hlines(reference.hertz, places - 0.42, places + 0.42, color=BLACK, linewidth=0.9, zorder=2)
    pitch = 0.8 / len(rows)
    for k, (name, row) in enumerate(rows.items()):
        offset = (k - (len(rows) - 1) / 2) * pitch
        panel.plot(places + offset, row.v_post, linestyle="none", **marker_of(LOOKS[name]), zorder=3)
    panel.set_xticks(places)
    panel.set_xlabel("ball")
    panel.grid(visible=False, axis="x")


# --- Validation -------------------------------------------------------------------------------------------------------


def draw_validation_error(results: Results) -> Figure:
    """Distance of each law to the ideal exchange (above) and to Hertz (below): three balls over va, and cradles."""
    sweeps = _sweeps(results)
    chains = {name: rows for name in LOOKS if name != "qce-defer" and (rows := cradles(results, name))}
    figure = Figure(figsize=(TWO_COLUMNS, 4.4), layout="constrained")
    grid = figure.subplots(2, 2, sharex="col")
    for row, reference in enumerate(("ideal", "hertz")):
        _error_over_va(grid[row, 0], sweeps, reference)
        _error_over_balls(grid[row, 1], chains, reference)
        title = "to the ideal exchange" if reference == "ideal" else "to Hertz contact"
        grid[row, 0].set_title(f"three balls, {title}", loc="left")
        grid[row, 1].set_title(f"cradles, {title}", loc="left")
        grid[row, 0].set_ylabel("distance / v₀ [–]")
        grid[row, 1].set_ylabel("rms distance / v₀ [–]")
    grid[1, 0].set_xlabel(r"$v_A^- / v_0$ [–]")
    grid[1, 1].set_xlabel("balls (one to all but one moving)")
    band = Line2D([], [], color="0.85", linewidth=6, label="distance between the two references")
    _legend_below(figure, [*_law_handles(list(sweeps), lines=True), band], columns=5)
    return figure


def _truth(row: ThreeBallSweep | Cradle, reference: str) -> Floats:
    """The reference outcome of that name."""
    return row.ideal if reference == "ideal" else row.hertz


def _error_over_va(panel: Axes, sweeps: Mapping[str, ThreeBallSweep], reference: str) -> None:
    """Euclidean distance over va, above the band within which the references themselves differ."""
    first = next(iter(sweeps.values()))
    apart = np.linalg.norm(first.ideal - first.hertz, axis=1)
    panel.fill_between(first.va, 0.0, np.nan_to_num(apart), color="0.85", linewidth=0, zorder=1)
    for k, (name, sweep) in enumerate(sweeps.items()):
        look = LOOKS[name]
        error = np.linalg.norm(sweep.v_post - _truth(sweep, reference), axis=1)
        _curve(panel, look, sweep.va, error, place=k / len(sweeps))
    panel.set_xlim(first.va[0], first.va[-1])
    panel.set_ylim(bottom=0.0)


def _error_over_balls(panel: Axes, chains: Mapping[str, Sequence[Cradle]], reference: str) -> None:
    """Root mean square over the cradles of one length."""
    lengths = sorted({row.balls for rows in chains.values() for row in rows})
    for name, rows in chains.items():
        look = LOOKS[name]
        errors = [
            _rms([float(np.linalg.norm(row.v_post - _truth(row, reference))) for row in rows if row.balls == n])
            for n in lengths
        ]
        panel.plot(lengths, errors, color=look.color, linestyle=look.line, **marker_of(look), clip_on=False, zorder=3)
    for rows in list(chains.values())[:1]:
        apart = [
            _rms([float(np.linalg.norm(row.ideal - row.hertz)) for row in rows if row.balls == n]) for n in lengths
        ]
        panel.fill_between(lengths, 0.0, np.nan_to_num(apart), color="0.85", linewidth=0, zorder=1)
    if lengths:
        panel.set_xticks(lengths)
    panel.set_ylim(bottom=0.0)


def _rms(values: Sequence[float]) -> float:
    """Root mean square; NaN of nothing."""
    return math.sqrt(sum(value * value for value in values) / len(values)) if values else math.nan


# --- Energy -----------------------------------------------------------------------------------------------------------

# An energy error of zero is drawn here: below the rounding of any sum.
ZERO_ERROR = 1e-18
# A law that gains energy without bound is drawn here, with a mark of its own.
LARGEST_ERROR = 1e3
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


def draw_energy_error(results: Results) -> Figure:
    """Relative energy error of every solver over its elastic scenes, one point a scene."""
    # Only where a loss is gated must energy be kept: elsewhere restitution or friction takes it.
    elastic = {row.task.task for row in results.scores if row.metric == "energy lost" and row.gated}
    tolerance = {row.tolerance for row in results.scores if row.metric == "energy lost" and row.gated}
    errors: dict[str, list[float]] = {}
    for row in results.scores:
        kept = row.name == "KIN" and is_energy_error(row) and row.task.task in elastic
        if kept and not math.isnan(row.value):
            errors.setdefault(row.task.solver, []).append(abs(row.value))
    if not errors:
        raise _Skipped("no energy error of an elastic scene")
    names = sorted(errors, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name))
    figure = Figure(figsize=(ONE_COLUMN, 0.9 + 0.2 * len(names)), layout="constrained")
    panel = figure.subplots()
    for place, name in enumerate(names):
        _energy_strip(panel, place, np.sort(errors[name]))
    for bound in sorted(tolerance):
        panel.axvline(bound, color=VERMILLION, linestyle=(0, (4, 2)), linewidth=0.9, zorder=2)
    panel.axvline(PRINTED_ENERGY_ERROR, color="0.4", linestyle=(0, (1, 1)), linewidth=0.9, zorder=2)
    panel.set_xscale("log")
    _label_powers(panel)
    panel.set_yticks(range(len(names)), [f"{name} ({len(errors[name])})" for name in names])
    panel.set_ylim(len(names) - 0.4, -0.6)
    panel.set_xlabel("|K⁺ − K⁻| / K⁻ [–]")
    panel.grid(visible=False, axis="y")
    handles = [
        Line2D([], [], color=BLUE, linestyle="none", **SCENE, label="scene"),
        Line2D([], [], color=BLUE, linestyle="none", **BEYOND, label=f"scene, above {_power(LARGEST_ERROR)}"),
        Line2D([], [], color=BLACK, marker="|", linestyle="none", markersize=8, markeredgewidth=1.6, label="median"),
        Line2D([], [], color=VERMILLION, linestyle=(0, (4, 2)), label="tolerance"),
        Line2D([], [], color="0.4", linestyle=(0, (1, 1)), label="Zhang 2015, mean"),
    ]
    _legend_below(figure, handles, columns=2)
    return figure


SCENE: Mapping[str, Any] = {"marker": "o", "markersize": 2.4, "markerfacecolor": "none", "markeredgewidth": 0.6}
BEYOND: Mapping[str, Any] = {"marker": ">", "markersize": 3.6}


def _energy_strip(panel: Axes, place: int, values: Floats) -> None:
    """One solver's errors, shape (scenes,), spread over its line, and their median."""
    # Multiples of the golden ratio spread any number of points evenly, without a random number.
    spread = place + 0.6 * ((np.arange(values.size) * GOLDEN) % 1.0 - 0.5)
    within = values <= LARGEST_ERROR
    panel.plot(
        np.maximum(values[within], ZERO_ERROR), spread[within], linestyle="none", color=BLUE, **SCENE, zorder=3
    )  # fmt: skip
    beyond = np.full(int((~within).sum()), LARGEST_ERROR)
    panel.plot(beyond, spread[~within], linestyle="none", color=BLUE, **BEYOND, zorder=3)
    median = min(max(float(np.median(values)), ZERO_ERROR), LARGEST_ERROR)
    panel.plot(median, place, marker="|", markersize=9, markeredgewidth=1.6, color=BLACK, zorder=4)


def _label_powers(panel: Axes) -> None:
    """Ticks at every third power of ten; the place of zero is labelled as such."""
    powers = [10.0**power for power in range(-15, 4, 3)]
    panel.set_xticks([ZERO_ERROR, *powers], ["0", *map(_power, powers)])
    panel.minorticks_off()
    panel.set_xlim(ZERO_ERROR / 10, LARGEST_ERROR * 10)


FIGURES: Mapping[str, Callable[[Results], Figure]] = {
    "fig04_three_ball_chain": draw_three_ball_chain,
    "fig12_disturbed_cradle": draw_disturbed_cradle,
    "cradle_velocities": draw_cradles,
    "validation_error": draw_validation_error,
    "energy_error": draw_energy_error,
}
"""File name → drawing."""

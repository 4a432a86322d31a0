"""The figures of the bench: speed against error, growth with size, profiles; as PDF, SVG and PNG.

    bench_precision_K   one scene: verification and validation error over CPU time and over contact visits
    bench_lcp_K         one scene: the methods for the Newton LCP among each other
    bench_scaling       CPU time over the number of contacts, with fitted exponents
    bench_profile       performance profiles over time and visits, data profile

Style, colors and file formats are those of `reports.figures`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogFormatterSciNotation, LogLocator, NullFormatter
from matplotlib.transforms import offset_copy

from harness.statistics import data_profile, performance_profile
from harness.work_precision import VERIFICATION
from reports.bench_rows import (
    COMPARED_AT,
    Bench,
    Point,
    cost_matrix,
    exponent,
    is_own_reference,
    laws,
    scenes,
    sweep,
    validation_metric,
)
from reports.figures import (
    BLACK,
    BLUE,
    GREEN,
    LOOKS,
    ORANGE,
    PURPLE,
    SKY,
    STYLE,
    TWO_COLUMNS,
    VERMILLION,
    Look,
    marker_of,
    save,
)

GRAY = "0.45"

BENCH_LOOKS: Mapping[str, Look] = {
    **LOOKS,
    "ehi": Look("EHI", SKY, "P", "-", size=4.4),
    "hertz": Look("Hertz", BLACK, "p", (0, (1, 1.2)), filled=False, size=5.0),
    "gauss-seidel": Look("Gauss-Seidel", GRAY, "<", (0, (4, 1.2, 1, 1.2)), filled=False, size=4.2),
    "jacobi": Look("Jacobi", GRAY, ">", (0, (1, 1.2)), filled=False, size=4.2),
}
"""Laws of the registry that differ in their answers, in drawing order."""

SAME_AS_QCE = ("qce-lcp", "qce-blend")
"""At c_r = 1, as in all scenes of the bench, these are `qce`: they are in the tables."""

LCP_LOOKS: Mapping[str, Look] = {
    "lcp-pgs": Look("projected Gauss-Seidel", ORANGE, "^", (0, (4, 1.2, 1, 1.2))),
    "lcp-apgd": Look("accelerated projected gradient", BLUE, "s", (0, (4, 2)), filled=False, size=4.6),
    "lcp-spg": Look("spectral projected gradient", SKY, "D", (0, (6, 1.5)), size=3.4),
    "lcp-osqp": Look("OSQP", PURPLE, "v", (0, (1, 1.2)), size=4.2),
    "lcp-clarabel": Look("Clarabel", VERMILLION, "o", "-", filled=False, size=4.6),
    "lcp-nnls": Look("NNLS (active set)", GREEN, "*", "-", size=6.0),
}
"""Methods for one and the same law, the Newton LCP; `lcp-pgs` stands for it among the laws."""

OTHERS: Sequence[tuple[str, str, Any]] = (
    (GREEN, "X", "-"), (BLUE, "d", (0, (6, 1.5))), (PURPLE, "h", (0, (4, 2))), (ORANGE, "*", (0, (1, 1.2))),
)  # fmt: skip
"""Color, marker and line of laws that the user brings, in turn."""

# Errors below rounding are drawn on this line: a logarithm has no zero.
FLOOR = 1e-17
# What is farther off has diverged; drawn, it would hide all others. It is in the tables.
DIVERGED = 10.0
# Distance of a legend from the axis above it [pt], leaving room for its label, and height of one of its lines [in].
LEGEND_BELOW = 26.0
LEGEND_LINE = 0.145
# Factors over which a performance profile is drawn; what is slower by more is as good as lost.
LARGEST_FACTOR = 1e4
LARGEST_BUDGET = 1e5
CROSSED_OUT = "not converged"


def write_bench_figures(bench: Bench, folder: Path) -> list[Path]:
    """Draw every figure that the bench has rows for.

    Args:
        bench: the rows.
        folder: where to; it exists.

    Returns:
        The files.

    Raises:
        ReportError: the folder cannot be written to.
    """
    written: list[Path] = []
    with mpl.rc_context(STYLE):
        for name, draw in figures(bench).items():
            written += save(draw(), folder, name)
    return written


def figures(bench: Bench) -> dict[str, Callable[[], Figure]]:
    """Name → what draws it, for all that the rows are there for."""
    found: dict[str, Callable[[], Figure]] = {}
    for k, scene in enumerate(scenes(bench.points), start=1):
        here = [point for point in bench.points if point.scene == scene and point.timed]
        if _looks(here):
            found[f"bench_precision_{k}"] = lambda here=here: draw_precision(here)  # type: ignore[misc]
        if len(_known(here, LCP_LOOKS)) > 1:
            found[f"bench_lcp_{k}"] = lambda here=here: draw_lcp_methods(here)  # type: ignore[misc]
    if any(point.timed for point in bench.scaling):
        found["bench_scaling"] = lambda: draw_scaling(bench.scaling)
    if len(scenes(bench.points)) > 1 and cost_matrix(bench, visits=False)[1]:
        found["bench_profile"] = lambda: draw_profiles(bench)
    return found


def draw_precision(points: Sequence[Point]) -> Figure:
    """One scene: errors of both kinds over time and over visits, one line a law."""
    figure = Figure(figsize=(TWO_COLUMNS, 4.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col", sharey="row")
    looks = _looks(points)
    reference = validation_metric(points)
    titles = ("(a) ", "(b) ", "(c) ", "(d) ")
    for row, metric in enumerate((VERIFICATION, reference)):
        for column, cost in enumerate((_time, _visits)):
            panel = panels[row, column]
            shown = [point for point in points if not is_own_reference(point.law, metric)]
            _sweeps(panel, shown, looks, metric, cost)
            name = "own equations and approach" if row == 0 else f"against {reference.removeprefix('validation: ')}"
            panel.set_title(
                titles[2 * row + column] + ("verification: " if row == 0 else "validation: ") + name, loc="left"
            )
    _uncertainty(panels[1], points, reference)
    panels[0, 0].set_ylabel("residual [–]")
    panels[1, 0].set_ylabel(r"velocity error / $\max|v^-|$ [–]")
    panels[1, 0].set_xlabel("CPU time of one solve [s]")
    panels[1, 1].set_xlabel("contact visits [–]")
    figure.suptitle(points[0].scene, fontsize=8)
    _legend(figure, looks, columns=5)
    return figure


def draw_lcp_methods(points: Sequence[Point]) -> Figure:
    """One scene: residual of the Newton LCP over time and over visits, one line a method."""
    figure = Figure(figsize=(TWO_COLUMNS, 2.9), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for panel, cost, label in zip(
        panels, (_time, _visits), ("CPU time of one solve [s]", "contact visits [–]"), strict=True
    ):
        _sweeps(panel, points, LCP_LOOKS, VERIFICATION, cost)
        panel.set_xlabel(label)
    panels[0].set_ylabel("natural-map residual [–]")
    figure.suptitle(points[0].scene, fontsize=8)
    _legend(figure, {law: LCP_LOOKS[law] for law in _known(points, LCP_LOOKS)}, columns=3)
    return figure


def draw_scaling(points: Sequence[Point]) -> Figure:
    """CPU time over contacts, one panel a family, with the fitted exponents in the legend."""
    # An interrupted bench has families without any time yet.
    families = list(dict.fromkeys(point.family for point in points if point.timed))
    looks = _looks(points)
    entries = len(looks) + 2
    figure = Figure(figsize=(TWO_COLUMNS, 2.7 + LEGEND_LINE * entries), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(families), sharey=True))
    for panel, family, letter in zip(panels, families, "abcdefgh", strict=False):
        for law, look in looks.items():
            here = sorted((p for p in points if p.law == law and p.family == family), key=lambda p: p.contacts)
            _growth(panel, here, look)
        _slope_of_one(panel, [p for p in points if p.family == family and p.timed])
        panel.set_xscale("log")
        panel.set_yscale("log")
        _uncrowded(panel)
        panel.set_title(f"({letter}) {family}", loc="left")
        panel.set_xlabel("contacts [–]")
        below = offset_copy(panel.transAxes, fig=figure, y=-LEGEND_BELOW, units="points")
        panel.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), bbox_transform=below, handlelength=3.0)
    panels[0].set_ylabel("CPU time of one solve [s]")
    return figure


def draw_profiles(bench: Bench) -> Figure:
    """Performance profiles over time and visits, and the data profile over visits a contact."""
    figure = Figure(figsize=(TWO_COLUMNS, 2.9), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    factors = np.geomspace(1.0, LARGEST_FACTOR, 400)
    budgets = np.geomspace(1.0, LARGEST_BUDGET, 400)
    contacts = {point.scene: float(max(point.contacts, 1)) for point in bench.points}
    looks = _looks(bench.points)
    places = {law: place / len(looks) for place, law in enumerate(looks)}
    names: list[str] = []
    for column, (panel, visits) in enumerate(zip(panels, (False, True, True), strict=True)):
        where, names, costs = cost_matrix(bench, visits=visits)
        if column < 2:
            shares, x = performance_profile(costs, factors), factors
        else:
            shares, x = data_profile(costs, [contacts[scene] for scene in where], budgets), budgets
        for k, law in enumerate(names):
            if law in looks:
                _steps(panel, x, shares[:, k], looks[law], place=places[law])
        panel.set_xscale("log")
        panel.set_ylim(-0.03, 1.03)
    panels[0].set_ylabel(rf"share of scenes, residual $\leq 10^{{{math.log10(COMPARED_AT):.0f}}}$ [–]")
    panels[0].set_xlabel("CPU time / best [–]")
    panels[1].set_xlabel("contact visits / fewest [–]")
    panels[2].set_xlabel("visits of each contact [–]")
    for panel, title in zip(
        panels, ("(a) performance, time", "(b) performance, visits", "(c) data profile"), strict=True
    ):
        panel.set_title(title, loc="left")
    _legend(figure, {law: look for law, look in looks.items() if law in names}, columns=5)
    return figure


def _time(point: Point) -> float:
    return point.median_s


def _visits(point: Point) -> float:
    return point.work


def _looks(points: Sequence[Point]) -> dict[str, Look]:
    """Laws that differ in their answers with their looks: those of the registry, then what the user brought."""
    known = {law: BENCH_LOOKS[law] for law in _known(points, BENCH_LOOKS)}
    brought = [law for law in laws(points) if law not in {*BENCH_LOOKS, *LCP_LOOKS, *SAME_AS_QCE}]
    for k, law in enumerate(brought):
        color, marker, line = OTHERS[k % len(OTHERS)]
        # A law from a file is named by the file and the class, without the folder.
        known[law] = Look(law.rpartition("/")[2], color, marker, line, size=4.6)
    return known


def _known(points: Sequence[Point], looks: Mapping[str, Look]) -> list[str]:
    """Laws of some points that have a look, in drawing order."""
    found = set(laws(points))
    return [law for law in looks if law in found]


def _sweeps(
    panel: Axes, points: Sequence[Point], looks: Mapping[str, Look], metric: str, cost: Callable[[Point], float]
) -> None:
    """The settings of every law from coarse to fine; errors of zero stand on the floor."""
    for law in _known(points, looks):
        here = [
            p for p in sweep(points, law, points[0].scene) if p.error(metric) <= DIVERGED and math.isfinite(cost(p))
        ]
        x = [cost(point) for point in here]
        y = [max(point.error(metric), FLOOR) for point in here]
        look = looks[law]
        panel.plot(x, y, color=look.color, linestyle=look.line, **marker_of(look))
    panel.set_xscale("log")
    panel.set_yscale("log")
    _decades(panel)
    _uncrowded(panel)


def _uncrowded(panel: Axes) -> None:
    """Label powers of ten along x, and 2 and 5 times them only where there is room."""
    low, high = panel.get_xlim()
    if high / max(low, 1e-300) < 50.0:
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(math.inf, math.inf)))
    panel.xaxis.set_minor_formatter(NullFormatter())


def _decades(panel: Axes) -> None:
    """A tick every three decades of error where there are many, plain numbers where there are few."""
    low, high = panel.get_ylim()
    if high / max(low, 1e-300) < 100.0:
        panel.yaxis.set_major_formatter(FuncFormatter(lambda error, _: f"{error:g}"))
        panel.yaxis.set_minor_formatter(FuncFormatter(lambda error, _: f"{error:.2g}"))
        panel.yaxis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0)))
    if high / max(low, 1e-300) > 1e6:
        panel.yaxis.set_major_locator(LogLocator(base=1000.0, numticks=12))
        panel.yaxis.set_minor_locator(LogLocator(base=10.0, numticks=30))
        panel.yaxis.set_minor_formatter(NullFormatter())


def _uncertainty(panels: Sequence[Axes], points: Sequence[Point], reference: str) -> None:
    """Shade what is within the reference's own uncertainty: errors there are not distinguishable from none."""
    bound = max((point.uncertainties.get(reference, 0.0) for point in points), default=0.0)
    if bound <= 0.0:
        return
    for panel in panels:
        low, high = panel.get_ylim()
        if low < bound:
            panel.axhspan(low, bound, color="0.9", zorder=0)
            panel.set_ylim(low, high)


def _growth(panel: Axes, points: Sequence[Point], look: Look) -> None:
    """One law over size; sizes at which its own test did not pass are crossed out."""
    timed = [point for point in points if point.timed]
    if not timed:
        return
    law = exponent(timed)
    growth = "" if law is None else f" {law.exponent:.2f}"
    if law is not None and math.isfinite(law.low):
        growth += f" ± {law.high - law.exponent:.2f}"
    x, y = [point.contacts for point in timed], [point.median_s for point in timed]
    panel.plot(x, y, color=look.color, linestyle=look.line, label=look.label + growth, **marker_of(look))
    wrong = [point for point in timed if not point.converged]
    _, labels = panel.get_legend_handles_labels()
    label = CROSSED_OUT if wrong and CROSSED_OUT not in labels else None
    x, y = [point.contacts for point in wrong], [point.median_s for point in wrong]
    panel.plot(x, y, "x", color=BLACK, markersize=6.5, zorder=4, label=label)


def _slope_of_one(panel: Axes, points: Sequence[Point]) -> None:
    """A line under the fastest along which time grows with the number of contacts."""
    x = np.array([min(p.contacts for p in points), max(p.contacts for p in points)], dtype=np.float64)
    fastest = min(p.median_s / p.contacts for p in points)
    panel.plot(x, 0.4 * fastest * x, color="0.6", linewidth=2.2, zorder=0, solid_capstyle="butt", label="exponent 1")


def _steps(panel: Axes, x: Any, share: Any, look: Look, *, place: float) -> None:
    """One profile; markers are shifted by `place` of their distance, so that equal profiles stay apart."""
    every = len(x) // 6
    panel.plot(
        x, share, color=look.color, linestyle=look.line, drawstyle="steps-post", markevery=(int(place * every), every),
        **marker_of(look),
    )  # fmt: skip


def _legend(figure: Figure, looks: Mapping[str, Look], *, columns: int) -> None:
    """One legend for all panels, under them."""
    handles = [
        Line2D([], [], color=look.color, linestyle=look.line, label=look.label, **marker_of(look))
        for look in looks.values()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=3.2, columnspacing=1.4)

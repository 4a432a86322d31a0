"""Patterns of vibrated layers beside those of Bizon 1998, from their records alone: nothing is computed again.

patterns.md                     what each run shows, cycle by cycle, and Table 2 of Zhang 2015 beside ours
patterns.(pdf|svg|png)          last height map of each run, as Fig. 9 of Zhang 2015, and of the cycle after it
pattern_growth.(…)              five maps of each run, from its first to its last
pattern_measures.(…)            all measures over the cycles
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from harness.patterns import EVERY, PatternRecord
from reports.figures import BLACK, BLUE, GREEN, STYLE, TWO_COLUMNS, VERMILLION, save
from reports.files import prepare, write_whole
from reports.markdown import markdown_table
from reports.scorecard import ReportError
from scenarios.granular import DIRECTIONS, DRIVING, PUBLISHED, THRESHOLDS, faultless_measures, named_measures, shows
from scenarios.patterns import Pattern

COLORS = {"squares": VERMILLION, "stripes": BLUE, "hexagons": GREEN, "flat": BLACK}
MARKERS = {"squares": "s", "stripes": "^", "hexagons": "o", "flat": "."}
MEASURES = {
    "wavelength": "wavelength [D]", "q2": "Q2", "q4": "Q4", "q6": "Q6", "psi4": "ψ4", "psi6": "ψ6",
    "skewness": "skewness", "roughness": "roughness [D]",
}  # fmt: skip
"""Attribute of `Pattern` → its name."""
DIGITS = {"wavelength": 1, "q2": 3, "q4": 3, "q6": 3}
"""Decimals of a measure; two of the others."""
# Width of one of four panels side by side [in].
PANEL = TWO_COLUMNS / 4
# Maps of a run in the figure of its growth.
STAGES = 5
# Heights outside these percentiles of a map are drawn as the ends of the gray scale: single grains fly high.
SHOWN_PERCENTILES = (1.0, 99.0)

# Zhang 2015, Table 2, for the patterns of 60,000 grains: iterations of QCE (mean, largest, smallest), and seconds a
# step in contact resolving on one thread of a 3.0 GHz i5-2320 (mean, largest).
TABLE_2 = {
    "squares": (13, 46, 1, 0.28, 2.74),
    "stripes": (17, 44, 1, 0.33, 4.39),
    "hexagons": (12, 33, 1, 0.25, 2.87),
}
TABLE_2_NOTE = (
    "The paper's seconds are contact resolving alone, on one thread of a 3.0 GHz i5-2320, with a step of 0.0002 s for "
    "grains of unknown size. Ours are whole steps on the machine named below; what else ran on it, and time in which "
    "the run was stopped, counts in the mean and the most, hardly in the median."
)


def write_patterns(records: Sequence[PatternRecord], folder: Path, others: Sequence[PatternRecord] = ()) -> list[Path]:
    """Write the page and the figures of some runs.

    Args:
        records: one for each pattern.
        folder: where to.
        others: of runs with other settings, to be set beside these.

    Raises:
        ReportError: there is no record, or the folder cannot be written to.
    """
    if not records:
        raise ReportError(f"{folder} holds no records of patterns; name results folders of extended-pattern runs")
    ordered = sorted(records, key=lambda record: list(DRIVING).index(record.pattern))
    path = prepare(folder)
    written = [write_whole(path / "patterns.md", patterns_markdown(ordered, others).encode())]
    with mpl.rc_context(STYLE):
        written += save(_panels_figure(ordered), path, "patterns")
        written += save(_growth_figure(ordered), path, "pattern_growth")
        written += save(_measures_figure(ordered), path, "pattern_measures")
    return written


def patterns_markdown(records: Sequence[PatternRecord], others: Sequence[PatternRecord] = ()) -> str:
    """All runs as one Markdown page, and the last maps of others with other settings."""
    lines = [
        "# Patterns of vibrated layers",
        "",
        f"Height maps at the beginning of every {EVERY}th cycle (plate at its middle, going up), measured as "
        "`scenarios/patterns.py` says. Published: the panels of Bizon et al. 1998 by the same measure; \"cycles\" is "
        "when a run of the first author showed the pattern. Lengths are in mean diameters D of a grain.",
        "",
        "Settings are those of Bizon et al. 1998 where the command of a run does not say otherwise; among them a "
        "tangential restitution of 0.35 of contacts that stick, which Zhang 2015 does not have. A command that does "
        "not name it was run with 0.",
        "",
        "Q2, Q4 and Q6 are the published recipe: order of the whole map. ψ4 and ψ6 are the order about each peak away "
        "from the walls (1 for four, or six, neighbors at equal angles; about 0.5 both for few peaks at random). "
        "Skewness is that of the heights: hexagons show peaks in one cycle (> 0) and cells in the next one (about 0 "
        "and less); in squares and stripes what is up is like what is down half a wavelength away.",
        "",
        *markdown_table(
            ("pattern", "whose", "cycle", *MEASURES.values(), "pattern stands"),
            [row for record in records for row in _comparison_rows(record)],
        ),
        "",
        f"A pattern stands from the cycle on from which all later maps pass its thresholds: {_thresholds()}.",
        "",
        *_beside_lines(records, others),
        *_faultless_lines(records),
        "## Beside Table 2 of Zhang 2015",
        "",
        TABLE_2_NOTE,
        "",
        *markdown_table(
            ("pattern", "whose", "QCE iterations, mean / most / least", "seconds a step, mean / most", "median"),
            [row for record in records for row in _table_2_rows(record)],
        ),
        "",
    ]  # fmt: skip
    for record in records:
        lines += _run_lines(record)
    return "\n".join(lines)


def standing_since(record: PatternRecord) -> int | None:
    """First stored cycle from which on every map shows the pattern; None if the last one does not."""
    since = None
    for cycle, found in zip(record.cycles[: record.tenths], record.measures, strict=False):
        if not shows(record.pattern, named_measures(found)):
            since = None
        elif since is None:
            since = int(cycle)
    return since


def _comparison_rows(record: PatternRecord) -> Iterator[tuple[str, ...]]:
    """The last map beside the published panel."""
    panel, last = PUBLISHED[record.pattern], record.tenths - 1
    yield record.pattern, "here", str(record.cycles[last]), *_numbers(record.measures[last]), _stands(record)
    if last < len(record.cycles) - 1:
        yield "", "here, the other phase", str(record.cycles[-1]), *_numbers(record.measures[-1]), ""
    published = (f"{value:.3f}" for value in (panel.q2, panel.q4, panel.q6))
    yield "", "Bizon 1998", str(panel.cycles or "–"), f"{panel.wavelength or '–'}", *published, "–", "–", "–", "–", ""


def _stands(record: PatternRecord) -> str:
    """Since when the pattern stands, in words."""
    if record.pattern == "flat":
        return "none is expected"
    since = standing_since(record)
    if since is not None:
        return f"from cycle {since} on"
    showing = sum(shows(record.pattern, named_measures(found)) for found in record.measures[: record.tenths])
    return f"no; it shows in {showing} of {record.tenths} maps"


def _beside_lines(records: Sequence[PatternRecord], others: Sequence[PatternRecord]) -> Iterator[str]:
    """Runs of the same patterns with other settings."""
    other = {record.pattern: record for record in others}
    rows = [row for record in records if record.pattern in other for row in _beside_rows(record, other[record.pattern])]
    if not rows:
        return
    yield from (
        "## Beside other settings",
        "",
        "Maps of runs whose settings differ as said, at the last cycle that both have; and since when the pattern "
        "stands in the whole of each run.",
        "",
        *markdown_table(("pattern", "settings", "cycle", *MEASURES.values(), "pattern stands"), rows),
        "",
    )


def _beside_rows(record: PatternRecord, other: PatternRecord) -> Iterator[tuple[str, ...]]:
    """A run and another one at the same cycle, each by what it has that the other has not."""
    own, its = (set(str(run.run["scene"]).partition(":")[2].split(",")) for run in (record, other))
    last = min(record.cycles[record.tenths - 1], other.cycles[other.tenths - 1])
    named = {setting.partition("=")[0] for setting in its}
    for name, run, differs in (
        (record.pattern, record, own - its),
        ("", other, (its - own) | {f"no {s.partition('=')[0]}" for s in own if s.partition("=")[0] not in named}),
    ):
        found = run.measures[int(np.searchsorted(run.cycles, last))]
        yield name, ", ".join(sorted(differs)), str(last), *_numbers(found), _stands(run)


def _faultless_lines(records: Sequence[PatternRecord]) -> Iterator[str]:
    """What the measures of the recipe can be at best, beside their thresholds."""
    shown = [record for record in records if record.pattern in DIRECTIONS]
    if not shown:
        return
    yield from (
        "## Patterns without a fault",
        "",
        "The recipe's measures of standing waves in this box, least and largest over all ways in which they may be "
        "displaced: of the published wavelength, turned by any angle, and as long and turned as the waves of the last "
        "map are (mean wave number of the strongest shell and its neighbors); in brackets what counts as the pattern. "
        "So few waves do not come to 1; turned by some angles three waves of squares do not count, without a fault as "
        "they are; and waves of a length between two shells lie in both, so that a shell holds some directions alone.",
        "",
        *markdown_table(
            ("pattern", "waves across", "turned by", "Q2", "Q4", "Q6"),
            [row for record in shown for row in _faultless_rows(record)],
        ),
        "",
    )


def _faultless_rows(record: PatternRecord) -> Iterator[tuple[str, ...]]:
    """A pattern without a fault in any way and as the last map lies, and that map."""
    pattern, side, limits = record.pattern, record.side, THRESHOLDS[record.pattern]
    last = record.tenths - 1
    found, fold = record.measures[last], 2 * DIRECTIONS[pattern]
    turn = found.turns[fold]
    lies = f"{round(np.degrees(turn)) % (360 // fold)}°"
    names = ("Q2", "Q4", "Q6")
    bounds = [f" ({_limit(*limits[name])})" if name in limits else "" for name in names]
    for length, angle, words in (
        (PUBLISHED[pattern].wavelength, None, "any angle"),
        (found.mean_wavelength, turn, lies),
    ):
        ranges = faultless_measures(pattern, side, turn=angle, wavelength=length)
        between = (f"{least:.2f} - {most:.2f}" for least, most in (ranges[name] for name in names))
        marks = bounds if angle is None else ["", "", ""]
        waves = f"{side / (length or np.nan):.1f}"
        yield pattern, waves, words, *(text + mark for text, mark in zip(between, marks, strict=True))
    here = (f"{named_measures(found)[name]:.2f}" for name in names)
    yield f"{pattern}, here at cycle {record.cycles[last]}", "", lies, *here


def _numbers(found: Pattern) -> Iterator[str]:
    """All measures of a map."""
    for name in MEASURES:
        value = getattr(found, name)
        digits = DIGITS.get(name, 2)
        yield f"{value:.{digits}f}" if np.isfinite(value) else "–"


def _thresholds() -> str:
    """What a map must show of each pattern, in words."""
    return ", ".join(
        f"{pattern} " + " and ".join(f"{name} {_limit(*between)}" for name, between in bounds.items())
        for pattern, bounds in THRESHOLDS.items() if bounds
    )  # fmt: skip


def _limit(low: float, high: float) -> str:
    """One of two bounds, the other of which is infinite."""
    return f"> {low:g}" if np.isfinite(low) else f"< {high:g}"


def _table_2_rows(record: PatternRecord) -> Iterator[tuple[str, ...]]:
    """Statistics of all steps, beside the paper's where it has the pattern."""
    mean, most, least = record.run["iterations"]
    mean_s, median_s, most_s = record.run["wall_s"]
    yield (
        record.pattern, "here", f"{mean:.1f} / {most} / {least}", f"{mean_s:.3g} / {most_s:.3g}", f"{median_s:.3g}"
    )  # fmt: skip
    if record.pattern in TABLE_2:
        mean, most, least, mean_s, most_s = TABLE_2[record.pattern]
        yield "", "Zhang 2015", f"{mean} / {most} / {least}", f"{mean_s} / {most_s}", "–"


def _run_lines(record: PatternRecord) -> Iterator[str]:
    """How the run was made, how well its steps were solved, and what each map shows."""
    run, machine = record.run, record.run["machine"]
    yield from (
        f"## {record.pattern.capitalize()}",
        "",
        f"`impactbench simulate {run['scene']} --solver {run['solver']} --seed {run['seed']} --steps {run['steps']}`, "
        f"impactbench {machine['impactbench']} at commit {str(machine['commit'])[:10]}, Python {machine['python']}, "
        f"numba {machine['numba']}, {machine['cpu']}, {machine['cores']} cores.",
        "",
        f"{run['steps']} steps, {run['steps_per_cycle']} a cycle; contacts {run['contacts'][0]:.0f} on average, "
        f"{run['contacts'][1]} at most; {run['sweeps']:.3g} friction sweeps a step, after which "
        f"{100 * run['converged']:.3g} % of the steps passed the law's own tolerance; deepest overlap of a step below "
        f"{run['overlap'][0]:.2g} radii in 99 % of the steps, {run['overlap'][1]:.2g} at most.",
        "",
    )
    yield from markdown_table(
        ("cycle", *MEASURES.values(), "share", "shows the pattern"),
        [
            (str(cycle), *_numbers(found), f"{found.share:.2f}", _shown(record, found))
            for cycle, found in zip(record.cycles, record.measures, strict=True)
        ],
    )  # fmt: skip
    yield ""


def _shown(record: PatternRecord, found: Pattern) -> str:
    if record.pattern == "flat":
        return "–"
    return "yes" if shows(record.pattern, named_measures(found)) else "no"


def _draw_map(axes: Axes, record: PatternRecord, k: int) -> None:
    """One height map from above, x to the right; high is bright."""
    heights = record.heights[k]
    low, high = np.nanpercentile(heights, SHOWN_PERCENTILES)
    image = axes.imshow(
        heights.T, origin="lower", extent=(0.0, record.side, 0.0, record.side), cmap="gray", vmin=low, vmax=high,
        interpolation="nearest",
    )  # fmt: skip
    axes.grid(visible=False)
    axes.set_xticks([])
    axes.set_yticks([])
    figure = axes.get_figure()
    assert figure is not None
    bar = figure.colorbar(image, ax=axes, location="bottom", shrink=0.8, pad=0.03, aspect=18)
    bar.ax.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    bar.outline.set_linewidth(0.4)


def _panels_figure(records: Sequence[PatternRecord]) -> Figure:
    """Last map of each run, and below it that of the other phase where it is kept."""
    rows = 2 if any(record.tenths < len(record.cycles) for record in records) else 1
    figure = Figure(figsize=(PANEL * len(records), 2.5 * rows), layout="constrained")
    panels = figure.subplots(rows, len(records), squeeze=False)
    for column, record, letter in zip(panels.T, records, "abcd", strict=False):
        for axes, k in zip(column, range(record.tenths - 1, len(record.cycles)), strict=False):
            _draw_map(axes, record, k)
            axes.set_title(f"({letter}) {record.pattern}, cycle {record.cycles[k]}")
        for axes in column[len(record.cycles) - record.tenths + 1 :]:
            axes.set_visible(False)
    return _laid_out(figure)


def _growth_figure(records: Sequence[PatternRecord]) -> Figure:
    """Maps of each run at cycles that grow by a factor."""
    columns = min(STAGES, max(record.tenths for record in records))
    figure = Figure(figsize=(TWO_COLUMNS / STAGES * columns, 1.9 * len(records) + 0.2), layout="constrained")
    rows = figure.subplots(len(records), columns, squeeze=False)
    for record, panels in zip(records, rows, strict=True):
        stages = np.unique(np.geomspace(1, record.tenths, columns).round().astype(int)) - 1
        for axes, k in zip(panels, stages, strict=False):
            _draw_map(axes, record, k)
            axes.set_title(f"cycle {record.cycles[k]}")
        for axes in panels[len(stages) :]:
            axes.set_visible(False)
        panels[0].set_ylabel(record.pattern)
    return _laid_out(figure)


def _laid_out(figure: Figure) -> Figure:
    """Label all gray scales at once; bars below panels need a second pass of the layout, which `save` makes."""
    figure.supxlabel("height above the plate [D]", fontsize=STYLE["axes.labelsize"])
    figure.draw_without_rendering()
    return figure


def _measures_figure(records: Sequence[PatternRecord]) -> Figure:
    """Measures over the cycles, of one phase; the published values as dashes."""
    figure = Figure(figsize=(TWO_COLUMNS, 3.6), layout="constrained")
    panels = figure.subplots(2, len(MEASURES) // 2, sharex=True).ravel()
    for axes, (name, label) in zip(panels, MEASURES.items(), strict=True):
        for record in records:
            values = [getattr(found, name) for found in record.measures[: record.tenths]]
            color, published = COLORS[record.pattern], getattr(PUBLISHED[record.pattern], name, None)
            axes.plot(
                record.cycles[: record.tenths], values, color=color, marker=MARKERS[record.pattern], markersize=2.5,
                label=record.pattern,
            )  # fmt: skip
            if published is not None:
                axes.axhline(published, color=color, linestyle=(0, (4, 3)), linewidth=0.8)
        axes.set_ylabel(label)
        if name.startswith(("q", "psi")):
            axes.set_ylim(0.0, 1.0)
        elif name != "skewness":
            axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])
    for axes in panels[len(MEASURES) // 2 :]:
        axes.set_xlabel("cycle")
    lines, labels = panels[0].get_legend_handles_labels()
    published = Line2D([], [], color=BLACK, linestyle=(0, (4, 3)), linewidth=0.8, label="published panel")
    figure.legend(
        handles=[*lines, published], labels=[*labels, "published panel"], loc="outside lower center",
        ncols=len(lines) + 1,
    )  # fmt: skip
    return figure

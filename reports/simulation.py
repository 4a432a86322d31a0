"""A simulation as a page, figures and pictures; made from its results folder, nothing is computed again.

simulation.md                      the six scores, the statistics of the steps, the energy ledger, the measures
simulation_energy.(pdf|svg|png)    kinetic and potential energy, and where it went
simulation_measures.(…)            what the scene is judged by, over time
still-STEP.png, simulation.mp4     pictures (the video with the extra `render`)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from harness import trajectory
from harness.measurement import DESIDERATA, Kind, Verdict
from harness.results import Cell, Frames, Results, ResultsError
from harness.simulation import MEASURES, RUN, STEPS
from reports import pictures
from reports.figures import BLACK, BLUE, GREEN, ORANGE, PURPLE, STYLE, TWO_COLUMNS, VERMILLION, save
from reports.files import prepare, write_whole
from reports.markdown import markdown_table
from reports.scorecard import ReportError
from reports.wording import number
from solvers.solution import Floats

STILLS = 4
"""Pictures of a run, its first and last frame among them."""
# Frames of a video; a longer trajectory is thinned.
MOST_FRAMES = 250

# Zhang 2015, Table 2, for the patterns of 60,000 grains: iterations of QCE (mean, largest, smallest), and seconds a
# step in contact resolving on one thread of a 3.0 GHz i5-2320 (mean, largest).
TABLE_2 = {
    "squares": (13, 46, 1, 0.28, 2.74),
    "stripes": (17, 44, 1, 0.33, 4.39),
    "hexagons": (12, 33, 1, 0.25, 2.87),
}

TERMS = {
    "impact": (VERMILLION, "impact, normal"),
    "friction": (ORANGE, "friction"),
    "correction": (PURPLE, "position correction"),
    "shaking": (BLUE, "shaking"),
    "integration": (GREEN, "integration error"),
}
"""Terms of the energy ledger: color and label."""


def write_simulation(store: Frames, folder: Path) -> list[Path]:
    """Write the page and the figures of a simulation.

    Args:
        store: of the folder.
        folder: with series, measures and frames; the files go there too.

    Raises:
        ReportError: the folder holds no simulation, or cannot be written to.
    """
    series = _numbers(folder / STEPS)
    if not series:
        raise ReportError(f"{folder} holds no simulation; run one first: impactbench simulate")
    path = prepare(folder)
    written = [write_whole(path / "simulation.md", simulation_markdown(store, series).encode())]
    with mpl.rc_context(STYLE):
        written += save(_energy_figure(series), path, "simulation_energy")
        measures = _numbers(folder / MEASURES)
        if len(measures) > len(("step", "time")):
            written += save(_measures_figure(measures), path, "simulation_measures")
    return written


def simulation_markdown(store: Frames, series: Mapping[str, Floats]) -> str:
    """The whole run as one Markdown page."""
    try:
        results = Results(store, kinds=(Kind.SIMULATION,))
    except ResultsError as error:
        raise ReportError(str(error)) from error
    (solver,) = results.solvers
    # A run that was gone on with has one for each of its ends: the last one is the whole.
    runs = [task for task in results.tasks if task.parameters["of"] == RUN][-1:]
    probes = [task for task in results.tasks if task.parameters["of"] != RUN and task.done]
    body = [(name, *_cell_words(results.cell(solver, name))) for name in DESIDERATA]
    run_rows = [row for row in results.scores if row.task in runs]
    lines = [
        f"# {runs[0].label if runs else results.tasks[0].label} by {solver}",
        "",
        f"{len(series['step'])} steps, {series['time'][-1]:.6g} s of simulated time, "
        f"{series['wall_s'].sum():.3g} s of computation.",
        "",
        "## The six scores over the run",
        "",
        f"KIN over all steps; all of them on {len(probes)} impacts of single steps, taken by themselves "
        "(none where the scene is too large or solved without an `ImpactProblem`).",
        "",
        *markdown_table(("score", "verdict", "worst", "of"), body),
        "",
        "## Steps",
        "",
        *markdown_table(("per step", "mean", "largest", "smallest"), list(_step_rows(series))),
        "",
        *_table_2(results, series),
        "## Energy and what the scene is judged by",
        "",
        *markdown_table(
            ("what", "value"),
            [(row.metric, number(row.value)) for row in run_rows if row.name in ("KIN", "energy", "scene", "run")
             and not row.metric.endswith((", mean", ", largest", ", smallest"))],
        ),
        "",
    ]  # fmt: skip
    return "\n".join(lines)


def write_pictures(
    folder: Path,
    *,
    color: str,
    color_from: float = 0.0,
    video: bool,
    view: pictures.View,
    progress: Callable[[str], None],
) -> list[Path]:
    """Draw stills of a simulation, and a video if it is wanted.

    Args:
        folder: with frames.
        color: what the color shows: "height [m]", "depth [m]" or "speed [m/s]".
        color_from: time of the frame that the depth is taken from [s]; the last frame where none is as late.
        video: also write simulation.mp4.
        view: from where.
        progress: told what is drawn.

    Raises:
        ReportError: there is no frame, or a video is wanted without the extra `render`.
    """
    steps = [frame.step for frame in trajectory.read_frames(folder)]
    if not steps:
        raise ReportError(f"{folder} holds no frames")
    paint = _painter(folder, color, color_from)
    stage = pictures.stage_of((paint(frame) for frame in trajectory.read_frames(folder)), color)
    wanted = {steps[k] for k in np.linspace(0, len(steps) - 1, STILLS).round().astype(int)}
    written = []
    for frame in trajectory.read_frames(folder):
        if frame.step in wanted:
            path = folder / f"still-{frame.step:07}.png"
            written.append(pictures.write_still(path, paint(frame), stage, view))
            progress(f"drew {path.name}")
    if video:
        every = -(-len(steps) // MOST_FRAMES)
        frames = (paint(f) for k, f in enumerate(trajectory.read_frames(folder)) if k % every == 0)
        progress(f"drawing {-(-len(steps) // every)} frames of a video")
        written.append(pictures.write_video(folder / "simulation.mp4", frames, stage, view))
    return written


def _painter(folder: Path, color: str, color_from: float) -> Callable[[trajectory.Frame], pictures.Frame]:
    """Give each sphere its color, and each frame its title."""
    for frame in trajectory.read_frames(folder):
        depth = frame.place[:, 2].max() - frame.place[:, 2]
        # Times are sums of steps.
        if frame.time >= color_from * (1.0 - 1e-9):
            break
    shown: dict[str, Callable[[trajectory.Frame], Floats]] = {
        "height [m]": lambda frame: frame.place[:, 2],
        "depth [m]": lambda _: depth,
        "speed [m/s]": lambda frame: np.linalg.norm(frame.velocity, axis=1),
    }
    if color not in shown:
        raise ReportError(f"color must be one of {', '.join(shown)}, not {color!r}")
    return lambda frame: pictures.Frame(
        frame.place, shown[color](frame), f"step {frame.step}, t = {frame.time:.4g} s"
    )  # fmt: skip


def _cell_words(cell: Cell) -> tuple[str, str, str]:
    """Verdict, worst number and where it was measured."""
    if cell.verdict is None or cell.worst is None:
        return "not measured", "–", "–"
    if cell.verdict is Verdict.NOT_APPLICABLE:
        return "not applicable", "–", str(cell.worst.detail.get("reason", "–"))
    return cell.verdict.value, f"{cell.worst.metric} {number(cell.worst.value)}", cell.worst.task.label


def _step_rows(series: Mapping[str, Floats]) -> Iterator[tuple[str, ...]]:
    """Mean, largest and smallest of what varies from step to step."""
    for name in ("contacts", "iterations", "sweeps", "residual", "overlap", "fastest", "wall_s"):
        values = series[name][np.isfinite(series[name])]
        if values.size:
            yield name, number(float(values.mean())), number(float(values.max())), number(float(values.min()))


def _table_2(results: Results, series: Mapping[str, Floats]) -> list[str]:
    """The paper's statistics beside ours, for the patterns that it has."""
    scene = results.tasks[0].parameters["scene"]
    pattern = scene.get("pattern") if isinstance(scene, Mapping) else None
    if pattern not in TABLE_2:
        return []
    mean, most, least, mean_s, most_s = TABLE_2[pattern]
    iterations, wall = series["iterations"], series["wall_s"]
    body = [
        ("Zhang 2015", f"{mean} / {most} / {least}", f"{mean_s} / {most_s}"),
        (
            "here", f"{iterations.mean():.1f} / {iterations.max():.0f} / {iterations.min():.0f}",
            f"{wall.mean():.3g} / {wall.max():.3g}",
        ),
    ]  # fmt: skip
    return [
        "### Beside Table 2 of the paper",
        "",
        "The paper's seconds are contact resolving alone on one thread of a 3.0 GHz i5-2320 with a step of 0.0002 s "
        "for grains of unknown size; ours are whole steps on this machine.",
        "",
        *markdown_table(("where", "QCE iterations, mean / most / least", "seconds a step, mean / most"), body),
        "",
    ]


def _energy_figure(series: Mapping[str, Floats]) -> Figure:
    """Energy over time, and the running sum of each term of the ledger."""
    figure = Figure(figsize=(TWO_COLUMNS, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(series["time"], series["kinetic"], color=VERMILLION, label="kinetic")
    left.plot(series["time"], series["potential"], color=BLUE, label="potential")
    left.plot(series["time"], series["kinetic"] + series["potential"], color=BLACK, linewidth=0.7, label="sum")
    left.set_ylabel("energy [J]")
    for name, (color, label) in TERMS.items():
        right.plot(series["time"], np.cumsum(series[name]), color=color, label=label)
    right.set_ylabel("work since the start [J]")
    for axes in (left, right):
        axes.set_xlabel("time [s]")
        axes.legend()
    return figure


def _measures_figure(measures: Mapping[str, Floats]) -> Figure:
    """Every measure of the scene over time, a panel each."""
    names = [name for name in measures if name not in ("step", "time")]
    figure = Figure(figsize=(TWO_COLUMNS, 1.7 * -(-len(names) // 2)), layout="constrained")
    panels = figure.subplots(-(-len(names) // 2), 2, squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        axes.plot(measures["time"], measures[name], color=BLUE, marker="." if len(measures["time"]) < 60 else "")
        axes.set_ylabel(name)
        axes.set_xlabel("time [s]")
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    return figure


def _numbers(path: Path) -> dict[str, Floats]:
    """Columns of a CSV file as numbers; words are left out."""
    rows = trajectory.read_rows(path)
    return {
        name: np.array(values, dtype=np.float64) for name, values in rows.items() if name not in ("status",)
    }  # fmt: skip

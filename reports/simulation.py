"""A simulation as a page, figures and pictures; made from its results folder, nothing is computed again.

simulation.md                      the six scores, the statistics of the steps, the energy ledger, the measures
simulation_energy.(pdf|svg|png)    kinetic and potential energy, and where it went
simulation_measures.(…)            what the scene is judged by, over time
simulation_paths.(…)               how each body went, in scenes of few
simulation_layers.(…)              how a layer's parts moved, in scenes that are colored by depth
still-FRAME.png, simulation.mp4    pictures (the video with the extra `render`)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from harness import trajectory
from harness.measurement import DESIDERATA
from harness.results import Frames, Results
from harness.simulation import MEASURES, RUN, STEPS
from reports import pictures
from reports.figures import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, STYLE, TWO_COLUMNS, VERMILLION, save
from reports.files import prepare, write_whole
from reports.layers import Layers, at_or_after, layers_figure, layers_lines, read_layers
from reports.markdown import markdown_table
from reports.patterns import TABLE_2, TABLE_2_NOTE
from reports.runs import measured, measures_figure, numbers, results_of, solver_of, thinned, trace_figure
from reports.scorecard import ReportError
from reports.wording import number
from scenarios.world.moving_scene import STAGES_FIRED, MovingScene, Units
from scenarios.world.rigid_world import RigidWorld
from solvers.solution import Floats

VIEWS = {"xy": pictures.View(elevation=90.0, azimuth=-90.0), "tx": pictures.View(elevation=0.0, azimuth=-90.0)}
"""From where a scene is seen whose bodies stay in a plane, by what its traces show."""
STILLS = 4
"""Pictures of a run, its first and last frame among them."""
# Frames of a video; a longer trajectory is thinned.
MOST_FRAMES = 250

KINDS = (ORANGE, BLUE, VERMILLION, GREEN, PURPLE, SKY, BLACK)
"""Colors of the kinds of rigid bodies, in the order in which they are named."""
SCENERY = "lightgray"
"""Color of what does not move."""

TERMS = {
    "impact": (VERMILLION, "impact, normal"),
    "friction": (ORANGE, "friction"),
    "correction": (PURPLE, "position correction"),
    "shaking": (BLUE, "shaking"),
    "integration": (GREEN, "integration error"),
}
"""Terms of the energy ledger: color and label."""


def write_simulation(store: Frames, folder: Path, scene: MovingScene) -> list[Path]:
    """Write the page and the figures of a simulation.

    Args:
        store: of the folder.
        folder: with series, measures and frames; the files go there too.
        scene: that was run.

    Raises:
        ReportError: the folder holds no simulation, or cannot be written to.
    """
    series = numbers(folder / STEPS)
    if not series:
        raise ReportError(f"{folder} holds no simulation; run one first: impactbench simulate")
    path = prepare(folder)
    layers = read_layers(folder, scene)
    page = simulation_markdown(store, series, scene, layers) + stages_markdown(scene, numbers(folder / MEASURES))
    written = [write_whole(path / "simulation.md", page.encode())]
    with mpl.rc_context(STYLE):
        written += save(_energy_figure(series, scene.units), path, "simulation_energy")
        runs = {solver_of(store): folder}
        if measured(runs):
            written += save(measures_figure(runs, scene), path, "simulation_measures")
        if scene.trace:
            written += save(trace_figure(runs, scene), path, "simulation_paths")
        if layers is not None:
            written += save(layers_figure(layers, scene), path, "simulation_layers")
    return written


def simulation_markdown(
    store: Frames, series: Mapping[str, Floats], scene: MovingScene, layers: Layers | None
) -> str:  # fmt: skip
    """The whole run as one Markdown page."""
    results = results_of(store)
    (solver,) = results.solvers
    # A run that was gone on with has one for each of its ends: the last one is the whole.
    runs = [task for task in results.tasks if task.parameters["of"] == RUN][-1:]
    probes = [task for task in results.tasks if task.parameters["of"] != RUN and task.done]
    body = [(name, *_cell_words(results, solver, name)) for name in DESIDERATA]
    run_rows = [row for row in results.scores if row.task in runs]
    units = scene.units
    lines = [
        f"# {scene.label} by {solver}",
        "",
        f"{len(series['step'])} steps, {series['time'][-1]:.6g} {units.time} of simulated time, "
        f"{series['wall_s'].sum():.3g} s of computation. Units: {units.length}, {units.time}, {units.energy}.",
        "",
        "## The six scores over the run",
        "",
        f"KIN over all steps, what the scene itself measures over all of them, and all six on {len(probes)} impacts of "
        "single steps, taken by themselves (none where the scene is too large or solved without an `ImpactProblem`).",
        "",
        *markdown_table(("score", "verdict", "worst", "of"), body),
        "",
        "## Steps",
        "",
        *markdown_table(("per step", "mean", "largest", "smallest"), list(_step_rows(series))),
        "",
        *_table_2(results, series),
        *(layers_lines(layers, scene) if layers is not None else ()),
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


def stages_markdown(scene: MovingScene, measures: Mapping[str, Floats]) -> str:
    """When each stage of a scene was seen to have fired, and the first that did not; empty where it has none."""
    if not scene.stages:
        return ""
    body = []
    for k, name in enumerate(scene.stages):
        frames = np.flatnonzero(measures[STAGES_FIRED] > k)
        body.append((str(k + 1), name, number(float(measures["time"][frames[0]])) if frames.size else "did not fire"))
    missing = [name for _, name, when in body if when == "did not fire"]
    verdict = f"The chain breaks before: {missing[0]}." if missing else "All stages fired in their order."
    table = markdown_table(("", "stage", f"by the frame at [{scene.units.time}]"), body)
    return "\n".join(["", "## Stages", "", *table, "", verdict, ""])


def write_pictures(
    folder: Path, scene: MovingScene, *, video: bool, progress: Callable[[str], None]
) -> list[Path]:  # fmt: skip
    """Draw stills of a simulation, and a video if it is wanted; of a bed from when it lies, if the run got so far.

    Args:
        folder: with frames.
        scene: that was run; it says what the color shows.
        video: also write simulation.mp4.
        progress: told what is drawn.

    Raises:
        ReportError: there is no frame, or a video is wanted without the extra `render`.
    """
    late = [at_or_after(frame.time, scene.color_from) for frame in trajectory.read_frames(folder)]
    if not late:
        raise ReportError(f"{folder} holds no frames")
    first = late.index(True) if any(late) else 0

    def drawn() -> Iterator[trajectory.Frame]:
        return islice(trajectory.read_frames(folder), first, None)

    count = len(late) - first
    paint, view = _painter(folder, scene), VIEWS.get(scene.trace, pictures.View())
    painted = (paint(frame) for frame in drawn())
    if next(drawn()).turn.size:
        stage = pictures.stage_of_solids(painted, scene.color, solids_of(scene))
    else:
        stage = pictures.stage_of(painted, scene.color)
    wanted = set(np.linspace(0, count - 1, STILLS).round().astype(int))
    written = []
    for k, frame in enumerate(drawn()):
        if k in wanted:
            path = folder / f"still-{k:05}.png"
            written.append(pictures.write_still(path, paint(frame), stage, view))
            progress(f"drew {path.name}")
    if video:
        every = -(-count // MOST_FRAMES)
        frames = (paint(f) for k, f in enumerate(drawn()) if k % every == 0)
        progress(f"drawing {-(-count // every)} frames of a video")
        written.append(pictures.write_video(folder / "simulation.mp4", frames, stage, view))
    return written


def _painter(folder: Path, scene: MovingScene) -> Callable[[trajectory.Frame], pictures.Frame]:
    """Give each sphere its color, and each frame its title."""
    for frame in trajectory.read_frames(folder):
        depth = frame.place[:, 2].max() - frame.place[:, 2]
        if at_or_after(frame.time, scene.color_from):
            break
    shown: dict[str, Callable[[trajectory.Frame], Floats]] = {
        pictures.KIND: lambda frame: np.zeros(len(frame.place)),
        "height": lambda frame: frame.place[:, 2],
        "depth": lambda _: depth,
        "speed": lambda frame: np.linalg.norm(frame.velocity, axis=1),
    }
    color = shown[scene.color.partition(" ")[0]]
    return lambda frame: pictures.Frame(
        frame.place, color(frame), f"step {frame.step}, t = {frame.time:.4g} {scene.units.time}", frame.turn
    )  # fmt: skip


def solids_of(scene: MovingScene) -> list[pictures.Solid]:
    """What is drawn of a scene of rigid bodies, each kind in a color of its own."""
    world = scene.world()
    assert isinstance(world, RigidWorld)
    kinds: dict[str, str] = {}
    solids = []
    for name, vertices, faces, body in world.meshes():
        # "card 7" is a card; what does not move is gray.
        color = SCENERY
        if body >= 0:
            kind = name.rstrip(" 0123456789")
            color = kinds.setdefault(kind, KINDS[len(kinds) % len(KINDS)])
        solids.append(pictures.Solid(vertices, faces, body, color))
    return solids


def _cell_words(results: Results, solver: str, name: str) -> tuple[str, str, str]:
    """Verdict, worst number and where it was measured, or why there is none."""
    cell = results.cell(solver, name)
    if cell.verdict is None:
        return "not measured", "–", "no impact of the run was taken by itself"
    if cell.worst is None:
        reasons = dict.fromkeys(str(row.detail.get("reason", "–")) for row in results.scores_of(solver, name))
        return "not applicable", "–", "; ".join(reasons)
    detail = cell.worst.detail if cell.worst.task.parameters["of"] == RUN else {}
    where = ", ".join([cell.worst.task.label, *(f"{key} {value}" for key, value in detail.items())])
    return cell.verdict.value, f"{cell.worst.metric} {number(cell.worst.value)}", where


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
        TABLE_2_NOTE,
        "",
        *markdown_table(("where", "QCE iterations, mean / most / least", "seconds a step, mean / most"), body),
        "",
    ]


def _energy_figure(series: Mapping[str, Floats], units: Units) -> Figure:
    """Energy over time, and the running sum of each term of the ledger."""
    figure = Figure(figsize=(TWO_COLUMNS, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    work = thinned({name: np.cumsum(series[name]) for name in TERMS})
    series = thinned(series)
    left.plot(series["time"], series["kinetic"], color=VERMILLION, label="kinetic")
    left.plot(series["time"], series["potential"], color=BLUE, label="potential")
    left.plot(series["time"], series["kinetic"] + series["potential"], color=BLACK, linewidth=0.7, label="sum")
    left.set_ylabel(f"energy [{units.energy}]")
    for name, (color, label) in TERMS.items():
        right.plot(series["time"], work[name], color=color, label=label)
    right.set_ylabel(f"work since the start [{units.energy}]")
    for axes in (left, right):
        axes.set_xlabel(f"time [{units.time}]")
        axes.legend()
    return figure

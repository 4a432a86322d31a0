"""Runs of one moving scene side by side, by several solvers or of several members; nothing is computed again.

comparison.md                      the runs as a table: impacts, energy, measures, the six scores
comparison_paths.(pdf|svg|png)     how each body went, a panel a run, in scenes of few
comparison_measures.(…)            what the scene is judged by, a curve a run
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np

from harness.measurement import DESIDERATA
from harness.simulation import LEDGER, MEASURES, STEPS
from harness.store import Store
from harness.trajectory import read_table
from reports.figures import STYLE, save
from reports.files import prepare, write_whole
from reports.markdown import markdown_table
from reports.runs import is_error, measured, measures_figure, numbers, results_of, trace_figure
from reports.wording import cell_text, number
from scenarios.world.moving_scene import MovingScene


def write_comparison(runs: Mapping[str, Path], folder: Path, scene: MovingScene) -> list[Path]:
    """Write the page and the figures.

    Args:
        runs: what tells a run from the others → its results folder.
        folder: where to.
        scene: that they ran, or one of its family.

    Raises:
        ReportError: a folder holds no simulation, or `folder` cannot be written to.
    """
    path = prepare(folder)
    written = [write_whole(path / "comparison.md", comparison_markdown(runs, scene).encode())]
    with mpl.rc_context(STYLE):
        if scene.trace:
            written += save(trace_figure(runs, scene), path, "comparison_paths")
        if measured(runs):
            written += save(measures_figure(runs, scene), path, "comparison_measures")
    return written


def comparison_markdown(runs: Mapping[str, Path], scene: MovingScene) -> str:
    """All runs as one Markdown page."""
    names = measured(runs)
    lines = [
        f"# {scene.name}: {len(runs)} runs",
        "",
        *markdown_table(
            ("run", "steps", f"time [{scene.units.time}]", "energy kept", "converged", *map(_heading, names)),
            [tuple(_run_row(name, folder, names)) for name, folder in runs.items()],
        ),
        "",
        "Energy kept: kinetic and potential energy after the last step over that before the first. An error is the "
        "largest over the run, any other measure its least and its largest.",
        "",
        "## The six scores over the run",
        "",
        *markdown_table(("run", *DESIDERATA), [(name, *_cells(folder)) for name, folder in runs.items()]),
        "",
        "Each run's own page, `simulation.md` in its folder, says what stands behind a mark.",
        "",
    ]
    return "\n".join(lines)


def _heading(name: str) -> str:
    return f"{name}, largest" if is_error(name) else name


def _run_row(name: str, folder: Path, names: list[str]) -> Iterator[str]:
    """What one run came to."""
    series, measures = numbers(folder / STEPS), numbers(folder / MEASURES)
    energy = series["kinetic"] + series["potential"]
    yield name
    yield str(len(energy))
    yield number(float(measures["time"][-1]))
    # The series begins after the first step: what that one did is taken back.
    yield f"{energy[-1] / (energy[0] - sum(series[term][0] for term in LEDGER)):.6f}"
    yield f"{100 * (read_table(folder / STEPS)['status'] == 'converged').mean():.3g} %"
    for measure in names:
        values = measures[measure][np.isfinite(measures[measure])]
        if values.size == 0:
            yield "–"
        elif is_error(measure):
            yield number(float(values.max()))
        else:
            yield f"{number(float(values.min()))} … {number(float(values.max()))}"


def _cells(folder: Path) -> list[str]:
    with Store.open(folder) as store:
        results = results_of(store)
    (solver,) = results.solvers
    return [cell_text(results.cell(solver, name)) for name in DESIDERATA]

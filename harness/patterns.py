"""What a run of `extended-pattern` has to show, small enough to keep: its height maps and its statistics.

    PATTERN.npz
        cycle     (maps,)            cycles of the plate since the start: every tenth, and the last where it is odd
        height    (maps, 100, 100)   highest surface above the plate in each cell, uint16 in D/100; 0 where no grain is
        run       ()                 JSON: scene, solver, seed, statistics of all steps, machine

All maps are of the beginning of a cycle, when the plate goes up through its middle. Patterns repeat every two cycles:
maps ten cycles apart show the same one of the two. A run whose last frame is of an odd cycle has a map of the other.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from harness.files import replace_file
from harness.selection import choose_moving
from harness.simulation import STEPS
from harness.store import Store, StoreError
from harness.trajectory import BROKEN, read_frames, read_table
from scenarios.patterns import Pattern, height_map, measure_pattern
from solvers.solution import Floats

EVERY = 10
"""Cycles between two maps; even, since a pattern repeats every two."""
# Steps of the stored heights [D]: a hundredth of a grain, far below the roughness of any layer of grains.
UNIT = 0.01
SCENE = "extended-pattern"
MACHINE = ("impactbench", "commit", "python", "numba", "cpu", "cores")
"""Entries of the environment that are kept."""


@dataclass(frozen=True)
class PatternRecord:
    """Height maps of one run, and what its steps came to."""

    run: Mapping[str, Any]
    """JSON-able: scene, pattern, side, solver, seed, steps, statistics, machine."""
    cycles: npt.NDArray[np.int64]
    """Shape (maps,); a last one that is odd is of the other phase."""
    heights: Floats
    """Above the plate [D], NaN where no grain is; shape (maps, cells, cells)."""

    @property
    def pattern(self) -> str:
        """What is expected: "squares", "stripes", "hexagons" or "flat"."""
        return str(self.run["pattern"])

    @property
    def side(self) -> float:
        """Of the box [D]."""
        return float(self.run["side"])

    @property
    def tenths(self) -> int:
        """How many maps, from the first on, are of one phase."""
        return int((self.cycles % 2 == 0).sum())

    @cached_property
    def measures(self) -> list[Pattern]:
        """What each map shows."""
        return [measure_pattern(heights, self.side) for heights in self.heights]


def record_of_run(folder: Path) -> PatternRecord:
    """Gather what a results folder has to show.

    Raises:
        StoreError: it holds no run of `extended-pattern`, or none that reached its tenth cycle.
    """
    with Store.open(folder) as store:
        runs = store.frame("runs")
    if runs.empty or runs.iloc[-1]["settings"].get("results of") != "simulation":
        raise StoreError(f"{folder} holds no simulation")
    settings, environment = runs.iloc[-1]["settings"], runs.iloc[-1]["environment"]
    scene = choose_moving(_specification(settings["scene"]))
    if scene.name != SCENE:
        raise StoreError(f"{folder} holds a run of {scene.name}, not of {SCENE}")
    side = float(str(scene.parameters["side"]))
    maps, last = {}, None
    for frame in read_frames(folder):
        cycle, rest = divmod(frame.step, scene.steps_per_cycle)
        if frame.step == 0 or rest:
            continue
        if cycle % EVERY == 0:
            maps[cycle] = height_map(frame.place.astype(np.float64), side)
        last = (cycle, frame)
    if maps and last is not None and last[0] % 2:
        maps[last[0]] = height_map(last[1].place.astype(np.float64), side)
    if not maps:
        raise StoreError(f"{folder} has no frame at the beginning of a tenth cycle: run more cycles, with --frames "
                         f"{EVERY * scene.steps_per_cycle}")  # fmt: skip
    run = {
        "scene": _specification(settings["scene"]),
        "pattern": scene.parameters["pattern"],
        "side": side,
        "steps_per_cycle": scene.steps_per_cycle,
        "solver": settings["solver"],
        "seed": settings["seed"],
        **_statistics(folder),
        "machine": {name: environment[name] for name in MACHINE},
    }
    return PatternRecord(run, np.array(list(maps)), _rounded(np.array(list(maps.values()))))


def write_record(path: Path, record: PatternRecord) -> Path:
    """Write a record, whole or not at all; the same record gives the same bytes."""
    buffer = io.BytesIO()
    height = np.where(np.isnan(record.heights), 0.0, record.heights / UNIT)
    np.savez_compressed(
        buffer, cycle=record.cycles, height=np.rint(height).astype(np.uint16),
        run=np.array(json.dumps(record.run, sort_keys=True)),
    )  # fmt: skip
    return replace_file(path, buffer.getvalue())


def read_record(path: Path) -> PatternRecord:
    """Read a record.

    Raises:
        StoreError: the file is none, or broken.
    """
    try:
        # Opened here: NumPy leaves the file open where it is cut off.
        with path.open("rb") as file, np.load(file) as arrays:
            height = arrays["height"]
            return PatternRecord(
                json.loads(str(arrays["run"])), arrays["cycle"], np.where(height == 0, np.nan, height * UNIT)
            )
    except BROKEN as error:
        raise StoreError(f"{path} is no record of a pattern, or broken: {error}") from error


def _rounded(heights: Floats) -> Floats:
    """Heights as they are stored, so that a record and the file made of it say the same."""
    rounded: Floats = np.rint(heights / UNIT) * UNIT
    return rounded


def _specification(label: str) -> str:
    """A scene's label as the command line takes it: "name(a=1, b=2)" → "name:a=1,b=2"."""
    name, _, parameters = label.removesuffix(")").partition("(")
    return f"{name}:{parameters.replace(', ', ',')}"


def _statistics(folder: Path) -> dict[str, object]:
    """What all steps together came to: the counts and times of Table 2 of Zhang 2015, and how well they were solved."""
    series = read_table(folder / STEPS)
    iterations, wall_s = series["iterations"], series["wall_s"]
    return {
        "steps": len(series),
        "iterations": [float(iterations.mean()), int(iterations.max()), int(iterations.min())],
        "contacts": [float(series["contacts"].mean()), int(series["contacts"].max())],
        "sweeps": float(series["sweeps"].mean()),
        "converged": float((series["status"] == "converged").mean()),
        "overlap": [float(series["overlap"].quantile(0.99)), float(series["overlap"].max())],
        "wall_s": [float(wall_s.mean()), float(wall_s.median()), float(wall_s.max())],
    }

"""What a simulation leaves on disk: frames of the motion, and rows of numbers. Both can be cut back and gone on with.

    trajectory-000000.npz, trajectory-000001.npz, …    `FRAMES_PER_FILE` frames each:
        step      (frames,)             steps made
        time      (frames,)             [s]
        height    (frames,)             of the container over its place at rest [m]
        place     (frames, bodies, 4)   centers in the container's frame, radius [m], float32, in the order of the start
        velocity  (frames, bodies, 3)   [m/s], float32

A frame is float32: it is to be looked at and measured, not to go on from (see `harness.simulation` for checkpoints).
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.files import replace_file
from harness.store import StoreError
from solvers.solution import Floats

FRAMES_PER_FILE = 16
# Rows of the series that are held back before they are written: a write a step would cost more than a small step.
ROWS_HELD = 500


@dataclass(frozen=True)
class Frame:
    """The spheres at one moment."""

    step: int
    time: float
    """[s]."""
    height: float
    """Of the container over its place at rest [m]."""
    place: Floats
    """Centers and radii [m], shape (bodies, 4)."""
    velocity: Floats
    """[m/s], shape (bodies, 3)."""


class TrajectoryWriter:
    """Appends frames to the files of a folder; the last file is written anew with each.

    Args:
        folder: exists.
        frames: how many are there already; those after them are dropped (they belong to steps that are made again).

    Raises:
        StoreError: a file that should be there is missing or broken.
    """

    def __init__(self, folder: Path, *, frames: int = 0) -> None:
        self._folder = folder
        self.frames = frames
        """Frames written so far."""
        whole, rest = divmod(frames, FRAMES_PER_FILE)
        self._open: list[Frame] = list(_read_file(_file(folder, whole)))[:rest] if rest else []
        if len(self._open) < rest:
            raise StoreError(f"{_file(folder, whole)} has fewer frames than its checkpoint says")
        for path in sorted(folder.glob("trajectory-*.npz"))[whole + (1 if rest else 0) :]:
            path.unlink()

    def append(self, frame: Frame) -> None:
        """Add one frame; it is on disk when this returns."""
        self._open.append(frame)
        write_arrays(
            _file(self._folder, self.frames // FRAMES_PER_FILE),
            step=np.array([f.step for f in self._open]),
            time=np.array([f.time for f in self._open]),
            height=np.array([f.height for f in self._open]),
            place=np.array([f.place for f in self._open], dtype=np.float32),
            velocity=np.array([f.velocity for f in self._open], dtype=np.float32),
        )
        self.frames += 1
        if len(self._open) == FRAMES_PER_FILE:
            self._open = []


def read_frames(folder: Path) -> Iterator[Frame]:
    """Yield all frames of a folder, in order.

    Raises:
        StoreError: a file is broken.
    """
    for path in sorted(folder.glob("trajectory-*.npz")):
        yield from _read_file(path)


class RowWriter:
    """Appends rows to a CSV file.

    Args:
        path: the file.
        columns: names of the columns.
        rows: how many are there already; those after them are dropped.

    Raises:
        StoreError: the file has other columns or fewer rows.
    """

    def __init__(self, path: Path, columns: Sequence[str], *, rows: int = 0) -> None:
        self._path = path
        self._held: list[Sequence[object]] = []
        heading = _as_csv([columns])
        kept = _lines(path)[: rows + 1] if rows else [heading]
        if len(kept) < rows + 1 or kept[0] != heading:
            raise StoreError(f"{path} does not go with its checkpoint; choose another folder or --fresh")
        replace_file(path, "".join(kept).encode())

    def append(self, row: Sequence[object]) -> None:
        """Add one row; it may be held back until `flush`."""
        self._held.append(row)
        if len(self._held) >= ROWS_HELD:
            self.flush()

    def flush(self) -> None:
        """Write what is held back."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(_as_csv(self._held))
            file.flush()
            os.fsync(file.fileno())
        self._held = []


def read_rows(path: Path) -> dict[str, list[str]]:
    """Columns of a CSV file, as text; empty where there is no row."""
    heading, *rows = csv.reader(_lines(path)) if path.exists() else [[]]
    return {name: [row[k] for row in rows] for k, name in enumerate(heading)} if rows else {}


def write_arrays(path: Path, **arrays: Any) -> None:
    """Write arrays as compressed NPZ, whole or not at all."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    replace_file(path, buffer.getvalue())


def _file(folder: Path, number: int) -> Path:
    return folder / f"trajectory-{number:06}.npz"


def _read_file(path: Path) -> Iterator[Frame]:
    try:
        with np.load(path) as arrays:
            step, time, height = arrays["step"], arrays["time"], arrays["height"]
            place, velocity = arrays["place"], arrays["velocity"]
    except (OSError, ValueError, KeyError) as error:
        raise StoreError(f"{path} is no trajectory file, or broken: {error}") from error
    for k in range(len(step)):
        yield Frame(int(step[k]), float(time[k]), float(height[k]), place[k], velocity[k])


def _lines(path: Path) -> list[str]:
    """Lines of a text file with their ends; a last one without its end was cut off and is left out."""
    if not path.exists():
        return []
    return [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]


def _as_csv(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()

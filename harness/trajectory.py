"""What a simulation leaves on disk: frames of the motion, and rows of numbers. Both can be cut back and gone on with.

    trajectory-000000.npz, …    frames from the one that the name counts; `BODIES_PER_FILE` bodies in all, or one frame:
        step      (frames,)             steps made
        time      (frames,)             since the start
        height    (frames,)             of the container over its place at rest
        place     (frames, bodies, 4)   centers in the container's frame, radius; float32, in the order of the start
        velocity  (frames, bodies, 3)   float32
        turn      (frames, bodies, 4)   orientations as quaternions (w, x, y, z), float32; missing where all are spheres

in the units of the scene.

A frame is float32: it is to be looked at and measured, not to go on from (see `harness.simulation` for checkpoints).
"""

from __future__ import annotations

import csv
import io
import os
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from harness.files import replace_file
from harness.store import StoreError
from solvers.solution import Floats

FRAMES = "trajectory-*.npz"
BROKEN = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading an .npz file raises that was cut off, overwritten, or is none."""
BODIES_PER_FILE = 240_000
"""Bodies of all frames of a file together: some megabytes."""
# Rows of the series that are held back before they are written: a write a step would cost more than a small step.
ROWS_HELD = 500


@dataclass(frozen=True)
class Frame:
    """The spheres at one moment."""

    step: int
    """Steps made."""
    time: float
    """Since the start, in the scene's unit of time."""
    height: float
    """Of the container over its place at rest, in the scene's unit of length."""
    place: Floats
    """Centers and radii in the container's frame, in the scene's unit of length, shape (bodies, 4)."""
    velocity: Floats
    """In the scene's unit of speed, shape (bodies, 3)."""
    turn: Floats = field(default_factory=lambda: np.zeros((0, 4)))
    """Orientations as quaternions (w, x, y, z), shape (bodies, 4); (0, 4) where all bodies are spheres."""


class TrajectoryWriter:
    """Appends frames to the files of a folder; they are held back until `flush`, or until a file is full.

    Args:
        folder: exists.
        frames: how many are there already; those after them are dropped (they belong to steps that are made again).

    Raises:
        StoreError: a file that should be there is missing or broken.
    """

    def __init__(self, folder: Path, *, frames: int = 0) -> None:
        self._folder = folder
        self.frames = frames
        """Frames taken so far."""
        self._open: list[Frame] = []
        """Frames of the last file."""
        self._held = False
        """Whether that file lacks some of them."""
        kept = 0
        before = []
        for path in sorted(folder.glob(FRAMES)):
            if _first_frame(path) >= frames:
                path.unlink()
            else:
                before.append(path)
        for path in before[-1:]:
            first = _first_frame(path)
            self._open = list(_read_file(path))[: frames - first]
            # Those after them must go from the file as well.
            self._held = True
            kept = first + len(self._open)
        if kept < frames:
            raise StoreError(f"{folder} has {kept} frames, fewer than its checkpoint says: {frames}")
        self._close_if_full()

    def append(self, frame: Frame) -> None:
        """Add one frame."""
        self._open.append(frame)
        self._held = True
        self.frames += 1
        self._close_if_full()

    def flush(self) -> None:
        """Write what is held back."""
        if self._held:
            self._held = False
            write_arrays(
                self._folder / f"trajectory-{self.frames - len(self._open):06}.npz",
                step=np.array([f.step for f in self._open]),
                time=np.array([f.time for f in self._open]),
                height=np.array([f.height for f in self._open]),
                place=np.array([f.place for f in self._open], dtype=np.float32),
                velocity=np.array([f.velocity for f in self._open], dtype=np.float32),
                **_turns(self._open),
            )

    def _close_if_full(self) -> None:
        if sum(len(frame.place) for frame in self._open) >= BODIES_PER_FILE:
            self.flush()
            self._open = []


def read_frames(folder: Path) -> Iterator[Frame]:
    """Yield all frames of a folder, in order.

    Raises:
        StoreError: a file is broken.
    """
    for path in sorted(folder.glob(FRAMES)):
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


def read_table(path: Path) -> pd.DataFrame:
    """Columns of a CSV file as numbers or words; empty where there is no row."""
    lines = _lines(path)
    if len(lines) < 2:
        return pd.DataFrame()
    return pd.read_csv(io.StringIO("".join(lines)))


def write_arrays(path: Path, **arrays: Any) -> None:
    """Write arrays as compressed NPZ, whole or not at all."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    replace_file(path, buffer.getvalue())


def _first_frame(path: Path) -> int:
    """Number of a file's first frame, by its name."""
    return int(path.stem.rpartition("-")[2])


def _read_file(path: Path) -> Iterator[Frame]:
    try:
        # Opened here: NumPy leaves the file open where it is cut off.
        with path.open("rb") as file, np.load(file) as arrays:
            step, time, height = arrays["step"], arrays["time"], arrays["height"]
            place, velocity = arrays["place"], arrays["velocity"]
            turn = arrays["turn"] if "turn" in arrays else np.zeros((len(step), 0, 4))
    except BROKEN as error:
        raise StoreError(f"{path} is no trajectory file, or broken: {error}") from error
    for k in range(len(step)):
        yield Frame(int(step[k]), float(time[k]), float(height[k]), place[k], velocity[k], turn[k])


def _turns(frames: Sequence[Frame]) -> dict[str, Any]:
    """Orientations, where there are any."""
    turn = np.array([frame.turn for frame in frames], dtype=np.float32)
    return {"turn": turn} if turn.size else {}


def _lines(path: Path) -> list[str]:
    """Lines of a text file with their ends; a last one without its end was cut off and is left out."""
    if not path.exists():
        return []
    return [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]


def _as_csv(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()

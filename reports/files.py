"""Writing report files: whole or not at all, and a clear word where it cannot be done."""

from __future__ import annotations

import os
from pathlib import Path

from harness.files import replace_file
from reports.scorecard import ReportError


def prepare(folder: str | os.PathLike[str]) -> Path:
    """Make the folder of a report.

    Raises:
        ReportError: it cannot be made, or something else has its name.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReportError(f"cannot make the report folder {path}: {error.strerror}; choose another") from error
    return path


def write_whole(path: Path, content: bytes) -> Path:
    """Write one file of a report, whole or not at all.

    Raises:
        ReportError: the folder cannot be written to or is full; an older file of the name is as it was.
    """
    try:
        return replace_file(path, content)
    except OSError as error:
        raise ReportError(f"cannot write {path}: {error.strerror}; choose another folder or free some space") from error

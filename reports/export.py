"""Tables of the store for use elsewhere: CSV, JSON, Parquet."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from reports.files import write_whole
from reports.scorecard import ReportError


def as_csv(frame: pd.DataFrame) -> str:
    """A table as CSV; structured cells as JSON text."""
    return str(_flat(frame).to_csv(index=False, lineterminator="\n"))


def as_json(frame: pd.DataFrame) -> str:
    """A table as a list of records, in JSON that every reader takes: NaN is null, infinity a word."""
    records = [{key: _strict(value) for key, value in record.items()} for record in frame.to_dict("records")]
    return json.dumps(records, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_parquet(frame: pd.DataFrame, to: Path) -> None:
    """Write a table as Parquet, whole or not at all; structured cells as JSON text.

    Raises:
        ReportError: pyarrow is not installed, or the file cannot be written.
    """
    if importlib.util.find_spec("pyarrow") is None:
        raise ReportError("Parquet needs pyarrow: pip install 'impactbench[export]', or choose --format csv")
    write_whole(to, _flat(frame).to_parquet(None, index=False))


def _flat(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.map(lambda value: json.dumps(value, ensure_ascii=False) if isinstance(value, (dict, list)) else value)


def _strict(value: Any) -> object:
    """Replace what strict JSON does not have: NaN becomes null, infinity a word."""
    if isinstance(value, Mapping):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_strict(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value.item() if hasattr(value, "item") else value

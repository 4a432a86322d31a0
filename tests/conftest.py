"""Shared by the tests of the run: a user's own solver in a file."""

from __future__ import annotations

import signal
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

IMPORTS = """
from __future__ import annotations
import os, signal, sys, time
from dataclasses import dataclass
import numpy as np
from solvers import ImpactProblem, ImpactSolution, Status, UnsupportedProblem
"""


def pytest_configure() -> None:
    """Let what the tests start be interrupted: a shell's background jobs, these tests too, are begun deaf to SIGINT."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def write_solver() -> Callable[[Path, str], Path]:
    """Write my_law.py into a folder as a user would, with the imports in place; returns its path."""

    def write(folder: Path, source: str) -> Path:
        path = folder / "my_law.py"
        path.write_text(IMPORTS + textwrap.dedent(source), encoding="utf-8")
        return path

    return write


@pytest.fixture
def user_file(tmp_path: Path, write_solver: Callable[[Path, str], Path]) -> Callable[[str], Path]:
    """Write my_law.py into the test's own folder; returns its path."""
    return lambda source: write_solver(tmp_path, source)

"""Checks of a family's parameters: each names the parameter and the rule that it breaks."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence

import numpy as np

from scenarios.scenario import Scenario
from solvers import ProblemError
from solvers.solution import Floats


def check_count(name: str, value: int, at_least: int) -> None:
    """Check a whole number ≥ `at_least`.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < at_least:
        raise ProblemError(f"{name} must be a whole number ≥ {at_least}, not {value!r}")


def check_number(name: str, value: float, *, low: float = -math.inf, high: float = math.inf) -> None:
    """Check a finite number in [low, high].

    Raises:
        ProblemError: names the parameter and the rule.
    """
    if not _is_number(value) or not low <= value <= high:
        if math.isinf(low) and math.isinf(high):
            rule = "be a finite number"
        elif math.isinf(high):
            rule = f"be a finite number ≥ {low:g}"
        else:
            rule = f"lie in [{low:g}, {high:g}]"
        raise ProblemError(f"{name} must {rule}, not {value!r}")


def check_positive(name: str, value: float) -> None:
    """Check a finite number > 0.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    if not _is_number(value) or not value > 0:
        raise ProblemError(f"{name} must be a finite number > 0, not {value!r}")


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Check one of a closed set of words.

    Raises:
        ProblemError: names the parameter and the words.
    """
    if not isinstance(value, str) or value not in choices:
        raise ProblemError(f"{name} must be one of {', '.join(repr(choice) for choice in choices)}, not {value!r}")


def check_masses(masses: Sequence[float] | None, bodies: int) -> Floats:
    """Check one mass [kg] for each body, or None for equal masses of 1 kg; returns shape (bodies,).

    Raises:
        ProblemError: names the parameter and the rule.
    """
    if masses is None:
        return np.ones(bodies)
    if isinstance(masses, str) or not isinstance(masses, (Sequence, np.ndarray)) or len(masses) != bodies:
        raise ProblemError(f"masses must be None or a sequence of {bodies} numbers, one for each ball, not {masses!r}")
    for index, mass in enumerate(masses):
        check_positive(f"masses[{index}]", mass)
    return np.array(masses, dtype=np.float64)


def given(family: Callable[..., Scenario], values: dict[str, object]) -> dict[str, object]:
    """Keep the parameters that make a scenario again: the first always, the others where they differ from default.

    Args:
        family: the family's function.
        values: its local variables; other names than its parameters are ignored.
    """
    signature = inspect.signature(family).parameters
    kept: dict[str, object] = {}
    for position, (name, parameter) in enumerate(signature.items()):
        value = _plain(values[name])
        if position == 0 or value != _plain(parameter.default):
            kept[name] = value
    return kept


def _is_number(value: object) -> bool:
    return (
        isinstance(value, (int, float, np.integer, np.floating))
        and not isinstance(value, bool)
        and math.isfinite(float(value))
    )


def _plain(value: object) -> object:
    """A parameter as JSON knows it: NumPy scalars and sequences become Python's own."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    return value

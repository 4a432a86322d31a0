"""What a solver returns, how it says how it went, and what an implementer must hold to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from solvers.problem import ImpactProblem

Floats = npt.NDArray[np.float64]


class Status(Enum):
    """What a computation came to; each member says what happened and what to change."""

    CONVERGED = ("converged", "The law's own stopping test passed.", "Nothing.")
    ITERATION_LIMIT = (
        "iteration limit",
        "The bound on iterations or contact visits was reached before the stopping test passed; the result is the last "
        "iterate.",
        "Raise the solver's max_iterations or max_visits, loosen its tolerance, or accept its residual.",
    )
    STALLED = (
        "stalled",
        "No further progress was possible: the remaining contacts cannot end, or rounding stopped the residual.",
        "Check whether the contacts squeeze a body from both sides; loosen the tolerance if the residual is near it.",
    )
    NOT_FINITE = (
        "not finite",
        "A NaN or an infinity appeared in the computation.",
        "Check the scale of the problem (mass ratios, velocities), then report it: a law should not overflow.",
    )
    UNSUPPORTED = (
        "unsupported",
        "The law does not apply to this problem; the reason says why.",
        "Choose a law that does, or change the problem as the reason says.",
    )

    def __init__(self, label: str, happened: str, remedy: str) -> None:
        self.label = label
        self.happened = happened
        self.remedy = remedy

    def __str__(self) -> str:
        return self.label


class UnsupportedProblem(Exception):
    """The law does not apply to this problem; the text is the reason. The harness makes it a row."""


@dataclass(frozen=True)
class ImpactSolution:
    """A solver's answer, and what it claims of it."""

    impulse: Floats | None
    """Normal impulse [N s], shape (m,), ≥ 0 pushes. None where a solver knows velocities only (physics engines)."""

    v_post: Floats
    """Post-impact generalized velocity [m/s, rad/s], shape (n,)."""

    status: Status
    """What the computation came to."""

    iterations: int
    """Outer iterations of the law: what it repeats until no contact approaches, or sweeps of an iterative method."""

    visits: int
    """Contact visits: how often the row of one contact was evaluated. A cost that no machine changes."""

    residual: float = math.nan
    """The law's own stopping residual, dimensionless; NaN where it has none."""

    friction_impulse: Floats | None = None
    """Friction impulse [N s], shape (2m,), rows 2i and 2i + 1 belong to contact i. None without friction."""


class Solver(Protocol):
    """A law or method for one multi-impact. To write your own, hold to this list.

    1. It is a frozen dataclass whose fields are its settings, each with a default, a unit and a meaning.
       `Law()` must work, and two equal settings must give the same answer, bit for bit.
    2. `solve` does not change the problem (its arrays are read-only), keeps no state and uses no global random numbers.
    3. It returns an `ImpactSolution`: `impulse` of shape (m,) and `v_post` of shape (n,), both finite, with
       v_post = v_pre + M⁻¹(Jᵀ impulse + Dᵀ friction_impulse). `problem.v_after(impulse)` computes it.
       The harness recomputes v_post from the impulse and scores the difference.
    4. Where no contact approaches (u_pre ≥ 0), or there is none (m = 0), nothing happens: zero impulse, same velocity.
    5. Tolerances are relative to the problem (`problem.speed`, the diagonal of W): units change nothing.
    6. Work is bounded by counts (iterations, steps), never by seconds. At the bound it returns what it reached with
       `Status.ITERATION_LIMIT` or `Status.STALLED`. It never raises for a hard problem and never says "converged"
       of an answer that its own test did not pass.
    7. A law that does not apply (friction, unequal restitution, too many contacts) raises
       `UnsupportedProblem("reason")`. Input is checked by `ImpactProblem` already.
    8. `iterations` and `visits` count the work done.
    9. A method whose answer does not depend on where it starts may take `start`, a keyword-only first guess of the
       normal impulse of shape (m,): `bench` then measures what a warm start saves.
    """

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        """Solve one multi-impact."""
        ...

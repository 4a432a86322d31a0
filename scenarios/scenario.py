"""A scenario: one impact problem, what is known of its outcome, and what must not change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from solvers import ImpactProblem
from solvers.solution import Floats


class ReferenceKind(Enum):
    """Where a reference comes from."""

    CLOSED_FORM = "closed form"
    ODE = "ODE"
    OTHER_CODE = "other code"
    EXPERIMENT = "experiment"


class Quantity(Enum):
    """What a reference is a value of."""

    VELOCITY = "v_post"
    ITERATIONS = "iterations"


@dataclass(frozen=True)
class Reference:
    """A known outcome. Every error names the reference that it is measured against."""

    name: str
    """Short name shown beside every error: "ideal exchange", "Hertz", "QCE closed form", …"""

    value: Floats
    """Post-impact velocity [m/s, rad/s], shape (n,); or the number of iterations, shape (1,)."""

    kind: ReferenceKind
    source: str
    """Author, year and equation, or the computation."""

    uncertainty: float
    """Largest absolute error of any entry of `value`, in its unit. An error below it is not distinguishable."""

    quantity: Quantity = Quantity.VELOCITY

    laws: tuple[str, ...] = ()
    """Names of the solvers whose own closed form this is (verification). Empty: truth for every law (validation)."""


@dataclass(frozen=True)
class Symmetry:
    """A linear map S of velocities that maps the scene on itself: S carries contacts to contacts and keeps M."""

    name: str
    matrix: sp.csr_array
    """S, shape (n, n): v_post(S v_pre) = S v_post(v_pre)."""


@dataclass(frozen=True)
class Invariant:
    """A conserved momentum c · M v: a direction with J c = 0 (and D c = 0 where there is friction)."""

    name: str
    direction: Floats
    """c, shape (n,), zero at immovable bodies."""


@dataclass(frozen=True)
class Scenario:
    """One impact problem with all that is known of it."""

    name: str
    """Name of the family, the key in `CATALOG`."""

    parameters: Mapping[str, object]
    """The family's parameters that make this scenario again."""

    problem: ImpactProblem

    source: str
    """Where the scene comes from: author, year, figure."""

    reference_builders: tuple[Callable[[], Reference], ...] = ()
    """Each makes one reference when first asked: an ODE solution costs time."""

    symmetries: tuple[Symmetry, ...] = ()
    invariants: tuple[Invariant, ...] = ()

    tags: frozenset[str] = field(default_factory=frozenset)
    """What the scene is: "chain", "rack", "pack", "redundant", "jammed", "mass-ratio", "friction", …"""

    dofs_per_body: int = 1
    """Length of the vectors in v: 1 on a line, 2 for discs, 3 in space (rotations act on blocks of this length)."""

    positions: Floats | None = None
    """Centers of the bodies [m], shape (bodies, 2 or 3), for pictures; None on a line."""

    @cached_property
    def references(self) -> tuple[Reference, ...]:
        """All references, computed when first asked."""
        return tuple(build() for build in self.reference_builders)

    @property
    def label(self) -> str:
        """Name with parameters, unique within a plan: "three-ball-chain(va=0.5)"."""
        inside = ", ".join(f"{key}={_short(value)}" for key, value in self.parameters.items())
        return f"{self.name}({inside})"


def _short(value: object) -> str:
    """A parameter as text: numbers as short as they are exact, sequences in brackets."""
    if isinstance(value, (bool, str, int)) or value is None:
        return str(value)
    if isinstance(value, (float, np.floating)):
        return f"{float(value):g}" if float(f"{float(value):g}") == float(value) else repr(float(value))
    if isinstance(value, (list, tuple, np.ndarray)):
        return "[" + ",".join(_short(item) for item in value) + "]"
    return str(value)

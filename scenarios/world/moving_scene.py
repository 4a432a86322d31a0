"""A moving scene: how it starts, and what is known of it."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, TypeAlias, TypeVar

from scenarios.parameters import check_count
from scenarios.world.checkpoint import Arrays
from scenarios.world.container import Container
from scenarios.world.impact import ByProblem, Resolver, Streamed
from scenarios.world.spheres import Spheres
from scenarios.world.stepping import StepReport
from solvers import SOLVERS, ImpactProblem, ProblemError, Solver

Law = TypeVar("Law", Solver, Streamed)

STREAMED: dict[str, Streamed] = {
    "qce-lcp-accurate": Streamed(max_sweeps=2_000),
    "qce-lcp-fast": Streamed(),
}
"""The packed QCE-LCP for many spheres: name → setting. All other solvers go through an `ImpactProblem`."""


class MovingWorld(Protocol):
    """A scene in motion: `World` and `RigidWorld` with a fixed step, `EventWorld` from impact to impact."""

    steps: int
    """Steps made."""

    @property
    def identity(self) -> str:
        """What scene this is, with all that its trajectory depends on."""
        ...

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        ...

    @property
    def period(self) -> float:
        """Length of a cycle [s]; inf if there is none."""
        ...

    @property
    def spheres(self) -> Spheres:
        """Where the bodies are and how they move; of a body of another shape, the sphere around it."""
        ...

    @property
    def container(self) -> Container:
        """Walls, and how they move."""
        ...

    @property
    def over(self) -> bool:
        """True where no step can follow: no further impact will come."""
        ...

    def step(self) -> StepReport:
        """Go on by one step."""
        ...

    def problem(self) -> ImpactProblem:
        """The impact that the next step will solve, as any solver takes it."""
        ...

    def state(self) -> Arrays:
        """All that changes from step to step."""
        ...

    def restore(self, state: Arrays) -> None:
        """Go on from a state of the same scene."""
        ...


@dataclass(frozen=True)
class Units:
    """What lengths, times, speeds and energies of a scene are given in."""

    length: str = "m"
    time: str = "s"
    speed: str = "m/s"
    energy: str = "J"


SI = Units()

Start: TypeAlias = Callable[[str, Resolver, int], MovingWorld]


STAGES_FIRED = "stages that fired"
"""Name of the measure that counts the stages of a scene that has some."""


def nothing_measured(world: MovingWorld) -> Mapping[str, float]:
    """Measures of a scene that is judged by the eye."""
    return {}


def never(measures: Mapping[str, float]) -> bool:
    """Say of all measures that the scene goes on."""
    return False


@dataclass(frozen=True)
class MovingScene:
    """A scene in motion, without the law that solves its impacts."""

    name: str
    """Name of the family, the key in `MOVING`."""

    parameters: Mapping[str, object]
    """The family's parameters that make this scene again."""

    description: str
    """What happens, in a line."""

    source: str
    """Where the scene comes from: author, year, figure."""

    start: Start
    """Makes the world from its identity, a resolver and a seed."""

    default_solver: str = "qce-lcp"
    """Name of the solver that suits the scene."""

    steps_per_cycle: int = 0
    """Steps in a period of what drives the scene; 0 where nothing does."""

    default_steps: int = 1_000
    """Steps after which the scene has shown what it is for; `impactbench simulate` stops there unless told."""

    frame_every: int = 20
    """Steps between two frames of its trajectory, unless told."""

    frame_time: float = math.inf
    """Time between two frames of a scene that goes from impact to impact; inf where steps are of equal length."""

    duration: float = math.inf
    """Time at which the scene has shown what it is for; a run ends there unless told, or after its steps."""

    period: float = math.inf
    """Time after which an ideal scene without a step of its own repeats; inf where it does not."""

    measure: Callable[[MovingWorld], Mapping[str, float]] = nothing_measured
    """What the scene is judged by: name with unit → number, the same names always."""

    measure_every: int = 0
    """Steps between two measures; 0: at every frame."""

    judged: Mapping[str, str] = field(default_factory=dict)
    """Desideratum → the measure that shows it over a run: "SYM", how far from symmetric (≥ 0), and "BRK", how far apart
    what should part, over the ideal (NaN at times when nothing should be apart)."""

    stages: tuple[str, ...] = ()
    """What is to happen, in this order; the measure `STAGES_FIRED` counts what did."""

    reached: Callable[[Mapping[str, float]], bool] = never
    """Whether its measures show what the scene is for: a pattern that stands."""

    color: str = "height [m]"
    """What pictures show by color: "height", "depth" or "speed", with its unit; or "kind", of rigid bodies."""

    color_from: float = 0.0
    """Time from which the depth is taken for good: when a layer has come to rest."""

    trace: str = ""
    """What a figure shows of each body: "xy", its path from above; "tx", its x over time; "" where there are many."""

    units: Units = SI
    """Of all its numbers, those of its measures too; docstrings name SI."""

    @property
    def label(self) -> str:
        """Name with parameters: "extended-pattern(pattern=stripes)"."""
        return f"{self.name}({', '.join(f'{key}={value}' for key, value in self.parameters.items())})"

    def world(self, *, solver: str | Solver | Streamed | None = None, seed: int = 0) -> MovingWorld:
        """Start the scene.

        Args:
            solver: a name in `STREAMED` or `SOLVERS`, the latter with numbers for settings if wanted
                ("qce-lcp:tolerance=1e-6"), or a solver; `default_solver` if None.
            seed: of all that is random in the scene, ≥ 0.

        Raises:
            ProblemError: names the parameter and the rule.
        """
        check_count("seed", seed, 0)
        resolver = _resolver(self.default_solver if solver is None else solver)
        return self.start(f"{self.label}, seed {seed}, by {resolver!r}", resolver, seed)


def _resolver(solver: str | Solver | Streamed) -> Resolver:
    if isinstance(solver, Streamed):
        return solver
    if not isinstance(solver, str):
        return ByProblem(solver)
    name, _, settings = solver.partition(":")
    if name in STREAMED:
        return _with_settings(partial(replace, STREAMED[name]), settings)
    if name in SOLVERS:
        return ByProblem(_with_settings(SOLVERS[name], settings))
    raise ProblemError(f"solver must be one of {', '.join(sorted([*SOLVERS, *STREAMED]))}, not {solver!r}")


def _with_settings(law: Callable[..., Law], settings: str) -> Law:
    """A solver with numbers for some of its settings: "tolerance=1e-6,max_sweeps=500"."""
    pairs = (pair.partition("=") for pair in settings.split(",") if pair)
    try:
        return law(**{name: ast.literal_eval(value) for name, _, value in pairs})
    except (SyntaxError, TypeError, ValueError) as error:
        raise ProblemError(f"solver must have settings such as tolerance=1e-6, not {settings!r}: {error}") from error

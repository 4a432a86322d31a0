"""A moving scene: how it starts, and what is known of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from scenarios.parameters import check_count
from scenarios.world.checkpoint import Arrays
from scenarios.world.container import Container
from scenarios.world.impact import ByProblem, Resolver, Streamed
from scenarios.world.spheres import Spheres
from scenarios.world.stepping import StepReport
from solvers import SOLVERS, ImpactProblem, ProblemError, Solver

STREAMED: dict[str, Streamed] = {
    "qce-lcp-accurate": Streamed(max_sweeps=2_000),
    "qce-lcp-fast": Streamed(),
}
"""The packed QCE-LCP for many spheres: name → setting. All other solvers go through an `ImpactProblem`."""


class MovingWorld(Protocol):
    """A scene in motion: `World` with a fixed step, `EventWorld` from impact to impact."""

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
        """Where the bodies are and how they move."""
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


Start: TypeAlias = Callable[[str, Resolver, int], MovingWorld]


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

    measure: Callable[[MovingWorld], Mapping[str, float]] = nothing_measured
    """What the scene is judged by, measured at every frame: name with unit → number, the same names always."""

    reached: Callable[[Mapping[str, float]], bool] = never
    """Whether its measures show what the scene is for: a pattern that stands."""

    color: str = "height [m]"
    """What pictures show by color: "height [m]", "depth [m]" or "speed [m/s]"."""

    color_from: float = 0.0
    """Time from which the depth is taken for good [s]: when a layer has come to rest."""

    @property
    def label(self) -> str:
        """Name with parameters: "extended-pattern(pattern=stripes)"."""
        return f"{self.name}({', '.join(f'{key}={value}' for key, value in self.parameters.items())})"

    def world(self, *, solver: str | Solver | Streamed | None = None, seed: int = 0) -> MovingWorld:
        """Start the scene.

        Args:
            solver: a name in `SOLVERS` or `STREAMED`, or a solver with settings of its own; `default_solver` if None.
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
    if solver in STREAMED:
        return STREAMED[solver]
    if solver in SOLVERS:
        return ByProblem(SOLVERS[solver]())
    raise ProblemError(f"solver must be one of {', '.join(sorted([*SOLVERS, *STREAMED]))}, not {solver!r}")

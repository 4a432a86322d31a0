"""All that one task measures: one solver on one scene, or over one sweep of scenes.

The number of solves depends on counts alone (contacts, visits and iterations of the first solve), never on seconds, so
that the same task measures the same rows on every machine: about 180 solves on small scenes, 40 on middle ones, 15 on
large ones, 8 where a solve is dear, 3 where it is dearer still or did not even end. Random variants come from the
task's seed.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from harness import accuracy, desiderata, metamorphic, robustness
from harness.checked import Tally, claim, termination
from harness.hard_cases import ending_scores
from harness.measurement import InvalidSolution, Measurement, Score, Series, Verdict, not_applicable, shown, upper_bound
from harness.sweeps import SWEEPS
from scenarios.scenario import Reference, Scenario
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Solver, Status, UnsupportedProblem
from solvers.solution import Floats

# A scene with more velocities than this is not stored entry by entry.
STORED_VELOCITIES = 200
# Why a relation that costs further solves was left out.
TOO_DEAR = "not tried: the scene is too large or one solve too dear"
INVARIANCES = ("contact entered twice", "contact entered twice, stiffness halved", "body added", "mirror", "rotation")
# Names by which scenarios call the two references that scores ask for.
IDEAL = "ideal exchange"
COMPLIANT = "Hertz"


@dataclass(frozen=True)
class Effort:
    """How many variants of a scene are solved."""

    symmetries: int
    """Symmetries tried, the first ones of the scene."""
    random_velocities: int
    """Random velocities at which symmetry is tried besides the scene's own."""
    renumberings: int
    duplicates: int
    """Contacts entered twice, one after the other."""
    frames: int
    """1 to try a mirror and a body added, 0 to leave them."""
    rotations: int
    probe_pairs: int
    """Random disturbances of the size `robustness.PROBE`, each in both directions."""
    sizes: tuple[float, ...]
    """Sizes of the other disturbances."""
    disturbances: int
    """How many of the disturbances are tried at every size."""
    jump_directions: int
    """Disturbances along which a jump is looked for, up to 39 solves each."""
    units: tuple[str, ...]
    """Units that are changed."""
    factors: tuple[float, ...]
    """Factors of the units."""


LARGE, UNITS = metamorphic.LARGE, ("mass", "speed", "gap")
FULL = Effort(8, 1, 3, 4, 1, 2, 32, robustness.SIZES, 6, 2, UNITS, (LARGE, 1 / LARGE))
REDUCED = Effort(2, 1, 1, 1, 1, 1, 2, (1e-12, 1e-8, 1e-4, 1e-1), 1, 1, UNITS, (LARGE,))
MINIMAL = Effort(1, 0, 1, 1, 1, 1, 1, (1e-8, 1e-2), 1, 0, UNITS, (LARGE,))
SCANT = Effort(1, 0, 1, 0, 1, 0, 1, (), 0, 0, ("speed",), (LARGE,))
# A solve that was cut off, or is dear by itself: only its symmetry is looked at.
ONCE = Effort(1, 0, 1, 0, 0, 0, 0, (), 0, 0, (), ())
# Contacts up to which the effort is full or reduced.
SMALL, MIDDLE = 60, 500
# Work of one solve, in contact visits, up to which the effort is full, reduced or minimal: at 10-100 ns a visit the
# 180, 40 and 15 solves of these then take about a second at most.
CHEAP, DEAR, DEAREST = 60_000, 250_000, 1_500_000
# Above this a solve takes a good tenth of a second, and eight of them would be most of a run's time.
ENOUGH = 3_000_000
# One iteration of a law that is composed of kernels in Python costs as much as so many visits.
VISITS_PER_ITERATION = 500


def effort_for(*, contacts: int, solution: ImpactSolution) -> Effort:
    """Choose the effort by the size of the scene and the work of the first solve."""
    work = int(solution.visits) + VISITS_PER_ITERATION * int(solution.iterations)
    if contacts <= SMALL and work <= CHEAP:
        return FULL
    if contacts <= MIDDLE and work <= DEAR:
        return REDUCED
    if solution.status is not Status.CONVERGED or work > ENOUGH:
        return ONCE
    return MINIMAL if work <= DEAREST else SCANT


def registry_name(solver: Solver) -> str:
    """Name of a solver's class in the registry; empty for any other."""
    return next((name for name, law in SOLVERS.items() if type(solver) is law), "")


def measure_sweep(solver: Solver, sweep: str, parameters: Mapping[str, object], *, seed: int) -> Measurement:
    """Measure one solver over one sweep of `SWEEPS`.

    Raises:
        UnsupportedProblem: the solver refuses a scene of the sweep.
        InvalidSolution: an answer breaks the contract.
    """
    return SWEEPS[sweep](solver, seed=seed, **parameters)


def measure_impact(solver: Solver, scenario: Scenario, *, seed: int, name: str | None = None) -> Measurement:
    """Measure all scores of one solver on one scene.

    Args:
        solver: the law.
        scenario: the scene.
        seed: of all random variants.
        name: the solver's name in the registry, under which references and own equations know it; looked up if None.

    Raises:
        UnsupportedProblem: the solver refuses the scene itself.
        InvalidSolution: its answer to the scene itself breaks the contract.
    """
    solve = Tally(solver)
    problem = scenario.problem
    solution = solve(problem)
    effort = effort_for(contacts=problem.m, solution=solution)
    scores = [
        *_desiderata(scenario, solution),
        *_relations(solve, scenario, solution.v_post, effort, seed),
        *claim(problem, solution),
        *termination(solution, tags=scenario.tags),
        *ending_scores(scenario, solution),
        *_errors(solve, scenario, solution, registry_name(solver) if name is None else name),
    ]
    if "jammed" in scenario.tags and solution.status is not Status.CONVERGED:
        scores = [_without_outcome(score) for score in scores]
    disturbed, series = _robustness(solve, problem, solution.v_post, effort, seed)
    return Measurement(
        solution.status.label,
        int(solution.iterations),
        int(solution.visits),
        (*scores, *disturbed),
        (*solution_series(problem, solution), *series),
    )


def _without_outcome(score: Score) -> Score:
    """Show without a gate what judges an outcome, where a jammed scene has none: the solve was cut off, and said so.

    An elastic iteration need not end there, and an integrator is cut off with energy in its springs. What holds for
    every iterate stays gated: energy gained, momentum, the sign of impulses, the velocity claim.
    """
    of_outcome = score.name in ("SYM", "invariance", "scale") or score.metric in ("energy lost", "verification: energy")
    if not of_outcome or score.verdict is Verdict.NOT_APPLICABLE:
        return score
    detail = {**score.detail, "not gated": "the solve was cut off on a jammed scene: this is an iterate, no outcome"}
    return shown(score.name, score.metric, score.value, score.reference, detail)


def solution_series(problem: ImpactProblem, solution: ImpactSolution) -> tuple[Series, ...]:
    """The velocities before and after, and the impulse; nothing for scenes too large to be drawn from the store."""
    if problem.n > STORED_VELOCITIES:
        return ()
    columns = {
        "v_pre": problem.v_pre.tolist(),
        "v_post": solution.v_post.tolist(),
        "u_pre": problem.u_pre.tolist(),
        "u_post": (problem.J @ solution.v_post).tolist(),
        "impulse": None if solution.impulse is None else solution.impulse.tolist(),
    }
    return (Series("solution", columns),)


def _random(seed: int, purpose: str) -> np.random.Generator:
    """A stream of its own for every purpose, so that adding one changes no other."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


def _reference(scenario: Scenario, name: str) -> Reference | None:
    """The scene's reference of a name that is truth for every law."""
    return next((r for r in scenario.references if r.name == name and not r.laws), None)


def _desiderata(scenario: Scenario, solution: ImpactSolution) -> Iterator[Score]:
    """BRK, KIN, MOM and ONE: what one solve tells."""
    problem = scenario.problem
    ideal, compliant = _reference(scenario, IDEAL), _reference(scenario, COMPLIANT)
    if ideal is not None:
        yield desiderata.brk_chain(problem, solution.v_post, ideal)
    elif compliant is not None:
        yield desiderata.brk_share(problem, solution.v_post, compliant)
    else:
        yield not_applicable("BRK", "worst separation of touching contacts", "no reference says what should separate")
    yield from desiderata.kin(problem, solution.v_post)
    yield desiderata.mom(problem, solution.v_post, scenario.invariants)
    yield from desiderata.one(problem, solution, tags=scenario.tags)


def _relations(solve: Tally, scenario: Scenario, v_post: Floats, effort: Effort, seed: int) -> Iterator[Score]:
    """SYM, invariance and scale: what a second solve tells."""
    if scenario.problem.m == 0:
        yield not_applicable("SYM", "worst symmetry residual", "there is no contact")
        return
    yield from _symmetry(solve, scenario, v_post, effort, seed)
    yield from _invariance(solve, scenario, v_post, effort, seed)
    for unit in UNITS:
        metric = f"{unit} scaled"
        if unit not in effort.units:
            yield not_applicable("scale", metric, TOO_DEAR)
            continue
        scaled = partial(metamorphic.scale, unit, effort.factors, solve, scenario.problem, v_post)
        yield _scored(solve, "scale", metric, scaled)


def _scored(solve: Tally, name: str, metric: str, build: Callable[[], Score]) -> Score:
    """Build a score that solves a variant of the scene.

    A refusal of the variant makes the score not applicable; an answer that breaks the contract there fails it. Neither
    touches what was measured on the scene itself.
    """
    before = solve.unfinished.copy()
    try:
        score = build()
    except UnsupportedProblem as refusal:
        return not_applicable(name, metric, f"the solver refuses the variant: {refusal}")
    except InvalidSolution as broken:
        return upper_bound(name, metric, math.nan, 0.0, detail={"reason": f"invalid answer on the variant: {broken}"})
    unfinished = solve.unfinished - before
    if not unfinished:
        return score
    return replace(score, detail={**score.detail, "variants not converged": dict(unfinished)})


def _symmetry(solve: Tally, scenario: Scenario, v_post: Floats, effort: Effort, seed: int) -> Iterator[Score]:
    """SYM over the scene's symmetries and over renumberings, at its own velocity and at random ones."""
    problem = scenario.problem
    rng = _random(seed, "symmetry")
    velocities = [metamorphic.random_approach(problem, rng) for _ in range(effort.random_velocities)]
    symmetries = scenario.symmetries[: effort.symmetries]
    orders = [
        metamorphic.random_renumbering(rng, m=problem.m, n=problem.n, dofs_per_body=scenario.dofs_per_body)
        for _ in range(effort.renumberings)
    ]

    def worst(metric: str, residuals: Callable[[ImpactProblem, Floats], dict[str, float]]) -> Score:
        found = residuals(problem, v_post)
        for k, v in enumerate(velocities):
            other = problem.replace(v_pre=v)
            more = residuals(other, solve(other).v_post)
            found |= {f"{key}, random velocity {k + 1}": value for key, value in more.items()}
        return desiderata.sym(metric, found)

    metric = "worst symmetry residual"
    if symmetries:
        yield _scored(
            solve, "SYM", metric, partial(worst, metric, partial(metamorphic.symmetry_residuals, solve, symmetries))
        )
    else:
        yield not_applicable("SYM", metric, "the scene has no symmetry")
    metric = "worst renumbering residual"
    yield _scored(
        solve, "SYM", metric, partial(worst, metric, partial(metamorphic.renumbering_residuals, solve, orders))
    )


def _invariance(solve: Tally, scenario: Scenario, v_post: Floats, effort: Effort, seed: int) -> Iterator[Score]:
    """A contact entered twice, a body added, a mirror, rotations."""
    problem, block = scenario.problem, scenario.dofs_per_body
    rng = _random(seed, "invariance")
    contacts = rng.permutation(problem.m)[: effort.duplicates]
    relations: dict[str, Callable[[], Score]] = {}
    if effort.duplicates:
        for metric, share in (("contact entered twice", 1.0), ("contact entered twice, stiffness halved", 0.5)):
            relations[metric] = partial(
                metamorphic.duplicate, solve, problem, v_post, contacts=contacts, stiffness_share=share, metric=metric
            )
    if effort.frames:
        relations["body added"] = partial(metamorphic.bystander, solve, problem, v_post)
        reflection = metamorphic.mirror(n=problem.n, dofs_per_body=block)
        relations["mirror"] = partial(metamorphic.coordinates, "mirror", solve, problem, v_post, [reflection])
    if effort.rotations and block > 1 and problem.n % block == 0:
        turns = [metamorphic.random_rotation(rng, n=problem.n, dofs_per_body=block) for _ in range(effort.rotations)]
        relations["rotation"] = partial(metamorphic.coordinates, "rotation", solve, problem, v_post, turns)
    for metric in INVARIANCES:
        if metric in relations:
            yield _scored(solve, "invariance", metric, relations[metric])
        elif metric == "rotation" and block == 1:
            yield not_applicable("invariance", metric, "the bodies move on a line")
        else:
            yield not_applicable("invariance", metric, TOO_DEAR)


def _errors(solve: Tally, scenario: Scenario, solution: ImpactSolution, name: str) -> Iterator[Score]:
    """Validation against the truths, verification against the law's closed forms and its own equations."""
    problem = scenario.problem
    yield from accuracy.validation(problem, solution.v_post, scenario.references)
    yield from accuracy.verification(problem, solution, scenario.references, name=name)
    own = accuracy.OWN_EQUATIONS.get(name)
    if own is not None:
        yield _scored(solve, "error", "verification: own equations", partial(own, solve.solver, problem, solution))


def _robustness(
    solve: Tally, problem: ImpactProblem, v_post: Floats, effort: Effort, seed: int
) -> tuple[list[Score], list[Series]]:
    """Responses to disturbances, and jumps."""
    if problem.speed == 0.0:
        return [not_applicable("robustness", "largest response", "no contact has a relative velocity")], []
    scores: list[Score] = []
    series: list[Series] = []

    if effort.probe_pairs == 0:
        return [not_applicable("robustness", metric, TOO_DEAR) for metric in ("largest response", "jump")], []
    rng = _random(seed, "disturbance")
    directions = robustness.disturbances(problem, rng, pairs=effort.probe_pairs)
    along = directions[: 2 * effort.jump_directions : 2]

    def respond() -> Score:
        found = robustness.responses(solve, problem, v_post, directions, sizes=effort.sizes, along=effort.disturbances)
        series.append(robustness.response_series(found))
        scores.append(robustness.lipschitz(found))
        # The first search goes where a small disturbance moves the outcome most.
        along[:1] = [found.steepest]
        return robustness.largest_response(found)

    def jump() -> Score:
        return robustness.largest_jump([robustness.find_jump(solve, problem, v_post, xi) for xi in along])

    scores.append(_scored(solve, "robustness", "largest response", respond))
    if effort.jump_directions:
        scores.append(_scored(solve, "robustness", "jump", jump))
    else:
        scores.append(not_applicable("robustness", "jump", TOO_DEAR))
    return scores, series

"""Hard cases: every own solver on every scene that laws break on, rulings, certificate, table, and bad input."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from harness.hard_cases import (
    Certificate,
    Conduct,
    Ruling,
    attempt,
    certificate,
    ending_scores,
    measure_hard_case,
    opening,
    rule,
)
from harness.isolation import Limits
from harness.measurement import Kind, Outcome, Score, Verdict, shown
from harness.run import measure, plan_tasks
from harness.selection import ScenarioChoice, choose_solver
from harness.store import Store
from reports.hard_cases import (
    Case,
    HardTable,
    hard_cases_csv,
    hard_cases_markdown,
    hard_table,
    render_terminal,
    write_hard_cases,
)
from scenarios import CATALOG
from scenarios.jammed import interior_margin
from scenarios.scenario import Scenario
from scenarios.tiers import HARD, HARD_CASES, TIERS
from solvers import SOLVERS, ImpactProblem, ImpactSolution, ProblemError, Solver, Status, UnsupportedProblem
from solvers.boxed_lcp import project
from solvers.quadratic_contact_energy import QuadraticContactEnergy
from tests.handmade_rows import HandmadeStore

Instance = tuple[str, dict[str, object]]

# More contacts than this make a solve of some law take longer than a second.
CHEAP_CONTACTS = 250


def limited(name: str, **settings: object) -> Solver:
    """A registered solver with other settings."""
    law: Any = SOLVERS[name]
    solver: Solver = law(**settings)
    return solver


# Bounds at which a law that will not end here has shown it; the laws' own defaults are tried in the long test.
BOUNDS: Mapping[str, dict[str, object]] = {
    "gauss-seidel": {"max_iterations": 2000},
    "gr": {"max_iterations": 200},
    "hertz": {"max_visits": 100_000},
    "jacobi": {"max_iterations": 2000},
    "lcp-pgs": {"max_iterations": 2000},
    "lzb": {"max_visits": 100_000},
    "qce": {"max_iterations": 500},
    "qce-blend": {"max_iterations": 500, "max_sweeps": 2000},
    "qce-defer": {"max_iterations": 500},
    "qce-lcp": {"max_iterations": 500, "max_sweeps": 2000},
}
# Engines are others' work: the table shows what they come to, no test here demands it.
OWN = [name for name in SOLVERS if not name.startswith("engine-")]
FEW: Mapping[str, Solver] = {name: limited(name, **BOUNDS.get(name, {})) for name in OWN}
# Laws that gain energy, or lose it, by what they are: the negative controls.
CONTROLS = {"jacobi"}
# What the table found wrong in a law that is not mended yet, each with what it says; a mended one leaves this list.
FOUND_WRONG: Mapping[tuple[str, str], str] = {}


def size_of(instance: Instance) -> int:
    """Contacts of an instance as far as its parameters say, without building it."""
    numbers = [value for value in instance[1].values() if isinstance(value, int) and not isinstance(value, bool)]
    return max(numbers, default=1)


CHEAP = [instance for instance in TIERS[HARD] if size_of(instance) <= CHEAP_CONTACTS]
every_cheap_case = pytest.mark.parametrize(
    "instance", CHEAP, ids=[f"{name}-{parameters}" for name, parameters in CHEAP]
)


@cache
def built(position: int) -> Scenario:
    name, parameters = TIERS[HARD][position]
    return CATALOG[name](**parameters)


def build(instance: Instance) -> Scenario:
    return built(TIERS[HARD].index(instance))


# --- every own solver on every hard case -----------------------------------------------------------------------------


@every_cheap_case
def test_no_own_solver_gives_nan_or_a_silent_wrong_answer(instance: Instance) -> None:
    scene = build(instance)
    for name, solver in FEW.items():
        ruling = attempt(solver, scene)
        found = FOUND_WRONG.get((name, scene.label))
        if name not in CONTROLS and not (found and ruling.reason.startswith(found)):
            assert ruling.conduct in (Conduct.PASSED, Conduct.STALLED, Conduct.REFUSED), f"{name}: {ruling.reason}"
        assert ruling.conduct is Conduct.PASSED or ruling.reason, name


@pytest.mark.long
@pytest.mark.parametrize("position", range(len(TIERS[HARD])), ids=lambda k: f"{TIERS[HARD][k]}")
@pytest.mark.parametrize("name", [name for name in OWN if name not in CONTROLS])
def test_no_registered_solver_gives_a_silent_wrong_answer_at_its_own_settings(name: str, position: int) -> None:
    ruling = attempt(SOLVERS[name](), built(position))
    assert ruling.conduct in (Conduct.PASSED, Conduct.STALLED, Conduct.REFUSED), ruling.reason


@every_cheap_case
def test_where_no_contact_approaches_every_solver_leaves_the_scene_as_it_is(instance: Instance) -> None:
    scene = build(instance)
    problem = scene.problem.replace(v_pre=-scene.problem.v_pre) if (scene.problem.u_pre <= 0).all() else scene.problem
    if (problem.u_pre < 0).any():
        pytest.skip("something approaches, whichever way it moves")
    for name, solver in FEW.items():
        try:
            solution = solver.solve(problem)
        except UnsupportedProblem:
            continue
        assert solution.status is Status.CONVERGED, name
        assert np.array_equal(solution.v_post, problem.v_pre), name
        assert solution.impulse is not None
        assert not solution.impulse.any(), name


def test_a_recovered_law_ends_on_every_cheap_jammed_case() -> None:
    law = QuadraticContactEnergy(recover_after=100)
    for instance in HARD_CASES["squeezed from all sides"]:
        scene = build(instance)
        if (scene.problem.restitution == 1).all():
            ruling = attempt(law, scene)
            assert ruling.conduct is Conduct.STALLED
            assert ruling.natural
            left = {row.metric: row.value for row in measure_hard_case(law, scene).scores}["approach left"]
            assert left <= 1e-11


# --- the catalog of hard cases ---------------------------------------------------------------------------------------


def test_hard_instances_have_their_parameters_in_the_form_in_which_they_are_stored() -> None:
    for position, (_, parameters) in enumerate(TIERS[HARD]):
        assert dict(built(position).parameters) == parameters


def test_the_hard_cases_have_what_section_6_of_the_physics_asks_for() -> None:
    scenes = [built(position) for position in range(len(TIERS[HARD]))]
    masses = [scene.problem.inverse_mass.diagonal() for scene in scenes]
    assert max(mass.max() / mass.min() for mass in masses) == pytest.approx(1e12)
    assert any(scene.problem.m == 99_999 for scene in scenes)
    assert {scene.problem.m for scene in scenes if scene.name == "box-on-floor"} >= {4, 100, 1000}
    assert sum("jammed" in scene.tags for scene in scenes) >= 10
    sizes = {scene.parameters["size"] for scene in scenes if scene.name == "disturbed-cradle"}
    assert min(sizes) == 1e-16  # type: ignore[type-var]
    assert max(sizes) == 1e-1  # type: ignore[type-var]
    assert any(scene.problem.m == 0 for scene in scenes)
    assert any(scene.problem.m and (scene.problem.u_pre >= 0).all() for scene in scenes)
    restitutions = [scene.problem.restitution for scene in scenes if scene.problem.m]
    assert {0.0, 0.5, 1.0} <= {float(e[0]) for e in restitutions if (e == e[0]).all()}
    assert any(np.unique(e).size > 1 for e in restitutions)


def test_a_resting_stack_falls_one_step_and_only_its_floor_is_approached() -> None:
    scene = CATALOG["resting-stack"](height=4, shape="pyramid", step=1e-2)
    falling = scene.problem.v_pre.reshape(-1, 2)
    assert falling == pytest.approx(np.tile([0.0, -9.81e-2], (10, 1)))
    assert (scene.problem.u_pre < -1e-3).sum() == 4
    assert scene.problem.m == 4 + 6 + 12


def test_normals_of_a_wedge_have_the_angle_that_it_says() -> None:
    nearly_one = CATALOG["ball-in-wedge"](angle=1e-3).problem.J.toarray()
    assert math.acos(float(nearly_one[0] @ nearly_one[1])) == pytest.approx(1e-3, rel=1e-6)
    opposed = CATALOG["ball-in-wedge"](angle=1e-3, normals="opposed").problem.J.toarray()
    assert math.pi - math.acos(float(opposed[0] @ opposed[1])) == pytest.approx(1e-3, rel=1e-6)


def test_a_narrow_wedge_takes_as_many_bounces_as_the_unfolded_billiard() -> None:
    # Unfolded, the disc goes straight through copies of the wedge, over a right angle from its bisector.
    solution = SOLVERS["qce"]().solve(CATALOG["ball-in-wedge"](angle=1e-2, normals="opposed").problem)
    assert abs(solution.iterations - math.pi / 2e-2) <= 1


def test_three_balls_collapse_below_the_critical_restitution_alone() -> None:
    # McNamara and Young 1992: three balls take infinitely many impacts below 7 - 4√3 = 0.0718. One ball strikes two.
    def passes(restitution: float) -> int:
        problem = CATALOG["three-ball-chain"](va=0.0, restitution=restitution).problem
        return SOLVERS["gauss-seidel"]().solve(problem).iterations

    assert passes(0.08) <= 6
    assert passes(0.06) >= 8


@pytest.mark.parametrize(
    ("name", "parameters", "field"),
    [
        ("long-chain", {"balls": 0}, "balls"),
        ("long-chain", {"start": "up"}, "start"),
        ("long-chain", {"restitution": 2.0}, "restitution"),
        ("heavy-and-light", {"mass_ratio": 0.5}, "mass_ratio"),
        ("heavy-and-light", {"mass_ratio": math.inf}, "mass_ratio"),
        ("heavy-and-light", {"arrangement": "none"}, "arrangement"),
        ("ball-in-wedge", {"angle": 0.0}, "angle"),
        ("ball-in-wedge", {"angle": 3.0}, "angle"),
        ("ball-in-wedge", {"normals": "opposed", "planes": 3}, "planes"),
        ("jammed-box", {"rows": 0}, "rows"),
        ("jammed-box", {"columns": 1}, "columns"),
        ("resting-stack", {"height": 2.5}, "height"),
        ("resting-stack", {"shape": "heap"}, "shape"),
        ("resting-stack", {"step": 0.0}, "step"),
        ("mixed-restitution", {"pattern": []}, "pattern"),
        ("mixed-restitution", {"pattern": [0.5, -0.1]}, re.escape("pattern[1]")),
        ("mixed-restitution", {"balls": 1}, "balls"),
        ("inelastic-collapse", {"balls": 2}, "balls"),
        ("inelastic-collapse", {"restitution": math.nan}, "restitution"),
    ],
)
def test_a_wrong_parameter_of_a_hard_scene_is_named(name: str, parameters: dict[str, object], field: str) -> None:
    with pytest.raises(ProblemError, match=f"^{field} must "):
        CATALOG[name](**parameters)


# --- bad input -------------------------------------------------------------------------------------------------------


def problem_with(**changes: Any) -> ImpactProblem:
    """Two balls on a line and a third body that cannot move, with one field changed."""
    arguments: dict[str, Any] = {
        "inverse_mass": [1.0, 1.0, 0.0],
        "J": [[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]],
        "v_pre": [1.0, 0.0, 0.0],
        "restitution": [1.0, 0.5],
    }
    return ImpactProblem(**(arguments | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inverse_mass": [1.0, 0.0, 0.0]}, "contact 1 moves no body"),
        ({"inverse_mass": [0.0, 0.0, 0.0]}, "contact 0 moves no body"),
        ({"J": [[-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]}, "contact 1 moves no body"),
        ({"inverse_mass": [1.0, -1.0, 0.0]}, "inverse_mass"),
        ({"inverse_mass": [1.0, math.nan, 0.0]}, "inverse_mass must be finite"),
        ({"inverse_mass": [1.0, 1.0]}, "inverse_mass"),
        ({"inverse_mass": [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 0.0]]}, "inverse_mass"),
        ({"J": [[-1.0, math.inf, 0.0], [0.0, -1.0, 1.0]]}, "J must be finite"),
        ({"J": [[-1.0, 1.0], [0.0, -1.0]]}, "J must have one column for each entry of v_pre"),
        ({"J": [-1.0, 1.0, 0.0]}, "J must have"),
        ({"J": "contacts"}, "J must be"),
        ({"v_pre": [math.nan, 0.0, 0.0]}, "v_pre must be finite"),
        ({"v_pre": [-math.inf, 0.0, 0.0]}, "v_pre must be finite"),
        ({"v_pre": [1.0, 0.0]}, "v_pre"),
        ({"v_pre": [[1.0, 0.0, 0.0]]}, "v_pre must have one dimension"),
        ({"restitution": 1.0 + 1e-15}, "restitution must lie in [0, 1]"),
        ({"restitution": -1e-300}, "restitution must lie in [0, 1]"),
        ({"restitution": [1.0, 0.5, 0.0]}, "restitution"),
        ({"restitution": math.nan}, "restitution must be finite"),
        ({"friction": -0.1, "D": np.zeros((4, 3))}, "friction must be ≥ 0"),
        ({"friction": 0.1}, "friction > 0 needs D"),
        ({"friction": 0.1, "D": np.zeros((2, 3))}, "D must have shape (2m, n) = (4, 3)"),
        ({"stiffness": 0.0}, "stiffness must be > 0"),
    ],
)
def test_bad_input_is_refused_before_any_solver_sees_it(changes: dict[str, Any], message: str) -> None:
    problem_with()
    with pytest.raises(ProblemError) as refusal:
        problem_with(**changes)
    assert message in str(refusal.value)


# --- rulings on solvers that are spoiled on purpose ------------------------------------------------------------------

CRADLE = CATALOG["newtons-cradle"]()
WALLS = CATALOG["ball-between-walls"]()
QCE = QuadraticContactEnergy()


@dataclass(frozen=True)
class Spoiled:
    """QCE with its answer spoiled."""

    change: Callable[[ImpactProblem, ImpactSolution], ImpactSolution]

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        return self.change(problem, QCE.solve(problem))


def claimed(problem: ImpactProblem, impulse: Any, status: Status = Status.CONVERGED) -> ImpactSolution:
    """An answer whose velocity goes with its impulse."""
    return ImpactSolution(np.asarray(impulse, np.float64), problem.v_after(impulse), status, 1, problem.m, 0.0)


def impulse_of(solution: ImpactSolution) -> Any:
    assert solution.impulse is not None
    return solution.impulse


def plastic(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    return claimed(problem, project(problem, np.zeros(problem.m), tolerance=1e-13, max_sweeps=1000).impulse)


SPOILED: dict[str, tuple[Callable[[ImpactProblem, ImpactSolution], ImpactSolution], str]] = {
    "claims to be done and did nothing": (lambda p, s: claimed(p, np.zeros(p.m)), "converged but not feasible"),
    "pushes twice as hard": (lambda p, s: claimed(p, 2 * impulse_of(s)), "energy gained"),
    "pushes a millionth harder": (lambda p, s: claimed(p, (1 + 1e-6) * impulse_of(s)), "energy gained"),
    "is plastic where it should be elastic": (plastic, "energy lost"),
    "pulls": (lambda p, s: claimed(p, np.where(np.arange(p.m) == 1, -0.1, impulse_of(s))), "pulling impulse"),
    "moves what no impulse moved": (
        lambda p, s: ImpactSolution(s.impulse, s.v_post + 1e-9, Status.CONVERGED, 1, 1), "velocity from impulse",
    ),
    "loses momentum": (
        lambda p, s: ImpactSolution(None, 0.999 * s.v_post, Status.CONVERGED, 1, 1), "worst momentum drift",
    ),
    "returns NaN": (
        lambda p, s: ImpactSolution(impulse_of(s) * np.nan, s.v_post, Status.CONVERGED, 1, 1), "must be finite",
    ),
    "returns an infinite velocity": (
        lambda p, s: ImpactSolution(s.impulse, np.full(p.n, np.inf), Status.STALLED, 1, 1), "must be finite",
    ),
    "returns another shape": (
        lambda p, s: ImpactSolution(s.impulse, s.v_post[:-1], Status.CONVERGED, 1, 1), "must have shape",
    ),
    "met an infinity, by its own account": (
        lambda p, s: claimed(p, np.zeros(p.m), Status.NOT_FINITE), "NaN or an infinity",
    ),
    "gains energy and says that it stalled": (
        lambda p, s: claimed(p, 2 * impulse_of(s), Status.STALLED), "energy gained",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("change", "why"), SPOILED.values(), ids=SPOILED)
def test_a_solver_that_is_wrong_is_ruled_wrong_with_the_reason(change: Any, why: str) -> None:
    ruling = attempt(Spoiled(change), CRADLE)
    assert ruling.conduct is Conduct.WRONG
    assert why in ruling.reason
    assert attempt(QCE, CRADLE) == Ruling(Conduct.PASSED)


@pytest.mark.parametrize("start", ["separating", "together"])
def test_who_moves_anything_where_nothing_approaches_is_ruled_wrong(start: str) -> None:
    scene = CATALOG["long-chain"](balls=10, start=start)
    assert attempt(QCE, scene).conduct is Conduct.PASSED
    # Within every other gate: the largest velocity changes by 1e-14 and energy stays to rounding.
    nudge = Spoiled(lambda p, s: claimed(p, np.full(p.m, 1e-14)))
    ruling = attempt(nudge, scene)
    assert ruling.conduct is Conduct.WRONG
    assert "something happens where no contact approaches" in ruling.reason


def test_a_refusal_carries_its_reason() -> None:
    ruling = attempt(QCE, CATALOG["newtons-cradle"](restitution=0.5))
    assert ruling.conduct is Conduct.REFUSED
    assert "restitution must be 1" in ruling.reason


def test_a_stall_is_the_problems_where_no_motion_opens_the_contacts_and_the_solvers_elsewhere() -> None:
    few = QuadraticContactEnergy(max_iterations=2)
    jammed, open_ended = attempt(few, WALLS), attempt(few, CRADLE)
    assert jammed.conduct is open_ended.conduct is Conduct.STALLED
    assert jammed.natural
    assert "no motion opens all contacts" in jammed.reason
    assert not open_ended.natural
    assert "the solver's bound" in open_ended.reason
    assert "iteration limit after 2 iterations, 1.0e+00 of the approach is left" in open_ended.reason


def test_a_jammed_scene_excuses_no_lcp_and_no_plastic_impact() -> None:
    ring = CATALOG["ball-ring"](start="all")
    assert attempt(SOLVERS["lcp-pgs"](), ring).conduct is Conduct.PASSED
    one = CATALOG["ball-ring"](start="one")
    cut_off = attempt(limited("lcp-pgs", max_iterations=1), one)
    assert cut_off.conduct is Conduct.STALLED
    assert not cut_off.natural
    plastic_ring = CATALOG["ball-ring"](start="one", restitution=0.0)
    unfinished = attempt(limited("gauss-seidel", max_iterations=1), plastic_ring)
    assert unfinished.conduct is Conduct.STALLED
    assert not unfinished.natural


@dataclass(frozen=True)
class End:
    """How a task ended, by hand."""

    outcome: Outcome | None
    solver: str = "mine"
    reason: str = "as it was"
    status: str = ""
    iterations: int | None = None


@pytest.mark.parametrize(
    ("outcome", "conduct"),
    [
        (None, Conduct.OPEN),
        (Outcome.REFUSED, Conduct.REFUSED),
        (Outcome.INVALID, Conduct.WRONG),
        (Outcome.TIMED_OUT, Conduct.TIMED_OUT),
        (Outcome.RAISED, Conduct.CRASHED),
        (Outcome.CRASHED, Conduct.CRASHED),
        (Outcome.OUT_OF_MEMORY, Conduct.CRASHED),
    ],
)
def test_a_task_without_an_answer_is_ruled_by_its_end(outcome: Outcome | None, conduct: Conduct) -> None:
    ruling = rule(End(outcome), ())
    assert ruling.conduct is conduct
    assert ruling.reason == ("" if outcome is None else "as it was")


def test_every_end_of_a_task_has_a_ruling() -> None:
    for outcome in Outcome:
        for status in Status:
            assert isinstance(rule(End(outcome, status=status.label, iterations=1), ()).conduct, Conduct)


def test_a_measured_answer_without_a_certificate_is_not_excused() -> None:
    ruling = rule(End(Outcome.MEASURED, status="stalled", iterations=3), ())
    assert ruling.conduct is Conduct.STALLED
    assert not ruling.natural
    assert "not decided" in ruling.reason


# --- the certificate -------------------------------------------------------------------------------------------------


@every_cheap_case
def test_the_certificate_agrees_with_the_linear_program_and_the_tag(instance: Instance) -> None:
    scene = build(instance)
    if scene.problem.m == 0:
        return
    found = certificate(scene)
    assert found.interior == ("jammed" not in scene.tags)
    # The program is solved to 1e-7; the motion that was found beside it may be better by that.
    assert found.margin == pytest.approx(max(interior_margin(scene.problem), 0.0), abs=1e-6)


def test_a_motion_that_opens_all_contacts_is_a_proof_and_any_other_is_none() -> None:
    problem = CATALOG["long-chain"](balls=5).problem
    assert opening(problem, np.linspace(-3.0, 3.0, 5)) == pytest.approx(0.5 / math.sqrt(2))
    assert opening(problem, np.zeros(5)) == -math.inf
    assert opening(problem, np.full(5, np.nan)) == -math.inf
    assert opening(problem, np.array([0.0, 1.0, 0.5, 2.0, 3.0])) < 0


def test_a_chain_of_a_hundred_thousand_balls_is_proven_open_without_a_linear_program() -> None:
    found = certificate(CATALOG["long-chain"](balls=100_000))
    # The best motion opens each of the 99,999 contacts by √2 / 99,999; this one by most of it.
    best = math.sqrt(2) / 99_999
    assert found.interior
    assert 0.9 * best <= found.margin <= best * (1 + 1e-9)
    assert "lower bound" in found.how


def test_a_wedge_far_narrower_than_the_program_resolves_is_still_open() -> None:
    # The upright motion opens both planes by sin(angle / 2) = 5e-9; the linear program alone would call it jammed.
    found = certificate(CATALOG["ball-in-wedge"](angle=1e-8, normals="opposed"))
    assert found.interior
    assert found.margin == pytest.approx(5e-9, rel=1e-2)


def test_the_certificate_is_left_open_where_the_program_is_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.hard_cases.LARGEST_PROGRAM", 10)
    scene = CATALOG["jammed-box"](rows=2, columns=4)
    assert certificate(scene).interior is None
    margin, left = ending_scores(scene, limited("qce", max_iterations=1).solve(scene.problem))
    assert margin.verdict is Verdict.NOT_APPLICABLE
    assert left.value > 0


# --- the run and the table -------------------------------------------------------------------------------------------

BREAKERS = """
    class Loops:
        def solve(self, problem):
            while True:
                pass

    class Dies:
        def solve(self, problem):
            os._exit(3)

    class Raises:
        def solve(self, problem):
            raise ArithmeticError("the wheel came off")

    class NotANumber:
        def solve(self, problem):
            return ImpactSolution(np.zeros(problem.m), problem.v_pre * np.nan, Status.CONVERGED, 1, 1)

    class Idle:
        def solve(self, problem):
            return ImpactSolution(np.zeros(problem.m), problem.v_pre.copy(), Status.CONVERGED, 1, 1)
"""
TRIED = (
    ScenarioChoice("three-ball-chain", {"va": 1e-16}, exact=True),
    ScenarioChoice("long-chain", {"balls": 1}, exact=True),
)
# Far more than any of these solvers asks for, except the one that never ends.
PATIENT = Limits(timeout_s=100.0, memory_mb=1024.0)
# A hung solver costs the test this long.
IMPATIENT = Limits(timeout_s=2.0, memory_mb=1024.0)


def run_hard(folder: Path, specifications: list[str], scenes: tuple[ScenarioChoice, ...], limits: Limits) -> Path:
    """Measure hard cases in child processes."""
    plan = plan_tasks([choose_solver(name) for name in specifications], tier=HARD, scenarios=scenes)
    assert {planned.task.kind for planned in plan} == {Kind.HARD_CASE}
    measure(
        folder, plan, tier=HARD, seed=0, jobs=1, limits=limits, command="test", on_progress=lambda progress: None
    )  # fmt: skip
    return folder


def conducts(case: Case) -> dict[str, Conduct]:
    """Class or name of each solver → what it came to."""
    return {solver.rpartition(":")[2]: ruling.conduct for solver, ruling in case.rulings.items()}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory, write_solver: Callable[[Path, str], Path]) -> Path:
    folder = tmp_path_factory.mktemp("hard")
    path = write_solver(folder, BREAKERS)
    breakers = [f"{path}:{law}" for law in ("Dies", "Raises", "NotANumber", "Idle")]
    return run_hard(folder, ["qce", *breakers], TRIED, PATIENT)


def test_the_table_rules_what_child_processes_came_to(measured: Path) -> None:
    with Store.open(measured) as store:
        table = hard_table(store)
    chain, single = table.cases[0], table.cases[-1]
    assert chain.label == "three-ball-chain(va=1e-16)"
    assert chain.chapter == "disturbances from 1e-16 to 1e-1"
    assert conducts(chain) == {
        "qce": Conduct.PASSED, "Dies": Conduct.CRASHED, "Raises": Conduct.CRASHED, "NotANumber": Conduct.WRONG,
        "Idle": Conduct.WRONG,
    }  # fmt: skip
    # One ball without a contact: who does nothing is right.
    assert conducts(single) == conducts(chain) | {"Idle": Conduct.PASSED}
    assert table.missing == len(TIERS[HARD]) - 2
    assert len(table.faults()) == 7


def test_a_solver_that_never_ends_is_timed_out(tmp_path: Path, user_file: Callable[[str], Path]) -> None:
    path = user_file(BREAKERS)
    with Store.open(run_hard(tmp_path, [f"{path}:Loops"], TRIED[-1:], IMPATIENT)) as store:
        (case,) = hard_table(store).cases
    assert conducts(case) == {"Loops": Conduct.TIMED_OUT}
    assert "killed at the time limit of 2 s" in case.rulings[f"{path}:Loops"].reason


def test_terminal_markdown_and_csv_say_the_same(measured: Path, tmp_path: Path) -> None:
    with Store.open(measured) as store:
        table = hard_table(store)
        files = write_hard_cases(store, tmp_path)
        again = [path.read_bytes() for path in write_hard_cases(store, tmp_path)]
    assert [path.name for path in files] == ["hard_cases.md", "hard_cases.csv"]
    assert [path.read_bytes() for path in files] == again
    page = files[0].read_text()
    assert page == hard_cases_markdown(table)
    assert "Incomplete" in page
    assert "the wheel came off" in page
    assert "exit code 3" in page
    lines = hard_cases_csv(table).splitlines()
    assert len(lines) == 1 + 2 * 5
    assert sum(",wrong," in line for line in lines) == 3
    shown_text = StringIO()
    render_terminal(table, Console(file=shown_text, width=160))
    assert "Wrong, timed out or crashed: 7" in shown_text.getvalue()


def test_a_store_without_hard_cases_has_no_table_and_no_files(tmp_path: Path) -> None:
    store = HandmadeStore()
    store.all_six("qce")
    table = hard_table(store)
    assert table.cases == ()
    assert table.missing == len(TIERS[HARD])
    assert write_hard_cases(store, tmp_path) == []
    assert list(tmp_path.iterdir()) == []
    text = StringIO()
    render_terminal(table, Console(file=text))
    assert text.getvalue() == ""


def test_what_was_planned_and_not_measured_is_not_done_and_never_passed() -> None:
    store = HandmadeStore()
    store.task("qce", "long-chain", kind="hard case", outcome=None, parameters={"balls": 1})
    store.task("gr", "long-chain", kind="hard case", parameters={"balls": 1})
    table = hard_table(store)
    assert table.solvers == ("gr", "qce")
    assert table.cases[0].rulings == {"qce": Ruling(Conduct.OPEN), "gr": Ruling(Conduct.PASSED)}
    assert "1 planned tasks are not done" in hard_cases_markdown(table)


def test_the_table_reads_the_rows_and_nothing_else() -> None:
    def ruled(verdict: Verdict, value: float) -> Conduct:
        store = HandmadeStore()
        task = store.task("qce", "long-chain", kind="hard case", parameters={"balls": 1})
        store.score(task, "KIN", value, metric="energy gained", verdict=verdict.value)
        return hard_table(store).cases[0].rulings["qce"].conduct

    assert ruled(Verdict.PASS, 1e-15) is Conduct.PASSED
    assert ruled(Verdict.FAIL, 1e-3) is Conduct.WRONG
    assert ruled(Verdict.NOT_APPLICABLE, math.nan) is Conduct.PASSED


def test_counts_add_up_to_the_cases() -> None:
    rulings = {"qce": Ruling(Conduct.STALLED, "", natural=True)}
    case = Case("mass ratios to 1e12", "scene", 0.0, False, {}, rulings)
    table = HardTable(("qce",), (case, case), 0)
    assert table.counts("qce") == {Conduct.STALLED: 2}
    assert table.faults() == ()


def test_fresh_scores_and_stored_rows_are_ruled_alike() -> None:
    end = End(Outcome.MEASURED, status="converged", iterations=1)
    good = shown("termination", "approach left", 0.0)
    bad = Score("MOM", "worst momentum drift", math.nan, Verdict.FAIL, 1e-12)
    assert rule(end, (good,)).conduct is Conduct.PASSED
    assert rule(end, (good, bad)).conduct is Conduct.WRONG


def test_a_certificate_says_how_it_was_found() -> None:
    assert certificate(WALLS) == Certificate(0.0, False, "linear program")

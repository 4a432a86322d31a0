"""Hard cases: what a solver came to on each, ruled from the stored rows alone; and whose a stall is.

    passed    it says that it converged, and every check of the harness holds
    refused   the law says that it does not apply, and why
    stalled   it reached its own bound, says so, and what it returned breaks nothing that holds for every iterate
    wrong     it says that it converged and did not; or energy gained, a pull, momentum lost, NaN, a velocity that is
              not its impulses', whatever it says
    timed out, crashed

The certificate: if one motion opens all contacts at once (interior margin > 0), the impulses of every elastic law are
bounded and its iteration has an end (Vouga 2017; Gordan's alternative). Without one it may go on for ever,
and a solver that stops at its bound and says so has done what can be done. This excuses elastic iterations alone: an
LCP has a solution on every scene, and so has any law where nothing is restituted.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from harness import accuracy, desiderata
from harness.checked import HONESTY_TOLERANCE, checked_solve, claim, remaining_approach, termination
from harness.measurement import InvalidSolution, Measurement, Outcome, Score, Verdict, not_applicable, shown
from scenarios.hard import IDENTITY, NOTHING_HAPPENS
from scenarios.jammed import INTERIOR_TOLERANCE, interior_margin
from scenarios.scenario import Scenario
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Solver, Status, UnsupportedProblem
from solvers.solution import Floats

MARGIN = "interior margin"
"""Metric of the certificate, under "termination"."""
LEFT = "approach left"
"""Metric of the fastest approach that is left, whatever the solver says, under "termination"."""

# The linear program takes about a second at so many contacts of a pack; its time grows faster than their number.
PROGRAM_CONTACTS = 2_000
# A pack of 12,189 contacts took 18 s, once a process; above this many the certificate is left open.
LARGEST_PROGRAM = 15_000
# J c of a motion c with |c| ≤ 1 is a sum of few products: what exceeds its rounding by so much is really > 0.
PROOF_TOLERANCE = 1e-12
# Added to the unit diagonal of J Jᵀ where contacts depend on one another; it costs the motion as many digits.
REGULARIZATION = 1e-10

_KNOWN: dict[bytes, Certificate] = {}

ITERATE_CHECKS = (
    ("KIN", "energy gained"),
    ("MOM", "worst momentum drift"),
    ("ONE", "pulling impulse"),
    ("claim", "velocity from impulse"),
)
"""What must hold for every answer, whatever its status says: (name, metric) of gated rows."""

CONVERGED_CHECKS = (
    ("claim", "converged but not feasible"),
    ("KIN", "energy lost"),
)
"""What must hold besides where the solver says that it converged."""

LCP_PREFIX = "lcp-"
"""How the names of laws begin that solve one LCP and iterate no elastic impacts."""


class Conduct(Enum):
    """What a solver came to on a hard case."""

    PASSED = "passed"
    REFUSED = "refused"
    STALLED = "stalled"
    WRONG = "wrong"
    TIMED_OUT = "timed out"
    CRASHED = "crashed"
    OPEN = "not done"
    """Planned and not measured yet."""


@dataclass(frozen=True)
class Ruling:
    """What a solver came to on a hard case, and why."""

    conduct: Conduct
    reason: str = ""
    """Empty where it passed."""
    natural: bool = False
    """True for a stall that the certificate puts down to the problem: no motion opens all contacts."""


@dataclass(frozen=True)
class Certificate:
    """Whether one motion opens all contacts of a scene."""

    margin: float
    """Largest t with J c ≥ t and |c| ≤ 1, rows of J of unit length; NaN where it is not known."""
    interior: bool | None
    """True: it opens them; False: none does, the scene is jammed; None: not decided."""
    how: str
    """How the margin was found."""


class TaskEnd(Protocol):
    """What a ruling reads of a task."""

    @property
    def solver(self) -> str:
        """The solver's specification."""

    @property
    def outcome(self) -> Outcome | None:
        """How it ended; None while it is planned."""

    @property
    def reason(self) -> str:
        """Why, where it was not measured."""

    @property
    def status(self) -> str:
        """The solver's own status label."""

    @property
    def iterations(self) -> int | None:
        """Iterations of the solver."""


class Row(Protocol):
    """What a ruling reads of a score, stored or fresh."""

    @property
    def name(self) -> str:
        """Name of the score."""

    @property
    def metric(self) -> str:
        """Which number."""

    @property
    def value(self) -> float:
        """The number."""

    @property
    def tolerance(self) -> float:
        """Its bound."""

    @property
    def verdict(self) -> Verdict:
        """What the bound says."""

    @property
    def detail(self) -> Mapping[str, object]:
        """Particulars."""


def rule(task: TaskEnd, rows: Sequence[Row]) -> Ruling:
    """Rule what a solver came to on one scene, from its row of the tasks and its rows of the scores.

    Args:
        task: how the task ended.
        rows: all that it measured.
    """
    if task.outcome is None:
        return Ruling(Conduct.OPEN)
    if task.outcome is not Outcome.MEASURED:
        return Ruling(_CONDUCT_OF[task.outcome], task.reason)
    faults = [*_faults(rows, task.status)]
    if faults:
        return Ruling(Conduct.WRONG, f"says {task.status}; " + "; ".join(faults))
    if task.status == Status.CONVERGED.label:
        return Ruling(Conduct.PASSED)
    if task.status == Status.UNSUPPORTED.label:
        return Ruling(Conduct.REFUSED, "status unsupported")
    return _stall(task, rows)


_CONDUCT_OF = {
    Outcome.REFUSED: Conduct.REFUSED,
    Outcome.INVALID: Conduct.WRONG,
    Outcome.TIMED_OUT: Conduct.TIMED_OUT,
    # An exception breaks the contract as a dead process does: a hard problem must have an answer.
    Outcome.RAISED: Conduct.CRASHED,
    Outcome.CRASHED: Conduct.CRASHED,
    Outcome.OUT_OF_MEMORY: Conduct.CRASHED,
}


def _faults(rows: Sequence[Row], status: str) -> Iterator[str]:
    """Say what is wrong with an answer."""
    converged = status == Status.CONVERGED.label
    checks = ITERATE_CHECKS + (CONVERGED_CHECKS if converged else ())
    for row in rows:
        if (row.name, row.metric) in checks and row.verdict is Verdict.FAIL:
            yield f"{row.metric} {row.value:.1e}, bound {row.tolerance:.0e}"
        elif row.name == "error" and row.metric.endswith(NOTHING_HAPPENS) and row.value != 0.0:
            yield f"something happens where no contact approaches: {row.value:.1e}"
    if status == Status.NOT_FINITE.label:
        yield Status.NOT_FINITE.happened


def _stall(task: TaskEnd, rows: Sequence[Row]) -> Ruling:
    """Say how far an honest stall came, and whose it is."""
    found = {row.metric: row for row in rows if row.name == "termination"}
    left = ""
    if LEFT in found:
        some = found[LEFT].value > HONESTY_TOLERANCE
        left = f", {found[LEFT].value:.1e} of the approach is left" if some else ", no approach is left"
    ended = f"{task.status} after {task.iterations} iterations{left}"
    detail = found[MARGIN].detail if MARGIN in found else {}
    if detail.get("interior") is None:
        return Ruling(Conduct.STALLED, f"{ended}; whose stall it is was not decided")
    if detail["interior"]:
        margin = f"margin {found[MARGIN].value:.1e}, an elastic iteration has an end"
        return Ruling(Conduct.STALLED, f"{ended}; the solver's bound: {margin}")
    if not detail.get("elastic") or task.solver.startswith(LCP_PREFIX):
        return Ruling(Conduct.STALLED, f"{ended}; the solver's bound: no elastic iteration is needed here")
    return Ruling(Conduct.STALLED, f"{ended}; the problem's nature: no motion opens all contacts", natural=True)


@dataclass(frozen=True)
class _Attempt:
    """How one solve ended, as a ruling reads it."""

    solver: str
    outcome: Outcome
    reason: str = ""
    status: str = ""
    iterations: int | None = None


def measure_hard_case(solver: Solver, scenario: Scenario) -> Measurement:
    """Measure what a ruling reads: one solve of one scene and its checks, no variants of it.

    The limit of time is thus that of one solve, and a time-out is the solver's.

    Raises:
        UnsupportedProblem: the solver refuses the scene.
        InvalidSolution: its answer breaks the contract.
    """
    problem = scenario.problem
    solution = checked_solve(solver, problem)
    scores = [
        *desiderata.kin(problem, solution.v_post),
        desiderata.mom(problem, solution.v_post, scenario.invariants),
        *desiderata.one(problem, solution, tags=scenario.tags),
        *claim(problem, solution),
        *termination(solution, tags=scenario.tags),
        *ending_scores(scenario, solution),
    ]
    if IDENTITY in scenario.tags:
        scores += accuracy.validation(problem, solution.v_post, scenario.references)
    return Measurement(solution.status.label, int(solution.iterations), int(solution.visits), tuple(scores))


def attempt(solver: Solver, scenario: Scenario) -> Ruling:
    """Try one solver on one scene in this process, and rule as the rows of a run are ruled.

    In a run the process is bounded in time and memory; here it is not.

    Raises:
        Exception: whatever the solver raises, but `UnsupportedProblem`.
    """
    name = next((name for name, law in SOLVERS.items() if type(solver) is law), "")
    try:
        measured = measure_hard_case(solver, scenario)
    except UnsupportedProblem as refusal:
        return rule(_Attempt(name, Outcome.REFUSED, str(refusal)), ())
    except InvalidSolution as broken:
        return rule(_Attempt(name, Outcome.INVALID, str(broken)), ())
    return rule(_Attempt(name, Outcome.MEASURED, "", measured.status, measured.iterations), measured.scores)


def ending_scores(scenario: Scenario, solution: ImpactSolution) -> tuple[Score, ...]:
    """Rows that say whose a stall is: the scene's certificate, and what the solver left approaching; neither gates."""
    left = shown("termination", LEFT, remaining_approach(scenario.problem, solution.v_post))
    if scenario.problem.m == 0:
        return not_applicable("termination", MARGIN, "there is no contact"), left
    found = certificate(scenario)
    detail = {"interior": found.interior, "elastic": bool(scenario.problem.restitution.any()), "how": found.how}
    if math.isnan(found.margin):
        return not_applicable("termination", MARGIN, found.how), left
    return shown("termination", MARGIN, found.margin, detail=detail), left


def certificate(scenario: Scenario) -> Certificate:
    """Decide whether one motion opens all contacts of a scene: by one linear program, or by showing such a motion.

    Computed once for the same contacts within a process: a scene meets all solvers one after the other.

    Args:
        scenario: a scene with contacts.
    """
    J = scenario.problem.J
    content = hashlib.sha256(b"".join(part.tobytes() for part in (J.indptr, J.indices, J.data))).digest()
    if content not in _KNOWN:
        _KNOWN[content] = _certificate(scenario)
    return _KNOWN[content]


def _certificate(scenario: Scenario) -> Certificate:
    """The certificate, computed."""
    problem = scenario.problem
    bound = max((opening(problem, c) for c in _motions(scenario)), default=-math.inf)
    proven = bound > PROOF_TOLERANCE
    if proven and problem.m > PROGRAM_CONTACTS:
        return Certificate(bound, True, "a motion that opens all contacts: a lower bound")
    if problem.m > LARGEST_PROGRAM:
        return Certificate(math.nan, None, f"not decided: {problem.m} contacts are too many for the linear program")
    try:
        margin = interior_margin(problem)
    except ArithmeticError as error:
        return Certificate(bound, True, "a motion") if proven else Certificate(math.nan, None, str(error))
    # The motion that stands still opens nothing: no margin is below 0.
    return Certificate(max(0.0, margin, bound), proven or margin > INTERIOR_TOLERANCE, "linear program")


def opening(problem: ImpactProblem, motion: Floats) -> float:
    """Slowest opening of any contact under a motion c, shape (n,), scaled to |c| = 1; rows of J have unit length.

    A positive number proves that the interior margin is at least as large.
    """
    largest = float(np.abs(motion).max(initial=0.0))
    if not (np.isfinite(motion).all() and largest > 0.0):
        return -math.inf
    return float((problem.J @ (motion / largest) / _row_lengths(problem)).min())


def _motions(scenario: Scenario) -> Iterator[Floats]:
    """Motions that open many scenes: the shortest with J c = 1, and growth of the scene about its lowest point."""
    problem = scenario.problem
    rows = sp.csr_array(sp.diags_array(1.0 / _row_lengths(problem)) @ problem.J)
    gram = sp.csc_array(rows @ rows.T + REGULARIZATION * sp.eye_array(problem.m))
    if gram.nnz <= 10 * problem.m:
        # Few neighbors each, as in chains: the factors stay sparse.
        yield rows.T @ splu(gram).solve(np.ones(problem.m))
    centers = scenario.positions
    if centers is not None and centers.size == problem.n:
        lowest = centers.mean(axis=0)
        lowest[-1] = centers[:, -1].min() - 1e-3 * float(np.ptp(centers, axis=0).max())
        yield (centers - lowest).ravel()


def _row_lengths(problem: ImpactProblem) -> Floats:
    lengths: Floats = np.sqrt(np.asarray(problem.J.multiply(problem.J).sum(axis=1), dtype=np.float64)).reshape(-1)
    return lengths

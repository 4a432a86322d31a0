"""The conformance kit: the numbered contract of `solvers.Solver`, tried on a few small problems.

    check_solver(MySolver())                              one call; AssertionError names the point that is broken

    from harness.conformance import parametrize_with_checks

    @parametrize_with_checks([MySolver()])                one test for each point and problem, in your own suite
    def test_my_solver_keeps_the_contract(check):
        check()

In the spirit of scikit-learn's `check_estimator`. It judges the contract, not the law: a bad law that is honest passes.
It needs no network, no store and no child process; hence a solver that never ends hangs here (`impactbench run` kills
it and says so). Every message has the point of the contract, the problem, and the number.
"""

from __future__ import annotations

import copy
import dataclasses
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import scipy.sparse as sp

from harness.checked import CLAIM_TOLERANCE, HONESTY_TOLERANCE, checked_solve, claim, ratio, velocity_mismatch
from harness.measurement import InvalidSolution
from harness.metamorphic import LARGE, in_units
from harness.selection import setting_fields
from harness.warm_start import Started, takes_start
from scenarios import CATALOG
from solvers import ImpactProblem, ImpactSolution, Solver, Status, UnsupportedProblem
from solvers.solution import Floats

if TYPE_CHECKING:
    import pytest

POINTS = {
    1: "settings",
    2: "no side effects",
    3: "answer",
    4: "nothing approaches",
    5: "units",
    6: "bounded and honest",
    7: "refusal",
    8: "counts",
    9: "start",
}
"""Point of the contract in `solvers.Solver` → what it is about."""

# Units are changed by a power of two, which rounds nothing: only tolerances in absolute units and functions like powers
# and roots, amplified by the conditioning of the law, leave a difference.
UNIT_TOLERANCE = 1e-9
# A solver that ignores a restitution of 0 or 0.5 is off by at least 0.5 of the approach; half of that is between.
RESTITUTION_TOLERANCE = 0.25
# Two answers that both meet a solver's tolerance, which is relative to the approach and far below this.
START_TOLERANCE = 1e-6
# Slip that is left over the slip before, above which a contact slides; friction must oppose what slides.
SLIDING = 1e-6
# Random problems of the kit are the same for everyone.
SEED = 20150
# What solvers raise instead of a status; anything else passes through with a note.
RAISED = (
    ArithmeticError, AssertionError, AttributeError, LookupError, NameError, RuntimeError, TypeError, ValueError,
    Warning,
)  # fmt: skip
# Arrays of a problem that a solver could write to.
TAMPERED = ("J", "W", "JM", "JT", "MJT", "inverse_mass")
TAMPERED_VECTORS = ("v_pre", "u_pre", "restitution", "friction", "stiffness", "tangential_restitution", "W_diagonal")


def check_solver(solver: Solver) -> None:
    """Try every point of the contract on every problem of the kit.

    Args:
        solver: an instance, with default or other settings.

    Raises:
        AssertionError: a point of the contract is broken; the text names the point, the problem and the number.
    """
    for _, check in solver_checks(solver):
        check()


def solver_checks(solver: Solver) -> Iterator[tuple[str, Callable[[], None]]]:
    """Yield every check with its name, "5 units: chain of five"; a check takes nothing and raises AssertionError."""
    yield _name(1, "the class"), partial(check_settings, solver)
    elastic = elastic_problems()
    yield _name(2, "one problem between others"), partial(check_no_memory, solver, elastic)
    every = elastic | jammed_problems() | special_problems()
    for name, problem in every.items():
        yield _name(3, name), partial(check_answer, solver, name, problem)
    for name, problem in elastic.items():
        yield _name(1, name), partial(check_equal_settings_give_equal_bits, solver, name, problem)
        yield _name(2, name), partial(check_no_side_effects, solver, name, problem)
        at_rest = problem.replace(v_pre=np.zeros(problem.n))
        yield _name(4, f"{name}, at rest"), partial(check_nothing_happens, solver, f"{name}, at rest", at_rest)
        yield _name(5, name), partial(check_units, solver, name, problem)
        if takes_start(solver):
            yield _name(9, name), partial(check_start, solver, name, problem)
    for name, problem in idle_problems().items():
        yield _name(4, name), partial(check_nothing_happens, solver, name, problem)
    for name, problem in every.items():
        yield _name(6, name), partial(check_honesty, solver, name, problem)
        yield _name(6, f"{name}, bounds of 1"), partial(check_bounds, solver, name, problem)
        yield _name(8, name), partial(check_counts, solver, name, problem)
    for restitution in (0.0, 0.5, 1.0):
        yield _name(7, f"one ball, restitution {restitution:g}"), partial(check_restitution, solver, restitution)
    yield _name(7, "sliding ball, friction 0.5"), partial(check_friction, solver)
    yield _name(7, "ball that sticks, tangential restitution 0.5"), partial(check_tangential_restitution, solver)
    yield _name(7, "all elastic problems"), partial(check_applies_to_something, solver, elastic)


def parametrize_with_checks(solvers: Sequence[Solver]) -> pytest.MarkDecorator:
    """Decorate a pytest function with an argument `check`: it becomes one test for each solver, point and problem.

    Args:
        solvers: instances.
    """
    import pytest

    cases = [(type(solver).__name__, name, check) for solver in solvers for name, check in solver_checks(solver)]
    names = [f"{law}: {name}" for law, name, _ in cases]
    return pytest.mark.parametrize("check", [check for *_, check in cases], ids=names)


def elastic_problems() -> dict[str, ImpactProblem]:
    """Small elastic frictionless problems, name → problem."""
    rng = np.random.default_rng(SEED)
    scenes = {
        "three balls": CATALOG["three-ball-chain"](va=0.5),
        "cradle of five": CATALOG["newtons-cradle"](balls=5),
        "striker into two discs": CATALOG["bernoulli"](),
        "box on four points": CATALOG["box-on-floor"](points=4, spin=[0.3, 0.2, 0.0]),
    }
    return {
        **{name: scene.problem for name, scene in scenes.items()},
        "chain of five": _chain(rng, 5),
        "mass ratio of a million": ImpactProblem([1e-6, 1.0, 1e6], _rows(3), [1.0, 0.0, -0.3]),
        "random Jacobian": _random_jacobian(rng),
    }


def jammed_problems() -> dict[str, ImpactProblem]:
    """Elastic problems on which no elastic iteration need end: a solver must end all the same, and say so."""
    return {"ball between walls": CATALOG["ball-between-walls"]().problem}


def idle_problems() -> dict[str, ImpactProblem]:
    """Problems in which nothing happens."""
    rng = np.random.default_rng(SEED)
    return {
        "no contact": ImpactProblem([1.0, 2.0], sp.csr_array((0, 2)), [1.0, -1.0]),
        "all contacts separate": ImpactProblem([1.0, 2.0, 3.0, 4.0], _rows(4), np.sort(rng.normal(size=4))),
        "all contacts rest": ImpactProblem(np.ones(4), _rows(4), np.full(4, 0.7)),
        "all separate, inelastic": ImpactProblem(np.ones(3), _rows(3), [-1.0, 0.0, 1.0], restitution=0.0),
    }


def special_problems() -> dict[str, ImpactProblem]:
    """Problems that a law may refuse, and must not answer wrongly."""
    J, v_pre = _rows(4), [1.0, 0.2, -0.1, -1.0]
    disc = CATALOG["bernoulli"](friction=0.3).problem
    return {
        "inelastic": ImpactProblem(np.ones(4), J, v_pre, restitution=0.0),
        "restitution of one half": ImpactProblem(np.ones(4), J, v_pre, restitution=0.5),
        "restitution for each contact": ImpactProblem(np.ones(4), J, v_pre, restitution=[0.2, 0.9, 0.5]),
        "stiffness for each contact": ImpactProblem(np.ones(4), J, v_pre, stiffness=[1.0, 10.0, 0.1]),
        "friction": disc,
        "friction and restitution": disc.replace(restitution=0.5),
        "friction and tangential restitution": disc.replace(tangential_restitution=0.5),
    }


def check_settings(solver: Solver) -> None:
    """Point 1: a frozen dataclass, every setting with a default."""
    law: Any = type(solver)
    if not dataclasses.is_dataclass(solver):
        _broken(1, "the class", f"{law.__name__} is no dataclass: its settings must be fields")
    if not law.__dataclass_params__.frozen:
        _broken(1, "the class", f"{law.__name__} is not frozen: use @dataclass(frozen=True)")
    for entry in dataclasses.fields(law):
        if entry.init and entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING:
            _broken(1, "the class", f"the setting {entry.name} has no default: {law.__name__}() must work")
    if law() != law():
        _broken(1, "the class", f"two {law.__name__}() are not equal: a setting has no equality")


def check_equal_settings_give_equal_bits(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 1: a second instance with equal settings gives the same answer, bit for bit."""
    first, second = _solve(solver, 1, name, problem), _solve(copy.deepcopy(solver), 1, name, problem)
    if first is None or second is None:
        if first is not second:
            _broken(1, name, "one of two equal instances refuses, the other answers")
        return
    _require_same_bits(1, name, first, second, "two equal instances")


def check_no_side_effects(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 2: the problem is as it was, and global random numbers are neither used nor changed."""
    before = _fingerprint(problem)
    states = np.random.get_state(), random.getstate()  # noqa: NPY002  it is the global generator that is watched
    first = _solve(solver, 2, name, problem)
    changed = [field for field, bits in _fingerprint(problem).items() if bits != before[field]]
    if changed:
        _broken(2, name, f"solve changed the problem: {', '.join(changed)}")
    after = np.random.get_state(), random.getstate()  # noqa: NPY002
    if not (_equal_states(states[0], after[0]) and states[1] == after[1]):
        _broken(2, name, "solve draws from a global random generator; take a seed as a setting instead")
    second = _solve(solver, 2, name, problem)
    if first is not None and second is not None:
        _require_same_bits(2, name, first, second, "the first and the second solve of one instance")


def check_no_memory(solver: Solver, problems: Mapping[str, ImpactProblem]) -> None:
    """Point 2: what was solved between does not show in the answer."""
    name, problem = next(iter(problems.items()))
    before, first = _solve(solver, 1, name, problem), _solve(solver, 1, name, problem)
    if before is not None and first is not None:
        _require_same_bits(1, name, before, first, "two solves of one instance, one after the other")
    for other, between in problems.items():
        _solve(solver, 2, other, between)
        again = _solve(solver, 2, name, problem)
        if first is not None and again is not None:
            _require_same_bits(2, name, first, again, f"before and after solving {other!r}")


def check_answer(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 3: shapes, finite numbers, and the velocity that goes with the impulses."""
    solution = _solve(solver, 3, name, problem)
    if solution is None:
        return
    if problem.has_friction and solution.friction_impulse is None and solution.impulse is not None:
        _broken(3, name, f"friction_impulse must have shape (2m,) = ({2 * problem.m},) where friction > 0, not None")
    mismatch = velocity_mismatch(problem, solution)
    # NaN where the solver gives no impulse (physics engines).
    if mismatch > CLAIM_TOLERANCE:
        _broken(
            3, name, f"v_post differs from v_pre + M⁻¹(Jᵀ impulse + Dᵀ friction_impulse) by {mismatch:.3g} of the sum "
            f"(allowed {CLAIM_TOLERANCE:g}); `problem.v_after(impulse)` computes it",
        )  # fmt: skip


def check_nothing_happens(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 4: where no contact approaches, the impulse is zero and the velocity the same."""
    solution = _solve(solver, 4, name, problem)
    if solution is None:
        return
    if solution.impulse is not None and solution.impulse.any():
        largest = float(np.abs(solution.impulse).max())
        _broken(4, name, f"no contact approaches, and the largest impulse is {largest:.3g}, not 0")
    change = float(np.abs(solution.v_post - problem.v_pre).max(initial=0.0))
    if change:
        _broken(4, name, f"no contact approaches, and v_post differs from v_pre by {change:.3g}, not 0")
    if solution.status is not Status.CONVERGED:
        _broken(4, name, f"no contact approaches: nothing is left to do, and the status is {solution.status}")


def check_units(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 5: other units of mass, speed and length change nothing."""
    plain = _solve(solver, 5, name, problem)
    if plain is None:
        return
    scale = float(np.abs(problem.v_pre).max(initial=0.0))
    for unit in ("mass", "speed", "gap"):
        for factor in (LARGE, 1 / LARGE):
            image = _solve(solver, 5, f"{name}, {unit} × {factor:.0e}", in_units(problem, **{unit: factor}))
            if image is None:
                _broken(5, name, f"{unit} × {factor:.0e} is refused, and the problem itself is not")
            v_post = image.v_post / factor if unit == "speed" else image.v_post
            difference = ratio(float(np.abs(v_post - plain.v_post).max(initial=0.0)), scale)
            if not difference <= UNIT_TOLERANCE:
                what = f"{unit} × {factor:.0e} changes v_post by {difference:.3g} of the largest |v_pre|"
                _broken(5, name, f"{what} (allowed {UNIT_TOLERANCE:g}): a tolerance is absolute")


def check_honesty(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 6: it does not raise, and what it calls converged is feasible."""
    solution = _solve(solver, 6, name, problem)
    if solution is not None:
        _require_honest(name, problem, solution)


def check_bounds(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 6: at a bound of 1 (every setting that begins with "max_") it returns what it has, and says so."""
    for setting in setting_fields(type(solver)):
        if not setting.startswith("max_") or type(getattr(solver, setting)) is not int:
            continue
        bounded = copy.copy(solver)
        # As `dataclasses.replace` does, also for a class whose __init__ is its own.
        object.__setattr__(bounded, setting, 1)
        where = f"{name}, {setting} = 1"
        solution = _solve(bounded, 6, where, problem)
        if solution is not None:
            _require_honest(where, problem, solution)


def check_restitution(solver: Solver, restitution: float) -> None:
    """Point 7: a restitution is answered or refused, never ignored: one ball leaves the wall at c_r times its speed."""
    name = f"one ball, restitution {restitution:g}"
    problem = ImpactProblem([1.0], [[1.0]], [-1.0], restitution=restitution)
    solution = _solve(solver, 7, name, problem)
    if solution is None or solution.status is not Status.CONVERGED:
        return
    error = abs(float(solution.v_post[0]) - restitution)
    if not error <= RESTITUTION_TOLERANCE:
        _broken(
            7, name, f"the ball leaves at {solution.v_post[0]:.3g} of its speed: a law without this restitution must "
            "refuse it",
        )  # fmt: skip


def check_friction(solver: Solver) -> None:
    """Point 7: friction is answered or refused, never ignored: what slides is held back."""
    name = "sliding ball, friction 0.5"
    problem = ImpactProblem(np.ones(3), [[0.0, 0.0, 1.0]], [3.0, 0.0, -1.0], 1.0, 0.5, [[1, 0, 0], [0, 1, 0]])
    solution = _solve(solver, 7, name, problem)
    if solution is None or solution.status is not Status.CONVERGED:
        return
    if not solution.v_post[0] <= 3.0 * (1.0 - SLIDING):
        _broken(7, name, "the ball slides as fast as before: a law without friction must refuse friction > 0")


def check_tangential_restitution(solver: Solver) -> None:
    """Point 7: a tangential restitution is answered or refused, never ignored: what sticks parts with its share."""
    name, share = "ball that sticks, tangential restitution 0.5", 0.5
    J, D, v_pre = [[0.0, 0.0, 1.0]], [[1, 0, 0], [0, 1, 0]], [1.0, 0.0, -1.0]
    problem = ImpactProblem(np.ones(3), J, v_pre, 1.0, friction=2.0, D=D, tangential_restitution=share)
    solution = _solve(solver, 7, name, problem)
    if solution is None or solution.status is not Status.CONVERGED:
        return
    error = abs(float(solution.v_post[0]) + share)
    if not error <= RESTITUTION_TOLERANCE:
        _broken(
            7, name, f"it slides at {solution.v_post[0]:.3g}, not {-share:g}: a law without tangential "
            "restitution must refuse it",
        )  # fmt: skip


def check_applies_to_something(solver: Solver, problems: Mapping[str, ImpactProblem]) -> None:
    """Point 7: a law that refuses every elastic frictionless problem cannot be checked."""
    if all(_solve(solver, 7, name, problem) is None for name, problem in problems.items()):
        _broken(7, "all elastic problems", f"each of the {len(problems)} was refused: nothing could be checked")


def check_counts(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 8: who changes a velocity has done an iteration, and visited what it pushes."""
    solution = _solve(solver, 8, name, problem)
    if solution is None or solution.impulse is None:
        return
    pushing = int(np.count_nonzero(solution.impulse))
    if pushing and (solution.iterations < 1 or solution.visits < pushing):
        _broken(
            8, name, f"{pushing} contacts push, after {solution.iterations} iterations and {solution.visits} visits: "
            "both must count the work",
        )  # fmt: skip


def check_start(solver: Solver, name: str, problem: ImpactProblem) -> None:
    """Point 9: a start changes the way, not the answer, whether it is the answer or nonsense."""
    cold = _solve(solver, 9, name, problem)
    if cold is None or cold.impulse is None or cold.status is not Status.CONVERGED:
        return
    before = cold.impulse.copy()
    for start, what in ((cold.impulse, "its own answer"), (np.full(problem.m, problem.speed), "any impulse")):
        warm = _solve(Started(solver, start), 9, name, problem)
        if warm is None:
            _broken(9, name, f"it answers from zero and refuses to start from {what}")
        difference = float(np.abs(warm.v_post - cold.v_post).max(initial=0.0))
        if not difference <= START_TOLERANCE * problem.speed:
            _broken(9, name, f"started from {what} it is {difference:.3g} away from its answer from zero")
    if (cold.impulse != before).any():
        _broken(9, name, "solve writes to its start")


def _solve(solver: Solver, point: int, name: str, problem: ImpactProblem) -> ImpactSolution | None:
    """Solve and check the form of the answer; None for a refusal with a reason."""
    try:
        return checked_solve(solver, problem)
    except UnsupportedProblem as refusal:
        if not str(refusal).strip():
            _broken(7, name, "UnsupportedProblem is raised without a reason")
        return None
    except InvalidSolution as error:
        counts = str(error).startswith(("iterations", "visits"))
        _broken(8 if counts else 3, name, str(error))
    except RAISED as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        if isinstance(error, ValueError) and "read-only" in str(error):
            raise AssertionError(_message(2, name, f"solve writes to the problem ({text})")) from error
        text += "; a hard problem is a status, one to which the law does not apply is UnsupportedProblem"
        special = name in special_problems() or point == 7
        raise AssertionError(_message(7 if special else 6, name, text)) from error
    except BaseException as error:
        error.add_note(_message(point, name, "solve raised this"))
        raise


def _require_honest(name: str, problem: ImpactProblem, solution: ImpactSolution) -> None:
    """Require that what is called converged is feasible."""
    for score in claim(problem, solution):
        if score.metric == "converged but not feasible" and score.value > HONESTY_TOLERANCE:
            worst = max(score.detail, key=lambda part: float(str(score.detail[part])))
            _broken(6, name, f"it says converged, and {worst} is {score.value:.3g} (allowed {HONESTY_TOLERANCE:g})")


def _require_same_bits(point: int, name: str, first: ImpactSolution, second: ImpactSolution, who: str) -> None:
    """Require that two answers are the same bit for bit."""
    for field in ("v_post", "impulse", "friction_impulse"):
        one, other = getattr(first, field), getattr(second, field)
        if (one is None) != (other is None):
            _broken(point, name, f"{who} differ in {field}: one of them is None")
        if one is not None and one.tobytes() != other.tobytes():
            _broken(point, name, f"{who} differ in {field} by {float(np.abs(one - other).max()):.3g}, not 0")
    for field in ("status", "iterations", "visits"):
        if getattr(first, field) != getattr(second, field):
            _broken(point, name, f"{who} differ in {field}: {getattr(first, field)} and {getattr(second, field)}")


def _fingerprint(problem: ImpactProblem) -> dict[str, bytes]:
    """All bits of a problem that a solver could change."""
    bits = {field: getattr(problem, field).tobytes() for field in TAMPERED_VECTORS}
    for field in TAMPERED:
        matrix = getattr(problem, field)
        bits[field] = b"|".join(part.tobytes() for part in (matrix.data, matrix.indices, matrix.indptr))
    return bits


def _equal_states(first: Any, second: Any) -> bool:
    """Compare two states of NumPy's global generator."""
    return all(np.array_equal(one, other) for one, other in zip(first, second, strict=True))


def _name(point: int, problem: str) -> str:
    return f"{point} {POINTS[point]}: {problem}"


def _message(point: int, problem: str, text: str) -> str:
    return f"contract point {point} ({POINTS[point]}), problem {problem!r}: {text}"


def _broken(point: int, problem: str, text: str) -> NoReturn:
    raise AssertionError(_message(point, problem, text))


def _rows(balls: int) -> Floats:
    """Contact Jacobian of a chain of balls, shape (balls - 1, balls)."""
    return np.eye(balls - 1, balls, 1) - np.eye(balls - 1, balls)


def _chain(rng: np.random.Generator, balls: int) -> ImpactProblem:
    """A chain with masses within a factor of ten and random velocities."""
    return ImpactProblem(10.0 ** rng.uniform(-0.5, 0.5, balls), _rows(balls), rng.normal(size=balls))


def _random_jacobian(rng: np.random.Generator) -> ImpactProblem:
    """Random rows and a dense mass; one direction opens every contact, so that elastic iterations end."""
    J, opening, root = rng.normal(size=(5, 4)), rng.normal(size=4), rng.normal(size=(4, 4)) + 2.0 * np.eye(4)
    return ImpactProblem(root @ root.T, J * np.sign(J @ opening)[:, None], rng.normal(size=4))

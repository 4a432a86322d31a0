"""Newton LCP by several methods: all reach the exact velocity, and none claims what its residual does not show."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.packs import sphere_pack
from solvers import ImpactProblem, Solver, Status, UnsupportedProblem
from solvers.lcp_gradient import AcceleratedProjectedGradient, SpectralProjectedGradient
from solvers.lcp_qp import NewtonLcpClarabel, NewtonLcpNnls, NewtonLcpOsqp
from solvers.newton_lcp import NewtonLcp
from tests.random_problems import KINDS, make, problems

GRADIENTS: list[Solver] = [AcceleratedProjectedGradient(), SpectralProjectedGradient()]
PACKAGES: list[Solver] = [NewtonLcpOsqp(), NewtonLcpClarabel()]
METHODS = [*GRADIENTS, *PACKAGES]
every_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: type(method).__name__)
every_gradient = pytest.mark.parametrize("method", GRADIENTS, ids=lambda method: type(method).__name__)

# A natural map below 1e-8 (the loosest tolerance here) leaves an error of it over W's smallest nonzero eigenvalue,
# which is above 0.01 in these problems.
SAME_VELOCITY = 1e-6
# Two ways to sum the same numbers.
ROUNDING = 1e-13


def natural_map(problem: ImpactProblem, impulse: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """The residual by its definition, dense."""
    W = problem.J.toarray() @ problem.inverse_mass.toarray() @ problem.J.toarray().T
    gradient = W @ impulse + (1 + problem.restitution) * problem.u_pre
    return float(np.abs(np.minimum(gradient, np.diag(W) * impulse)).max(initial=0.0)) / problem.speed


@every_method
@given(problem=problems, restitution=st.floats(min_value=0.0, max_value=1.0))
@settings(deadline=None, max_examples=60)
def test_every_method_reaches_the_exact_velocity(method: Solver, problem: ImpactProblem, restitution: float) -> None:
    if problem.speed == 0.0:
        return
    problem = problem.replace(restitution=restitution)
    solution = method.solve(problem)
    exact = NewtonLcpNnls().solve(problem)
    assert solution.impulse is not None
    assert solution.impulse.min(initial=0.0) >= 0.0
    scale = max(problem.speed, float(np.abs(exact.impulse).max(initial=0.0)))  # type: ignore[arg-type]
    # The natural map that it reports is the one that the definition gives, whatever it came to.
    assert natural_map(problem, solution.impulse) == pytest.approx(
        solution.residual, abs=ROUNDING * scale / problem.speed
    )
    if solution.status is Status.CONVERGED:
        np.testing.assert_allclose(solution.v_post, exact.v_post, atol=SAME_VELOCITY * problem.speed)
    else:
        assert solution.residual > method.tolerance  # type: ignore[attr-defined]


@every_method
@pytest.mark.parametrize("kind", KINDS)
def test_every_method_converges_on_ordinary_problems(method: Solver, kind: str) -> None:
    for seed in range(20):
        assert method.solve(make(kind, seed)).status is Status.CONVERGED


@pytest.mark.kernels
@every_gradient
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_agree_with_projected_gauss_seidel(method: Solver, kind: str) -> None:
    for seed in range(3):
        problem = make(kind, seed)
        v = NewtonLcp().solve(problem).v_post
        np.testing.assert_allclose(method.solve(problem).v_post, v, atol=SAME_VELOCITY * problem.speed)


@every_gradient
def test_gradients_reach_their_residual_on_a_pack_within_a_few_hundred_products(method: Solver) -> None:
    problem = sphere_pack(spheres=100, start="hot").problem
    solution = method.solve(problem)
    assert solution.status is Status.CONVERGED
    # Projected Gauss-Seidel needs thousands of sweeps for this.
    assert solution.iterations < 3000
    exact = NewtonLcpNnls(max_contacts=problem.m).solve(problem)
    np.testing.assert_allclose(solution.v_post, exact.v_post, atol=SAME_VELOCITY * problem.speed)


@every_method
def test_every_method_takes_restitution_per_contact(method: Solver) -> None:
    problem = make("spheres", 5)
    problem = problem.replace(restitution=np.linspace(0.0, 1.0, problem.m))
    solution = method.solve(problem)
    assert solution.status is Status.CONVERGED
    np.testing.assert_allclose(
        solution.v_post, NewtonLcpNnls().solve(problem).v_post, atol=SAME_VELOCITY * problem.speed
    )


@every_method
def test_contacts_entered_twice_give_the_same_velocity(method: Solver) -> None:
    once = make("discs", 3)
    twice = ImpactProblem(once.inverse_mass, once.J[np.repeat(np.arange(once.m), 2)], once.v_pre)
    np.testing.assert_allclose(method.solve(twice).v_post, method.solve(once).v_post, atol=SAME_VELOCITY * once.speed)


@every_method
@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_units_change_nothing(method: Solver, unit: float) -> None:
    problem = make("spheres", 7)
    plain = method.solve(problem)
    faster = method.solve(problem.replace(v_pre=problem.v_pre * unit))
    heavier = method.solve(ImpactProblem(problem.inverse_mass / unit, problem.J, problem.v_pre))
    np.testing.assert_allclose(faster.v_post / unit, plain.v_post, atol=SAME_VELOCITY * problem.speed)
    np.testing.assert_allclose(heavier.v_post, plain.v_post, atol=SAME_VELOCITY * problem.speed)


@every_method
def test_a_bound_that_is_reached_is_said(method: Solver) -> None:
    problem = sphere_pack(spheres=200, start="hot").problem
    hurried = type(method)(max_iterations=3)  # type: ignore[call-arg]
    solution = hurried.solve(problem)
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.iterations <= 3
    assert solution.residual > hurried.tolerance  # type: ignore[attr-defined]
    assert np.isfinite(solution.v_post).all()


@pytest.mark.parametrize("method", [NewtonLcpOsqp, NewtonLcpClarabel])
def test_a_package_that_is_content_too_early_is_not_believed(
    method: type[NewtonLcpOsqp] | type[NewtonLcpClarabel],
) -> None:
    # The package says "solved" at this tolerance; the natural map says otherwise.
    solution = method(solver_tolerance=1e-2).solve(make("discs", 1))
    if method is NewtonLcpClarabel:
        assert solution.status is not Status.CONVERGED
    assert (solution.status is Status.CONVERGED) == (solution.residual <= method().tolerance)


@every_method
def test_no_velocity_satisfies_contradicting_restitutions_and_nobody_says_that_one_does(method: Solver) -> None:
    # Between two walls: v ≥ 1 from one contact, v ≤ 1/2 from the other.
    problem = ImpactProblem([1.0], [[1.0], [-1.0]], [-1.0], restitution=[1.0, 0.5])
    solution = method.solve(problem)
    assert solution.status is not Status.CONVERGED
    assert np.isfinite(solution.v_post).all()


@every_method
def test_friction_is_refused_with_the_reason(method: Solver) -> None:
    problem = ImpactProblem(np.ones(3), [[0.0, 0.0, 1.0]], [1.0, 0.0, -1.0], friction=0.3, D=np.eye(3)[:2])
    with pytest.raises(UnsupportedProblem, match="friction"):
        method.solve(problem)


@pytest.mark.parametrize("method", PACKAGES, ids=lambda method: type(method).__name__)
def test_a_missing_package_is_named(method: Solver, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(UnsupportedProblem, match="pip install"):
        method.solve(make("chain", 0))


@every_method
def test_nothing_happens_where_nothing_approaches(method: Solver) -> None:
    for problem in (
        ImpactProblem(np.ones(3), [[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]], [-1.0, 0.0, 2.0]),
        ImpactProblem(np.ones(2), np.zeros((0, 2)), [1.0, -1.0]),
    ):
        solution = method.solve(problem)
        assert solution.status is Status.CONVERGED
        assert solution.impulse is not None
        assert not solution.impulse.any()
        np.testing.assert_array_equal(solution.v_post, problem.v_pre)

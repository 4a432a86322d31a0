"""Closed forms of the impact laws (physics: Zhang 2015; Smith 2012; Galperin 2003), and exact small cases."""

from __future__ import annotations

import math

import numpy as np
import pytest

from harness import accuracy
from solvers import SOLVERS, ImpactProblem, ProblemError, Status, UnsupportedProblem
from solvers.quadratic_contact_energy import QuadraticContactEnergy, solve_elastic
from solvers.solution import Floats

pytestmark = pytest.mark.kernels

# A handful of operations on numbers near one.
ROUNDING = 1e-14
# Projected Gauss-Seidel stops at a natural-map residual of 1e-11; W's smallest eigenvalue in these chains is 0.1.
ITERATIVE = 1e-9


def chain(masses: list[float], v_pre: list[float], restitution: float = 1.0) -> ImpactProblem:
    n = len(masses)
    J = np.zeros((n - 1, n))
    J[np.arange(n - 1), np.arange(n - 1)] = -1.0
    J[np.arange(n - 1), np.arange(1, n)] = 1.0
    return ImpactProblem(1.0 / np.array(masses), J, v_pre, restitution)


def outcome(name: str, problem: ImpactProblem) -> Floats:
    solution = SOLVERS[name]().solve(problem)
    assert solution.status is Status.CONVERGED
    return solution.v_post


@pytest.mark.parametrize("va", [0.05, 0.25, 0.5, 0.75, 0.99])
def test_qce_three_balls_follow_the_closed_form(va: float) -> None:
    v = outcome("qce", chain([1, 1, 1], [va, 0, -1]))
    v_c = va / (2 - va)
    # v_A and v_B from momentum and energy: two unknowns, the root with A thrown back.
    total, energy = va - 1 - v_c, va * va + 1 - v_c * v_c
    v_a = (total - math.sqrt(2 * energy - total * total)) / 2
    np.testing.assert_allclose(v, [v_a, total - v_a, v_c], atol=ROUNDING)


def test_qce_three_balls_at_one_half_are_the_printed_numbers() -> None:
    np.testing.assert_allclose(outcome("qce", chain([1, 1, 1], [0.5, 0, -1])), [-1.045820, 0.212486, 1 / 3], atol=5e-7)


@pytest.mark.parametrize("name", ["lcp-pgs", "lcp-nnls", "gr"])
@pytest.mark.parametrize("va", [0.05, 0.5, 1.0])
def test_newton_lcp_and_reflections_agree_on_three_balls(name: str, va: float) -> None:
    v = outcome(name, chain([1, 1, 1], [va, 0, -1]))
    np.testing.assert_allclose(v, [-(va + 2) / 3, 2 * (va - 1) / 3, (2 * va + 1) / 3], atol=ITERATIVE)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("qce", [-1, 0, 0]), ("gr", [-1, 0, 0]), ("gauss-seidel", [-1, 0, 0]), ("lcp-pgs", [-2 / 3, -2 / 3, 1 / 3])],
)
def test_one_ball_strikes_two_at_rest(name: str, expected: list[float]) -> None:
    np.testing.assert_allclose(outcome(name, chain([1, 1, 1], [0, 0, -1])), expected, atol=ITERATIVE)


@pytest.mark.parametrize("name", ["qce", "qce-defer", "gr"])
@pytest.mark.parametrize(("balls", "moving"), [(n, k) for n in range(2, 8) for k in range(1, n)])
def test_in_a_cradle_as_many_balls_fly_as_came(name: str, balls: int, moving: int) -> None:
    v = outcome(name, chain([1.0] * balls, [1.0] * moving + [0.0] * (balls - moving)))
    np.testing.assert_allclose(v, [0.0] * (balls - moving) + [1.0] * moving, atol=ROUNDING * balls)


@pytest.mark.parametrize("balls", [2, 3, 5, 9])
def test_reflections_of_a_cradle_are_one_less_than_its_balls(balls: int) -> None:
    solution = SOLVERS["gr"]().solve(chain([1.0] * balls, [1.0] + [0.0] * (balls - 1)))
    assert solution.iterations == balls - 1


@pytest.mark.parametrize("name", ["qce", "gr", "gauss-seidel"])
@pytest.mark.parametrize(("mass", "count"), [(1, 3), (10, 10), (100, 31), (1_000, 99), (10_000, 314)])
def test_galperins_billiard_has_its_exact_number_of_impacts(name: str, mass: float, count: int) -> None:
    problem = ImpactProblem([1.0, 1.0 / mass], [[1.0, 0.0], [-1.0, 1.0]], [0.0, -1.0])
    solution = SOLVERS[name]().solve(problem)
    assert count == math.ceil(math.pi / math.atan(1 / math.sqrt(mass))) - 1
    # One pass of Gauss-Seidel reflects the floor contact and the upper one.
    impacts = solution.iterations if name != "gauss-seidel" else count
    assert impacts == count
    if name == "gauss-seidel":
        assert solution.iterations in (count // 2, count // 2 + 1)


def bernoulli(mass: float) -> ImpactProblem:
    """Unit striker along x into two touching targets of the given mass, radius 1/2, contacts at ±30°."""
    c, s = math.sqrt(3) / 2, 0.5
    J = [[-c, -s, c, s, 0, 0], [-c, s, 0, 0, c, -s]]
    return ImpactProblem([1, 1, 1 / mass, 1 / mass, 1 / mass, 1 / mass], J, [1, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("name", ["qce", "gr", "lcp-pgs", "lcp-nnls", "qce-defer"])
def test_bernoullis_striker_returns_with_a_fifth_of_its_speed(name: str) -> None:
    v = outcome(name, bernoulli(1.0))
    np.testing.assert_allclose(v, [-0.2, 0, 0.6, 0.2 * math.sqrt(3), 0.6, -0.2 * math.sqrt(3)], atol=ITERATIVE)


@pytest.mark.parametrize("copies", [1, 2, 3])
def test_qce_depends_on_how_often_a_contact_is_entered(copies: int) -> None:
    J = np.array([[-1.0, 1.0, 0.0]] + [[0.0, -1.0, 1.0]] * copies)
    v = outcome("qce", ImpactProblem(np.ones(3), J, [0.5, 0.0, -1.0]))
    assert v[0] == pytest.approx({1: -1.0458, 2: -1.0366, 3: -1.0259}[copies], abs=5e-5)


@pytest.mark.parametrize("name", ["lcp-pgs", "lcp-nnls", "gr"])
def test_newton_lcp_does_not_depend_on_how_often_a_contact_is_entered(name: str) -> None:
    J = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, -1.0, 1.0]])
    once = outcome(name, chain([1, 1, 1], [0.5, 0, -1]))
    np.testing.assert_allclose(outcome(name, ImpactProblem(np.ones(3), J, [0.5, 0.0, -1.0])), once, atol=ITERATIVE)


@pytest.mark.parametrize("name", sorted(SOLVERS))
@pytest.mark.parametrize("restitution", [1.0, 0.7])
def test_two_bodies_are_newtons_law(name: str, restitution: float) -> None:
    problem = chain([1.0, 3.0], [2.0, -1.0], restitution)
    try:
        v = outcome(name, problem)
    except UnsupportedProblem:
        assert restitution != 1.0
        return
    impulse = (1 + restitution) * 3.0 / (1 + 1 / 3)
    np.testing.assert_allclose(v, [2.0 - impulse, -1.0 + impulse / 3.0], atol=ITERATIVE)


def test_disturbance_of_nearly_zero_costs_no_energy() -> None:
    # u = -1e-16 beside -1: updating slopes by subtraction loses 18 % of the energy here.
    for tolerance in (1e-10, 0.0):
        problem = chain([1, 1, 1], [1e-16, 0, -1])
        v = QuadraticContactEnergy(tolerance=tolerance).solve(problem).v_post
        assert abs(problem.kinetic_energy(v) - problem.kinetic_energy(problem.v_pre)) < ROUNDING


@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_nothing_happens_where_nothing_approaches(name: str) -> None:
    for problem in (
        chain([1, 1, 1], [-1.0, 0.0, 2.0]),
        chain([1, 1, 1], [3.0, 3.0, 3.0]),
        ImpactProblem(np.ones(2), np.zeros((0, 2)), [1.0, -1.0]),
    ):
        solution = SOLVERS[name]().solve(problem)
        assert solution.status is Status.CONVERGED
        assert (solution.v_post == problem.v_pre).all()
        assert solution.impulse is not None
        assert not solution.impulse.any()


@pytest.mark.parametrize("name", ["qce", "qce-defer", "qce-lcp", "qce-blend", "gr", "gauss-seidel", "jacobi"])
def test_a_ball_between_two_walls_ends_at_the_bound_and_says_so(name: str) -> None:
    problem = ImpactProblem([1.0], [[1.0], [-1.0]], [-1.0])
    solution = SOLVERS[name]().solve(problem)
    assert solution.status in (Status.ITERATION_LIMIT, Status.STALLED)
    assert np.isfinite(solution.v_post).all()


def test_two_walls_that_close_on_a_ball_stall() -> None:
    # Both contacts approach and no velocity of the ball helps either: the work never returns to zero.
    problem = ImpactProblem([1.0, 0.0, 0.0], [[1.0, -1.0, 0.0], [-1.0, 0.0, 1.0]], [0.0, 1.0, -1.0])
    solution = SOLVERS["qce"]().solve(problem)
    assert solution.status is Status.STALLED
    assert np.isfinite(solution.v_post).all()


def sliding_block(friction: float, slope: float) -> ImpactProblem:
    """A point mass that meets the floor with unit normal speed, and tangential speed `slope`."""
    J, D = [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    return ImpactProblem(np.ones(3), J, [slope, 0.0, -1.0], restitution=0.5, friction=friction, D=D)


@pytest.mark.parametrize("name", ["lcp-pgs", "qce-lcp", "qce-blend", "gr"])
@pytest.mark.parametrize(("friction", "slope"), [(0.2, 1.0), (0.2, 0.1), (1.0, 1.0), (0.0, 1.0)])
def test_friction_slides_by_mu_times_the_impulse_or_sticks(name: str, friction: float, slope: float) -> None:
    v = outcome(name, sliding_block(friction, slope))
    # Normal impulse 1.5; sliding takes μ 1.5 of the tangential speed, but never reverses it.
    np.testing.assert_allclose(v, [max(slope - 1.5 * friction, 0.0), 0.0, 0.5], atol=ITERATIVE)


@pytest.mark.parametrize("name", ["lcp-pgs", "qce-lcp", "qce-blend", "gr"])
@pytest.mark.parametrize(("friction", "slope"), [(0.2, 1.0), (0.2, 0.2), (0.2, 0.22), (1.0, 1.0), (0.0, 1.0)])
def test_what_sticks_parts_with_its_tangential_restitution(name: str, friction: float, slope: float) -> None:
    # Walton 1993, with no spin: friction takes μ 1.5 of the tangential speed, but never more than (1 + β₀) of it.
    problem = sliding_block(friction, slope).replace(tangential_restitution=0.4)
    np.testing.assert_allclose(problem.slip_target, [-0.4 * slope, 0.0])
    v = outcome(name, problem)
    expected = max(slope - 1.5 * friction, -0.4 * slope)
    np.testing.assert_allclose(v, [expected, 0.0, 0.5], atol=ITERATIVE)
    assert accuracy.tangent_map(problem, SOLVERS[name]().solve(problem)) <= ITERATIVE


def test_tangential_restitution_follows_the_velocity_and_is_none_without_friction() -> None:
    plain = sliding_block(0.2, 1.0)
    assert not plain.slip_target.any()
    bouncing = plain.replace(tangential_restitution=0.4)
    faster = bouncing.replace(v_pre=3.0 * bouncing.v_pre)
    np.testing.assert_allclose(faster.slip_target, 3.0 * bouncing.slip_target)
    np.testing.assert_array_equal(
        outcome("qce-lcp", bouncing.replace(friction=0.0)), outcome("qce-lcp", plain.replace(friction=0.0))
    )
    with pytest.raises(ProblemError, match=r"tangential_restitution must lie in \[0, 1\]: entry 0 is 1.5"):
        plain.replace(tangential_restitution=1.5)


def test_ehi_refuses_a_tangential_restitution() -> None:
    problem = sliding_block(0.2, 1.0).replace(tangential_restitution=0.4)
    with pytest.raises(UnsupportedProblem, match="tangential_restitution must be 0"):
        SOLVERS["ehi"]().solve(problem)


@pytest.mark.parametrize("name", ["qce", "qce-defer", "lcp-nnls", "gauss-seidel", "jacobi"])
def test_laws_without_friction_refuse_it_with_the_reason(name: str) -> None:
    with pytest.raises(UnsupportedProblem, match="friction"):
        SOLVERS[name]().solve(sliding_block(0.3, 1.0).replace(restitution=1.0))


@pytest.mark.parametrize("name", ["gr", "qce-blend"])
def test_laws_of_one_restitution_refuse_two(name: str) -> None:
    with pytest.raises(UnsupportedProblem, match="one restitution"):
        SOLVERS[name]().solve(chain([1, 1, 1], [0.5, 0, -1]).replace(restitution=[0.5, 1.0]))


def test_qce_lcp_is_the_plastic_lcp_at_zero_and_qce_at_one() -> None:
    for restitution, peer in ((0.0, "lcp-nnls"), (1.0, "qce")):
        problem = chain([1, 2, 1, 3], [1.0, 0.5, 0.0, -1.0], restitution)
        np.testing.assert_allclose(outcome("qce-lcp", problem), outcome(peer, problem), atol=1e-11)


def test_the_blend_does_not_solve_the_qce_lcp() -> None:
    # Zhang 2015, appendix, claims that it does. Where QCE pushes at a contact that the plastic LCP leaves,
    # complementarity fails: the two laws differ.
    worst = 0.0
    rng = np.random.default_rng(0)
    for _ in range(50):
        problem = chain(list(10.0 ** rng.uniform(-1, 1, 4)), list(rng.normal(size=4)), 0.5)
        worst = max(worst, float(np.abs(outcome("qce-lcp", problem) - outcome("qce-blend", problem)).max()))
    assert worst > 1e-3


def naive_outer_iteration(W: Floats, u: Floats) -> Floats:
    """One compression phase by brute force, dense, from the integral itself: the oracle of the heap."""
    F = np.maximum(-u, 0.0)
    ends = np.full(u.size, np.inf)
    active = F > 0

    def work(i: int, s: float) -> float:
        # e_i(s) = u_i s + ½ Σ_j W_ij F_j [s² - (s - s_j)₊²]
        late = np.maximum(s - ends, 0.0)
        return float(u[i] * s + 0.5 * (W[i] * F) @ (s * s - late * late))

    while active.any():
        best, first = np.inf, -1
        for i in np.flatnonzero(active).tolist():
            # Quadratic in s between two ends of others: the smallest root above the last end, by its coefficients.
            last = ends[np.isfinite(ends)].max(initial=0.0)
            e0, e1, e2 = (work(i, last + t) for t in (0.0, 1.0, 2.0))
            w = e2 - 2 * e1 + e0
            v = e1 - e0 - w / 2
            roots = np.roots([w / 2, v, e0]) if w != 0 else np.array([-e0 / v])
            real = [r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 1e-12 and v + w * r.real > 0]
            if real and last + min(real) < best:
                best, first = last + min(real), i
        assert first >= 0
        ends[first] = best
        active[first] = False
    return F * np.where(F > 0, ends, 0.0)


@pytest.mark.parametrize("seed", range(30))
def test_qce_equals_brute_force_on_its_integral(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m = int(rng.integers(2, 6))
    root = rng.normal(size=(m, m + 2))
    W, u = root @ root.T, -rng.uniform(0.1, 1.0, m)
    problem = ImpactProblem.from_delassus(W, u)
    first = solve_elastic(problem, defer=0.0, tolerance=1e-10, max_iterations=1)
    assert first.impulse is not None
    # The oracle finds roots by polynomial coefficients of differences: about 1e-10 of accuracy.
    np.testing.assert_allclose(first.impulse, naive_outer_iteration(W, u), rtol=1e-8)

"""QCE at scale: the streamed fixed point gives what the heap gives, in any order, and conserves energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.billiards import pool_break
from scenarios.packs import sphere_pack
from solvers import SOLVERS, ImpactProblem, Status, qce_stream
from solvers.qce_heap import solve_by_heap
from solvers.quadratic_contact_energy import MOST_CONTACTS_OF_A_BODY, SMALL, solve_elastic
from solvers.solution import Floats
from solvers.sphere_rows import RENUMBERED, STRIPS, sphere_rows
from tests.random_problems import KINDS, make, problems, reordered

# Both evaluate the same equations; their rounding grows over tens to thousands of outer iterations.
SAME_ANSWER = 1e-11
# The law returns each contact's energy; only rounding may remain.
ENERGY = 1e-13
TOLERANCE = 1e-10

KERNELS = [name for name, function in vars(qce_stream).items() if hasattr(function, "py_func")]

Parts = tuple[Floats, int, int, int]
Streamed = Callable[..., Parts]


def by_sparse_rows(problem: ImpactProblem, **settings: float) -> tuple[Floats, int, int, int]:
    return qce_stream.solve_sparse(problem, **settings)  # type: ignore[arg-type]


def by_sphere_rows(problem: ImpactProblem, **settings: float) -> tuple[Floats, int, int, int]:
    rows = sphere_rows(problem)
    assert rows is not None
    impulse, iterations, visits, flag = qce_stream.solve_spheres(rows, **settings)  # type: ignore[arg-type]
    return rows.in_problem_order(impulse), iterations, visits, flag


def in_strips(problem: ImpactProblem, strips: int, *, threshold: float, defer: float) -> Parts:
    """As threads share it out, on one thread: the contacts of a chain, cut into strips of equal length."""
    rows = sphere_rows(problem)
    assert rows is not None
    strip = (np.arange(strips + 1) * problem.m // strips).astype(np.int32)
    return qce_stream._solve_spheres(rows.normal, rows.body, rows.V, strip, threshold, defer, 10_000, 10**9)


def check_against_heap(problem: ImpactProblem, *, defer: float = 0.0, max_iterations: int = 10_000) -> None:
    """Impulses, outer iterations and the verdict of every streamed form agree with the heap's."""
    options = {"threshold": TOLERANCE * problem.speed, "defer": defer, "max_iterations": max_iterations}
    expected, iterations, _, stalled = solve_by_heap(problem, **options)  # type: ignore[arg-type]
    forms: list[Streamed] = [by_sparse_rows]
    if sphere_rows(problem) is not None:
        forms.append(by_sphere_rows)
    for form in forms:
        impulse, count, visits, flag = form(problem, **options)
        np.testing.assert_allclose(impulse, expected, rtol=0, atol=SAME_ANSWER * expected.max(initial=0.0))
        assert count == iterations
        assert visits >= problem.m
        assert flag == (qce_stream.STALLED if stalled else 0)


def energy_error(problem: ImpactProblem, v_post: Floats) -> float:
    before = problem.kinetic_energy(problem.v_pre)
    return abs(problem.kinetic_energy(v_post) - before) / before


def chain(n: int, v_pre: Floats) -> ImpactProblem:
    rows = np.arange(n - 1)
    J = np.zeros((n - 1, n))
    J[rows, rows] = -1.0
    J[rows, rows + 1] = 1.0
    return ImpactProblem(np.ones(n), J, v_pre)


def star(arms: int, seed: int) -> ImpactProblem:
    """A heavy ball in the middle of others that all fly at it: every contact has all others as neighbors."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(arms, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    J = np.zeros((arms, 3 * (arms + 1)))
    for i, normal in enumerate(normals):
        J[i, :3] = -normal
        J[i, 3 * (i + 1) : 3 * (i + 2)] = normal
    v_pre = np.concatenate([np.zeros(3), (-normals * rng.uniform(0.5, 1.5, (arms, 1))).ravel()])
    return ImpactProblem(np.concatenate([np.full(3, 0.1), np.ones(3 * arms)]), J, v_pre)


@pytest.mark.kernels
@pytest.mark.parametrize("kind", KINDS)
def test_every_kernel_gives_the_heaps_answer(kind: str) -> None:
    for seed in range(3):
        check_against_heap(make(kind, seed), max_iterations=20)
    check_against_heap(star(26, seed=0), max_iterations=1)
    # Few of its contacts approach: they are searched around what moved.
    check_against_heap(chain(60, np.concatenate([np.ones(2), np.zeros(58)])), max_iterations=5)


@pytest.mark.kernels
@pytest.mark.parametrize("defer", [0.0, 0.1])
def test_strips_give_the_heaps_answer(defer: float) -> None:
    balls = 41
    problem = chain(balls, np.random.default_rng(5).normal(size=balls))
    threshold = TOLERANCE * problem.speed
    expected, iterations, _, _ = solve_by_heap(problem, threshold=threshold, defer=defer, max_iterations=10_000)
    # Contacts i and i + 1 share a ball: even with strips of two contacts those of one parity share none.
    for strips in (1, 3, 8, 20):
        impulse, count, _, flag = in_strips(problem, strips, threshold=threshold, defer=defer)
        np.testing.assert_allclose(impulse, expected, rtol=0, atol=SAME_ANSWER * expected.max())
        assert (count, flag) == (iterations, 0)


@given(problems, st.sampled_from([0.0, 0.1]))
@settings(deadline=None, max_examples=200)
def test_the_stream_gives_the_heaps_answer_on_random_problems(problem: ImpactProblem, defer: float) -> None:
    check_against_heap(problem, defer=defer)


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", [100, 1000])
def test_the_stream_gives_the_heaps_answer_on_packs(start: str, spheres: int) -> None:
    check_against_heap(sphere_pack(spheres=spheres, start=start).problem)


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
@settings(deadline=None, max_examples=60)
def test_the_stream_gives_the_heaps_answer_where_couplings_are_negative_and_dense(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(m, m + 2))
    check_against_heap(ImpactProblem.from_delassus(root @ root.T, rng.normal(size=m)), max_iterations=50)


@pytest.mark.parametrize("balls", [15, 55])
def test_ties_of_a_symmetric_rack_end_together(balls: int) -> None:
    problem = pool_break(balls=balls).problem
    check_against_heap(problem)
    impulse = by_sparse_rows(problem, threshold=TOLERANCE * problem.speed, defer=0.0, max_iterations=10_000)[0]
    order = np.random.default_rng(0).permutation(problem.m)
    shuffled = by_sparse_rows(
        reordered(problem, order), threshold=TOLERANCE * problem.speed, defer=0.0, max_iterations=10_000
    )[0]
    np.testing.assert_allclose(shuffled, impulse[order], rtol=0, atol=SAME_ANSWER * impulse.max())


@pytest.mark.parametrize(("balls", "moving"), [(20, 1), (20, 7), (300, 2)])
def test_cradles_agree_with_the_heap(balls: int, moving: int) -> None:
    check_against_heap(chain(balls, np.concatenate([np.ones(moving), np.zeros(balls - moving)])))


def test_a_long_chain_is_searched_around_what_moved_alone() -> None:
    # One ball flies into 2,000: each outer iteration moves the pulse by one, and must not look at all contacts.
    balls = 2001
    v_pre = np.zeros(balls)
    v_pre[0] = 1.0
    problem = chain(balls, v_pre)
    solution = SOLVERS["qce"]().solve(problem)
    assert solution.status is Status.CONVERGED
    assert solution.v_post[-1] == pytest.approx(1.0, abs=1e-12)
    assert solution.iterations == balls - 1
    assert solution.visits < 20 * balls


@pytest.mark.parametrize("arms", [20, 60])
def test_a_star_whose_contacts_all_touch_one_body_agrees_with_the_heap(arms: int) -> None:
    check_against_heap(star(arms, seed=arms))


def test_bodies_with_very_many_contacts_are_left_to_the_heap(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(qce_stream, "solve_spheres", refuse)
    problem = star(SMALL + 1, seed=0)
    assert problem.m > MOST_CONTACTS_OF_A_BODY
    solution = solve_elastic(problem, defer=0.0, tolerance=TOLERANCE, max_iterations=10_000)
    assert energy_error(problem, solution.v_post) < ENERGY


def test_a_restless_fixed_point_falls_back_on_the_heap(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = sphere_pack(spheres=200).problem
    expected = solve_elastic(problem, defer=0.0, tolerance=TOLERANCE, max_iterations=10_000)
    restless = (np.zeros(problem.m), 1, 1, qce_stream.RESTLESS)
    monkeypatch.setattr(qce_stream, "solve_spheres", lambda *_, **__: restless)
    solution = solve_elastic(problem, defer=0.0, tolerance=TOLERANCE, max_iterations=10_000)
    np.testing.assert_allclose(solution.v_post, expected.v_post, atol=SAME_ANSWER * problem.speed)
    assert solution.status is Status.CONVERGED


def test_stalls_and_bounds_are_reported_alike() -> None:
    closing = ImpactProblem([1.0, 0.0, 0.0], [[1.0, -1.0, 0.0], [-1.0, 0.0, 1.0]], [0.0, 1.0, -1.0])
    check_against_heap(closing)
    between_walls = ImpactProblem([1.0], [[1.0], [-1.0]], [-1.0])
    check_against_heap(between_walls, max_iterations=101)
    pack = sphere_pack(spheres=200).problem
    solution = solve_elastic(pack, defer=0.0, tolerance=TOLERANCE, max_iterations=5)
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.iterations == 5


def test_a_bound_in_contact_visits_ends_a_chain_that_closes_on_itself() -> None:
    # Balls that fly at each other with a steady gradient of velocity exchange it pair by pair, n²/2 times in all.
    problem = chain(301, np.linspace(1.0, -1.0, 301))
    bound = 10_000
    for law in ("qce", "qce-defer"):
        solution = SOLVERS[law](max_visits=bound).solve(problem)  # type: ignore[call-arg]
        assert solution.status is Status.ITERATION_LIMIT
        assert solution.residual > 0.0
        # The outer iteration in progress is finished.
        assert bound <= solution.visits < bound + 10 * problem.m
        assert energy_error(problem, solution.v_post) < ENERGY
    assert SOLVERS["qce"]().solve(problem).status is Status.CONVERGED


def test_the_heap_leaves_an_outer_iteration_that_its_bound_interrupts() -> None:
    problem = star(40, seed=0)
    threshold = TOLERANCE * problem.speed
    impulse, _, visits, stalled = solve_by_heap(
        problem, threshold=threshold, defer=0.0, max_iterations=1, max_visits=100
    )
    assert not impulse.any()
    assert not stalled
    assert visits < 200
    whole = solve_by_heap(problem, threshold=threshold, defer=0.0, max_iterations=1)[0]
    assert (whole > 0).all()


@pytest.mark.parametrize("TILE", [5, 64])
def test_tiles_change_nothing_but_the_order_of_evaluation(TILE: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = sphere_pack(spheres=100, start="hot").problem
    expected = by_sphere_rows(problem, threshold=TOLERANCE * problem.speed, defer=0.0, max_iterations=3)
    # Compiled kernels have read the constant already: their Python originals read it anew.
    for name in KERNELS:
        monkeypatch.setattr(qce_stream, name, getattr(qce_stream, name).py_func)
    monkeypatch.setattr(qce_stream, "TILE", TILE)
    monkeypatch.setattr(qce_stream, "CHUNK", 7)
    for form in (by_sphere_rows, by_sparse_rows):
        impulse, iterations, _, flag = form(problem, threshold=TOLERANCE * problem.speed, defer=0.0, max_iterations=3)
        np.testing.assert_allclose(impulse, expected[0], rtol=0, atol=SAME_ANSWER * expected[0].max())
        assert (iterations, flag) == (expected[1], expected[3])


@pytest.mark.parametrize("start", ["kick", "hot", "patch"])
def test_packs_conserve_energy_to_rounding(start: str) -> None:
    problem = sphere_pack(spheres=1000, start=start).problem
    solution = SOLVERS["qce"]().solve(problem)
    assert solution.status is Status.CONVERGED
    assert energy_error(problem, solution.v_post) < ENERGY


@pytest.mark.long
@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", [4000, 15_000, 60_000])
def test_large_packs_conserve_energy_to_rounding(start: str, spheres: int) -> None:
    problem = sphere_pack(spheres=spheres, start=start).problem
    solution = SOLVERS["qce"]().solve(problem)
    assert solution.status is Status.CONVERGED
    assert energy_error(problem, solution.v_post) < ENERGY
    check_against_heap(problem)


def test_the_same_problem_gives_the_same_bits() -> None:
    problem = sphere_pack(spheres=1000, start="hot").problem
    first, second = (SOLVERS["qce"]().solve(problem) for _ in range(2))
    np.testing.assert_array_equal(first.v_post, second.v_post)
    assert (first.iterations, first.visits) == (second.iterations, second.visits)


@pytest.mark.parametrize("start", ["kick", "hot"])
def test_strips_and_threads_change_no_bit(start: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = sphere_pack(spheres=3000, start=start).problem
    options = {"threshold": TOLERANCE * problem.speed, "defer": 0.0, "max_iterations": 10_000}
    together = by_sphere_rows(problem, **options)
    monkeypatch.setattr(qce_stream, "SHARED_CONTACTS", 0)
    rows = sphere_rows(problem)
    assert rows is not None
    assert rows.strip.size == STRIPS + 1
    available = numba.get_num_threads()
    answers = []
    for threads in sorted({1, available}):
        numba.set_num_threads(threads)
        answers.append(by_sphere_rows(problem, **options))
    numba.set_num_threads(available)
    for answer in answers:
        np.testing.assert_array_equal(answer[0], answers[0][0])
        assert answer[1:] == answers[0][1:]
        # Strips are another order of evaluation.
        np.testing.assert_allclose(answer[0], together[0], rtol=0, atol=SAME_ANSWER * together[0].max())
        assert answer[1] == together[1]


def test_strips_of_one_parity_share_no_movable_body() -> None:
    rows = sphere_rows(sphere_pack(spheres=3000, start="hot").problem)
    assert rows is not None
    for parity in range(2):
        owner = np.full(rows.V.shape[0], -1)
        for c in range(parity, STRIPS, 2):
            bodies = np.unique(rows.body[rows.strip[c] : rows.strip[c + 1]])
            bodies = bodies[rows.V[bodies, 3] > 0]
            assert (owner[bodies] == -1).all()
            owner[bodies] = c


def test_many_strips_are_joined_with_their_neighbors(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = sphere_rows(sphere_pack(spheres=100).problem)
    assert rows is not None
    m = len(rows.normal)
    thin = replace(rows, strip=(np.arange(17) * m // 16).astype(np.int32))
    np.testing.assert_array_equal(qce_stream._strips(thin), [0, m])
    monkeypatch.setattr(qce_stream, "SHARED_CONTACTS", 0)
    np.testing.assert_array_equal(qce_stream._strips(thin), thin.strip[:: 16 // STRIPS])
    np.testing.assert_array_equal(qce_stream._strips(rows), [0, m])


def test_contacts_that_cannot_be_cut_are_one_strip() -> None:
    # A plate that all balls lie on is in every strip.
    balls = 2 * RENUMBERED
    rng = np.random.default_rng(2)
    index = np.stack([np.arange(balls), np.full(balls, balls)], axis=1)
    J = sp.csr_array((np.tile([1.0, -1.0], balls), index.ravel(), 2 * np.arange(balls + 1)), shape=(balls, balls + 1))
    rows = sphere_rows(ImpactProblem(np.ones(balls + 1), J, rng.normal(size=balls + 1)))
    assert rows is not None
    np.testing.assert_array_equal(rows.strip, [0, balls])


def test_a_problem_is_packed_once_and_no_solver_changes_what_it_keeps() -> None:
    problem = sphere_pack(spheres=3000, start="kick").problem
    still = problem.spheres_at_rest
    assert still is not None
    kept = [array.copy() for array in (still.normal, still.body, still.V, still.contact, still.owner, still.strip)]
    laws = [SOLVERS["qce"](), SOLVERS["ehi"](), SOLVERS["gr"](max_iterations=3), SOLVERS["lcp-pgs"](max_iterations=3)]  # type: ignore[call-arg]
    for law in laws:
        law.solve(problem)
    faster = problem.replace(v_pre=2.0 * problem.v_pre)
    assert faster.spheres_at_rest is still
    for before, after in zip(
        kept, (still.normal, still.body, still.V, still.contact, still.owner, still.strip), strict=True
    ):
        np.testing.assert_array_equal(before, after)
    twice, once = sphere_rows(faster), sphere_rows(problem)
    assert twice is not None
    assert once is not None
    np.testing.assert_array_equal(twice.V[:, :3], 2.0 * once.V[:, :3])


@pytest.mark.parametrize("kind", ["chain", "discs", "spheres"])
def test_the_largest_approach_of_packed_contacts_is_that_of_the_problem(kind: str) -> None:
    for seed in range(5):
        problem = make(kind, seed)
        rows = sphere_rows(problem)
        assert rows is not None
        expected = max(-problem.u_pre.min(initial=0.0), 0.0)
        assert qce_stream.largest_approach(rows) == pytest.approx(expected, abs=1e-14 * problem.speed)


def test_packs_do_not_depend_on_the_order_of_contacts() -> None:
    problem = sphere_pack(spheres=1000, start="hot").problem
    order = np.random.default_rng(1).permutation(problem.m)
    solution = SOLVERS["qce"]().solve(problem)
    shuffled = SOLVERS["qce"]().solve(reordered(problem, order))
    np.testing.assert_allclose(shuffled.v_post, solution.v_post, atol=SAME_ANSWER * problem.speed)


@pytest.mark.parametrize("kind", ["chain", "discs", "spheres"])
def test_spheres_discs_and_beads_are_recognized(kind: str) -> None:
    for seed in range(20):
        problem = make(kind, seed)
        rows = sphere_rows(problem)
        assert rows is not None
        a, b = rows.body[:, 0], rows.body[:, 1]
        u = np.einsum("ij,ij->i", rows.normal, rows.V[b, :3] - rows.V[a, :3])
        np.testing.assert_allclose(rows.in_problem_order(u), problem.u_pre, atol=1e-14 * problem.speed)


def test_other_rows_are_not_taken_for_spheres() -> None:
    dense = make("random Jacobian", 0)
    levers = ImpactProblem(np.ones(4), [[-1.0, 0.0, 2.0, 0.0]], np.ones(4))
    three_bodies = ImpactProblem(np.ones(9), [[1.0, 0, 0, -1.0, 0, 0, 1.0, 0, 0]], np.ones(9))
    anisotropic = ImpactProblem([1.0, 2.0, 3.0, 1.0, 2.0, 4.0], [[0.6, 0.8, 0, 0, -0.6, -0.8]], np.ones(6))
    for problem in (dense, levers, three_bodies, anisotropic):
        assert sphere_rows(problem) is None


def test_renumbering_keeps_every_contact_and_body() -> None:
    problem = sphere_pack(spheres=3000, start="hot").problem
    assert problem.m > RENUMBERED
    rows = sphere_rows(problem)
    assert rows is not None
    np.testing.assert_array_equal(np.sort(rows.contact), np.arange(problem.m))
    assert (rows.contact != np.arange(problem.m)).any()
    a, b = rows.body[:, 0], rows.body[:, 1]
    u = np.einsum("ij,ij->i", rows.normal, rows.V[b, :3] - rows.V[a, :3])
    np.testing.assert_allclose(rows.in_problem_order(u), problem.u_pre, atol=1e-14 * problem.speed)


def test_small_problems_use_the_heap(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(qce_stream, "solve_spheres", refuse)
    monkeypatch.setattr(qce_stream, "solve_sparse", refuse)
    problem = chain(SMALL, np.linspace(1.0, -1.0, SMALL))
    assert SOLVERS["qce"]().solve(problem).status is Status.CONVERGED
    with pytest.raises(AssertionError):
        SOLVERS["qce"]().solve(chain(SMALL + 1, np.linspace(1.0, -1.0, SMALL + 1)))

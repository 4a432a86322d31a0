"""The compliant laws `hertz` and `lzb`: known outcomes, independent integrations, conservation, honest ends."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from solvers import ImpactProblem, ImpactSolution, Status, UnsupportedProblem
from solvers.compression import VISITS_PER_CONTACT, pair_duration
from solvers.hertz import Hertz, hertz_reference
from solvers.liu_zhao_brogliato import SMALLEST_RESTITUTION, LiuZhaoBrogliato
from solvers.solution import Floats

Law = Hertz | LiuZhaoBrogliato

# The values of the literature and of the physics page are printed with six digits (LZB at e < 1: five).
SIX_DIGITS = 6e-7
FIVE_DIGITS = 6e-6
# Asked of the adaptive method on chains; its default tolerance of a step is 1e-12.
ACCURACY = 1e-9
# The harness gates the energy of elastic laws at this.
ENERGY = 1e-9
# Momentum is a sum of the same impulses with both signs: only rounding may remain.
MOMENTUM = 1e-12
# Violation that a converged solution may leave, relative to the largest |u_pre|.
REMAINING = 1e-10

every_law = pytest.mark.parametrize("law", [Hertz(), LiuZhaoBrogliato()], ids=["hertz", "lzb"])
every_method = pytest.mark.parametrize("adaptive_contacts", [200, 0], ids=["adaptive", "leapfrog"])


def chain(
    v_pre: npt.ArrayLike,
    *,
    mass: npt.ArrayLike = 1.0,
    restitution: npt.ArrayLike = 1.0,
    stiffness: npt.ArrayLike = 1.0,
) -> ImpactProblem:
    """Touching balls on a line, one velocity each."""
    v = np.asarray(v_pre, dtype=np.float64)
    J = np.eye(v.size - 1, v.size, 1) - np.eye(v.size - 1, v.size)
    inverse_mass = 1.0 / np.broadcast_to(np.asarray(mass, dtype=np.float64), v.shape)
    return ImpactProblem(inverse_mass, J, v, restitution, stiffness=stiffness)


def spheres(positions: Floats, v_pre: Floats) -> ImpactProblem:
    """Equal spheres of unit diameter and mass, a contact where two touch, three velocities each."""
    rows = []
    for i in range(len(positions)):
        for j in range(i + 1, len(positions)):
            apart = positions[j] - positions[i]
            distance = float(np.linalg.norm(apart))
            if distance < 1.0 + 1e-9:
                row = np.zeros_like(positions)
                row[i] = -apart / distance
                row[j] = apart / distance
                rows.append(row.ravel())
    return ImpactProblem(np.ones(positions.size), np.array(rows), v_pre.ravel())


def cluster(seed: int, count: int) -> ImpactProblem:
    """Spheres stuck together one by one in random directions, with random velocities."""
    rng = np.random.default_rng(seed)
    positions = [np.zeros(3)]
    while len(positions) < count:
        direction = rng.normal(size=3)
        place = positions[rng.integers(len(positions))] + direction / np.linalg.norm(direction)
        if min(float(np.linalg.norm(place - other)) for other in positions) > 1.0 - 1e-9:
            positions.append(place)
    return spheres(np.array(positions), rng.normal(size=(count, 3)))


def block_of_spheres(side: int) -> ImpactProblem:
    """A face-centered cubic block whose lowest layer is hit by the rest: enough contacts for the leapfrog."""
    grid = [
        (2 * i + (j + k) % 2, math.sqrt(3) * (j + (k % 2) / 3), 2 * math.sqrt(6) / 3 * k)
        for k in range(side)
        for j in range(side)
        for i in range(side)
    ]
    positions = 0.5 * np.array(grid)
    v = np.random.default_rng(4).normal(scale=0.2, size=positions.shape)
    v[positions[:, 2] > 0.1, 2] -= 1.0
    return spheres(positions, v)


def impulse_of(solution: ImpactSolution) -> Floats:
    """The impulse, which these laws always give."""
    assert solution.impulse is not None
    return solution.impulse


def momentum_drift(problem: ImpactProblem, v_post: Floats) -> float:
    """Change of the total momentum along a line, relative to the sum of all momenta in magnitude."""
    mass = 1.0 / problem.inverse_mass.diagonal()
    scale = float(np.abs(mass * problem.v_pre).sum())
    return abs(float(mass @ (v_post - problem.v_pre))) / scale


def energy_error(problem: ImpactProblem, v_post: Floats) -> float:
    return abs(problem.kinetic_energy(v_post) / problem.kinetic_energy(problem.v_pre) - 1.0)


# Known outcomes


@pytest.mark.kernels
@pytest.mark.parametrize(
    ("v_pre", "v_post"),
    [
        ([0.0, 0.0, -1.0], [-0.994549, -0.076403, 0.070952]),
        ([0.25, 0.0, -1.0], [-0.997095, -0.013881, 0.260976]),
        ([0.5, 0.0, -1.0], [-0.999242, -0.002267, 0.501508]),
        ([1.0, 0.0, 0.0], [-0.070952, 0.076403, 0.994549]),
        ([1.0, 0.0, 0.0, 0.0, 0.0], [-0.071085, -0.030274, -0.014464, 0.127045, 0.988777]),
    ],
)
def test_hertz_chains_end_as_known(v_pre: list[float], v_post: list[float]) -> None:
    solution = Hertz().solve(chain(v_pre))
    assert solution.status is Status.CONVERGED
    assert solution.v_post == pytest.approx(v_post, abs=SIX_DIGITS)


def test_linear_springs_of_three_balls_end_as_known() -> None:
    solution = Hertz(exponent=1.0).solve(chain([1.0, 0.0, 0.0]))
    assert solution.v_post == pytest.approx([-0.130262, 0.150230, 0.980032], abs=SIX_DIGITS)


@pytest.mark.kernels
def test_lzb_with_restitution_ends_as_known() -> None:
    solution = LiuZhaoBrogliato().solve(chain([1.0, 0.0, 0.0], restitution=0.7))
    assert solution.v_post == pytest.approx([0.11041, 0.15840, 0.73119], abs=FIVE_DIGITS)


@every_law
def test_bernoulli_striker_hits_two_targets_alike(law: Law) -> None:
    slope = math.sqrt(3) / 2
    problem = ImpactProblem(np.ones(6), [[-slope, -0.5, slope, 0.5, 0, 0], [-slope, 0.5, 0, 0, slope, -0.5]],
                            [1.0, 0, 0, 0, 0, 0])  # fmt: skip
    v = law.solve(problem).v_post
    assert v == pytest.approx([-0.2, 0.0, 0.6, 0.12**0.5, 0.6, -(0.12**0.5)], abs=ACCURACY)


@given(
    restitution=st.floats(0.01, 1.0), mass=st.floats(1e-4, 1e4), stiffness=st.floats(1e-6, 1e6),
    speed=st.floats(1e-9, 1e9), exponent=st.sampled_from([1.0, 1.5, 2.5]),
)  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_two_bodies_obey_newton(
    restitution: float, mass: float, stiffness: float, speed: float, exponent: float
) -> None:
    problem = chain([speed, 0.0], mass=[1.0, mass], restitution=restitution, stiffness=stiffness)
    solution = LiuZhaoBrogliato(exponent=exponent).solve(problem)
    assert solution.status is Status.CONVERGED
    assert float((problem.J @ solution.v_post)[0]) == pytest.approx(restitution * speed, abs=ACCURACY * speed)


def test_three_linear_balls_match_their_modes() -> None:
    mass = np.array([1.0, 0.6, 1.7])
    problem = chain([1.0, 0.0, -0.2], mass=mass, stiffness=[1.0, 3.0])
    solution = Hertz(exponent=1.0).solve(problem)
    # Both contacts press: δ'' = -W k δ, in modes of k^½ W k^½.
    root = np.sqrt(problem.stiffness)
    squares, modes = np.linalg.eigh(root[:, None] * problem.W.toarray() * root)
    frequency = np.sqrt(squares)
    amplitude = modes.T @ (-problem.u_pre * root) / frequency

    def compression(t: float) -> Floats:
        return np.asarray(modes @ (amplitude * np.sin(frequency * t)) / root)

    def rate(t: float) -> Floats:
        return np.asarray(modes @ (amplitude * frequency * np.cos(frequency * t)) / root)

    times = np.linspace(1e-3, 10.0, 2000)
    first = next(t for t in times if compression(t).min() < 0.0)
    opens = int(compression(first).argmin())
    end = brentq(lambda t: compression(t)[opens], first - (times[1] - times[0]), first, xtol=1e-14)
    # Then the other one goes on as a pair until its energy is back.
    u = -rate(end)
    other = 1 - opens
    W = problem.W.toarray()
    u_other = math.sqrt(u[other] ** 2 + W[other, other] * problem.stiffness[other] * compression(end)[other] ** 2)
    u[opens] += W[opens, other] / W[other, other] * (u_other - u[other])
    u[other] = u_other
    assert problem.J @ solution.v_post == pytest.approx(u, abs=ACCURACY)


def test_a_pair_contact_lasts_as_known() -> None:
    assert pair_duration(1.0) == pytest.approx(math.pi, rel=1e-14)
    assert pair_duration(1.5) == pytest.approx(2.94, abs=5e-3)


# Independent integrations


@pytest.mark.parametrize(
    "problem",
    [
        chain([1.0, 0.0, 0.0, 0.0]),
        chain([1.0, 0.3, 0.0, -0.6], mass=[1.0, 0.5, 2.0, 1.0], stiffness=[1.0, 2.0, 0.5]),
        # The light ball goes to and fro: a gap opens and closes.
        chain([1.0, 0.0, 0.0, 0.0], mass=[1.0, 0.1, 1.0, 3.0]),
    ],
    ids=["cradle", "unequal", "light-ball"],
)
def test_hertz_matches_an_integration_in_time(problem: ImpactProblem) -> None:
    m, W = problem.m, problem.W.toarray()

    def slope(t: float, state: Floats) -> Floats:
        force = problem.stiffness * np.maximum(state[m:], 0.0) ** 1.5
        return np.concatenate([W @ force, -state[:m]])

    start = np.concatenate([problem.u_pre, np.zeros(m)])
    run = solve_ivp(slope, (0.0, 40.0), start, method="DOP853", rtol=1e-11, atol=1e-13)
    u = run.y[:m, -1]
    # The integration must itself be over.
    assert run.y[m:, -1].max() < 0
    assert u.min() > 0
    solution = Hertz().solve(problem)
    assert problem.J @ solution.v_post == pytest.approx(u, abs=1e-8)


@pytest.mark.parametrize("restitution", [1.0, 0.7])
@pytest.mark.parametrize("stiffness", [(1.0, 1.0), (1.0, 4.0)])
def test_lzb_matches_its_own_form_in_the_impulse_clock(restitution: float, stiffness: tuple[float, float]) -> None:
    problem = chain([1.0, 0.0, 0.0], restitution=restitution, stiffness=stiffness)
    m, W, k = problem.m, problem.W.toarray(), problem.stiffness
    # From E = 0 the law in this clock has many solutions; a seed of energy picks the one that grows.
    seed = 1e-24

    def share(E: Floats) -> Floats:
        weight = np.asarray(k**0.4 * np.maximum(E, 0.0) ** 0.6)
        return np.asarray(weight / max(float(weight.sum()), 1e-300))

    def slope(s: float, state: Floats) -> Floats:
        E, P = state[:m], state[m:]
        dP = share(E)
        u = problem.u_pre + W @ P
        return np.concatenate([-u * dP * np.where(u > 0, 1.0 / restitution**2, 1.0), dP])

    def used_up(s: float, state: Floats) -> float:
        return float(state[:m].max()) - 1e-10  # what is left then adds some 1e-10 to the impulse

    used_up.terminal = True  # type: ignore[attr-defined]
    used_up.direction = -1  # type: ignore[attr-defined]
    start = np.concatenate([np.full(m, seed), np.zeros(m)])
    run = solve_ivp(slope, (0.0, 3.0), start, method="RK45", rtol=1e-8, atol=1e-20, events=used_up)
    assert run.status == 1
    u = problem.u_pre + W @ run.y[m:, -1]
    solution = LiuZhaoBrogliato().solve(problem)
    assert problem.J @ solution.v_post == pytest.approx(u, abs=1e-6)


@every_law
@pytest.mark.parametrize("exponent", [1.0, 1.5])
def test_leapfrog_has_order_two(law: Law, exponent: float) -> None:
    problem = cluster(seed=4, count=8)
    exact = type(law)(exponent=exponent).solve(problem).v_post
    errors = []
    for steps in (50.0, 100.0, 200.0, 400.0):
        coarse = type(law)(exponent=exponent, adaptive_contacts=0, steps_per_contact=steps).solve(problem)
        assert coarse.status is Status.CONVERGED
        errors.append(float(np.abs(coarse.v_post - exact).max()))
    # Eight times finer: 64 times as accurate at order two; half of that leaves room for the kinks of the force.
    assert errors[-1] < errors[0] / 32.0


@every_law
def test_both_methods_agree_on_a_block_of_spheres(law: Law) -> None:
    problem = block_of_spheres(3)
    assert 40 < problem.m <= law.adaptive_contacts
    adaptive = law.solve(problem)
    fine = type(law)(adaptive_contacts=0, steps_per_contact=400.0).solve(problem)
    coarse = type(law)(adaptive_contacts=0, steps_per_contact=200.0).solve(problem)
    assert adaptive.status is fine.status is Status.CONVERGED
    # The change on halving the step bounds the error of the finer run.
    change = float(np.abs(fine.v_post - coarse.v_post).max())
    assert 0.0 < change < 1e-2
    assert float(np.abs(fine.v_post - adaptive.v_post).max()) < change


# Invariance


@every_law
@pytest.mark.parametrize("name", ["stiffness", "mass", "speed"])
@pytest.mark.parametrize("factor", [1e-12, 1e-3, 1e12])
def test_scales_change_nothing(law: Law, name: str, factor: float) -> None:
    v_pre, mass = np.array([1.0, 0.2, 0.0, -0.5]), np.array([1.0, 3.0, 0.5, 1.0])
    stiffness = np.array([1.0, 2.0, 5.0])
    base = law.solve(chain(v_pre, mass=mass, stiffness=stiffness))
    scaled = {
        "stiffness": chain(v_pre, mass=mass, stiffness=factor * stiffness),
        "mass": chain(v_pre, mass=factor * mass, stiffness=stiffness),
        "speed": chain(factor * v_pre, mass=mass, stiffness=stiffness),
    }[name]
    unit = factor if name == "speed" else 1.0
    solution = law.solve(scaled)
    assert solution.status is Status.CONVERGED
    assert solution.v_post / unit == pytest.approx(base.v_post, abs=ACCURACY)


@every_law
def test_a_mirrored_chain_gives_the_mirrored_answer(law: Law) -> None:
    v_pre, mass = np.array([1.0, 0.1, 0.0, -0.3, -0.2]), np.array([1.0, 2.0, 0.3, 1.0, 4.0])
    v = law.solve(chain(v_pre, mass=mass)).v_post
    mirrored = law.solve(chain(-v_pre[::-1], mass=mass[::-1])).v_post
    assert -mirrored[::-1] == pytest.approx(v, abs=ACCURACY)


@every_law
def test_a_symmetric_chain_stays_symmetric(law: Law) -> None:
    v = law.solve(chain([1.0, 0.0, 0.0, 0.0, 0.0, -1.0])).v_post
    assert v + v[::-1] == pytest.approx(np.zeros(6), abs=ACCURACY)


@every_law
@pytest.mark.parametrize("size", [1e-16, 1e-13, 1e-10, 1e-7])
def test_a_disturbance_changes_the_answer_by_its_own_size(law: Law, size: float) -> None:
    v_pre = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    base = law.solve(chain(v_pre)).v_post
    for sign in (1.0, -1.0):
        disturbed = law.solve(chain(v_pre + sign * size * np.array([0.0, 0.0, 1.0, -1.0, 0.0]))).v_post
        assert float(np.abs(disturbed - base).max()) < 20.0 * size + ACCURACY


def test_gap_memory_alone_tells_the_two_laws_apart() -> None:
    # Without a contact that opens and presses again they are one law.
    alike = chain([1.0, 0.0, 0.0])
    assert Hertz().solve(alike).v_post == pytest.approx(LiuZhaoBrogliato().solve(alike).v_post, abs=ACCURACY)
    bouncing = chain([1.0, 0.0, 0.0, 0.0], mass=[1.0, 0.1, 1.0, 3.0])
    apart = Hertz().solve(bouncing).v_post - LiuZhaoBrogliato().solve(bouncing).v_post
    assert float(np.abs(apart).max()) > 1e-4


@every_law
def test_contacts_that_hardly_press_never_pull(law: Law) -> None:
    # A triangular rack of 21 discs: the far contacts get impulses of 1e-38.
    places = [(column - row / 2, row * math.sqrt(3) / 2, 0.0) for row in range(6) for column in range(row + 1)]
    positions = np.array([(0.0, -1.0, 0.0), *places])
    v_pre = np.zeros_like(positions)
    v_pre[0, 1] = 1.0
    solution = law.solve(spheres(positions, v_pre))
    assert solution.status is Status.CONVERGED
    assert impulse_of(solution).min() >= 0.0


# Conservation on random problems

masses = st.floats(-1.0, 1.0).map(lambda power: 10.0**power)
speeds = st.integers(-100, 100).map(lambda hundredths: hundredths / 100.0)


@every_law
@given(balls=st.lists(st.tuples(speeds, masses, masses), min_size=2, max_size=6))
@settings(max_examples=40, deadline=None)
def test_random_chains_keep_energy_and_momentum(law: Law, balls: list[tuple[float, float, float]]) -> None:
    v_pre, mass, stiffness = map(np.array, zip(*balls, strict=True))
    problem = chain(v_pre, mass=mass, stiffness=stiffness[1:])
    solution = law.solve(problem)
    assert solution.status is Status.CONVERGED
    assert impulse_of(solution).min() >= 0.0
    assert (problem.J @ solution.v_post).min() >= -REMAINING * problem.speed
    if problem.u_pre.min() < 0:
        assert energy_error(problem, solution.v_post) <= ENERGY
        assert momentum_drift(problem, solution.v_post) <= MOMENTUM


@every_law
@given(seed=st.integers(0, 10**6), count=st.integers(2, 8))
@settings(max_examples=25, deadline=None)
def test_random_clusters_keep_energy_and_momentum(law: Law, seed: int, count: int) -> None:
    problem = cluster(seed, count)
    solution = law.solve(problem)
    assert solution.status is Status.CONVERGED
    assert impulse_of(solution).min() >= 0.0
    assert (problem.J @ solution.v_post).min() >= -REMAINING * problem.speed
    if problem.u_pre.min() < 0:
        assert energy_error(problem, solution.v_post) <= ENERGY
        drift = (solution.v_post - problem.v_pre).reshape(-1, 3).sum(axis=0)
        assert float(np.abs(drift).max()) <= MOMENTUM * float(np.abs(problem.v_pre).sum())


@given(seed=st.integers(0, 10**6), restitution=st.floats(SMALLEST_RESTITUTION, 1.0))
@settings(max_examples=25, deadline=None)
def test_lzb_with_restitution_never_gains_energy(seed: int, restitution: float) -> None:
    problem = cluster(seed, 5).replace(restitution=restitution)
    solution = LiuZhaoBrogliato().solve(problem)
    assert solution.status is Status.CONVERGED
    gained = problem.kinetic_energy(solution.v_post) / problem.kinetic_energy(problem.v_pre) - 1.0
    assert gained <= ENERGY
    # The ledger of every contact is closed: what was not given back was lost by restitution.
    assert solution.residual <= ENERGY


def test_restitution_may_differ_from_contact_to_contact() -> None:
    # Two pairs that do not know of each other.
    problem = ImpactProblem(np.ones(4), [[-1, 1, 0, 0], [0, 0, -1, 1]], [1, 0, 1, 0], [0.3, 0.8])
    u = problem.J @ LiuZhaoBrogliato().solve(problem).v_post
    assert u == pytest.approx([0.3, 0.8], abs=ACCURACY)


@every_law
def test_the_leapfrog_puts_its_energy_right_and_says_by_how_much(law: Law) -> None:
    problem = block_of_spheres(side=5)
    assert problem.m > law.adaptive_contacts
    solution = law.solve(problem)
    assert solution.status is Status.CONVERGED
    assert energy_error(problem, solution.v_post) <= MOMENTUM
    assert 1e-9 < solution.residual < 1e-4


@pytest.mark.kernels
@every_law
def test_the_leapfrog_reports_its_energy_error(law: Law) -> None:
    problem = cluster(seed=3, count=4)
    solution = type(law)(adaptive_contacts=0, steps_per_contact=25.0).solve(problem)
    work = 0.5 * float(impulse_of(solution) @ (problem.u_pre + problem.J @ solution.v_post))
    change = problem.kinetic_energy(solution.v_post) - problem.kinetic_energy(problem.v_pre)
    assert work == pytest.approx(change, abs=1e-12)
    assert solution.residual > 1e-9
    assert (problem.J @ solution.v_post).min() >= -REMAINING * problem.speed


# Hard problems


def test_a_ball_between_floor_and_heavy_mass_bounces_to_its_end() -> None:
    # Galperin's billiard with M = 10⁴: 99 rounds of two contacts for instantaneous impacts.
    problem = ImpactProblem([1.0, 1e-4], [[1, 0], [-1, 1]], [0.0, -1.0])
    solution = Hertz().solve(problem)
    assert solution.status is Status.CONVERGED
    assert solution.iterations < 10_000
    assert energy_error(problem, solution.v_post) <= ENERGY


@every_law
@every_method
@pytest.mark.parametrize("balls", [1, 5])
def test_balls_between_two_walls_end_at_the_bound(law: Law, adaptive_contacts: int, balls: int) -> None:
    J = np.vstack(
        [np.eye(1, balls), np.eye(balls - 1, balls, 1) - np.eye(balls - 1, balls), -np.eye(1, balls)[:, ::-1]]
    )
    problem = ImpactProblem(np.ones(balls), J, np.eye(1, balls)[0])
    solution = type(law)(adaptive_contacts=adaptive_contacts, max_visits=100_000).solve(problem)
    assert solution.status is Status.ITERATION_LIMIT
    # One step of the adaptive method, of twelve stages, or one sweep may overshoot the bound.
    assert solution.visits <= 100_000 + (VISITS_PER_CONTACT + 12) * problem.m
    assert np.isfinite(solution.v_post).all()
    assert impulse_of(solution).min() >= 0.0


@every_law
@every_method
def test_nothing_happens_where_nothing_approaches(law: Law, adaptive_contacts: int) -> None:
    solver = type(law)(adaptive_contacts=adaptive_contacts)
    for problem in (
        chain([0.0, 0.0, 1.0]),
        chain([2.0, 2.0]),
        ImpactProblem(np.ones(3), np.zeros((0, 3)), [1.0, 2.0, 3.0]),
    ):
        solution = solver.solve(problem)
        assert solution.status is Status.CONVERGED
        assert impulse_of(solution).tolist() == [0.0] * problem.m
        assert solution.v_post.tolist() == problem.v_pre.tolist()


@every_law
@every_method
def test_equal_settings_give_equal_bits(law: Law, adaptive_contacts: int) -> None:
    problem = cluster(seed=11, count=6)
    first, second = (type(law)(adaptive_contacts=adaptive_contacts).solve(problem) for _ in range(2))
    assert impulse_of(first).tolist() == impulse_of(second).tolist()


def test_a_reference_covers_its_error() -> None:
    problem = chain([1.0, 0.0, 0.0, 0.0, 0.0])
    v, uncertainty = hertz_reference(problem)
    finest = Hertz(tolerance=1e-14).solve(problem).v_post
    assert float(np.abs(v - finest).max()) <= uncertainty <= ACCURACY


@pytest.mark.parametrize(
    ("solve", "reason"),
    [
        (lambda: Hertz().solve(chain([1.0, 0.0], restitution=0.9)), "restitution"),
        (lambda: LiuZhaoBrogliato().solve(chain([1.0, 0.0], restitution=0.0)), "restitution"),
        (lambda: Hertz().solve(_rough_pair()), "friction"),
        (lambda: LiuZhaoBrogliato().solve(_rough_pair()), "friction"),
    ],
)
def test_what_a_law_does_not_know_it_refuses(solve: Callable[[], object], reason: str) -> None:
    with pytest.raises(UnsupportedProblem, match=reason):
        solve()


def _rough_pair() -> ImpactProblem:
    return ImpactProblem(np.ones(3), [[0.0, 0.0, 1.0]], [0.0, 0.0, -1.0], friction=0.3, D=np.eye(2, 3))


@every_law
@pytest.mark.parametrize(
    "setting", [{"exponent": 0.5}, {"tolerance": 0.0}, {"steps_per_contact": -1.0}], ids=lambda s: next(iter(s))
)
def test_settings_that_cannot_be_honored_are_refused(law: Law, setting: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(setting))):
        type(law)(**setting)  # type: ignore[arg-type]

"""The contract's input side: what `ImpactProblem` accepts, computes and refuses."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from solvers import ImpactProblem, ProblemError

CHAIN = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
VELOCITY = np.array([0.5, 0.0, -1.0])
# Products of numbers near one, a handful of operations.
ROUNDING = 1e-15


def test_dense_sparse_and_diagonal_input_make_the_same_problem() -> None:
    diagonal = ImpactProblem(np.array([1.0, 2.0, 4.0]), CHAIN, VELOCITY)
    dense = ImpactProblem(np.diag([1.0, 2.0, 4.0]), sp.coo_array(CHAIN), VELOCITY)
    matrix = ImpactProblem(sp.csc_matrix(np.diag([1.0, 2.0, 4.0])), sp.csr_matrix(CHAIN), list(VELOCITY))
    for other in (dense, matrix):
        assert (other.W != diagonal.W).nnz == 0
        assert (other.u_pre == diagonal.u_pre).all()


def test_delassus_operator_and_velocities_follow_their_definitions() -> None:
    problem = ImpactProblem([1.0, 2.0, 4.0], CHAIN, VELOCITY)
    np.testing.assert_allclose(problem.W.toarray(), [[3.0, -2.0], [-2.0, 6.0]], atol=ROUNDING)
    np.testing.assert_allclose(problem.W_diagonal, [3.0, 6.0], atol=ROUNDING)
    np.testing.assert_allclose(problem.u_pre, [-0.5, -1.0], atol=ROUNDING)
    np.testing.assert_allclose(problem.v_after([1.0, 2.0]), [0.5 - 1.0, 2.0 - 4.0, -1.0 + 8.0], atol=ROUNDING)
    assert problem.kinetic_energy(VELOCITY) == pytest.approx(0.5 * (0.25 + 0.25), abs=ROUNDING)
    assert problem.speed == 1.0


def test_sparse_data_have_32_bit_indices_and_cannot_be_written() -> None:
    problem = ImpactProblem(np.ones(3), CHAIN, VELOCITY)
    for matrix in (problem.J, problem.W, problem.JM, problem.JT, problem.MJT, problem.inverse_mass, problem.mass):
        assert matrix.indices.dtype == np.int32
        assert matrix.indptr.dtype == np.int32
        assert not matrix.data.flags.writeable
    for vector in (problem.v_pre, problem.u_pre, problem.restitution, problem.friction, problem.stiffness):
        assert not vector.flags.writeable


def test_problem_keeps_its_own_copy_of_the_input() -> None:
    J, v = CHAIN.copy(), VELOCITY.copy()
    problem = ImpactProblem(np.ones(3), J, v)
    J[:] = 7.0
    v[:] = 7.0
    assert problem.u_pre.tolist() == [-0.5, -1.0]


def test_from_delassus_has_the_given_operator_and_velocity() -> None:
    W = np.array([[2.0, -1.0], [-1.0, 2.0]])
    problem = ImpactProblem.from_delassus(sp.csr_array(W), [-0.5, -1.0], restitution=0.5)
    np.testing.assert_allclose(problem.W.toarray(), W, atol=ROUNDING)
    assert problem.u_pre.tolist() == [-0.5, -1.0]
    # The energy that an impulse changes needs no bodies: λᵀ(u_pre + u_post)/2.
    impulse = np.array([0.3, 0.4])
    v_post = problem.v_after(impulse)
    change = problem.kinetic_energy(v_post) - problem.kinetic_energy(problem.v_pre)
    assert change == pytest.approx(0.5 * impulse @ (problem.u_pre + v_post), abs=1e-14)


def test_kinetic_energy_of_full_blocks_uses_the_inverse_whatever_its_units() -> None:
    root = np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.2, 0.3, 1.0]])
    units = np.diag([1.0, 1e9, 1e-9])
    inverse_mass = units @ root @ root.T @ units
    problem = ImpactProblem(sp.block_diag([inverse_mass, np.zeros((1, 1))]), np.ones((1, 4)), np.ones(4))
    v = np.array([1.0, 1e9, 1e-9, 5.0])
    scaled = np.linalg.solve(root @ root.T, np.ones(3))
    expected = 0.5 * float(np.ones(3) @ scaled)
    assert problem.kinetic_energy(v) == pytest.approx(expected, rel=1e-12)


def test_immovable_bodies_have_no_kinetic_energy() -> None:
    problem = ImpactProblem([1.0, 0.0], [[-1.0, 1.0]], [1.0, 3.0])
    assert problem.kinetic_energy(problem.v_pre) == 0.5


def test_a_problem_without_contacts_is_fine() -> None:
    problem = ImpactProblem(np.ones(2), np.zeros((0, 2)), [1.0, 2.0])
    assert problem.m == 0
    assert problem.W.shape == (0, 0)
    assert problem.speed == 0.0


def test_replace_shares_what_does_not_change() -> None:
    problem = ImpactProblem(np.ones(3), CHAIN, VELOCITY)
    W = problem.W
    other = problem.replace(v_pre=-VELOCITY, restitution=0.5)
    assert other.W is W
    assert other.u_pre.tolist() == [0.5, 1.0]
    assert other.restitution.tolist() == [0.5, 0.5]
    assert problem.speed == 1.0
    assert problem.replace(v_pre=2.0 * VELOCITY).speed == 2.0
    assert not problem.has_friction
    rough = ImpactProblem(np.ones(3), CHAIN, VELOCITY, D=np.zeros((4, 3))).replace(friction=0.5)
    assert rough.has_friction
    assert not rough.replace(friction=0.0).has_friction
    with pytest.raises(ProblemError, match="friction > 0 needs D"):
        problem.replace(friction=0.5)
    with pytest.raises(ProblemError, match="one column for each entry of v_pre"):
        problem.replace(v_pre=[1.0])
    with pytest.raises(ProblemError, match="restitution"):
        problem.replace(restitution=1.5)


def arguments(**changes: Any) -> dict[str, Any]:
    return {"inverse_mass": np.ones(3), "J": CHAIN, "v_pre": VELOCITY, **changes}


FRICTION_DIRECTIONS = np.zeros((4, 3))

BAD = {
    "v_pre: NaN": (arguments(v_pre=[0.5, np.nan, -1.0]), "v_pre must be finite: entry 1 is nan"),
    "v_pre: infinite": (arguments(v_pre=[np.inf, 0.0, -1.0]), "v_pre must be finite: entry 0 is inf"),
    "v_pre: matrix": (arguments(v_pre=np.ones((3, 1))), "v_pre must have one dimension"),
    "v_pre: text": (arguments(v_pre=["a", "b", "c"]), "v_pre must be an array of real numbers"),
    "J: columns": (arguments(J=np.ones((2, 4))), "J must have one column for each entry of v_pre"),
    "J: NaN": (arguments(J=[[np.nan, 1.0, 0.0]]), "J must be finite"),
    "J: ragged": (arguments(J=[[1.0], [1.0, 2.0]]), "J must be a matrix"),
    "inverse_mass: negative": (arguments(inverse_mass=[1.0, -2.0, 1.0]), "a diagonal ≥ 0: entry 1 is -2"),
    "inverse_mass: infinite": (arguments(inverse_mass=[1.0, np.inf, 1.0]), "inverse_mass must be finite"),
    "inverse_mass: length": (arguments(inverse_mass=np.ones(2)), "inverse_mass must have one entry for each"),
    "inverse_mass: shape": (arguments(inverse_mass=np.ones((2, 2))), "inverse_mass must have shape"),
    "inverse_mass: asymmetric": (
        arguments(inverse_mass=[[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "inverse_mass must be symmetric",
    ),
    "inverse_mass: indefinite": (
        arguments(inverse_mass=[[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "inverse_mass must be positive semidefinite",
    ),
    "restitution: above one": (arguments(restitution=1.1), "restitution must lie in [0, 1]: entry 0 is 1.1"),
    "restitution: negative": (arguments(restitution=[0.5, -0.1]), "restitution must lie in [0, 1]: entry 1 is -0.1"),
    "restitution: NaN": (arguments(restitution=np.nan), "restitution must be finite"),
    "restitution: length": (arguments(restitution=[1.0, 1.0, 1.0]), "restitution must be a number or have shape (m,)"),
    "friction: negative": (arguments(friction=-0.1, D=FRICTION_DIRECTIONS), "friction must be ≥ 0"),
    "friction: no directions": (arguments(friction=0.3), "friction > 0 needs D"),
    "D: shape": (arguments(D=np.ones((2, 3))), "D must have shape (2m, n)"),
    "stiffness: zero": (arguments(stiffness=0.0), "stiffness must be > 0"),
    "two immovable bodies": (arguments(inverse_mass=[1.0, 0.0, 0.0]), "contact 1 moves no body"),
    "an empty row": (arguments(J=[[-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]), "contact 1 moves no body"),
}  # fmt: skip


@pytest.mark.parametrize(("given", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_with_the_field_and_the_rule(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=re.escape(message)):
        ImpactProblem(**given)


@pytest.mark.parametrize(
    ("W", "u_pre", "message"),
    [
        ([[2.0, 1.0], [0.0, 2.0]], [0.0, -1.0], "W must be symmetric"),
        ([[2.0, 1.0, 0.0], [1.0, 2.0, 0.0]], [0.0, -1.0], "W must have shape (m, m)"),
        ([[0.0, 0.0], [0.0, 2.0]], [0.0, -1.0], "contact 0 moves no body"),
        ([[1.0, 2.0], [2.0, 1.0]], [0.0, -1.0], "positive semidefinite"),
        ([[np.nan]], [0.0], "W must be finite"),
    ],
)
def test_bad_delassus_operators_are_refused(W: list[list[float]], u_pre: list[float], message: str) -> None:
    with pytest.raises(ProblemError, match=re.escape(message)):
        ImpactProblem.from_delassus(W, u_pre)

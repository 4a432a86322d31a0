"""Contacts with friction where sweeps creep: proximal steps, each solved by Newton's method on the rows that hold.

    x ← the x with   0 <= λ complementary to  u + ε diag(W) (x - c) >= 0,   |λ_f| <= μ λ opposing w + ε diag (x - c)

x = (λ, λ_f), u = J v - target, w = D v + β₀ D v_pre, v = v_pre + M⁻¹(Jᵀ λ + Dᵀ λ_f), c the iterate before. The problem
itself is ε = 0. A box bounds friction along each axis by itself: where a face slides and turns, the second axis of its
corners has to reach its bound too, along impulses that cancel one another and change no velocity. A sweep goes that way
by a fixed small step, thousands of times; a proximal step goes 1/ε as far, and leaves a regular system where contacts
are redundant.

Newton's method takes the rows as they are at an iterate: normals that push and tangents within their bounds hold, the
others slide at ± μ λ with λ unknown, or are open (primal-dual active set: Hintermüller, Ito and Kunisch 2002). With
the change of x being -(G Δv + r) / (ε diag) for what holds, that of v is the solution of

    (1 + Σ (M⁻¹ Gᵀ)_k G_k / (ε diag)_k) Δv = -Σ (M⁻¹ Gᵀ)_k r_k / (ε diag)_k          r: what is left, ε diag (x - c) too

(M⁻¹Gᵀ of a normal with its share ± μ of the tangents that slide). It is as sparse as the graph of the bodies: blocks
of `BLOCK` velocities are eliminated in the order of the least degree, pivots within a block alone; what rounding that
leaves is the next iteration's to correct. All of it is a guess: the caller measures.
Proximal point: Rockafellar 1976.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.problem import ImpactProblem, Matrix
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]
Indices = npt.NDArray[np.uint32]

# Velocities that are eliminated together: those of a rigid body. Any other number is correct, too, but slower.
BLOCK = 6
# The same for columns, which are unsigned: a division of signed numbers takes longer.
WIDTH = np.uint32(BLOCK)
# Products of blocks in one elimination, each of `BLOCK`³ multiplications; larger problems are left to sweeps.
LARGEST = 100_000
# The order of elimination is found on a dense graph.
MOST_BLOCKS = 500
# Newton's iterations in a proximal step: either a few are enough, or they go round in circles.
ITERATIONS = 14
# A step is given up when so many iterations in a row leave more than this share of the least violation before.
PATIENCE, PROGRESS = 2, 0.9
# A row of less than this share of the normal's entry of W moves nothing but by rounding.
IMMOVABLE = 1e-20
# A proximal step is solved to this share of the tolerance of the whole.
SHARE = 0.1
# What the rows of a contact do.
OPEN, HOLDS, SLIDES = 0, 1, 2


@dataclass(frozen=True)
class Elimination:
    """The order in which blocks are eliminated, and the blocks that there are."""

    order: Ints
    """Block of each position."""
    start: Ints
    """Where the later neighbors of each position start in `later`."""
    later: Ints
    """Blocks that are eliminated later and coupled, fill included."""
    slot: Ints
    """Where each block of the matrix is kept, -1 where it is zero; shape (blocks, blocks)."""
    products: int
    """Products of blocks in one elimination."""


def eliminate(problem: ImpactProblem) -> Elimination | None:
    """Find the order of elimination; None where the problem is too large for it."""
    blocks = -(-problem.n // BLOCK)
    if not problem.has_friction or blocks > MOST_BLOCKS:
        return None
    order, start, later, slot, products = _eliminate(
        *_structure(problem.J),
        *_structure(_tangents(problem)),
        *_structure(problem.JM),
        *_structure(problem.DM),
        blocks,
    )
    return Elimination(order, start, later, slot, products) if products <= LARGEST else None


def proximal_step(
    problem: ImpactProblem, elimination: Elimination, target: Floats, impulse: Floats, friction_impulse: Floats, *,
    epsilon: float, tolerance: float,
) -> tuple[Floats, Floats, bool, int]:  # fmt: skip
    """One proximal step.

    Args:
        problem: bodies, contacts, friction.
        elimination: of this problem.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        impulse: λ before [N s], shape (m,).
        friction_impulse: λ_f before [N s], shape (2m,).
        epsilon: ε, > 0; the smaller, the farther the step goes and the harder it is to solve.
        tolerance: natural map of the whole problem that is asked for [m/s].

    Returns:
        λ and λ_f after [N s], the best that was seen; whether the step was solved; Newton's iterations.
    """
    center = np.column_stack([impulse, friction_impulse.reshape(-1, 2)])
    best, solved, iterations = _proximal(
        *_parts(problem.J), *_parts(_tangents(problem)), *_parts(problem.JM), *_parts(problem.DM),
        problem.W_diagonal, problem.friction, problem.v_pre, target, problem.slip_target, center,
        elimination.order, elimination.start, elimination.later, elimination.slot, epsilon, SHARE * tolerance,
    )  # fmt: skip
    return best[:, 0].copy(), best[:, 1:].ravel(), solved, iterations


def _tangents(problem: ImpactProblem) -> Matrix:
    """D; the empty D M⁻¹ stands for it without friction."""
    return problem.DM if problem.D is None else problem.D


def _structure(matrix: Matrix) -> tuple[Ints, Indices]:
    """Rows and columns of a CSR matrix as the kernels read them."""
    return matrix.indptr, matrix.indices.view(np.uint32)


def _parts(matrix: Matrix) -> tuple[Ints, Indices, Floats]:
    """CSR as the kernels read it; no copy."""
    return matrix.indptr, matrix.indices.view(np.uint32), matrix.data


@kernel
def _mark(start: Ints, column: Indices, row: int, found: Ints, count: int) -> int:
    """Add the blocks of a row to those that were found."""
    for q in range(start[row], start[row + 1]):
        block = column[q] // WIDTH
        new = True
        for k in range(count):
            if found[k] == block:
                new = False
        if new:
            found[count] = block
            count += 1
    return count


@kernel
def _eliminate(
    J_start: Ints, J_column: Indices, D_start: Ints, D_column: Indices,
    JM_start: Ints, JM_column: Indices, DM_start: Ints, DM_column: Indices, blocks: int,
) -> tuple[Ints, Ints, Ints, Ints, int]:  # fmt: skip
    """Order of least degree, later neighbors, places of the blocks, products of blocks."""
    coupled = np.zeros((blocks, blocks), np.bool_)
    found = np.empty(blocks, np.int32)
    for i in range(J_start.size - 1):
        count = _mark(J_start, J_column, i, found, 0)
        count = _mark(JM_start, JM_column, i, found, count)
        for row in range(2 * i, 2 * i + 2):
            count = _mark(D_start, D_column, row, found, count)
            count = _mark(DM_start, DM_column, row, found, count)
        for k in range(count):
            for other in range(count):
                coupled[found[k], found[other]] = True
    degree = np.zeros(blocks, np.int32)
    for a in range(blocks):
        coupled[a, a] = False
        for b in range(blocks):
            if coupled[a, b]:
                degree[a] += 1
    order = np.empty(blocks, np.int32)
    start = np.zeros(blocks + 1, np.int32)
    later = np.empty(blocks * (blocks - 1) // 2 + 1, np.int32)
    slot = np.full((blocks, blocks), -1, np.int32)
    gone = np.zeros(blocks, np.bool_)
    kept = 0
    products = 0
    for position in range(blocks):
        pivot = -1
        for a in range(blocks):
            if not gone[a] and (pivot < 0 or degree[a] < degree[pivot]):
                pivot = a
        order[position] = pivot
        gone[pivot] = True
        slot[pivot, pivot] = kept
        kept += 1
        first = start[position]
        last = first
        for a in range(blocks):
            if coupled[pivot, a] and not gone[a]:
                later[last] = a
                last += 1
                slot[pivot, a] = kept
                slot[a, pivot] = kept + 1
                kept += 2
                degree[a] -= 1
        start[position + 1] = last
        products += (last - first + 1) ** 2
        # What is coupled to the pivot becomes coupled to one another.
        for p in range(first, last):
            for q in range(first, last):
                a = later[p]
                b = later[q]
                if a != b and not coupled[a, b]:
                    coupled[a, b] = True
                    degree[a] += 1
    return order, start, later[: start[blocks]].copy(), slot, products


@kernel
def _row(start: Ints, column: Indices, value: Floats, row: int, v: Floats) -> float:
    """A row times v."""
    total = 0.0
    for q in range(start[row], start[row + 1]):
        total += value[q] * v[column[q]]
    return total


@kernel
def _add_row(start: Ints, column: Indices, value: Floats, row: int, factor: float, v: Floats) -> None:
    """Add a multiple of a row to v."""
    for q in range(start[row], start[row + 1]):
        v[column[q]] += factor * value[q]


@kernel
def _add_product(
    start: Ints, column: Indices, value: Floats, row: int,
    other_start: Ints, other_column: Indices, other_value: Floats, other_row: int,
    factor: float, slot: Ints, matrix: Floats,
) -> None:  # fmt: skip
    """Add a multiple of one row, transposed, times another to the matrix of blocks."""
    for p in range(start[row], start[row + 1]):
        a = column[p] // WIDTH
        within = column[p] - a * WIDTH
        scaled = factor * value[p]
        q = other_start[other_row]
        while q < other_start[other_row + 1]:
            # All columns of one block.
            b = other_column[q] // WIDTH
            line = matrix[slot[a, b], within]
            while q < other_start[other_row + 1] and other_column[q] - b * WIDTH < WIDTH:
                line[other_column[q] - b * WIDTH] += scaled * other_value[q]
                q += 1


@kernel
def _invert(block: Floats, work: Floats) -> None:
    """Invert a block in place (Gauss and Jordan, pivots by rows); what has no pivot is left at a huge inverse."""
    for a in range(BLOCK):
        for b in range(BLOCK):
            work[a, b] = block[a, b]
            block[a, b] = 1.0 if a == b else 0.0
    for k in range(BLOCK):
        pivot = k
        for a in range(k + 1, BLOCK):
            if abs(work[a, k]) > abs(work[pivot, k]):
                pivot = a
        if work[pivot, k] == 0.0:
            work[pivot, k] = 1e-300
        if pivot != k:
            for b in range(BLOCK):
                work[k, b], work[pivot, b] = work[pivot, b], work[k, b]
                block[k, b], block[pivot, b] = block[pivot, b], block[k, b]
        scale = 1.0 / work[k, k]
        for b in range(BLOCK):
            work[k, b] *= scale
            block[k, b] *= scale
        for a in range(BLOCK):
            factor = work[a, k]
            if a != k and factor != 0.0:
                for b in range(BLOCK):
                    work[a, b] -= factor * work[k, b]
                    block[a, b] -= factor * block[k, b]


@kernel
def _multiply_right(block: Floats, right: Floats, work: Floats) -> None:
    """Replace a block by block times right."""
    for a in range(BLOCK):
        for b in range(BLOCK):
            total = 0.0
            for k in range(BLOCK):
                total += block[a, k] * right[k, b]
            work[a, b] = total
    for a in range(BLOCK):
        for b in range(BLOCK):
            block[a, b] = work[a, b]


@kernel
def _solve(matrix: Floats, order: Ints, start: Ints, later: Ints, slot: Ints, y: Floats) -> None:
    """Eliminate block after block (the matrix is spent); the solution takes the place of the right side, padded."""
    work = np.empty((BLOCK, BLOCK))
    part = np.empty(BLOCK)
    for position in range(order.size):
        k = order[position]
        diagonal = matrix[slot[k, k]]
        _invert(diagonal, work)
        for p in range(start[position], start[position + 1]):
            i = later[p]
            lower = matrix[slot[i, k]]
            _multiply_right(lower, diagonal, work)
            for a in range(BLOCK):
                for b in range(BLOCK):
                    y[BLOCK * i + a] -= lower[a, b] * y[BLOCK * k + b]
            for q in range(start[position], start[position + 1]):
                j = later[q]
                upper = matrix[slot[k, j]]
                changed = matrix[slot[i, j]]
                for a in range(BLOCK):
                    for c in range(BLOCK):
                        factor = lower[a, c]
                        for b in range(BLOCK):
                            changed[a, b] -= factor * upper[c, b]
    for position in range(order.size - 1, -1, -1):
        k = order[position]
        for p in range(start[position], start[position + 1]):
            j = later[p]
            upper = matrix[slot[k, j]]
            for a in range(BLOCK):
                for b in range(BLOCK):
                    y[BLOCK * k + a] -= upper[a, b] * y[BLOCK * j + b]
        inverse = matrix[slot[k, k]]
        for a in range(BLOCK):
            total = 0.0
            for b in range(BLOCK):
                total += inverse[a, b] * y[BLOCK * k + b]
            part[a] = total
        for a in range(BLOCK):
            y[BLOCK * k + a] = part[a]


@kernel
def _tangent_diagonal(
    D_start: Ints, D_column: Indices, D: Floats, DM_start: Ints, DM_column: Indices, DM: Floats,
    W_diagonal: Floats, mu: Floats, n: int,
) -> Floats:  # fmt: skip
    """Diagonal of W of all rows, shape (m, 3); zero for tangents without friction or that move nothing."""
    diagonal = np.zeros((mu.size, 3))
    spread = np.zeros(n)
    for i in range(mu.size):
        diagonal[i, 0] = W_diagonal[i]
        if mu[i] == 0.0:
            continue
        for axis in range(2):
            row = 2 * i + axis
            _add_row(D_start, D_column, D, row, 1.0, spread)
            entry = _row(DM_start, DM_column, DM, row, spread)
            diagonal[i, 1 + axis] = entry if entry > IMMOVABLE * W_diagonal[i] else 0.0
            for q in range(D_start[row], D_start[row + 1]):
                spread[D_column[q]] = 0.0
    return diagonal


@kernel
def _choose(diagonal: Floats, mu: Floats, epsilon: float, x: Floats, u: Floats, act: Ints, sign: Floats) -> None:
    """What each row does where each goes to its own optimum, and with which sign it slides."""
    for i in range(mu.size):
        wanted = x[i, 0] - u[i, 0] / ((1.0 + epsilon) * diagonal[i, 0])
        act[i, 0] = HOLDS if wanted > 0.0 else OPEN
        bound = mu[i] * wanted
        for k in range(1, 3):
            act[i, k] = OPEN
            sign[i, k] = 0.0
            if wanted > 0.0 and diagonal[i, k] > 0.0:
                grip = x[i, k] - u[i, k] / ((1.0 + epsilon) * diagonal[i, k])
                act[i, k] = HOLDS if abs(grip) < bound else SLIDES
                if act[i, k] == SLIDES:
                    sign[i, k] = 1.0 if grip > 0.0 else -1.0


@kernel
def _velocity(
    JM_start: Ints, JM_column: Indices, JM: Floats, DM_start: Ints, DM_column: Indices, DM: Floats,
    v_pre: Floats, x: Floats, v: Floats,
) -> None:  # fmt: skip
    """Velocity after impulses."""
    for d in range(v_pre.size):
        v[d] = v_pre[d]
    for i in range(x.shape[0]):
        if x[i, 0] != 0.0:
            _add_row(JM_start, JM_column, JM, i, x[i, 0], v)
        for k in range(1, 3):
            if x[i, k] != 0.0:
                _add_row(DM_start, DM_column, DM, 2 * i + k - 1, x[i, k], v)


@kernel
def _gradient(
    J_start: Ints, J_column: Indices, J: Floats, D_start: Ints, D_column: Indices, D: Floats,
    diagonal: Floats, target: Floats, slip: Floats, center: Floats, epsilon: float, x: Floats, v: Floats, u: Floats,
) -> None:  # fmt: skip
    """Relative velocities of all rows with the proximal term, shape (m, 3)."""
    for i in range(target.size):
        u[i, 0] = _row(J_start, J_column, J, i, v) - target[i]
        for k in range(1, 3):
            row = 2 * i + k - 1
            u[i, k] = _row(D_start, D_column, D, row, v) - slip[row] if diagonal[i, k] > 0.0 else 0.0
        for k in range(3):
            u[i, k] += epsilon * diagonal[i, k] * (x[i, k] - center[i, k])


@kernel
def _natural_map(diagonal: Floats, mu: Floats, epsilon: float, x: Floats, u: Floats) -> float:
    """Largest violation of the proximal step's conditions [m/s]."""
    largest = 0.0
    for i in range(mu.size):
        weight = (1.0 + epsilon) * diagonal[i, 0]
        largest = max(largest, abs(min(u[i, 0], weight * x[i, 0])))
        bound = mu[i] * x[i, 0]
        for k in range(1, 3):
            weight = (1.0 + epsilon) * diagonal[i, k]
            if weight > 0.0:
                wanted = min(max(x[i, k] - u[i, k] / weight, -bound), bound)
                largest = max(largest, abs(wanted - x[i, k]) * weight)
    return largest


@kernel
def _newton(
    J_start: Ints, J_column: Indices, J: Floats, D_start: Ints, D_column: Indices, D: Floats,
    JM_start: Ints, JM_column: Indices, JM: Floats, DM_start: Ints, DM_column: Indices, DM: Floats,
    diagonal: Floats, mu: Floats, v_pre: Floats, target: Floats, slip: Floats, center: Floats, act: Ints,
    sign: Floats,
    order: Ints, start: Ints, later: Ints, slot: Ints, matrix: Floats, epsilon: float,
    x: Floats, u: Floats, v: Floats, change: Floats,
) -> None:  # fmt: skip
    """Impulses x (changed) at which the rows do what they are said to: a correction, so that rounding is corrected."""
    for i in range(mu.size):
        if act[i, 0] == OPEN:
            x[i, 0] = 0.0
        for k in range(1, 3):
            if act[i, k] != HOLDS:
                x[i, k] = sign[i, k] * mu[i] * x[i, 0]
    _velocity(JM_start, JM_column, JM, DM_start, DM_column, DM, v_pre, x, v)
    _gradient(J_start, J_column, J, D_start, D_column, D, diagonal, target, slip, center, epsilon, x, v, u)
    matrix[:] = 0.0
    for block in range(order.size):
        for a in range(BLOCK):
            matrix[slot[block, block], a, a] = 1.0
    change[:] = 0.0
    for i in range(mu.size):
        if act[i, 0] == OPEN:
            continue
        stiffness = 1.0 / (epsilon * diagonal[i, 0])
        push = -stiffness * u[i, 0]
        _add_product(JM_start, JM_column, JM, i, J_start, J_column, J, i, stiffness, slot, matrix)
        _add_row(JM_start, JM_column, JM, i, push, change)
        for k in range(1, 3):
            row = 2 * i + k - 1
            if act[i, k] == SLIDES:
                share = sign[i, k] * mu[i]
                _add_product(DM_start, DM_column, DM, row, J_start, J_column, J, i, share * stiffness, slot, matrix)
                _add_row(DM_start, DM_column, DM, row, share * push, change)
            elif act[i, k] == HOLDS:
                grip = 1.0 / (epsilon * diagonal[i, k])
                _add_product(DM_start, DM_column, DM, row, D_start, D_column, D, row, grip, slot, matrix)
                _add_row(DM_start, DM_column, DM, row, -grip * u[i, k], change)
    _solve(matrix, order, start, later, slot, change)
    for i in range(mu.size):
        if act[i, 0] == OPEN:
            continue
        x[i, 0] -= (u[i, 0] + _row(J_start, J_column, J, i, change)) / (epsilon * diagonal[i, 0])
        for k in range(1, 3):
            if act[i, k] == HOLDS:
                left = u[i, k] + _row(D_start, D_column, D, 2 * i + k - 1, change)
                x[i, k] -= left / (epsilon * diagonal[i, k])
            else:
                x[i, k] = sign[i, k] * mu[i] * x[i, 0]


@kernel
def _proximal(
    J_start: Ints, J_column: Indices, J: Floats, D_start: Ints, D_column: Indices, D: Floats,
    JM_start: Ints, JM_column: Indices, JM: Floats, DM_start: Ints, DM_column: Indices, DM: Floats,
    W_diagonal: Floats, mu: Floats, v_pre: Floats, target: Floats, slip: Floats, center: Floats,
    order: Ints, start: Ints, later: Ints, slot: Ints, epsilon: float, tolerance: float,
) -> tuple[Floats, bool, int]:  # fmt: skip
    """Best impulses within their bounds, whether they solve the step, iterations."""
    m = mu.size
    diagonal = _tangent_diagonal(D_start, D_column, D, DM_start, DM_column, DM, W_diagonal, mu, v_pre.size)
    matrix = np.empty((slot.max() + 1, BLOCK, BLOCK))
    v = np.empty(v_pre.size)
    change = np.empty(BLOCK * order.size)
    u = np.empty((m, 3))
    act = np.empty((m, 3), np.int32)
    sign = np.empty((m, 3))
    x = center.copy()
    bounded = np.empty((m, 3))
    best = center.copy()
    least = np.inf
    vain = 0
    for iteration in range(ITERATIONS):
        _velocity(JM_start, JM_column, JM, DM_start, DM_column, DM, v_pre, x, v)
        _gradient(J_start, J_column, J, D_start, D_column, D, diagonal, target, slip, center, epsilon, x, v, u)
        _choose(diagonal, mu, epsilon, x, u, act, sign)
        _newton(
            J_start, J_column, J, D_start, D_column, D, JM_start, JM_column, JM, DM_start, DM_column, DM,
            diagonal, mu, v_pre, target, slip, center, act, sign, order, start, later, slot, matrix, epsilon,
            x, u, v, change,
        )  # fmt: skip
        for i in range(m):
            bounded[i, 0] = max(x[i, 0], 0.0)
            bound = mu[i] * bounded[i, 0]
            for k in range(1, 3):
                bounded[i, k] = min(max(x[i, k], -bound), bound)
        _velocity(JM_start, JM_column, JM, DM_start, DM_column, DM, v_pre, bounded, v)
        _gradient(J_start, J_column, J, D_start, D_column, D, diagonal, target, slip, center, epsilon, bounded, v, u)
        violation = _natural_map(diagonal, mu, epsilon, bounded, u)
        vain = 0 if violation < PROGRESS * least else vain + 1
        if violation < least:
            least = violation
            best[:] = bounded
        if violation <= tolerance or vain == PATIENCE:
            return best, violation <= tolerance, iteration + 1
    return best, False, ITERATIONS

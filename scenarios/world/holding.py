"""Impulses that hold what rests: a first guess for the solver of an inelastic impact with friction.

    y + Ĝᵀ R A Ĝ y = y' + Ĝᵀ (A λ + (1 - A) b),      λ ← A (λ - R Ĝ y) + (1 - A) b,       Ĝ = G M^(-1/2), y = M^(1/2) v

G has the rows of J and D. A marks what holds: normals that push, tangents within their bounds ±μ λ; b is the bound of
the others, 0 for normals. R is large beside 1 / diag W. That is the primal-dual active set method on the augmented
Lagrangian (Hintermüller, Ito and Kunisch 2002), with the friction bounds of the last iterate. It begins with everything
held and ends, mostly after a few iterations, where projected Gauss-Seidel takes thousands of sweeps for a stack. The
result is a guess and no more: the solver that is given it makes its own test.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scenarios.world.spheres import Ints
from solvers._jit import kernel
from solvers.solution import Floats

Flags = npt.NDArray[np.bool_]

# Multiplications of one factorization, about as many nanoseconds; larger scenes start from the last impulses alone.
LARGEST = 20_000_000
# Iterations after which the best guess so far is taken.
ITERATIONS = 12
# R over 1 / diag W: an iteration leaves this share of an error, and the factorization keeps ten digits beside it.
STIFF = 1e7
# A row of less than this share of the normal's entry of W moves nothing but by rounding.
IMMOVABLE = 1e-20
# Natural map, relative to the fastest approach, below which a guess is good enough.
GOOD = 1e-7


def holding_impulses(
    body: Ints, block: Floats, velocity: Floats, inverse_mass: Floats, friction: Floats, guess: Floats
) -> Floats:
    """Improve a guess of the impulses (λ, λ₁, λ₂) of an inelastic impact [N s], shape (m, 3).

    Args:
        body: of each contact, shape (m, 2).
        block: rows as `ContactRows.block`, shape (m, 3, 2, 6).
        velocity: (v, ω) before the impact, shape (b, 6).
        inverse_mass: shape (b, 6), zeros where nothing moves.
        friction: μ of each contact, shape (m,).
        guess: impulses to start from [N s], shape (m, 3).
    """
    scaled = _scaled(body, block, np.sqrt(inverse_mass))
    root = np.sqrt(inverse_mass)
    y_pre = np.divide(velocity, root, out=np.zeros_like(velocity), where=root > 0.0)
    # A direction in which nothing can move needs no hold: along the axis of a hinge against what is fixed.
    weight = (scaled**2).sum(axis=(2, 3))
    stiffness = np.divide(STIFF, weight, out=np.zeros_like(weight), where=weight > IMMOVABLE * weight[:, :1])
    impulse = _bounded(guess, friction)
    best, least = impulse, _natural_map(body, scaled, y_pre, impulse, friction)
    enough = GOOD * float(np.abs(_along(body, scaled, y_pre)[:, 0]).max(initial=0.0))
    if least <= enough:
        return best
    first = _profile(body, len(velocity))
    if int(((np.arange(first.size) - first) ** 2).sum()) > LARGEST:
        return best
    # At first everything holds: what lies on something that falls alike is pressed by nothing yet.
    holds = np.ones(impulse.shape, dtype=np.bool_)
    holds[:, 1:] = friction[:, None] > 0.0
    known = impulse
    for _ in range(ITERATIONS):
        trial = _solved(body, scaled, y_pre, known, stiffness, first, holds)
        impulse = _bounded(trial, friction)
        u = _along(body, scaled, _after(body, scaled, y_pre, impulse))
        bound = friction[:, None] * impulse[:, :1]
        # What holds goes on while it need not pull, or exceed its bound; what does not, where it would be pressed, or
        # would slide against its friction.
        holds[:, 0] = np.where(holds[:, 0], trial[:, 0] > 0.0, u[:, 0] < -enough)
        within = np.abs(trial[:, 1:]) <= bound
        holds[:, 1:] = np.where(holds[:, 1:], within, u[:, 1:] * impulse[:, 1:] > 0.0) & (bound > 0.0)
        known = np.where(holds, impulse, 0.0)
        known[:, 1:] = np.where(holds[:, 1:], impulse[:, 1:], np.sign(impulse[:, 1:]) * bound)
        residual = _natural_map(body, scaled, y_pre, impulse, friction)
        if residual < least:
            best, least = impulse, residual
        if least <= enough:
            break
    return best


def _solved(
    body: Ints, scaled: Floats, y_pre: Floats, known: Floats, stiffness: Floats, first: Ints, holds: Flags
) -> Floats:
    """Impulses where what holds keeps still, from those that are known; shape (m, 3)."""
    matrix = _matrix(body, scaled, np.where(holds, stiffness, 0.0), y_pre.shape[0])
    y = _after(body, scaled, y_pre, known).ravel()
    _solve(matrix, first, y)
    return np.where(holds, known - stiffness * _along(body, scaled, y.reshape(-1, 6)), known)


def _bounded(impulse: Floats, friction: Floats) -> Floats:
    """Impulses that push, within the friction bounds."""
    normal = np.maximum(impulse[:, :1], 0.0)
    bound = friction[:, None] * normal
    return np.concatenate([normal, np.clip(impulse[:, 1:], -bound, bound)], axis=1)


@kernel
def _scaled(body: Ints, block: Floats, root: Floats) -> Floats:
    """Ĝ."""
    scaled = np.zeros(block.shape)
    for i in range(block.shape[0]):
        for side in range(2):
            owner = body[i, side]
            if owner < root.shape[0]:
                for row in range(3):
                    for k in range(6):
                        scaled[i, row, side, k] = block[i, row, side, k] * root[owner, k]
    return scaled


@kernel
def _along(body: Ints, scaled: Floats, y: Floats) -> Floats:
    """Ĝ y, shape (m, 3)."""
    u = np.zeros((scaled.shape[0], 3))
    for i in range(scaled.shape[0]):
        for side in range(2):
            owner = body[i, side]
            if owner < y.shape[0]:
                for row in range(3):
                    for k in range(6):
                        u[i, row] += scaled[i, row, side, k] * y[owner, k]
    return u


@kernel
def _after(body: Ints, scaled: Floats, y_pre: Floats, impulse: Floats) -> Floats:
    """The sum y' + Ĝᵀ λ, shape (b, 6)."""
    y = y_pre.copy()
    for i in range(scaled.shape[0]):
        for side in range(2):
            owner = body[i, side]
            if owner < y.shape[0]:
                for row in range(3):
                    for k in range(6):
                        y[owner, k] += scaled[i, row, side, k] * impulse[i, row]
    return y


@kernel
def _natural_map(body: Ints, scaled: Floats, y_pre: Floats, impulse: Floats, friction: Floats) -> float:
    """Largest violation of the boxed LCP [m/s]."""
    u = _along(body, scaled, _after(body, scaled, y_pre, impulse))
    largest = 0.0
    for i in range(u.shape[0]):
        bound = friction[i] * impulse[i, 0]
        for row in range(3):
            diagonal = 0.0
            for side in range(2):
                for k in range(6):
                    diagonal += scaled[i, row, side, k] ** 2
            if row == 0:
                violation = abs(min(u[i, 0], diagonal * impulse[i, 0]))
            elif friction[i] > 0.0 and diagonal > 0.0:
                step = min(max(impulse[i, row] - u[i, row] / diagonal, -bound), bound) - impulse[i, row]
                violation = abs(step) * diagonal
            else:
                violation = 0.0
            largest = max(largest, violation)
    return largest


@kernel
def _matrix(body: Ints, scaled: Floats, weight: Floats, movable: int) -> Floats:
    """1 + Ĝᵀ R A Ĝ, the lower triangle, shape (6b, 6b)."""
    matrix = np.zeros((6 * movable, 6 * movable))
    for d in range(6 * movable):
        matrix[d, d] = 1.0
    for i in range(scaled.shape[0]):
        for side in range(2):
            a = body[i, side]
            if a >= movable:
                continue
            for other in range(2):
                b = body[i, other]
                if b > a:
                    continue
                for row in range(3):
                    if weight[i, row] == 0.0:
                        continue
                    for k in range(6):
                        factor = weight[i, row] * scaled[i, row, side, k]
                        for j in range(6):
                            matrix[6 * a + k, 6 * b + j] += factor * scaled[i, row, other, j]
    return matrix


@kernel
def _profile(body: Ints, movable: int) -> Ints:
    """First column of each row of the matrix that can be other than zero; it stays so in the factor."""
    lowest = np.arange(movable).astype(np.int32)
    for i in range(body.shape[0]):
        a = body[i, 0]
        b = body[i, 1]
        if a < movable and b < movable:
            low = min(a, b)
            lowest[max(a, b)] = min(lowest[max(a, b)], low)
    first = np.empty(6 * movable, np.int32)
    for row in range(first.size):
        first[row] = 6 * lowest[row // 6]
    return first


@kernel
def _solve(matrix: Floats, first: Ints, y: Floats) -> None:
    """Cholesky factor within the profile, in place of the lower triangle, and the solution in place of the right side.

    The matrix is the identity and a sum of squares: no pivot is below one but for rounding.
    """
    n = first.size
    for i in range(n):
        for j in range(first[i], i + 1):
            total = matrix[i, j]
            for k in range(max(first[i], first[j]), j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = max(total, 0.5) ** 0.5 if i == j else total / matrix[j, j]
    for i in range(n):
        total = y[i]
        for k in range(first[i], i):
            total -= matrix[i, k] * y[k]
        y[i] = total / matrix[i, i]
    for i in range(n - 1, -1, -1):
        y[i] /= matrix[i, i]
        for k in range(first[i], i):
            y[k] -= matrix[i, k] * y[i]

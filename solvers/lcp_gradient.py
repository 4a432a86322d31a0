"""Newton LCP by projected gradients: all contacts move at once, one product with W a step, no order of contacts.

    min ½ λᵀ W λ + bᵀ λ,  λ >= 0,   b = (1 + c_r) u_pre          (its optimality conditions are the LCP)

`lcp-apgd` is Nesterov's accelerated projected gradient with restart; `lcp-spg` the spectral projected gradient, whose
steps are Barzilai and Borwein's. Both work on y = √diag(W) λ (Jacobi scaling) and never form W: a product is one pass
from contacts to velocities and one back, over packed rows where the problem comes from spheres, over CSR otherwise.

Residual: the natural map max |min(W λ + b, diag(W) λ)| over the largest |u_pre|, as in `boxed_lcp`.

Sources: Nesterov 1983; O'Donoghue and Candès 2015, "Adaptive restart for accelerated gradient schemes" (gradient
scheme); Mazhar et al. 2015, "Using Nesterov's method to accelerate multibody dynamics with friction and contact";
Birgin, Martínez and Raydan 2000, "Nonmonotone spectral projected gradient methods on convex sets".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.boxed_lcp import MAX_VISITS, first_guess
from solvers.problem import ImpactProblem
from solvers.solution import Floats, ImpactSolution, Status, UnsupportedProblem
from solvers.sphere_rows import sphere_rows

Ints = npt.NDArray[np.int32]
Indices = npt.NDArray[np.uint32]

# Line search of the spectral method: how many former values may be exceeded, and the decrease asked for (Birgin 2000).
MEMORY = 10
DECREASE = 1e-4
# Bounds of the spectral step; W has a unit diagonal, so that 1 is a natural step.
SHORTEST, LONGEST = 1e-10, 1e10
# The gradient is carried along incrementally and computed anew so often.
REFRESH = 64
# The step 1/L must satisfy dᵀ W d ≤ L dᵀ d, up to the rounding of both sums.
ROUNDING = 1e-12


@dataclass(frozen=True)
class ProjectedGradient:
    """Settings of both methods."""

    tolerance: float = 1e-11
    """Natural-map residual at which to stop, relative to the largest |u_pre|."""

    max_iterations: int = 20_000
    """Bound on steps, each one product with W."""

    max_visits: int = MAX_VISITS
    """Bound on contact visits; one step may exceed it by two products."""


@dataclass(frozen=True)
class AcceleratedProjectedGradient(ProjectedGradient):
    """Newton LCP by Nesterov's accelerated projected gradient, restarted where it climbs; no friction."""

    def solve(self, problem: ImpactProblem, *, start: Floats | None = None) -> ImpactSolution:
        """Solve one multi-impact with any restitution per contact, without friction.

        Args:
            problem: the impact.
            start: first guess of the normal impulse [N s], shape (m,); a pull counts as 0.

        Raises:
            UnsupportedProblem: friction.
            ProblemError: the guess has another shape or is not finite.
        """
        return _solution(problem, _accelerated, first_guess(problem, start), self)


@dataclass(frozen=True)
class SpectralProjectedGradient(ProjectedGradient):
    """Newton LCP by the spectral projected gradient with a nonmonotone line search; no friction."""

    def solve(self, problem: ImpactProblem, *, start: Floats | None = None) -> ImpactSolution:
        """Solve one multi-impact with any restitution per contact, without friction.

        Args:
            problem: the impact.
            start: first guess of the normal impulse [N s], shape (m,); a pull counts as 0.

        Raises:
            UnsupportedProblem: friction.
            ProblemError: the guess has another shape or is not finite.
        """
        return _solution(problem, _spectral, first_guess(problem, start), self)


def _solution(problem: ImpactProblem, method: object, guess: Floats, settings: ProjectedGradient) -> ImpactSolution:
    """Run one of the two kernels on the scaled problem, and judge what it reached."""
    if problem.has_friction:
        raise UnsupportedProblem("projected gradients have no friction here: friction must be 0 (lcp-pgs takes any)")
    scale = np.sqrt(problem.W_diagonal)
    rows = sphere_rows(problem)
    J, JM = problem.J, problem.JM
    if rows is None:
        order = np.arange(problem.m, dtype=np.int32)
        normal, body, inverse_mass = np.empty((0, 3)), np.empty((0, 2), np.uint32), np.empty(0)
        J_scaled = J.data / np.repeat(scale, np.diff(J.indptr))
        JM_scaled = JM.data / np.repeat(scale, np.diff(JM.indptr))
    else:
        order = rows.contact
        normal, body, inverse_mass = rows.normal / scale[order, None], rows.body, rows.V[:, 3].copy()
        J_scaled, JM_scaled = np.empty(0), np.empty(0)
    speed = problem.speed or 1.0
    b = ((1.0 + problem.restitution) * problem.u_pre / scale)[order]
    y, iterations, visits = method(  # type: ignore[operator]
        normal, body, inverse_mass,
        J.indptr, J.indices.view(np.uint32), J_scaled, JM.indptr, JM.indices.view(np.uint32), JM_scaled,
        np.zeros(problem.n), np.zeros((inverse_mass.size, 3)),
        scale[order], b, (scale * guess)[order], settings.tolerance * speed, settings.max_iterations,
        settings.max_visits,
    )  # fmt: skip
    impulse = np.empty(problem.m)
    impulse[order] = y
    impulse /= scale
    bounded = iterations >= settings.max_iterations or visits >= settings.max_visits
    missed = Status.ITERATION_LIMIT if bounded else Status.STALLED
    return judged(problem, impulse, settings.tolerance, iterations, visits, missed=missed)


def judged(
    problem: ImpactProblem, impulse: Floats, tolerance: float, iterations: int, visits: int, *, missed: Status
) -> ImpactSolution:
    """Make a solution whose residual and status are computed from the impulse alone, whatever its method claims.

    Args:
        problem: the impact, without friction.
        impulse: normal impulse [N s], shape (m,).
        tolerance: natural-map residual up to which it counts as converged, relative to the largest |u_pre|.
        iterations: of the method.
        visits: contact visits.
        missed: status of an impulse whose residual is larger.
    """
    v = problem.v_after(impulse)
    excess = problem.J @ v + problem.restitution * problem.u_pre
    natural = np.minimum(excess, problem.W_diagonal * impulse)
    residual = float(np.abs(natural).max(initial=0.0)) / (problem.speed or 1.0)
    status = Status.CONVERGED if residual <= tolerance else missed
    if not np.isfinite(v).all():
        status = Status.NOT_FINITE
    return ImpactSolution(impulse, v, status, iterations, visits, residual)


@kernel
def _product(
    normal: Floats, body: Indices, inverse_mass: Floats,
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    dv: Floats, dV: Floats, x: Floats, Wx: Floats,
) -> None:  # fmt: skip
    """W x for the scaled W, from contacts to velocities and back; dv and dV are memory for the velocities."""
    if inverse_mass.size == 0:
        dv[:] = 0.0
        for i in range(x.size):
            for q in range(JM_start[i], JM_start[i + 1]):
                dv[JM_index[q]] += JM[q] * x[i]
        for i in range(x.size):
            u = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                u += J[q] * dv[J_index[q]]
            Wx[i] = u
        return
    dV[:] = 0.0
    for i in range(x.size):
        for axis in range(3):
            f = x[i] * normal[i, axis]
            dV[body[i, 0], axis] -= f
            dV[body[i, 1], axis] += f
    for c in range(inverse_mass.size):
        for axis in range(3):
            dV[c, axis] *= inverse_mass[c]
    for i in range(x.size):
        u = 0.0
        for axis in range(3):
            u += normal[i, axis] * (dV[body[i, 1], axis] - dV[body[i, 0], axis])
        Wx[i] = u


@kernel
def _accelerated(
    normal: Floats, body: Indices, inverse_mass: Floats,
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats, dv: Floats, dV: Floats,
    scale: Floats, b: Floats, y: Floats, tolerance: float, max_iterations: int, max_visits: int,
) -> tuple[Floats, int, int]:  # fmt: skip
    """Accelerated projected gradient from a guess (changed); returns the best y, iterations, contact visits."""
    m = b.size
    Wy = np.zeros(m)
    _product(normal, body, inverse_mass, J_start, J_index, J, JM_start, JM_index, JM, dv, dV, y, Wy)
    best = y.copy()
    best_residual = 0.0
    for i in range(m):
        best_residual = max(best_residual, scale[i] * abs(min(Wy[i] + b[i], y[i])))
    before = np.zeros(m)
    W_before = np.zeros(m)
    after = np.zeros(m)
    W_after = np.zeros(m)
    L = 1.0
    momentum = 1.0
    beta = 0.0
    iterations = 0
    while best_residual > tolerance and iterations < max_iterations and m * (iterations + 1) < max_visits:
        iterations += 1
        # A projected step from x = y + beta (y - before); its gradient by linearity.
        for i in range(m):
            x = y[i] + beta * (y[i] - before[i])
            g = Wy[i] + beta * (Wy[i] - W_before[i]) + b[i]
            after[i] = max(x - g / L, 0.0)
        _product(normal, body, inverse_mass, J_start, J_index, J, JM_start, JM_index, JM, dv, dV, after, W_after)
        residual = 0.0
        dWd = 0.0
        dd = 0.0
        climb = 0.0
        for i in range(m):
            u = W_after[i]
            x = y[i] + beta * (y[i] - before[i])
            Wx = Wy[i] + beta * (Wy[i] - W_before[i])
            d = after[i] - x
            dWd += d * (u - Wx)
            dd += d * d
            climb += (x - after[i]) * (after[i] - y[i])
            residual = max(residual, scale[i] * abs(min(u + b[i], after[i])))
        if residual < best_residual:
            best_residual = residual
            best[:] = after
        if dWd > L * dd * (1.0 + ROUNDING) and dd > 0.0:
            # The step was too long for this direction.
            L = max(1.1 * dWd / dd, 1.1 * L)
            continue
        if climb > 0.0:
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum * momentum))
        beta = (momentum - 1.0) / following
        momentum = following
        before, y, after = y, after, before
        W_before, Wy, W_after = Wy, W_after, W_before
    return best, iterations, m * (iterations + 1)


@kernel
def _spectral(
    normal: Floats, body: Indices, inverse_mass: Floats,
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats, dv: Floats, dV: Floats,
    scale: Floats, b: Floats, y: Floats, tolerance: float, max_iterations: int, max_visits: int,
) -> tuple[Floats, int, int]:  # fmt: skip
    """Spectral projected gradient from a guess (changed); returns the best y, iterations, contact visits."""
    m = b.size
    g = np.zeros(m)
    _product(normal, body, inverse_mass, J_start, J_index, J, JM_start, JM_index, JM, dv, dV, y, g)
    best = y.copy()
    best_residual = 0.0
    value = 0.0
    for i in range(m):
        g[i] += b[i]
        value += 0.5 * y[i] * (g[i] + b[i])
        best_residual = max(best_residual, scale[i] * abs(min(g[i], y[i])))
    d = np.zeros(m)
    Wd = np.zeros(m)
    values = np.full(MEMORY, -np.inf)
    values[0] = value
    step = 1.0
    products = 1
    iterations = 0
    while best_residual > tolerance and iterations < max_iterations and m * products < max_visits:
        iterations += 1
        products += 1
        # The projected spectral step, and W times it.
        gd = 0.0
        dd = 0.0
        for i in range(m):
            d[i] = max(y[i] - step * g[i], 0.0) - y[i]
            if d[i] != 0.0:
                gd += g[i] * d[i]
                dd += d[i] * d[i]
        _product(normal, body, inverse_mass, J_start, J_index, J, JM_start, JM_index, JM, dv, dV, d, Wd)
        dWd = 0.0
        for i in range(m):
            dWd += d[i] * Wd[i]
        # On a quadratic the line search ends with its first trial: the whole step, or the minimum along it.
        length = 1.0
        if value + gd + 0.5 * dWd > values.max() + DECREASE * gd and dWd > 0.0:
            length = min(max(-gd / dWd, 0.0), 1.0)
        value += length * gd + 0.5 * length * length * dWd
        values[iterations % MEMORY] = value
        residual = 0.0
        for i in range(m):
            y[i] = max(y[i] + length * d[i], 0.0)
            g[i] += length * Wd[i]
            residual = max(residual, scale[i] * abs(min(g[i], y[i])))
        if iterations % REFRESH == 0 or residual <= tolerance:
            # Gradient and value anew: increments collect rounding.
            _product(normal, body, inverse_mass, J_start, J_index, J, JM_start, JM_index, JM, dv, dV, y, g)
            residual = 0.0
            value = 0.0
            for i in range(m):
                g[i] += b[i]
                value += 0.5 * y[i] * (g[i] + b[i])
                residual = max(residual, scale[i] * abs(min(g[i], y[i])))
            values[iterations % MEMORY] = value
            products += 1
        if residual < best_residual:
            best_residual = residual
            best[:] = y
        step = min(max(dd / dWd, SHORTEST), LONGEST) if dWd > 0.0 else LONGEST
        if dd == 0.0:
            break
    return best, iterations, m * products

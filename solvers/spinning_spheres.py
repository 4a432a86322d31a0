"""The LCP with restitution and friction for spheres that spin, packed: `boxed_lcp` for the contacts of granular scenes.

    0 <= λ  complementary to  n · Δv - target >= 0              Δv = v_b - v_a
    |λ_k| <= μ λ, opposing  t_k · (Δv - (s_a + s_b) × n)        k = 1, 2;  s = r ω, the spin as a surface speed

A contact's row is a normal and two bodies; t₁ = (-n_y, n_x, 0) / √(n_x² + n_y²) and t₂ = n × t₁ follow from the normal.
An impulse Q = λ n + λ₁ t₁ + λ₂ t₂ changes v by ± Q / m and the spins of both bodies by -κ n × Q / m, κ = m r² / I, so
that W_ii = 1/m_a + 1/m_b for the normal and (1 + κ) W_ii for both tangents, whatever the radii.

Projected Gauss-Seidel as in Zhang 2015, Eq. 21, but with each contact's tangents beside its normal: a contact and its
bodies are read once for three rows. Contacts come in stripes; those of stripes 0, 2, 4, … share no movable body, nor do
those of 1, 3, 5, …, so that each half runs on all threads and gives the same bits on any number of them.

Residual: the natural map, as in `boxed_lcp`, over the largest |u_pre|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel, parallel_kernel, prange
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]
# Unsigned, because a signed index costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]

# Closer to the vertical than this, a normal leaves no usable horizontal direction beside it.
VERTICAL = 1e-9
# Columns of a row: normal, horizontal tangent (x, y), 1 / W_ii, target, λ, λ₁, λ₂, u before, unused.
NORMAL, TANGENT, FREEDOM, TARGET, PUSH, RUB, RUB_2, BEFORE, COLUMNS = 0, 3, 5, 6, 7, 8, 9, 10, 12
# What a stripe reports: residual [m/s], work of the normal impulses [J], largest change of a sweep [m/s].
RESIDUAL, WORK, CHANGE = 0, 1, 2


@dataclass(frozen=True)
class SpinningRows:
    """Contacts between spheres, in stripes."""

    normal: Floats
    """Unit normal from the first body to the second, shape (m, 3)."""

    body: Indices
    """First and second body, shape (m, 2); an immovable one is the first."""

    motion: Floats
    """v [m/s], 1/m [1/kg], s [m/s] and a zero of each body, shape (bodies, 8); immovable bodies have 1/m = 0."""

    stripe: Ints
    """Where each stripe's contacts begin, and m; shape (stripes + 1,). Stripes k and k + 2 share no movable body."""


@dataclass(frozen=True)
class SpinningResult:
    """What the sweeps came to; the velocities are in `motion`."""

    impulse: Floats
    """λ ≥ 0, λ₁ and λ₂ [N s], shape (m, 3)."""
    sweeps: int
    residual: float
    """Natural map [m/s]."""
    normal_work: float
    """Work of the normal impulses, Σ λ (u_pre + u_post) / 2 [J]: the energy that restitution takes."""


def sweep_spheres(
    rows: SpinningRows, target: Floats, start: Floats, *, friction: float, inertia: float, tolerance: float,
    max_sweeps: int,
) -> SpinningResult:  # fmt: skip
    """Solve the LCP with friction from given impulses; `rows.motion` is changed to the velocities after it.

    Args:
        rows: contacts and the velocities before them.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        start: first guess of λ ≥ 0, λ₁ and λ₂ [N s], shape (m, 3).
        friction: coefficient of friction μ ≥ 0 of all contacts.
        inertia: κ = m r² / I, 2.5 for solid spheres.
        tolerance: natural-map residual at which to stop [m/s]; it is measured when a sweep changes less than that.
        max_sweeps: bound on sweeps, each over normals and tangents.
    """
    report = np.zeros((rows.stripe.size - 1, 3))
    packed = _prepare(rows.normal, rows.body, rows.motion, rows.stripe, target, start, inertia)
    sweeps = 0
    while True:
        _sweep(packed, rows.body, rows.motion, rows.stripe, friction, inertia, report)
        sweeps += 1
        if sweeps >= max_sweeps or report[:, CHANGE].max() <= tolerance:
            _measure(packed, rows.body, rows.motion, rows.stripe, friction, inertia, report)
            residual = float(report[:, RESIDUAL].max())
            if sweeps >= max_sweeps or residual <= tolerance:
                break
    # One thread adds a fixed number of sums in order: the same bits on any number of threads.
    work = float(report[:, WORK].sum())
    return SpinningResult(packed[:, PUSH : RUB_2 + 1].copy(), sweeps, residual, work)


@kernel
def _apply(
    row: Floats, i: int, motion: Floats, a: int, b: int, push: float, rub: float, rub_2: float, inertia: float
) -> None:
    """Change the velocities of two bodies by an impulse along normal and tangents."""
    nx = row[i, NORMAL]
    ny = row[i, NORMAL + 1]
    nz = row[i, NORMAL + 2]
    tx = row[i, TANGENT]
    ty = row[i, TANGENT + 1]
    # t₂ = n × t₁ with t₁ horizontal.
    bx = -nz * ty
    by = nz * tx
    bz = nx * ty - ny * tx
    wa = motion[a, 3]
    wb = motion[b, 3]
    qx = push * nx + rub * tx + rub_2 * bx
    qy = push * ny + rub * ty + rub_2 * by
    qz = push * nz + rub_2 * bz
    # n × Q = λ₁ t₂ - λ₂ t₁.
    sx = -inertia * (rub * bx - rub_2 * tx)
    sy = -inertia * (rub * by - rub_2 * ty)
    sz = -inertia * (rub * bz)
    # All stripes share the immovable body: threads that write to it would take its cache line from one another.
    if wa > 0.0:
        motion[a, 0] -= wa * qx
        motion[a, 1] -= wa * qy
        motion[a, 2] -= wa * qz
        motion[a, 4] += wa * sx
        motion[a, 5] += wa * sy
        motion[a, 6] += wa * sz
    motion[b, 0] += wb * qx
    motion[b, 1] += wb * qy
    motion[b, 2] += wb * qz
    motion[b, 4] += wb * sx
    motion[b, 5] += wb * sy
    motion[b, 6] += wb * sz


@kernel
def _approach(row: Floats, i: int, motion: Floats, a: int, b: int) -> float:
    """Normal relative velocity."""
    return float(
        row[i, NORMAL] * (motion[b, 0] - motion[a, 0])
        + row[i, NORMAL + 1] * (motion[b, 1] - motion[a, 1])
        + row[i, NORMAL + 2] * (motion[b, 2] - motion[a, 2])
    )


@kernel
def _slide(row: Floats, i: int, motion: Floats, a: int, b: int) -> tuple[float, float]:
    """Sliding velocity along both tangents."""
    nx = row[i, NORMAL]
    ny = row[i, NORMAL + 1]
    nz = row[i, NORMAL + 2]
    tx = row[i, TANGENT]
    ty = row[i, TANGENT + 1]
    sx = motion[a, 4] + motion[b, 4]
    sy = motion[a, 5] + motion[b, 5]
    sz = motion[a, 6] + motion[b, 6]
    # v_b - v_a, and the part of the surfaces: -(s × n).
    dx = motion[b, 0] - motion[a, 0] - (sy * nz - sz * ny)
    dy = motion[b, 1] - motion[a, 1] - (sz * nx - sx * nz)
    dz = motion[b, 2] - motion[a, 2] - (sx * ny - sy * nx)
    return tx * dx + ty * dy, -nz * ty * dx + nz * tx * dy + (nx * ty - ny * tx) * dz


@kernel
def _clamped(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


@parallel_kernel
def _prepare(
    normal: Floats, body: Indices, motion: Floats, stripe: Ints, target: Floats, start: Floats, inertia: float
) -> Floats:
    """Pack the contacts, and apply the first guess of their impulses."""
    row = np.zeros((normal.shape[0], COLUMNS))
    for k in prange(stripe.size - 1):
        for i in range(stripe[k], stripe[k + 1]):
            nx = normal[i, 0]
            ny = normal[i, 1]
            level = np.sqrt(nx * nx + ny * ny)
            upright = level < VERTICAL
            row[i, NORMAL] = nx
            row[i, NORMAL + 1] = ny
            row[i, NORMAL + 2] = normal[i, 2]
            row[i, TANGENT] = 1.0 if upright else -ny / level
            row[i, TANGENT + 1] = 0.0 if upright else nx / level
            a = body[i, 0]
            b = body[i, 1]
            row[i, FREEDOM] = 1.0 / (motion[a, 3] + motion[b, 3])
            row[i, TARGET] = target[i]
            row[i, PUSH] = start[i, 0]
            row[i, RUB] = start[i, 1]
            row[i, RUB_2] = start[i, 2]
            row[i, BEFORE] = _approach(row, i, motion, a, b)
    for half in range(2):
        for k in prange((stripe.size - half) // 2):
            for i in range(stripe[2 * k + half], stripe[2 * k + half + 1]):
                push, rub, rub_2 = row[i, PUSH], row[i, RUB], row[i, RUB_2]
                _apply(row, i, motion, body[i, 0], body[i, 1], push, rub, rub_2, inertia)
    return row


@kernel
def _sweep_stripe(
    row: Floats, body: Indices, motion: Floats, begin: int, end: int, friction: float, inertia: float
) -> float:
    """One sweep over one stripe; returns the largest change of a relative velocity that it made."""
    change = 0.0
    slip = 1.0 / (1.0 + inertia)
    for i in range(begin, end):
        a = body[i, 0]
        b = body[i, 1]
        freedom = row[i, FREEDOM]
        push = row[i, PUSH]
        new_push = max(push - (_approach(row, i, motion, a, b) - row[i, TARGET]) * freedom, 0.0)
        # Neither normal nor friction impulse, as before: half of the contacts of a moving layer.
        if new_push == 0.0 and push == 0.0:
            continue
        along, across = _slide(row, i, motion, a, b)
        bound = friction * new_push
        rub = row[i, RUB]
        rub_2 = row[i, RUB_2]
        new_rub = _clamped(rub - along * freedom * slip, bound)
        new_rub_2 = _clamped(rub_2 - across * freedom * slip, bound)
        row[i, PUSH] = new_push
        row[i, RUB] = new_rub
        row[i, RUB_2] = new_rub_2
        _apply(row, i, motion, a, b, new_push - push, new_rub - rub, new_rub_2 - rub_2, inertia)
        jump = max(abs(new_push - push), max(abs(new_rub - rub), abs(new_rub_2 - rub_2)) * (1.0 + inertia))
        jump *= motion[a, 3] + motion[b, 3]
        change = max(change, jump)
    return change


@parallel_kernel
def _sweep(
    row: Floats, body: Indices, motion: Floats, stripe: Ints, friction: float, inertia: float, report: Floats
) -> None:
    """One sweep over all contacts, the even stripes first."""
    for half in range(2):
        for k in prange((stripe.size - half) // 2):
            s = 2 * k + half
            report[s, CHANGE] = _sweep_stripe(row, body, motion, stripe[s], stripe[s + 1], friction, inertia)


@parallel_kernel
def _measure(
    row: Floats, body: Indices, motion: Floats, stripe: Ints, friction: float, inertia: float, report: Floats
) -> None:
    """Natural map of normals and tangents, and the work of the normal impulses, per stripe."""
    slip = 1.0 / (1.0 + inertia)
    for k in prange(stripe.size - 1):
        residual = 0.0
        work = 0.0
        for i in range(stripe[k], stripe[k + 1]):
            u = _approach(row, i, motion, body[i, 0], body[i, 1])
            along, across = _slide(row, i, motion, body[i, 0], body[i, 1])
            freedom = row[i, FREEDOM]
            push = row[i, PUSH]
            bound = friction * push
            residual = max(residual, abs(min(u - row[i, TARGET], push / freedom)))
            rub = row[i, RUB]
            rub_2 = row[i, RUB_2]
            sliding = max(
                abs(_clamped(rub - along * freedom * slip, bound) - rub),
                abs(_clamped(rub_2 - across * freedom * slip, bound) - rub_2),
            )
            residual = max(residual, sliding * (1.0 + inertia) / freedom)
            work += 0.5 * push * (row[i, BEFORE] + u)
        report[k, RESIDUAL] = residual
        report[k, WORK] = work

"""The LCP with restitution and friction for spheres that spin, packed: `boxed_lcp` for the contacts of granular scenes.

    0 <= λ  complementary to  n · Δv - target >= 0              Δv = v_b - v_a
    |λ_k| <= μ λ, opposing  w_k + β₀ w_k,pre                    w_k = t_k · (Δv - (s_a + s_b) × n),  k = 1, 2

with s = r ω, the spin as a surface speed. A contact that sticks gives back the share β₀ of the velocity with which its
surfaces slid, the other way around: the tangential restitution of Walton (1993), 0 in Zhang 2015.

A contact's row is a normal and two bodies; t₁ = (-n_y, n_x, 0) / √(n_x² + n_y²) and t₂ = n × t₁ follow from the normal.
An impulse Q = λ n + λ₁ t₁ + λ₂ t₂ changes v by ± Q / m and the spins of both bodies by -κ n × Q / m, κ = m r² / I, so
that W_ii = 1/m_a + 1/m_b for the normal and (1 + κ) W_ii for both tangents, whatever the radii.

Projected Gauss-Seidel as in Zhang 2015, Eq. 21, but with each contact's tangents beside its normal: a contact and its
bodies are read once for three rows. Contacts come in stripes; those of stripes 0, 2, 4, … share no movable body, nor do
those of 1, 3, 5, …, so that each half runs on all threads and gives the same bits on any number of them.

Each stripe is swept twice in a row, the second time out of the cache: first with changes that overshoot by a factor
(successive over-relaxation), then plainly, which solves a contact without neighbors exactly. With a factor of 1.7 six
sweeps come as near to the answer as ten plain ones (`tests/benchmarks/test_bench_world.py` prints the error of both).

Residual: the natural map, as in `boxed_lcp`, over the largest |u_pre|.

Sweeps that end before they converge may leave more kinetic energy than there was: ΔK(α) = α p·u_pre + ½ α² p·Wp for a
share α of all impulses p. The share is then cut to the root of ΔK, α = -2 p·u_pre / p·Wp < 1: nothing is gained, no
momentum is lost, every impulse stays in its bounds, and an answer that gains nothing is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel, parallel_kernel, prange
from solvers.buffers import Buffers
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]
# Unsigned, because a signed index costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]

# Closer to the vertical than this, a normal leaves no usable horizontal direction beside it.
VERTICAL = 1e-9
# Columns of a row: normal, horizontal tangent (x, y), 1 / W_ii, target, λ. It fills a line of the cache; what only
# contacts that press need is elsewhere.
NORMAL, TANGENT, FREEDOM, TARGET, PUSH, COLUMNS = 0, 3, 5, 6, 7, 8
# Sweeps of a stripe before the next one is swept.
SWEEPS_IN_A_ROW = 2
# What a stripe reports: residual [m/s], largest change of a sweep [m/s], λ·u and p·u of all rows before and after [J].
RESIDUAL, CHANGE, PUSH_BEFORE, PUSH_AFTER, ALL_BEFORE, ALL_AFTER, REPORTS = 0, 1, 2, 3, 4, 5, 6


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

    push: Floats
    """λ ≥ 0 [N s], shape (m,): as `rub`, it lasts until the next call with the same buffers."""
    rub: Floats
    """λ₁ and λ₂ [N s], shape (m, 2)."""
    sweeps: int
    residual: float
    """Natural map [m/s]."""
    normal_work: float
    """Work of the normal impulses, Σ λ (u_pre + u_post) / 2 [J]: the energy that restitution takes."""
    share: float
    """Share of the sweeps' impulses that was taken, 1 unless they gained energy."""

    @property
    def impulse(self) -> Floats:
        """λ, λ₁ and λ₂ [N s], a copy, shape (m, 3)."""
        return np.column_stack([self.push, self.rub])


def sweep_spheres(
    rows: SpinningRows, target: Floats, start: Floats, rub_start: Floats | None = None, *, friction: float,
    inertia: float, tolerance: float, max_sweeps: int, overshoot: float = 1.0, tangential_restitution: float = 0.0,
    buffers: Buffers | None = None,
) -> SpinningResult:  # fmt: skip
    """Solve the LCP with friction from given impulses; `rows.motion` is changed to the velocities after it.

    Args:
        rows: contacts and the velocities before them.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        start: first guess of λ ≥ 0 [N s], shape (m,).
        rub_start: first guess of λ₁ and λ₂ [N s], shape (m, 2); None: 0.
        friction: coefficient of friction μ ≥ 0 of all contacts.
        inertia: κ = m r² / I, 2.5 for solid spheres.
        tolerance: natural-map residual at which to stop [m/s]; it is measured when a sweep changes less than that.
        max_sweeps: bound on sweeps, each over normals and tangents; two are made at a time.
        overshoot: factor ≥ 1 of the changes of every other sweep.
        tangential_restitution: β₀ in [0, 1] of all contacts.
        buffers: memory for the rows.
    """
    m = len(rows.normal)
    buffers = buffers or Buffers()
    row, rub, before = buffers.array("row", (m, COLUMNS)), buffers.array("rub", (m, 2)), buffers.array("pre", (m, 3))
    guess = np.empty((0, 2)) if rub_start is None else rub_start
    report = np.zeros((rows.stripe.size - 1, REPORTS))
    body, motion, stripe, rebound = rows.body, rows.motion, rows.stripe, tangential_restitution
    _prepare(rows.normal, body, motion, stripe, target, start, guess, inertia, row, rub, before)
    sweeps = 0
    while True:
        _sweep(row, rub, before, body, motion, stripe, friction, inertia, rebound, overshoot, report)
        sweeps += SWEEPS_IN_A_ROW
        if sweeps >= max_sweeps or report[:, CHANGE].max() <= tolerance:
            _measure(row, rub, before, body, motion, stripe, friction, inertia, rebound, report)
            if sweeps >= max_sweeps or report[:, RESIDUAL].max() <= tolerance:
                break
    share = _share(report)
    if share < 1.0:
        _shorten(row, rub, body, motion, stripe, inertia, share)
        _measure(row, rub, before, body, motion, stripe, friction, inertia, rebound, report)
    # One thread adds a fixed number of sums in order: the same bits on any number of threads.
    work = 0.5 * float(report[:, PUSH_BEFORE].sum() + report[:, PUSH_AFTER].sum())
    return SpinningResult(row[:, PUSH], rub, sweeps, float(report[:, RESIDUAL].max()), work, share)


def _share(report: Floats) -> float:
    """Share of the impulses that gains no energy: 2 ΔK = α p·u_pre + α (p·u_pre + α p·Wp)."""
    before, after = float(report[:, ALL_BEFORE].sum()), float(report[:, ALL_AFTER].sum())
    return 1.0 if before + after <= 0.0 else max(-2.0 * before / (after - before), 0.0)


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
def _approach(row: Floats, i: int, motion: Floats, a: int, b: int) -> tuple[float, float, float]:
    """Relative velocity along normal and tangents."""
    nx = row[i, NORMAL]
    ny = row[i, NORMAL + 1]
    nz = row[i, NORMAL + 2]
    tx = row[i, TANGENT]
    ty = row[i, TANGENT + 1]
    # t₂ = n × t₁ with t₁ horizontal.
    ox = -nz * ty
    oy = nz * tx
    oz = nx * ty - ny * tx
    dx = motion[b, 0] - motion[a, 0]
    dy = motion[b, 1] - motion[a, 1]
    dz = motion[b, 2] - motion[a, 2]
    sx = motion[a, 4] + motion[b, 4]
    sy = motion[a, 5] + motion[b, 5]
    sz = motion[a, 6] + motion[b, 6]
    # The surfaces add -(s × n): -s · t₂ along t₁, s · t₁ along t₂.
    return (
        nx * dx + ny * dy + nz * dz,
        tx * dx + ty * dy - (sx * ox + sy * oy + sz * oz),
        ox * dx + oy * dy + oz * dz + (sx * tx + sy * ty),
    )


@kernel
def _clamped(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


@kernel
def _pack(
    normal: Floats, body: Indices, motion: Floats, begin: int, end: int, target: Floats, start: Floats,
    guess: Floats, row: Floats, rub: Floats, before: Floats,
) -> None:  # fmt: skip
    """Pack some contacts, and the first guess of their impulses."""
    guessed = guess.shape[0] > 0
    for i in range(np.uint64(begin), np.uint64(end)):
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
        row[i, PUSH] = start[i]
        rub[i, 0] = guess[i, 0] if guessed else 0.0
        rub[i, 1] = guess[i, 1] if guessed else 0.0
        before[i, 0], before[i, 1], before[i, 2] = _approach(row, i, motion, a, b)


@kernel
def _push(row: Floats, rub: Floats, body: Indices, motion: Floats, begin: int, end: int, inertia: float) -> None:
    """Apply the impulses of some contacts."""
    for i in range(np.uint64(begin), np.uint64(end)):
        if row[i, PUSH] != 0.0 or rub[i, 0] != 0.0 or rub[i, 1] != 0.0:
            _apply(row, i, motion, body[i, 0], body[i, 1], row[i, PUSH], rub[i, 0], rub[i, 1], inertia)


@parallel_kernel
def _prepare(
    normal: Floats, body: Indices, motion: Floats, stripe: Ints, target: Floats, start: Floats, guess: Floats,
    inertia: float, row: Floats, rub: Floats, before: Floats,
) -> None:  # fmt: skip
    """Pack the contacts, and apply the first guess of their impulses."""
    for k in prange(stripe.size - 1):
        _pack(normal, body, motion, stripe[k], stripe[k + 1], target, start, guess, row, rub, before)
    for half in range(2):
        for k in prange((stripe.size - half) // 2):
            s = 2 * k + half
            _push(row, rub, body, motion, stripe[s], stripe[s + 1], inertia)


@kernel
def _sweep_stripe(
    row: Floats, rub: Floats, before: Floats, body: Indices, motion: Floats, begin: int, end: int, friction: float,
    inertia: float, rebound: float, factor: float,
) -> float:  # fmt: skip
    """One sweep over one stripe; returns the largest change of a relative velocity that it made.

    `factor` multiplies the changes before they are cut to their bounds.

    All is written out, with every velocity read once: a call would cost as much as the work.
    """
    change = 0.0
    slip = 1.0 / (1.0 + inertia)
    for i in range(np.uint64(begin), np.uint64(end)):
        a = body[i, 0]
        b = body[i, 1]
        nx = row[i, NORMAL]
        ny = row[i, NORMAL + 1]
        nz = row[i, NORMAL + 2]
        vx_a, vy_a, vz_a = motion[a, 0], motion[a, 1], motion[a, 2]
        vx_b, vy_b, vz_b = motion[b, 0], motion[b, 1], motion[b, 2]
        dx = vx_b - vx_a
        dy = vy_b - vy_a
        dz = vz_b - vz_a
        freedom = row[i, FREEDOM] * factor
        push = row[i, PUSH]
        new_push = max(push - (nx * dx + ny * dy + nz * dz - row[i, TARGET]) * freedom, 0.0)
        # Neither normal nor friction impulse, as before: half of the contacts of a moving layer.
        if new_push == 0.0 and push == 0.0:
            continue
        tx = row[i, TANGENT]
        ty = row[i, TANGENT + 1]
        # t₂ = n × t₁ with t₁ horizontal.
        ox = -nz * ty
        oy = nz * tx
        oz = nx * ty - ny * tx
        sx_a, sy_a, sz_a = motion[a, 4], motion[a, 5], motion[a, 6]
        sx_b, sy_b, sz_b = motion[b, 4], motion[b, 5], motion[b, 6]
        sx = sx_a + sx_b
        sy = sy_a + sy_b
        sz = sz_a + sz_b
        along = tx * dx + ty * dy - (sx * ox + sy * oy + sz * oz)
        across = ox * dx + oy * dy + oz * dz + (sx * tx + sy * ty)
        # Otherwise `before` stays out of the cache.
        if rebound > 0.0:
            along += rebound * before[i, 1]
            across += rebound * before[i, 2]
        bound = friction * new_push
        rub_1 = rub[i, 0]
        rub_2 = rub[i, 1]
        new_rub_1 = min(max(rub_1 - along * freedom * slip, -bound), bound)
        new_rub_2 = min(max(rub_2 - across * freedom * slip, -bound), bound)
        row[i, PUSH] = new_push
        rub[i, 0] = new_rub_1
        rub[i, 1] = new_rub_2
        # Q, and -κ n × Q with n × Q = λ₁ t₂ - λ₂ t₁.
        p = new_push - push
        p_1 = new_rub_1 - rub_1
        p_2 = new_rub_2 - rub_2
        qx = p * nx + p_1 * tx + p_2 * ox
        qy = p * ny + p_1 * ty + p_2 * oy
        qz = p * nz + p_2 * oz
        ux = inertia * (p_2 * tx - p_1 * ox)
        uy = inertia * (p_2 * ty - p_1 * oy)
        uz = -inertia * p_1 * oz
        w_a = motion[a, 3]
        w_b = motion[b, 3]
        # All stripes share the immovable body: threads that write to it would take its cache line from one another.
        if w_a > 0.0:
            motion[a, 0], motion[a, 1], motion[a, 2] = vx_a - w_a * qx, vy_a - w_a * qy, vz_a - w_a * qz
            motion[a, 4], motion[a, 5], motion[a, 6] = sx_a + w_a * ux, sy_a + w_a * uy, sz_a + w_a * uz
        motion[b, 0], motion[b, 1], motion[b, 2] = vx_b + w_b * qx, vy_b + w_b * qy, vz_b + w_b * qz
        motion[b, 4], motion[b, 5], motion[b, 6] = sx_b + w_b * ux, sy_b + w_b * uy, sz_b + w_b * uz
        jump = max(abs(p), max(abs(p_1), abs(p_2)) * (1.0 + inertia)) * (w_a + w_b)
        change = max(change, jump)
    return change


@parallel_kernel
def _sweep(
    row: Floats, rub: Floats, before: Floats, body: Indices, motion: Floats, stripe: Ints, friction: float,
    inertia: float, rebound: float, overshoot: float, report: Floats,
) -> None:  # fmt: skip
    """Two sweeps over all contacts, the even stripes first."""
    for half in range(2):
        for k in prange((stripe.size - half) // 2):
            s = 2 * k + half
            begin = stripe[s]
            end = stripe[s + 1]
            _sweep_stripe(row, rub, before, body, motion, begin, end, friction, inertia, rebound, overshoot)
            report[s, CHANGE] = _sweep_stripe(
                row, rub, before, body, motion, begin, end, friction, inertia, rebound, 1.0
            )  # fmt: skip


@kernel
def _measure_stripe(
    row: Floats, rub: Floats, before: Floats, body: Indices, motion: Floats, begin: int, end: int, friction: float,
    inertia: float, rebound: float, report: Floats,
) -> None:  # fmt: skip
    """Fill the report of one stripe, shape (REPORTS,)."""
    slip = 1.0 / (1.0 + inertia)
    residual = 0.0
    push_before = push_after = all_before = all_after = 0.0
    for i in range(np.uint64(begin), np.uint64(end)):
        u, along, across = _approach(row, i, motion, body[i, 0], body[i, 1])
        freedom = row[i, FREEDOM]
        push = row[i, PUSH]
        bound = friction * push
        residual = max(residual, abs(min(u - row[i, TARGET], push / freedom)))
        rub_1 = rub[i, 0]
        rub_2 = rub[i, 1]
        sliding = max(
            abs(_clamped(rub_1 - (along + rebound * before[i, 1]) * freedom * slip, bound) - rub_1),
            abs(_clamped(rub_2 - (across + rebound * before[i, 2]) * freedom * slip, bound) - rub_2),
        )
        residual = max(residual, sliding * (1.0 + inertia) / freedom)
        push_before += push * before[i, 0]
        push_after += push * u
        all_before += push * before[i, 0] + rub_1 * before[i, 1] + rub_2 * before[i, 2]
        all_after += push * u + rub_1 * along + rub_2 * across
    report[RESIDUAL] = residual
    report[PUSH_BEFORE] = push_before
    report[PUSH_AFTER] = push_after
    report[ALL_BEFORE] = all_before
    report[ALL_AFTER] = all_after


@parallel_kernel
def _measure(
    row: Floats, rub: Floats, before: Floats, body: Indices, motion: Floats, stripe: Ints, friction: float,
    inertia: float, rebound: float, report: Floats,
) -> None:  # fmt: skip
    """Natural map of normals and tangents, and what the work of the impulses is made of, per stripe."""
    for k in prange(stripe.size - 1):
        _measure_stripe(
            row, rub, before, body, motion, stripe[k], stripe[k + 1], friction, inertia, rebound, report[k]
        )  # fmt: skip


@parallel_kernel
def _shorten(
    row: Floats, rub: Floats, body: Indices, motion: Floats, stripe: Ints, inertia: float, share: float
) -> None:
    """Take back all of the impulses but a share."""
    for half in range(2):
        for k in prange((stripe.size - half) // 2):
            for i in range(np.uint64(stripe[2 * k + half]), np.uint64(stripe[2 * k + half + 1])):
                push = row[i, PUSH]
                rub_1 = rub[i, 0]
                rub_2 = rub[i, 1]
                row[i, PUSH] = share * push
                rub[i, 0] = share * rub_1
                rub[i, 1] = share * rub_2
                _apply(
                    row, i, motion, body[i, 0], body[i, 1],
                    (share - 1.0) * push, (share - 1.0) * rub_1, (share - 1.0) * rub_2, inertia,
                )  # fmt: skip

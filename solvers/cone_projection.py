"""Projection in the mass norm on the velocities that contacts allow, and reflections about it.

    project    v = argmin ½ |v - v_start|²  subject to  J v >= target        0 <= λ complementary to J v - target >= 0
    reflect    V = {i : u_i < -tol},  Π_V v = argmin |w - v|² s.t. J_V w >= 0,  v ← 2 Π_V v - v,  until V is empty

The LCP is solved to rounding: projected Gauss-Seidel finds the contacts that push, conjugate gradients on those alone
remove the slow modes that Gauss-Seidel leaves (in the spirit of Moré and Toraldo 1991, "On the solution of large
quadratic programming problems with bound constraints"). Both work on the couplings W_ij of the contacts that take
part, and on those alone: in a dense layer that is kicked at most four contacts in ten approach at a time, each with
three or four neighbors among them instead of ten. A visit is then a short row of W instead of two bodies' velocities,
read and written.

After a reflection only contacts of the bodies that moved can be violated: where few moved, only those are looked at, so
that a pulse that runs through a chain costs the same at every step, however long the chain.

Source of the reflections: Smith 2012, "Reflections on simultaneous impact".
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.problem import ImpactProblem
from solvers.solution import Floats, UnsupportedProblem
from solvers.sphere_rows import RENUMBERED, sparse_rows, sphere_rows

Ints = npt.NDArray[np.int32]
# Unsigned where an entry is itself an index: a signed one costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]
Offsets = npt.NDArray[np.int64]

# Gauss-Seidel sweeps between two conjugate-gradient runs: enough to change the set of pushing contacts.
SWEEPS_PER_FACE = 6
# A face is left when its gradient is so much smaller than the tolerance, or has come down to rounding (squared).
FACE_ACCURACY = 0.1
ROUNDING = 1e-30
# Where fewer than one contact in so many was violated, only their neighborhood is searched for violated ones.
SEARCH_ALL = 24
# Couplings take 12 bytes each; more than this is a body with tens of thousands of contacts.
MOST_COUPLINGS = 100_000_000


def project(
    problem: ImpactProblem,
    target: Floats,
    v_start: Floats,
    impulse: Floats,
    *,
    tolerance: float,
    max_sweeps: int,
    max_visits: int,
) -> tuple[Floats, Floats, int, int, float]:
    """Project v_start, shape (n,), on {J v ≥ target}, from a first guess of the impulse, shape (m,), ≥ 0.

    Args:
        problem: bodies and contacts; friction is not read.
        target: normal relative velocity to reach at least [m/s], shape (m,).
        v_start: velocity before [m/s], shape (n,).
        impulse: first guess [N s], shape (m,), ≥ 0.
        tolerance: natural map at which to stop [m/s].
        max_sweeps: bound on sweeps; a conjugate-gradient step counts as one.
        max_visits: bound on contact visits.

    Returns:
        impulse [N s], velocity [m/s], sweeps, contact visits, natural map [m/s].

    Raises:
        UnsupportedProblem: bodies have too many contacts.
    """
    _require_few_couplings(problem)
    J, JM = problem.J, problem.JM
    return _project(
        J.indptr, J.indices.view(np.uint32), J.data, JM.indptr, JM.indices.view(np.uint32), JM.data,
        v_start.copy(), target, impulse, tolerance, max_sweeps, max_visits,
    )  # fmt: skip


def reflect(
    problem: ImpactProblem,
    *,
    threshold: float,
    tolerance: float,
    max_iterations: int,
    max_sweeps: int,
    max_visits: int,
) -> tuple[Floats, Floats, int, int, int, float]:
    """Reflect the velocity about the inelastic outcome of all violated contacts until there are none.

    The velocity is carried along, not formed from the sum of the impulses: where a body is squeezed from both sides
    that sum grows without bound and the difference of its parts loses digits that the velocity itself keeps.

    Args:
        problem: bodies and contacts; friction and restitution are not read.
        threshold: a contact is violated when u < -threshold [m/s].
        tolerance: natural map of each inelastic LCP at which to stop [m/s].
        max_iterations: bound on reflections.
        max_sweeps: bound on the sweeps of one inelastic LCP.
        max_visits: bound on contact visits; the LCP in progress stops where it is.

    Returns:
        impulse [N s], velocity [m/s], reflections, violated contacts that are left, contact visits, largest natural
        map that an inelastic LCP was left with [m/s].

    Raises:
        UnsupportedProblem: bodies have too many contacts.
    """
    _require_few_couplings(problem)
    J, JM = problem.J, problem.JM
    rows = sphere_rows(problem) if problem.m >= RENUMBERED else None
    if rows is None:
        matrices = J.indptr, J.indices.view(np.uint32), J.data, JM.indptr, JM.indices.view(np.uint32), JM.data
        v_pre = problem.v_pre
    else:
        matrices = sparse_rows(rows)
        v_pre = rows.V[:, :3].ravel()
        for array in (*matrices, v_pre):
            # As the problem's own arrays are, so that the kernel compiles once.
            array.flags.writeable = False
    impulse, v, iterations, left, visits, residual = _reflect(
        *matrices, v_pre, threshold, tolerance, max_iterations, max_sweeps, max_visits
    )
    if rows is not None:
        impulse = rows.in_problem_order(impulse)
        v = rows.velocity_in_problem_order(v.reshape(-1, 3), problem.n)
    return impulse, v, iterations, left, visits, residual


def _require_few_couplings(problem: ImpactProblem) -> None:
    """Refuse bodies with so many contacts that the couplings would not fit in memory."""
    read, written = (np.bincount(rows.indices, minlength=problem.n) for rows in (problem.J, problem.JM))
    most = int(read @ written)
    if most > MOST_COUPLINGS:
        raise UnsupportedProblem(
            f"contacts that share bodies have up to {most} couplings, more than {MOST_COUPLINGS} "
            "(lcp-pgs stores none, however many contacts a body has)"
        )


@kernel
def _couplings(
    active: Indices, size: int, J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices,
    JM: Floats, count: Ints, first: Ints,
) -> tuple[Offsets, Indices, Floats, Floats]:  # fmt: skip
    """Rows of W among some contacts, scaled to a unit diagonal, which is left out; and √diag(W).

    `count`, zero for every velocity, and `first` are memory that is given back as it was.
    """
    # Per velocity: the active contacts that read it, one after the other.
    for k in range(size):
        i = active[k]
        for q in range(J_start[i], J_start[i + 1]):
            count[J_index[q]] += 1
    records = 0
    for k in range(size):
        i = active[k]
        for q in range(J_start[i], J_start[i + 1]):
            d = J_index[q]
            if count[d] > 0:
                first[d] = records
                records += count[d]
                count[d] = -count[d]
    record = np.empty(records)
    record_of = np.empty(records, np.uint32)
    for k in range(size):
        i = active[k]
        for q in range(J_start[i], J_start[i + 1]):
            d = J_index[q]
            count[d] = max(count[d], 0)
            p = first[d] + count[d]
            record[p] = J[q]
            record_of[p] = k
            count[d] += 1
    most = 0
    for k in range(size):
        i = active[k]
        for q in range(JM_start[i], JM_start[i + 1]):
            most += count[JM_index[q]]
    # The rows; contacts that share several velocities are met several times.
    start = np.empty(size + 1, np.int64)
    neighbor = np.empty(most, np.uint32)
    coupling = np.empty(most)
    scale = np.empty(size)
    met = np.full(size, -1, np.int64)
    row = 0
    start[0] = 0
    for k in range(size):
        i = active[k]
        stop = row
        own = 0.0
        for q in range(JM_start[i], JM_start[i + 1]):
            d = JM_index[q]
            for p in range(first[d], first[d] + count[d]):
                j = record_of[p]
                w = JM[q] * record[p]
                if j == k:
                    own += w
                elif met[j] < row:
                    met[j] = stop
                    neighbor[stop] = j
                    coupling[stop] = w
                    stop += 1
                else:
                    coupling[met[j]] += w
        scale[k] = np.sqrt(own)
        row = stop
        start[k + 1] = row
    for k in range(size):
        for q in range(start[k], start[k + 1]):
            coupling[q] /= scale[k] * scale[neighbor[q]]
        i = active[k]
        for q in range(J_start[i], J_start[i + 1]):
            count[J_index[q]] = 0
    return start, neighbor[:row], coupling[:row], scale


@kernel
def _pairs(start: Offsets, neighbor: Indices, coupling: Floats) -> tuple[Indices, Indices, Floats]:
    """The same couplings with each pair of contacts once, in one list: a product without rows has no inner loop.

    Rows of three or four entries, now more, now less, cost a mispredicted branch each: 15 ns a row, and 4 ns in this
    form (77,068 violated contacts of a kicked layer of 60,000 spheres).
    """
    # One place more than there are pairs: what is written there is not counted.
    most = neighbor.size // 2 + 1
    one = np.empty(most, np.uint32)
    other = np.empty(most, np.uint32)
    weight = np.empty(most)
    pairs = 0
    for k in range(start.size - 1):
        for q in range(start[k], start[k + 1]):
            one[pairs] = k
            other[pairs] = neighbor[q]
            weight[pairs] = coupling[q]
            pairs += neighbor[q] < k
    return one[:pairs], other[:pairs], weight[:pairs]


@kernel
def _product(one: Indices, other: Indices, weight: Floats, x: Floats, Wx: Floats) -> None:
    """W x, with the unit diagonal."""
    Wx[:] = x
    for q in range(one.size):
        i = one[q]
        j = other[q]
        Wx[i] += weight[q] * x[j]
        Wx[j] += weight[q] * x[i]


@kernel
def _longest_step(x: Floats, p: Floats, length: float) -> float:
    """How far x may go along p, at most by `length`, before an entry turns negative."""
    # Most steps are free, and to see that takes no division.
    pulling = 0
    for i in range(x.size):
        pulling += x[i] + length * p[i] < 0.0
    if pulling > 0:
        for i in range(x.size):
            if p[i] < 0.0:
                length = min(length, -x[i] / p[i])
    return length


@kernel
def _gauss_seidel(start: Offsets, neighbor: Indices, coupling: Floats, scale: Floats, b: Floats, x: Floats) -> float:
    """One projected sweep; returns the largest velocity change that it made."""
    change = 0.0
    for i in range(x.size):
        u = b[i]
        for q in range(start[i], start[i + 1]):
            u += coupling[q] * x[neighbor[q]]
        pushed = -u if u < 0.0 else 0.0
        jump = abs(pushed - x[i]) * scale[i]
        change = jump if jump > change else change
        x[i] = pushed
    return change


@kernel
def _descend(
    one: Indices, other: Indices, weight: Floats, scale: Floats, u: Floats, x: Floats,
    tolerance: float, max_steps: int, max_visits: int,
) -> tuple[int, int]:  # fmt: skip
    """Conjugate gradients on the pushing contacts, until one would pull; x is changed; returns steps and visits.

    They are compressed first: where few push, a step costs what those few cost. u = W x + b at all contacts.
    """
    # One place more than there are: what is written there is not counted.
    free = np.empty(x.size + 1, np.uint32)
    number = np.empty(x.size, np.uint32)
    m = 0
    for i in range(x.size):
        free[m] = i
        number[i] = m
        m += x[i] > 0.0
    face_one = np.empty(one.size + 1, np.uint32)
    face_other = np.empty(one.size + 1, np.uint32)
    face_weight = np.empty(one.size + 1)
    pairs = 0
    for q in range(one.size):
        face_one[pairs] = number[one[q]]
        face_other[pairs] = number[other[q]]
        face_weight[pairs] = weight[q]
        pairs += (x[one[q]] > 0.0) & (x[other[q]] > 0.0)
    y = np.empty(m)
    r = np.empty(m)
    p = np.empty(m)
    Wp = np.empty(m)
    face_scale = np.empty(m)
    rr = 0.0
    for k in range(m):
        i = free[k]
        y[k] = x[i]
        r[k] = -u[i]
        p[k] = r[k]
        face_scale[k] = scale[i]
        rr += r[k] * r[k]
    rr_start = rr
    steps = 0
    while steps < min(2 * m + 10, max_steps) and steps * m < max_visits and rr > ROUNDING * rr_start:
        _product(face_one[:pairs], face_other[:pairs], face_weight[:pairs], p, Wp)
        steps += 1
        pWp = 0.0
        for k in range(m):
            pWp += p[k] * Wp[k]
        if not pWp > 0.0:
            break
        wanted = rr / pWp
        length = _longest_step(y, p, wanted)
        rr_before = rr
        rr = 0.0
        largest = 0.0
        for k in range(m):
            pushed = y[k] + length * p[k]
            y[k] = pushed if pushed > 0.0 else 0.0
            r[k] -= length * Wp[k]
            rr += r[k] * r[k]
            left = abs(r[k]) * face_scale[k]
            largest = left if left > largest else largest
        if length < wanted or largest <= FACE_ACCURACY * tolerance:
            break
        beta = rr / rr_before
        for k in range(m):
            p[k] = r[k] + beta * p[k]
    for k in range(m):
        x[free[k]] = y[k]
    return steps, steps * m


@kernel
def _solve(
    start: Offsets, neighbor: Indices, coupling: Floats, scale: Floats, b: Floats, x: Floats,
    tolerance: float, max_sweeps: int, max_visits: int,
) -> tuple[Floats, int, int, float]:  # fmt: skip
    """0 <= x complementary to W x + b >= 0 from a guess (changed); returns x, sweeps, visits, natural map [m/s].

    x = √diag(W) λ and b = u / √diag(W), so that W has a unit diagonal. Loops without branches where it can be: half of
    all contacts push or pull, at random.
    """
    m = b.size
    best = x.copy()
    best_residual = np.inf
    one, other, weight = _pairs(start, neighbor, coupling)
    u = np.zeros(m)
    sweeps = 0
    visits = 0
    idle = 0
    while True:
        # Natural map.
        _product(one, other, weight, x, u)
        visits += m
        residual = 0.0
        for i in range(m):
            u[i] += b[i]
            least = abs(u[i] if u[i] < x[i] else x[i]) * scale[i]
            residual = least if least > residual else residual
        if residual < best_residual:
            idle = 0
            best_residual = residual
            best[:] = x
        else:
            idle += 1
        bounded = sweeps >= max_sweeps or visits >= max_visits or idle >= max_sweeps // 20 + 20
        if residual <= tolerance or bounded:
            return best, sweeps, visits, best_residual
        steps, step_visits = _descend(
            one, other, weight, scale, u, x, tolerance, max_sweeps - sweeps, max_visits - visits
        )
        sweeps += steps
        visits += step_visits
        # Gauss-Seidel: contacts that start or stop pushing.
        for _ in range(SWEEPS_PER_FACE):
            change = _gauss_seidel(start, neighbor, coupling, scale, b, x)
            sweeps += 1
            visits += m
            if change <= FACE_ACCURACY * tolerance:
                break


@kernel
def _push(
    active: Indices, size: int, factor: float, part: Floats, JM_start: Ints, JM_index: Indices, JM: Floats, v: Floats,
) -> None:  # fmt: skip
    """Add M⁻¹ Jᵀ times a multiple of the impulses of some contacts to v."""
    for k in range(size):
        i = active[k]
        for q in range(JM_start[i], JM_start[i + 1]):
            v[JM_index[q]] += factor * part[k] * JM[q]


@kernel
def _row(J_start: Ints, J_index: Indices, J: Floats, i: int, v: Floats) -> float:
    """Relative velocity of one contact."""
    u = 0.0
    for q in range(J_start[i], J_start[i + 1]):
        u += J[q] * v[J_index[q]]
    return u


@kernel
def _readers(J_start: Ints, J_index: Indices, n: int) -> tuple[Ints, Indices]:
    """The contacts that read each velocity, one velocity after the other."""
    start = np.zeros(n + 2, np.int32)
    for q in range(J_index.size):
        start[J_index[q] + 2] += 1
    for d in range(2, n + 2):
        start[d] += start[d - 1]
    reader = np.empty(J_index.size, np.uint32)
    for i in range(J_start.size - 1):
        for q in range(J_start[i], J_start[i + 1]):
            d = J_index[q] + 1
            reader[start[d]] = i
            start[d] += 1
    return start, reader


@kernel
def _project(
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    v: Floats, target: Floats, guess: Floats, tolerance: float, max_sweeps: int, max_visits: int,
) -> tuple[Floats, Floats, int, int, float]:  # fmt: skip
    """Returns impulse, velocity (changed), sweeps, visits, natural map [m/s]."""
    m = target.size
    every = np.arange(m).astype(np.uint32)
    start, neighbor, coupling, scale = _couplings(
        every, m, J_start, J_index, J, JM_start, JM_index, JM, np.zeros(v.size, np.int32), np.zeros(v.size, np.int32)
    )
    b = np.empty(m)
    for i in range(m):
        b[i] = (_row(J_start, J_index, J, i, v) - target[i]) / scale[i]
    x, sweeps, visits, residual = _solve(
        start, neighbor, coupling, scale, b, guess * scale, tolerance, max_sweeps, max_visits
    )
    impulse = x / scale
    _push(every, m, 1.0, impulse, JM_start, JM_index, JM, v)
    return impulse, v, sweeps, visits + m, residual


@kernel
def _reflect(
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    v_pre: Floats, threshold: float, tolerance: float, max_iterations: int, max_sweeps: int, max_visits: int,
) -> tuple[Floats, Floats, int, int, int, float]:  # fmt: skip
    """Returns impulse, velocity, reflections, violated contacts left, visits, largest natural map left [m/s]."""
    m = J_start.size - 1
    v = v_pre.copy()
    impulse = np.zeros(m)
    # One place more than there are contacts: what is written there is not counted.
    violated = np.empty(m + 1, np.uint32)
    reflected = np.empty(m + 1, np.uint32)
    u = np.empty(m + 1)
    count = np.zeros(v.size, np.int32)
    first = np.zeros(v.size, np.int32)
    # What only a search by neighborhood needs: the contacts of each velocity, and when each was looked at last.
    reader_start = np.empty(0, np.int32)
    reader = np.empty(0, np.uint32)
    contact_seen = np.empty(0, np.int32)
    velocity_seen = np.empty(0, np.int32)
    visits = 0
    iterations = 0
    worst = 0.0
    before = m
    while True:
        size = 0
        if before * SEARCH_ALL > m:
            # No branch here: a few in ten are violated, at random.
            for i in range(m):
                u_i = _row(J_start, J_index, J, i, v)
                violated[size] = i
                u[size] = u_i
                size += u_i < -threshold
            visits += m
        else:
            if reader_start.size == 0:
                reader_start, reader = _readers(J_start, J_index, v.size)
                contact_seen = np.full(m, -1, np.int32)
                velocity_seen = np.full(v.size, -1, np.int32)
            for k in range(before):
                i = reflected[k]
                for q in range(JM_start[i], JM_start[i + 1]):
                    d = JM_index[q]
                    if velocity_seen[d] == iterations:
                        continue
                    velocity_seen[d] = iterations
                    for p in range(reader_start[d], reader_start[d + 1]):
                        j = reader[p]
                        if contact_seen[j] == iterations:
                            continue
                        contact_seen[j] = iterations
                        u_j = _row(J_start, J_index, J, j, v)
                        violated[size] = j
                        u[size] = u_j
                        size += u_j < -threshold
                        visits += 1
        if size == 0 or iterations == max_iterations or visits >= max_visits:
            return impulse, v, iterations, size, visits, worst
        start, neighbor, coupling, scale = _couplings(
            violated, size, J_start, J_index, J, JM_start, JM_index, JM, count, first
        )
        x, _, inner_visits, residual = _solve(
            start, neighbor, coupling, scale, u[:size] / scale, np.zeros(size),
            tolerance, max_sweeps, max_visits - visits,
        )  # fmt: skip
        visits += inner_visits + size
        worst = max(worst, residual)
        # Twice the change: the reflection of v about the face of the inelastic outcome.
        for k in range(size):
            x[k] /= scale[k]
            impulse[violated[k]] += 2.0 * x[k]
        _push(violated, size, 2.0, x, JM_start, JM_index, JM, v)
        iterations += 1
        before = size
        violated, reflected = reflected, violated

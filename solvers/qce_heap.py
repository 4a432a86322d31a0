"""QCE by a heap: the reference that ends one contact after the other, earliest first.

Algorithm 1 of Zhang 2015 as `quadratic_contact_energy` corrects it, on an indexed binary heap and sparse rows; W is not
built. It serves small problems, bodies with very many contacts, and as the oracle of `qce_stream` in tests.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.problem import ImpactProblem
from solvers.solution import Floats

Ints = npt.NDArray[np.int32]
# Unsigned where an entry is itself an index: a signed one costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]

# Ends closer than a few rounding errors are one event: symmetric scenes have them always.
TIE = 8 * np.finfo(np.float64).eps
# Bound on contact visits where none is given: about a minute on one thread.
MAX_VISITS = 1_000_000_000


def solve_by_heap(
    problem: ImpactProblem, *, threshold: float, defer: float, max_iterations: int, max_visits: int = MAX_VISITS
) -> tuple[Floats, int, int, bool]:
    """Run QCE's outer iteration.

    Args:
        problem: bodies, contacts, velocities; restitution and friction are not read.
        threshold: a contact approaches when u < -threshold [m/s].
        defer: contacts with F_i < defer · max F wait for the next outer iteration; dimensionless.
        max_iterations: bound on outer iterations.
        max_visits: bound on contact visits; an outer iteration that it interrupts is not applied.

    Returns:
        impulse [N s], shape (m,); outer iterations; contact visits; whether it stalled.
    """
    J, JT, JM, MJT = problem.J, problem.JT, problem.JM, problem.MJT
    impulse, _, iterations, visits, stalled = _solve(
        J.indptr, J.indices.view(np.uint32), J.data,
        JT.indptr, JT.indices,
        JM.indptr, JM.indices.view(np.uint32), JM.data,
        MJT.indptr, MJT.indices.view(np.uint32), MJT.data,
        problem.v_pre, threshold, defer, max_iterations, max_visits,
    )  # fmt: skip
    return impulse, iterations, visits, stalled


@kernel
def _first_end(e: float, v: float, w: float) -> float:
    """First t ≥ 0 at which e + v t + ½ w t² crosses zero upward; inf where it never does."""
    if v <= 0.0:
        if w <= 0.0:
            return np.inf
        return float((-v + np.sqrt(max(v * v - 2.0 * w * e, 0.0))) / w)
    discriminant = v * v - 2.0 * w * e
    if discriminant < 0.0:
        return np.inf
    # Rounding may leave e slightly above zero: the contact ends now.
    return float(max(-2.0 * e / (v + np.sqrt(discriminant)), 0.0))


@kernel
def _sift_up(heap: Ints, place: Ints, end: Floats, start: int) -> None:
    """Move the contact at heap position `start` up until its parent ends no later."""
    position = start
    i = heap[position]
    while position > 0:
        parent = (position - 1) >> 1
        j = heap[parent]
        if end[j] <= end[i]:
            break
        heap[position] = j
        place[j] = position
        position = parent
    heap[position] = i
    place[i] = position


@kernel
def _sift_down(heap: Ints, place: Ints, end: Floats, start: int, size: int) -> None:
    """Move the contact at heap position `start` down until its children end no earlier."""
    position = start
    i = heap[position]
    while True:
        child = 2 * position + 1
        if child >= size:
            break
        if child + 1 < size and end[heap[child + 1]] < end[heap[child]]:
            child += 1
        j = heap[child]
        if end[i] <= end[j]:
            break
        heap[position] = j
        place[j] = position
        position = child
    heap[position] = i
    place[i] = position


@kernel
def _solve(
    J_start: Ints, J_index: Indices, J: Floats,
    JT_start: Ints, JT_index: Ints,
    JM_start: Ints, JM_index: Indices, JM: Floats,
    MJT_start: Ints, MJT_index: Indices, MJT: Floats,
    v_pre: Floats, threshold: float, defer: float, max_iterations: int, max_visits: int,
) -> tuple[Floats, Floats, int, int, bool]:  # fmt: skip
    """Outer iterations on an indexed heap; returns impulse, velocity, iterations, contact visits, stalled."""
    m = J_start.size - 1
    n = v_pre.size
    velocity = v_pre.copy()
    impulse = np.zeros(m)
    u = np.zeros(m)
    F = np.zeros(m)
    active = np.zeros(m, np.bool_)
    e = np.zeros(m)
    v = np.zeros(m)
    w = np.zeros(m)
    since = np.zeros(m)
    end = np.zeros(m)
    P = np.zeros(m)
    a = np.zeros(n)
    heap = np.zeros(m, np.int32)
    place = np.zeros(m, np.int32)
    ended = np.zeros(m, np.int32)
    touched = np.zeros(m, np.int32)
    contact_mark = np.full(m, -1, np.int64)
    body_mark = np.full(n, -1, np.int64)
    event = 0
    visits = 0
    iterations = 0
    while iterations < max_iterations and visits < max_visits:
        # What approaches, and how fast.
        F_max = 0.0
        for i in range(m):
            u_i = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                u_i += J[q] * velocity[J_index[q]]
            u[i] = u_i
            F_max = max(F_max, -u_i)
        visits += m
        if not F_max > threshold:
            break
        iterations += 1
        floor = max(threshold, defer * F_max)
        size = 0
        for i in range(m):
            active[i] = -u[i] > threshold and -u[i] >= floor
            F[i] = -u[i] if active[i] else 0.0
            P[i] = 0.0
            if active[i]:
                heap[size] = i
                place[i] = size
                size += 1
        # Acceleration of every velocity in the clock s, then of every active contact.
        for d in range(n):
            a_d = 0.0
            for q in range(MJT_start[d], MJT_start[d + 1]):
                a_d += MJT[q] * F[MJT_index[q]]
            a[d] = a_d
        for position in range(size):
            i = heap[position]
            w_i = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                w_i += J[q] * a[J_index[q]]
            e[i] = 0.0
            v[i] = u[i]
            w[i] = w_i
            since[i] = 0.0
            end[i] = _first_end(0.0, u[i], w_i)
        visits += size
        for position in range(size // 2 - 1, -1, -1):
            _sift_down(heap, place, end, position, size)
        # End one contact after the other, earliest first; equal ends are one event.
        stalled = False
        while size > 0 and visits < max_visits:
            s = end[heap[0]]
            if not s < np.inf:
                stalled = True
                break
            event += 1
            ended_count = 0
            while size > 0 and end[heap[0]] <= s + TIE * s:
                k = heap[0]
                size -= 1
                heap[0] = heap[size]
                place[heap[0]] = 0
                if size > 0:
                    _sift_down(heap, place, end, 0, size)
                P[k] = F[k] * end[k]
                F[k] = 0.0
                active[k] = False
                ended[ended_count] = k
                ended_count += 1
            # The velocities that the ended contacts drove: sum their acceleration anew.
            touched_count = 0
            for c in range(ended_count):
                k = ended[c]
                for p in range(JM_start[k], JM_start[k + 1]):
                    d = JM_index[p]
                    if body_mark[d] == event:
                        continue
                    body_mark[d] = event
                    a_d = 0.0
                    for q in range(MJT_start[d], MJT_start[d + 1]):
                        a_d += MJT[q] * F[MJT_index[q]]
                    a[d] = a_d
                    for q in range(JT_start[d], JT_start[d + 1]):
                        i = JT_index[q]
                        if active[i] and contact_mark[i] != event:
                            contact_mark[i] = event
                            touched[touched_count] = i
                            touched_count += 1
            # Their active contacts: advance to s, take the new slope, find the new end.
            for c in range(touched_count):
                i = touched[c]
                t = s - since[i]
                e[i] += (v[i] + 0.5 * w[i] * t) * t
                v[i] += w[i] * t
                since[i] = s
                w_i = 0.0
                for q in range(J_start[i], J_start[i + 1]):
                    w_i += J[q] * a[J_index[q]]
                w[i] = w_i
                before = end[i]
                end[i] = s + _first_end(e[i], v[i], w_i)
                if end[i] < before:
                    _sift_up(heap, place, end, place[i])
                else:
                    _sift_down(heap, place, end, place[i], size)
            visits += touched_count
        if size > 0:
            # Contacts that never end, or have not yet, would leave work behind: this iteration is not applied.
            return impulse, velocity, iterations, visits, stalled
        for d in range(n):
            dv = 0.0
            for q in range(MJT_start[d], MJT_start[d + 1]):
                dv += MJT[q] * P[MJT_index[q]]
            velocity[d] += dv
        for i in range(m):
            impulse[i] += P[i]
    return impulse, velocity, iterations, visits, False

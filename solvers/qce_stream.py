"""QCE for many contacts: the ends of one outer iteration as a causal fixed point, streamed in tiles.

    e_i(s) = u_i s + ½ Σ_j W_ij F_j [s² - (s - s_j)₊²] = 0      s_i is its first upward crossing

Only neighbors with s_j < s_i matter to contact i, hence the ends are unique and any order of evaluation that runs
until nothing changes gives what `qce_heap` gives, which pops the earliest end first. The speed comes from

- the order: contacts are sorted, coarsely, by the end that they would have if no neighbor ended before them. Most are
  then evaluated after all that they depend on: 1.16 (3,000 contacts) to 1.26 (183,000) evaluations an end;
- one root: with the neighbors that end before it known, the end is the root of one quadratic about s = 0,

      ½ A s² + (B - F) s - ½ C = 0,   A = Σ_late c_j,  B = Σ_early c_j s_j,  C = Σ_early c_j s_j²,   c_j = W_ij F_j

  It is the end if all early neighbors end before it, all late ones after it, and nothing crosses zero earlier. That
  holds if e(s)/s lies below a rising line through its root: e(s)/s + F = Σ c_j φ_j(s) with φ_j = s/2 up to s_j and
  s_j - s_j²/(2 s) after it, increasing and concave; the tangent of φ_j at the root where c_j > 0 and its chord from 0
  where c_j < 0 make the line, and its slope is positive if

      A s² + Σ_{c_j > 0} c_j s_j² + Σ_{c_j < 0} c_j (2 s s_j - s_j²) > 0        (sums over early neighbors)

  82 to 90 % of the evaluations pass (sphere packs); the others go through time piece by piece, as the heap does;
- no heap, no W: only the couplings of contacts that are active together, for one outer iteration.

No slope is updated by subtraction: the couplings of all neighbors still active are summed anew in each evaluation
(see `quadratic_contact_energy`). One thread, no random numbers, no dependence on memory addresses: the same input gives
the same bits.

Source: Zhang 2015, Algorithm 1, as corrected in `quadratic_contact_energy`; the fixed point is this project's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.problem import ImpactProblem
from solvers.qce_heap import MAX_VISITS
from solvers.solution import Floats
from solvers.sphere_rows import SphereRows

Ints = npt.NDArray[np.int32]
# Unsigned where an entry is itself an index: a signed one costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]
Flags = npt.NDArray[np.uint8]

# Ends that differ by a few rounding errors are one: symmetric scenes have them always, and each would wake the other.
TIE = 8 * float(np.finfo(np.float64).eps)
# End of a contact that was not evaluated yet, and of one that does not end as long as none of its neighbors does.
PENDING = float(np.inf)
NEVER = float(np.finfo(np.float64).max)
# Sorting keys are the leading bits of a float: its exponent and four bits of its mantissa, 16 keys an octave.
KEY_BITS = 48
KEYS = 512
# The contacts are sorted and evaluated in tiles of so many, which fit in the second-level cache with their couplings.
# Smaller ones cost more evaluations, as neighbors in a later tile are not known: 1.37 an end with 4,096, 1.26 with
# 8,192, 1.21 with 16,384 (kick, 183,000 contacts).
TILE = 8192
# Sweeps of a tile before the next is begun. Without the ends in later tiles two contacts can push each other's end on
# for ever; with all of them, only a contact that never ends does.
TILE_SWEEPS = 4
# Where fewer than one contact in so many was active, only their neighborhood is searched for approaching contacts.
SEARCH_ALL = 24
# Rounding can make tied contacts wake each other for ever; no problem met here needed 100 sweeps beyond its contacts.
SPARE_SWEEPS = 100

STALLED = 1
RESTLESS = 2


def solve_spheres(
    rows: SphereRows, *, threshold: float, defer: float, max_iterations: int, max_visits: int = MAX_VISITS
) -> tuple[Floats, int, int, int]:
    """Run QCE's outer iteration on packed contacts; `rows.V` is left at the velocities that it reaches.

    Args:
        rows: contacts, bodies and velocities.
        threshold: a contact approaches when u < -threshold [m/s].
        defer: contacts with F_i < defer · max F wait for the next outer iteration; dimensionless.
        max_iterations: bound on outer iterations.
        max_visits: bound on contact visits; the outer iteration in progress is finished.

    Returns:
        impulse [N s] in the order of `rows`, shape (m,); outer iterations; contact visits; 0, STALLED or RESTLESS.
    """
    return _solve_spheres(rows.normal, rows.body, rows.V, threshold, defer, max_iterations, max_visits)


def largest_approach(rows: SphereRows) -> float:
    """Largest -u of packed contacts [m/s], at least 0."""
    return _largest_approach(rows.normal, rows.body, rows.V)


def solve_sparse(
    problem: ImpactProblem, *, threshold: float, defer: float, max_iterations: int, max_visits: int = MAX_VISITS
) -> tuple[Floats, int, int, int]:
    """Run QCE's outer iteration on the sparse matrices of any problem; arguments and result as in `solve_spheres`."""
    J, JM = problem.J, problem.JM
    return _solve_sparse(
        J.indptr, J.indices.view(np.uint32), J.data, JM.indptr, JM.indices.view(np.uint32), JM.data,
        problem.v_pre, threshold, defer, max_iterations, max_visits,
    )  # fmt: skip


@kernel
def _end_by_pieces(
    F: float, own: float, begin: int, stop: int, neighbor: Indices, coupling: Floats, end: Floats
) -> float:
    """End of one contact, through the pieces of time between the ends of its neighbors."""
    now = 0.0
    e = 0.0
    v = -F
    while True:
        # The slope in the piece from `now` to the next end of a neighbor.
        w = own
        following = NEVER
        for q in range(begin, stop):
            s = end[neighbor[q]]
            c = coupling[q]
            w += c if s > now else 0.0
            s = s if s > now else NEVER
            following = s if s < following else following
        t = following - now
        last = following >= NEVER
        e_following = 0.0 if last else e + (v + 0.5 * w * t) * t
        # It may end in this piece: e is above zero at the end of it, or has a maximum within.
        if e_following >= 0.0 or (v > 0.0 and w < 0.0):
            discriminant = v * v - 2.0 * w * e
            first = PENDING
            if v > 0.0 and discriminant >= 0.0:
                # Rounding may leave e slightly above zero: the contact ends now.
                first = max(-2.0 * e / (v + np.sqrt(discriminant)), 0.0)
            elif v <= 0.0 and w > 0.0:
                first = max(np.sqrt(max(discriminant, 0.0)) - v, 0.0) / w
            if first <= t:
                return now + first
            if last:
                return NEVER
        e = e_following
        v += w * t
        now = following


@kernel
def _sweep(
    size: int, order: Indices, F: Floats, own: Floats, start: Ints, neighbor: Indices, coupling: Floats,
    end: Floats, awake: Flags, woken: Indices,
) -> int:  # fmt: skip
    """Evaluate the listed contacts; lists those that were evaluated before and must be again, and returns how many."""
    count = 0
    for p in range(size):
        k = order[p]
        before = end[k]
        # Early neighbors are those evaluated already that end before this one did, if it was itself evaluated.
        limit = min(before, NEVER)
        A = own[k]
        B = C = B_pull = C_pull = 0.0
        latest = 0.0
        following = PENDING
        # Selections, no branches: they would be mispredicted half of the time.
        for q in range(start[k], start[k + 1]):
            c = coupling[q]
            s_j = end[neighbor[q]]
            early = s_j < limit
            t = s_j if early else 0.0
            A += 0.0 if early else c
            b = c * t
            B += b
            C += b * t
            pull = min(b, 0.0)
            B_pull += pull
            C_pull += pull * t
            latest = t if t > latest else latest
            late = PENDING if early else s_j
            following = late if late < following else following
        # The root of the quadratic, without cancellation; 0 where it has none, which is refused.
        v = B - F[k]
        discriminant = v * v + A * C
        sum_of_roots = abs(v) + np.sqrt(max(discriminant, 0.0))
        denominator = sum_of_roots if v > 0.0 else A
        s = (C if v > 0.0 else sum_of_roots) / denominator if denominator > 0.0 else 0.0
        rising = A * s * s + 2.0 * s * B_pull + (C - 2.0 * C_pull)
        if not (discriminant >= 0.0 and rising > 0.0 and latest <= s and s <= following):
            s = _end_by_pieces(F[k], own[k], start[k], start[k + 1], neighbor, coupling, end)
        awake[k] = 0
        earlier = min(s, before)
        if s == before or abs(s - before) <= TIE * earlier:
            continue
        end[k] = s
        # What ends after it and did not know this end.
        if latest > earlier or following < PENDING:
            for q in range(start[k], start[k + 1]):
                j = neighbor[q]
                if earlier < end[j] and end[j] < PENDING and awake[j] == 0:
                    awake[j] = 1
                    woken[count] = j
                    count += 1
    return count


@kernel
def _sort(begin: int, stop: int, guess: Floats, key: Ints, first: Ints, order: Indices, listed: int) -> None:
    """Counting sort of some active contacts by their likely end, behind those listed; equal keys keep their order."""
    bits = guess.view(np.int64)
    total = 0
    finite = 0
    for k in range(begin, stop):
        key[k] = bits[k] >> KEY_BITS
        if guess[k] < NEVER:
            total += key[k]
            finite += 1
    lowest = total // max(finite, 1) - KEYS // 2
    first[:] = 0
    first[0] = listed
    for k in range(begin, stop):
        key[k] = min(max(key[k] - lowest, 0), KEYS - 1)
        first[key[k] + 1] += 1
    for c in range(KEYS):
        first[c + 1] += first[c]
    for k in range(begin, stop):
        place = first[key[k]]
        order[place] = k
        first[key[k]] = place + 1


@kernel
def _settle(
    begin: int, stop: int, size: int, left: int, F: Floats, own: Floats, slope: Floats, start: Ints,
    neighbor: Indices, coupling: Floats, end: Floats, awake: Flags, order: Indices, woken: Indices,
    key: Ints, first_key: Ints,
) -> tuple[int, int]:  # fmt: skip
    """Evaluate a tile and what others left over (the first entries of `order`); the last tile, until nothing changes.

    `slope` is Σ_j W_ij F_j over all neighbors; what is left in it is half of the end if none of them ended first.

    Returns:
        evaluations, and how many contacts are left over in `order`: after the last tile, 0 if a fixed point was found.
    """
    for k in range(begin, stop):
        slope[k] = F[k] / slope[k] if slope[k] > 0.0 else NEVER
    _sort(begin, stop, slope, key, first_key, order, left)
    left += stop - begin
    evaluations = 0
    due = order
    for _ in range(TILE_SWEEPS if stop < size else size + SPARE_SWEEPS):
        evaluations += left
        left = _sweep(left, due, F, own, start, neighbor, coupling, end, awake, woken)
        due, woken = woken, due
        if left == 0:
            break
    for p in range(left):
        order[p] = due[p]
    return evaluations, left


@kernel
def _keep_fast(size: int, active: Indices, F: Floats, defer: float) -> int:
    """Drop the contacts with F < defer · max F; returns how many are left."""
    F_max = 0.0
    for k in range(size):
        F_max = max(F_max, F[k])
    kept = 0
    for k in range(size):
        f = F[k]
        active[kept] = active[k]
        F[kept] = f
        kept += f >= defer * F_max
    return kept


@kernel
def _all_end(size: int, end: Floats) -> bool:
    """False where a contact never ends: it would leave work behind, and the outer iteration is not applied."""
    ended = 0
    for k in range(size):
        ended += end[k] < NEVER
    return ended == size


@kernel
def _approach(normal: Floats, body: Indices, V: Floats, i: int) -> float:
    """Approach velocity -u of one contact."""
    a = body[i, 0]
    b = body[i, 1]
    return -float(
        normal[i, 0] * (V[b, 0] - V[a, 0]) + normal[i, 1] * (V[b, 1] - V[a, 1]) + normal[i, 2] * (V[b, 2] - V[a, 2])
    )


@kernel
def _largest_approach(normal: Floats, body: Indices, V: Floats) -> float:
    """Largest approach velocity of all contacts, at least 0."""
    largest = 0.0
    for i in range(body.shape[0]):
        largest = max(largest, _approach(normal, body, V, i))
    return largest


@kernel
def _search(normal: Floats, body: Indices, V: Floats, threshold: float, found: Indices, F: Floats) -> int:
    """List the contacts that approach, and how fast; returns how many."""
    size = 0
    # No branch here: one contact in five approaches, at random.
    for i in range(body.shape[0]):
        F_i = _approach(normal, body, V, i)
        found[size] = i
        F[size] = F_i
        size += F_i > threshold
    return size


@kernel
def _search_nearby(
    normal: Floats, body: Indices, V: Floats, threshold: float, found: Indices, F: Floats,
    moved: int, pair: Indices, span: Indices, contact_of: Indices, seen: Ints, iteration: int,
) -> tuple[int, int]:  # fmt: skip
    """Search around the bodies that the last outer iteration moved; returns how many approach and were looked at."""
    size = 0
    looked = 0
    for k in range(moved):
        for side in range(2):
            b = pair[k, side]
            if not V[b, 3] > 0.0:
                continue
            for q in range(span[b, 0], span[b + 1, 0]):
                i = contact_of[q]
                if seen[i] == iteration:
                    continue
                seen[i] = iteration
                looked += 1
                F_i = _approach(normal, body, V, i)
                found[size] = i
                F[size] = F_i
                size += F_i > threshold
    return size, looked


@kernel
def _spans(body: Indices, bodies: int) -> Indices:
    """Where the contacts of each body begin in an array of all, and 0: how many of them are active."""
    span = np.zeros((bodies, 2), np.uint32)
    for i in range(body.shape[0]):
        span[body[i, 0], 0] += 1
        span[body[i, 1], 0] += 1
    total = 0
    for b in range(bodies):
        count = span[b, 0]
        span[b, 0] = total
        total += count
    return span


@kernel
def _contacts_of_bodies(body: Indices, span: Indices) -> Indices:
    """Contacts of each body, from where its span begins."""
    contact_of = np.empty(2 * body.shape[0], np.uint32)
    count = np.zeros(span.shape[0], np.uint32)
    for i in range(body.shape[0]):
        for side in range(2):
            b = body[i, side]
            contact_of[span[b, 0] + count[b]] = i
            count[b] += 1
    return contact_of


@kernel
def _enlist(
    size: int, found: Indices, F: Floats, normal: Floats, body: Indices, V: Floats, span: Indices,
    member: Indices, n: Floats, pair: Indices, own: Floats, slope: Floats, end: Floats, awake: Flags,
) -> None:  # fmt: skip
    """Pack the active contacts, and list them (twice their number, plus their side) with each movable body."""
    for k in range(size):
        i = found[k]
        inverse_mass = 0.0
        for side in range(2):
            b = body[i, side]
            pair[k, side] = b
            count = span[b, 1]
            member[span[b, 0] + count] = 2 * k + side
            span[b, 1] = count + (V[b, 3] > 0.0)
            inverse_mass += V[b, 3]
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        n[k, 0], n[k, 1], n[k, 2] = x, y, z
        own[k] = (x * x + y * y + z * z) * inverse_mass * F[k]
        slope[k] = own[k]
        end[k] = PENDING
        awake[k] = 1


@kernel
def _lay_out(
    size: int, pair: Indices, V: Floats, span: Indices, member: Indices, start: Ints, fill: Ints,
    shared: Indices, reach: Ints,
) -> int:  # fmt: skip
    """Where each contact's couplings begin, and the bodies with several active contacts; returns how many couplings.

    Bodies are listed in the order of their first contact, and `reach` says how many each tile has, with all before.
    """
    row = 0
    count = 0
    for tile in range((size - 1) // TILE + 1):
        for k in range(tile * TILE, min(tile * TILE + TILE, size)):
            start[k] = row
            fill[k] = row
            for side in range(2):
                b = pair[k, side]
                others = span[b, 1] - (1 if V[b, 3] > 0.0 else 0)
                row += others
                shared[count] = b
                count += (others > 0) & (member[span[b, 0]] >> 1 == k)
        reach[tile] = count
    start[size] = row
    return row


@kernel
def _couple(
    begin: int, stop: int, shared: Indices, F: Floats, n: Floats, V: Floats, span: Indices, member: Indices,
    near: Floats, near_contact: Indices, fill: Ints, neighbor: Indices, coupling: Floats, slope: Floats,
) -> None:  # fmt: skip
    """Couplings W_ij F_j of the contacts of some bodies."""
    spare = neighbor.size - 1
    for t in range(begin, stop):
        b = shared[t]
        first = span[b, 0]
        count = span[b, 1]
        for p in range(count):
            k = member[first + p] >> 1
            sign = 1.0 if member[first + p] & 1 else -1.0
            near_contact[p] = k
            for axis in range(3):
                near[p, axis] = sign * n[k, axis]
            near[p, 3] = F[k] * V[b, 3]
        for p in range(count):
            k = near_contact[p]
            to = fill[k]
            w = slope[k]
            for q in range(count):
                c = (near[p, 0] * near[q, 0] + near[p, 1] * near[q, 1] + near[p, 2] * near[q, 2]) * near[q, 3]
                # No branch: what a contact does to itself goes to a place that nobody reads.
                here = spare if p == q else to
                neighbor[here] = near_contact[q]
                coupling[here] = c
                w += 0.0 if p == q else c
                to += p != q
            fill[k] = to
            slope[k] = w


@kernel
def _apply(
    size: int, found: Indices, F: Floats, end: Floats, n: Floats, pair: Indices, V: Floats, span: Indices,
    impulse: Floats,
) -> None:  # fmt: skip
    """Apply the impulses of one outer iteration, and take its contacts off the bodies' lists."""
    for k in range(size):
        P = F[k] * end[k]
        impulse[found[k]] += P
        for side in range(2):
            b = pair[k, side]
            span[b, 1] = 0
            dv = (P if side == 1 else -P) * V[b, 3]
            for axis in range(3):
                V[b, axis] += dv * n[k, axis]


@kernel
def _most_contacts(span: Indices, V: Floats) -> int:
    """Contacts of the movable body that has most; the last body is immovable."""
    most = 0
    for b in range(span.shape[0] - 1):
        if V[b, 3] > 0.0:
            most = max(most, int(np.int64(span[b + 1, 0] - span[b, 0])))
    return most


@kernel
def _solve_spheres(
    normal: Floats, body: Indices, V: Floats, threshold: float, defer: float, max_iterations: int, max_visits: int
) -> tuple[Floats, int, int, int]:
    """Outer iterations on packed contacts (V is changed)."""
    m = normal.shape[0]
    impulse = np.zeros(m)
    # Per body: its span of all contacts, its active ones, and what `_couple` reads of those of one body.
    span = _spans(body, V.shape[0])
    member = np.empty(2 * m, np.uint32)
    shared = np.empty(V.shape[0] + 1, np.uint32)
    reach = np.empty(m // TILE + 1, np.int32)
    most = _most_contacts(span, V)
    near = np.empty((most, 4))
    near_contact = np.empty(most, np.uint32)
    # Per active contact; memory that no iteration needs is never touched.
    found = np.empty(m + 1, np.uint32)
    F = np.empty(m + 1)
    n = np.empty((m, 3))
    pair = np.empty((m, 2), np.uint32)
    own = np.empty(m)
    slope = np.empty(m)
    end = np.empty(m)
    awake = np.empty(m, np.uint8)
    start = np.empty(m + 1, np.int32)
    fill = np.empty(m, np.int32)
    order = np.empty(m, np.uint32)
    woken = np.empty(m, np.uint32)
    first_key = np.empty(KEYS + 1, np.int32)
    neighbor = np.empty(1, np.uint32)
    coupling = np.empty(1)
    # What only a search by neighborhood needs.
    contact_of = np.empty(0, np.uint32)
    seen = np.empty(0, np.int32)
    size = 0
    visits = 0
    iterations = 0
    everywhere = True
    while iterations < max_iterations and visits < max_visits:
        if everywhere:
            size = _search(normal, body, V, threshold, found, F)
            visits += m
        else:
            if seen.size == 0:
                contact_of = _contacts_of_bodies(body, span)
                seen = np.zeros(m, np.int32)
            size, looked = _search_nearby(
                normal, body, V, threshold, found, F, size, pair, span, contact_of, seen, iterations
            )
            visits += looked
        if size == 0:
            break
        iterations += 1
        if defer > 0.0:
            size = _keep_fast(size, found, F, defer)
        everywhere = defer > 0.0 or size * SEARCH_ALL > m
        visits += size
        _enlist(size, found, F, normal, body, V, span, member, n, pair, own, slope, end, awake)
        couplings = _lay_out(size, pair, V, span, member, start, fill, shared, reach)
        if couplings >= neighbor.size:
            neighbor = np.empty(couplings + couplings // 8 + 8, np.uint32)
            coupling = np.empty(neighbor.size)
        coupled = 0
        left = 0
        for tile in range((size - 1) // TILE + 1):
            _couple(
                coupled, reach[tile], shared, F, n, V, span, member, near, near_contact, fill, neighbor, coupling, slope
            )
            coupled = reach[tile]
            # The tile's part of `fill` has served; its couplings are still in the cache.
            evaluations, left = _settle(
                tile * TILE, min(tile * TILE + TILE, size), size, left, F, own, slope, start,
                neighbor, coupling, end, awake, order, woken, fill, first_key,
            )  # fmt: skip
            visits += evaluations
        if left > 0:
            return impulse, iterations, visits, RESTLESS
        if not _all_end(size, end):
            return impulse, iterations, visits, STALLED
        _apply(size, found, F, end, n, pair, V, span, impulse)
    return impulse, iterations, visits, 0


@kernel
def _search_sparse(
    J_start: Ints, J_index: Indices, J: Floats, v: Floats, threshold: float, found: Indices, F: Floats
) -> int:
    """List the contacts that approach, and how fast; returns how many."""
    size = 0
    for i in range(J_start.size - 1):
        u = 0.0
        for q in range(J_start[i], J_start[i + 1]):
            u += J[q] * v[J_index[q]]
        found[size] = i
        F[size] = -u
        size += u < -threshold
    return size


@kernel
def _enlist_sparse(
    size: int, found: Indices, F: Floats, J_start: Ints, J_index: Indices, J: Floats,
    first: Ints, count: Ints, record: Floats, record_of: Indices,
) -> None:  # fmt: skip
    """List the active contacts, and J_id F_i, with each velocity d that they read."""
    count[:] = 0
    for k in range(size):
        i = found[k]
        for q in range(J_start[i], J_start[i + 1]):
            count[J_index[q]] += 1
    records = 0
    for d in range(count.size):
        first[d] = records
        records += count[d]
        count[d] = 0
    for k in range(size):
        i = found[k]
        for q in range(J_start[i], J_start[i + 1]):
            d = J_index[q]
            record[first[d] + count[d]] = J[q] * F[k]
            record_of[first[d] + count[d]] = k
            count[d] += 1


@kernel
def _couple_sparse(
    size: int, found: Indices, JM_start: Ints, JM_index: Indices, JM: Floats, first: Ints, count: Ints,
    record: Floats, record_of: Indices, met: Ints, own: Floats, slope: Floats, end: Floats, awake: Flags,
    start: Ints, neighbor: Indices, coupling: Floats,
) -> tuple[Indices, Floats]:  # fmt: skip
    """Couplings W_ij F_j of all active contacts; returns their arrays, made larger where they were too small."""
    row = 0
    met[:size] = -1
    for k in range(size):
        i = found[k]
        start[k] = row
        if row + size > neighbor.size:
            more = np.empty(2 * neighbor.size + size, np.uint32)
            more[:row] = neighbor[:row]
            neighbor = more
            grown = np.empty(more.size)
            grown[:row] = coupling[:row]
            coupling = grown
        own_k = 0.0
        w = 0.0
        stop = row
        for q in range(JM_start[i], JM_start[i + 1]):
            d = JM_index[q]
            for p in range(first[d], first[d] + count[d]):
                j = record_of[p]
                c = JM[q] * record[p]
                w += c
                if j == k:
                    own_k += c
                elif met[j] < row:
                    met[j] = stop
                    neighbor[stop] = j
                    coupling[stop] = c
                    stop += 1
                else:
                    coupling[met[j]] += c
        own[k] = own_k
        slope[k] = w
        end[k] = PENDING
        awake[k] = 1
        row = stop
    start[size] = row
    return neighbor, coupling


@kernel
def _apply_sparse(
    size: int, found: Indices, F: Floats, end: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    v: Floats, impulse: Floats,
) -> None:  # fmt: skip
    """Apply the impulses of one outer iteration."""
    for k in range(size):
        i = found[k]
        P = F[k] * end[k]
        impulse[i] += P
        for q in range(JM_start[i], JM_start[i + 1]):
            v[JM_index[q]] += JM[q] * P


@kernel
def _solve_sparse(
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    v_pre: Floats, threshold: float, defer: float, max_iterations: int, max_visits: int,
) -> tuple[Floats, int, int, int]:  # fmt: skip
    """Outer iterations on sparse matrices."""
    m = J_start.size - 1
    v = v_pre.copy()
    impulse = np.zeros(m)
    # Per velocity: how many active contacts read it, and where their records begin.
    count = np.empty(v.size, np.int32)
    first = np.empty(v.size, np.int32)
    record = np.empty(J.size)
    record_of = np.empty(J.size, np.uint32)
    # Per active contact.
    found = np.empty(m + 1, np.uint32)
    F = np.empty(m + 1)
    own = np.empty(m)
    slope = np.empty(m)
    end = np.empty(m)
    awake = np.empty(m, np.uint8)
    start = np.empty(m + 1, np.int32)
    met = np.empty(m, np.int32)
    order = np.empty(m, np.uint32)
    woken = np.empty(m, np.uint32)
    first_key = np.empty(KEYS + 1, np.int32)
    neighbor = np.empty(8 * m + 8, np.uint32)
    coupling = np.empty(8 * m + 8)
    visits = 0
    iterations = 0
    while iterations < max_iterations and visits < max_visits:
        size = _search_sparse(J_start, J_index, J, v, threshold, found, F)
        visits += m
        if size == 0:
            break
        iterations += 1
        if defer > 0.0:
            size = _keep_fast(size, found, F, defer)
        visits += size
        _enlist_sparse(size, found, F, J_start, J_index, J, first, count, record, record_of)
        neighbor, coupling = _couple_sparse(
            size, found, JM_start, JM_index, JM, first, count, record, record_of, met, own, slope, end, awake,
            start, neighbor, coupling,
        )  # fmt: skip
        left = 0
        for begin in range(0, size, TILE):
            # `met` has served: it takes the sorting keys.
            evaluations, left = _settle(
                begin, min(begin + TILE, size), size, left, F, own, slope, start,
                neighbor, coupling, end, awake, order, woken, met, first_key,
            )  # fmt: skip
            visits += evaluations
        if left > 0:
            return impulse, iterations, visits, RESTLESS
        if not _all_end(size, end):
            return impulse, iterations, visits, STALLED
        _apply_sparse(size, found, F, end, JM_start, JM_index, JM, v, impulse)
    return impulse, iterations, visits, 0

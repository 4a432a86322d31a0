"""QCE for many contacts: the ends of one outer iteration as a causal fixed point, streamed in batches.

    e_i(s) = u_i s + ½ Σ_j W_ij F_j [s² - (s - s_j)₊²] = 0      s_i is its first upward crossing

Only neighbors with s_j < s_i matter to contact i, hence the ends are unique and any order of evaluation that runs
until nothing changes gives what `qce_heap` gives, which pops the earliest end first. The speed comes from

- the order: contacts are sorted, coarsely, by the end that they would have if no neighbor ended before them. Most are
  then evaluated after all that they depend on: about 1.15 evaluations an end instead of 1.7 in storage order;
- batches: contacts with equally many neighbors are evaluated together, one operation on all of a batch at a time, so
  that the compiler makes vector instructions of it and no branch is mispredicted;
- no heap, no W: only the couplings of contacts that are active together, for one outer iteration.

No slope is updated by subtraction: in each piece of time the couplings of all neighbors still active are summed anew
(see `quadratic_contact_energy`). One thread, no random numbers, no dependence on memory addresses: the same input gives
the same bits.

Source: Zhang 2015, Algorithm 1, as corrected in `quadratic_contact_energy`; the fixed point is this project's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from solvers._jit import kernel
from solvers.problem import ImpactProblem
from solvers.solution import Floats
from solvers.sphere_rows import SphereRows

Ints = npt.NDArray[np.int32]
# Unsigned where an entry is itself an index: a signed one costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]
Flags = npt.NDArray[np.uint8]

# Ends that differ by a few rounding errors are one: symmetric scenes have them always, and each would wake the other.
TIE = 8 * float(np.finfo(np.float64).eps)
INF = float(np.inf)

# Contacts of one batch: eight vectors of four; more did not help.
LANES = 32
# A smaller batch costs more than its contacts one by one.
FEWEST_LANES = 8
# Batches exist for up to so many neighbors; a contact with more is evaluated alone.
MOST_NEIGHBORS = 24
# Rows of LANES numbers in a batch's memory: the state of each contact, then (end, coupling) of each neighbor.
TIME, WORK, SPEED, SLOPE, NEXT, END, BASE, BEFORE, NEIGHBORS = (row * LANES for row in range(9))
BATCH = NEIGHBORS + 2 * MOST_NEIGHBORS * LANES
# Sorting keys are the leading bits of a float: its exponent and four bits of its mantissa, 16 keys an octave.
KEY_BITS = 48
KEYS = 512
# The contacts are sorted in tiles of so many, which fit in the second-level cache with all that they touch.
TILE = 4096
# Where fewer than one contact in so many was active, only their neighborhood is searched for approaching contacts.
SEARCH_ALL = 24
# Rounding can make tied contacts wake each other for ever; no problem met here needed 100 sweeps beyond its contacts.
SPARE_SWEEPS = 100

STALLED = 1
RESTLESS = 2


def solve_spheres(
    rows: SphereRows, *, threshold: float, defer: float, max_iterations: int
) -> tuple[Floats, int, int, int]:
    """Run QCE's outer iteration on packed contacts (`rows.V` is changed).

    Returns:
        impulse [N s] in the order of `rows`, shape (m,); outer iterations; contact visits; 0, STALLED or RESTLESS.
    """
    return _solve_spheres(rows.normal, rows.body, rows.V, threshold, defer, max_iterations)


def solve_sparse(
    problem: ImpactProblem, *, threshold: float, defer: float, max_iterations: int
) -> tuple[Floats, int, int, int]:
    """Run QCE's outer iteration on the sparse matrices of any problem; returns as `solve_spheres`."""
    J, JM = problem.J, problem.JM
    return _solve_sparse(
        J.indptr,
        J.indices.view(np.uint32),
        J.data,
        JM.indptr,
        JM.indices.view(np.uint32),
        JM.data,
        problem.v_pre,
        threshold,
        defer,
        max_iterations,
    )


@kernel
def _first_end(e: float, v: float, w: float) -> float:
    """First t ≥ 0 at which e + v t + ½ w t² crosses zero upward; inf where it never does."""
    discriminant = v * v - 2.0 * w * e
    root = np.sqrt(discriminant if discriminant > 0.0 else 0.0)
    q = abs(v) + root
    # v > 0: -2 e / (v + √), for either sign of w; v ≤ 0: (-v + √) / w, for w > 0 alone.
    numerator = -2.0 * e if v > 0.0 else q
    denominator = q if v > 0.0 else w
    never = -discriminant if v > 0.0 else (-w if w != 0.0 else 1.0)
    t = numerator / denominator
    # Rounding may leave e slightly above zero: the contact ends now.
    t = t if t > 0.0 else 0.0
    return INF if never > 0.0 else t


@kernel
def _end_alone(
    i: int, neighbors: int, F: Floats, base: Floats, start: Ints, neighbor: Indices, coupling: Floats, end: Floats
) -> float:
    """End of one contact, given those of its first so many neighbors; the same operations as in a batch."""
    now = 0.0
    e = 0.0
    v = -F[i]
    while True:
        w = base[i]
        following = INF
        for q in range(start[i], start[i] + neighbors):
            s = end[neighbor[q]]
            if s > now:
                w += coupling[q]
                following = min(following, s)
        t = following - now
        first = _first_end(e, v, w)
        if first <= t or following == INF:
            return now + first
        e += (v + 0.5 * w * t) * t
        v += w * t
        now = following


@kernel
def _evaluate_alone(
    i: int, neighbors: int, F: Floats, base: Floats,
    start: Ints, neighbor: Indices, coupling: Floats, end: Floats, awake: Flags,
) -> None:  # fmt: skip
    """Evaluate one contact, and wake what depended on its end if that changed."""
    awake[i] = 0
    s = _end_alone(i, neighbors, F, base, start, neighbor, coupling, end)
    before = end[i]
    earlier = min(s, before)
    if not (s == before or abs(s - before) <= TIE * earlier):
        end[i] = s
        for q in range(start[i], start[i + 1]):
            j = neighbor[q]
            awake[j] |= end[j] > earlier
    overlooked = False
    for q in range(start[i] + neighbors, start[i + 1]):
        overlooked |= end[neighbor[q]] < end[i]
    awake[i] |= overlooked


@kernel
def _advance(batch: Floats, neighbors: int) -> None:
    """Ends of a batch of contacts with so many neighbors each: every loop over lanes is one vector operation."""
    for _ in range(neighbors + 1):
        # The piece of time from `now` to the next end of a neighbor, and the slope in it.
        for lane in range(LANES):
            batch[SLOPE + lane] = batch[BASE + lane]
            batch[NEXT + lane] = INF
        for d in range(neighbors):
            row = NEIGHBORS + 2 * d * LANES
            for lane in range(LANES):
                s = batch[row + lane]
                c = batch[row + LANES + lane]
                following = batch[NEXT + lane]
                live = s > batch[TIME + lane]
                s = s if live else INF
                batch[SLOPE + lane] += c if live else 0.0
                batch[NEXT + lane] = s if s < following else following
        # `_first_end`, written out: a call would keep the loop from becoming vector instructions.
        for lane in range(LANES):
            now = batch[TIME + lane]
            e = batch[WORK + lane]
            v = batch[SPEED + lane]
            w = batch[SLOPE + lane]
            following = batch[NEXT + lane]
            before = batch[END + lane]
            discriminant = v * v - 2.0 * w * e
            root = np.sqrt(discriminant if discriminant > 0.0 else 0.0)
            q = abs(v) + root
            numerator = -2.0 * e if v > 0.0 else q
            denominator = q if v > 0.0 else w
            never = -discriminant if v > 0.0 else (-w if w != 0.0 else 1.0)
            first = numerator / denominator
            first = first if first > 0.0 else 0.0
            first = INF if never > 0.0 else first
            t = following - now
            s = now + first if first <= t else INF
            batch[END + lane] = s if s < before else before
            batch[WORK + lane] = e + (v + 0.5 * w * t) * t
            batch[SPEED + lane] = v + w * t
            batch[TIME + lane] = following
        going = 0
        for lane in range(LANES):
            going += 1 if (batch[END + lane] == INF and batch[TIME + lane] < INF) else 0
        if going == 0:
            break


@kernel
def _flush(
    batch: Floats, queue: Indices, neighbors: int, count: int, F: Floats, base: Floats,
    start: Ints, neighbor: Indices, coupling: Floats, end: Floats, awake: Flags,
) -> None:  # fmt: skip
    """Evaluate the queued contacts with so many neighbors, and wake what depended on the ends that changed."""
    head = neighbors * LANES
    if count < FEWEST_LANES:
        for lane in range(count):
            _evaluate_alone(queue[head + lane], neighbors, F, base, start, neighbor, coupling, end, awake)
        return
    for lane in range(count):
        i = queue[head + lane]
        awake[i] = 0
        batch[TIME + lane] = 0.0
        batch[WORK + lane] = 0.0
        batch[SPEED + lane] = -F[i]
        batch[END + lane] = INF
        batch[BASE + lane] = base[i]
        batch[BEFORE + lane] = end[i]
        q = start[i]
        for d in range(neighbors):
            row = NEIGHBORS + 2 * d * LANES
            batch[row + lane] = end[neighbor[q + d]]
            batch[row + LANES + lane] = coupling[q + d]
    for lane in range(count, LANES):
        batch[END + lane] = 0.0
        batch[TIME + lane] = INF
    _advance(batch, neighbors)
    # All ends first: whether a contact of the same batch must wake depends on its new end.
    for lane in range(count):
        s = batch[END + lane]
        before = batch[BEFORE + lane]
        earlier = s if s < before else before
        same = s == before or abs(s - before) <= TIE * earlier
        end[queue[head + lane]] = before if same else s
        batch[BEFORE + lane] = INF if same else earlier
    for lane in range(count):
        i = queue[head + lane]
        earlier = batch[BEFORE + lane]
        q_looked = start[i] + neighbors
        for q in range(start[i], q_looked):
            j = neighbor[q]
            awake[j] |= end[j] > earlier
        # Neighbors after it in the order may have been evaluated before it: batches fill at different times.
        overlooked = False
        for q in range(q_looked, start[i + 1]):
            j = neighbor[q]
            awake[j] |= end[j] > earlier
            overlooked |= end[j] < end[i]
        awake[i] |= overlooked


@kernel
def _first_sweep(
    begin: int, stop: int, order: Indices, F: Floats, base: Floats, start: Ints, middle: Ints,
    neighbor: Indices, coupling: Floats, end: Floats, awake: Flags,
    batch: Floats, queue: Indices, waiting: Ints,
) -> None:  # fmt: skip
    """Evaluate some active contacts in their likely order, with the neighbors that likely end before them alone.

    Those stand between `start` and `middle`; the couplings of the others are in `base`, as if they never ended.
    Contacts may be left waiting for their batch to fill.
    """
    for k in range(begin, stop):
        i = order[k]
        neighbors = middle[i] - start[i]
        if neighbors < MOST_NEIGHBORS:
            waits = waiting[neighbors]
            queue[neighbors * LANES + waits] = i
            waiting[neighbors] = waits + 1
            if waits + 1 == LANES:
                waiting[neighbors] = 0
                _flush(batch, queue, neighbors, LANES, F, base, start, neighbor, coupling, end, awake)
        else:
            _evaluate_alone(i, neighbors, F, base, start, neighbor, coupling, end, awake)


@kernel
def _later_sweeps(
    size: int, F: Floats, own: Floats, base: Floats, start: Ints,
    neighbor: Indices, coupling: Floats, end: Floats, awake: Flags,
    batch: Floats, queue: Indices, waiting: Ints,
) -> int:  # fmt: skip
    """Evaluate what waits and what was woken, with all neighbors, until nothing changes.

    Returns:
        evaluations, or -1 where no fixed point was found.
    """
    for neighbors in range(MOST_NEIGHBORS):
        if waiting[neighbors] > 0:
            count = waiting[neighbors]
            waiting[neighbors] = 0
            _flush(batch, queue, neighbors, count, F, base, start, neighbor, coupling, end, awake)
    evaluations = 0
    for _ in range(size + SPARE_SWEEPS):
        woken = 0
        for i in range(size):
            if awake[i] == 0:
                continue
            woken += 1
            neighbors = start[i + 1] - start[i]
            if neighbors < MOST_NEIGHBORS:
                waits = waiting[neighbors]
                queue[neighbors * LANES + waits] = i
                waiting[neighbors] = waits + 1
                if waits + 1 == LANES:
                    waiting[neighbors] = 0
                    _flush(batch, queue, neighbors, LANES, F, own, start, neighbor, coupling, end, awake)
            else:
                _evaluate_alone(i, neighbors, F, own, start, neighbor, coupling, end, awake)
        for neighbors in range(MOST_NEIGHBORS):
            if waiting[neighbors] > 0:
                count = waiting[neighbors]
                waiting[neighbors] = 0
                _flush(batch, queue, neighbors, count, F, own, start, neighbor, coupling, end, awake)
        evaluations += woken
        if woken == 0:
            return evaluations
    return -1


@kernel
def _sort(begin: int, stop: int, guess: Floats, key: Ints, first: Ints, order: Indices) -> None:
    """Counting sort of some active contacts by their likely end; equal keys keep their order."""
    bits = guess.view(np.int64)
    total = 0
    finite = 0
    for k in range(begin, stop):
        key[k] = bits[k] >> KEY_BITS
        if guess[k] < INF:
            total += key[k]
            finite += 1
    lowest = total // max(finite, 1) - KEYS // 2
    first[:] = 0
    for k in range(begin, stop):
        key[k] = min(max(key[k] - lowest, 0), KEYS - 1)
        first[key[k] + 1] += 1
    first[0] = begin
    for c in range(KEYS):
        first[c + 1] += first[c]
    for k in range(begin, stop):
        place = first[key[k]]
        order[place] = k
        first[key[k]] = place + 1


@kernel
def _contacts_of_bodies(body: Indices, bodies: int) -> tuple[Ints, Ints]:
    """Contacts of each body, CSR."""
    first = np.zeros(bodies + 2, np.int32)
    for i in range(body.shape[0]):
        first[body[i, 0] + 2] += 1
        first[body[i, 1] + 2] += 1
    for b in range(2, bodies + 2):
        first[b] += first[b - 1]
    contact = np.empty(2 * body.shape[0], np.int32)
    for i in range(body.shape[0]):
        for side in range(2):
            b = body[i, side] + 1
            contact[first[b]] = i
            first[b] += 1
    return first, contact


@kernel
def _closing(normal: Floats, body: Indices, V: Floats, i: int) -> float:
    """Approach velocity -u of one contact."""
    a = body[i, 0]
    b = body[i, 1]
    return -float(
        normal[i, 0] * (V[b, 0] - V[a, 0]) + normal[i, 1] * (V[b, 1] - V[a, 1]) + normal[i, 2] * (V[b, 2] - V[a, 2])
    )


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
def _solve_spheres(
    normal: Floats, body: Indices, V: Floats, threshold: float, defer: float, max_iterations: int
) -> tuple[Floats, int, int, int]:
    """Outer iterations on packed contacts (V is changed)."""
    m = normal.shape[0]
    bodies = V.shape[0] - 1
    impulse = np.zeros(m)
    found = np.empty(m + 1, np.uint32)
    F = np.empty(m + 1)
    # Per body: how many active contacts, where their records begin, and Σ F n.
    count = np.zeros(bodies + 1, np.int32)
    first = np.zeros(bodies + 1, np.int32)
    force = np.zeros((bodies + 1, 3))
    touched = np.empty(bodies + 1, np.uint32)
    touched_count = 0
    # What only a search by neighborhood needs.
    first_contact = np.empty(0, np.int32)
    contact_of = np.empty(0, np.int32)
    seen = np.empty(0, np.int32)
    # Per active contact; made larger where an iteration needs it.
    room = 0
    guess = np.empty(0)
    key = np.empty(0, np.int32)
    order = np.empty(0, np.uint32)
    own = np.empty(0)
    base = np.empty(0)
    end = np.empty(0)
    awake = np.empty(0, np.uint8)
    start = np.empty(0, np.int32)
    middle = np.empty(0, np.int32)
    record = np.empty((0, 4))
    record_of = np.empty(0, np.uint32)
    neighbor = np.empty(0, np.uint32)
    coupling = np.empty(0)
    first_key = np.empty(KEYS + 1, np.int32)
    batch = np.zeros(BATCH)
    queue = np.zeros(MOST_NEIGHBORS * LANES, np.uint32)
    waiting = np.zeros(MOST_NEIGHBORS, np.int32)
    visits = 0
    iterations = 0
    everywhere = True
    while iterations < max_iterations:
        # What approaches, and how fast.
        size = 0
        if everywhere:
            # No branch here: one contact in five approaches, at random.
            for i in range(m):
                F_i = _closing(normal, body, V, i)
                found[size] = i
                F[size] = F_i
                size += F_i > threshold
            visits += m
        else:
            if seen.size == 0:
                seen = np.full(m, -1, np.int32)
                first_contact, contact_of = _contacts_of_bodies(body, bodies)
            for t in range(touched_count):
                b = touched[t]
                for q in range(first_contact[b], first_contact[b + 1]):
                    i = contact_of[q]
                    if seen[i] == iterations:
                        continue
                    seen[i] = iterations
                    F_i = _closing(normal, body, V, i)
                    found[size] = i
                    F[size] = F_i
                    size += F_i > threshold
                    visits += 1
        if size == 0:
            break
        iterations += 1
        if defer > 0.0:
            size = _keep_fast(size, found, F, defer)
        visits += size
        everywhere = defer > 0.0 or size * SEARCH_ALL > m
        if size > room:
            room = size + size // 8 + 8
            guess = np.empty(room)
            key = np.empty(room, np.int32)
            order = np.empty(room, np.uint32)
            own = np.empty(room)
            base = np.empty(room)
            end = np.empty(room)
            awake = np.empty(room, np.uint8)
            start = np.empty(room + 1, np.int32)
            middle = np.empty(room, np.int32)
            record = np.empty((2 * room, 4))
            record_of = np.empty(2 * room, np.uint32)
        # Force on every body, and how many contacts press on it.
        touched_count = 0
        for k in range(size):
            i = found[k]
            for side in range(2):
                b = body[i, side]
                if V[b, 3] > 0.0:
                    if count[b] == 0:
                        touched[touched_count] = b
                        touched_count += 1
                        force[b, 0] = force[b, 1] = force[b, 2] = 0.0
                    count[b] += 1
                    f = F[k] if side == 1 else -F[k]
                    force[b, 0] += f * normal[i, 0]
                    force[b, 1] += f * normal[i, 1]
                    force[b, 2] += f * normal[i, 2]
        records = 0
        couplings = 0
        for t in range(touched_count):
            b = touched[t]
            first[b] = records
            records += count[b]
            couplings += count[b] * (count[b] - 1)
            count[b] = 0
        # The end of each contact if all others went on for ever; records of each body: F n, that end, the contact.
        for k in range(size):
            i = found[k]
            a = body[i, 0]
            b = body[i, 1]
            w = (
                normal[i, 0] * (V[b, 3] * force[b, 0] - V[a, 3] * force[a, 0])
                + normal[i, 1] * (V[b, 3] * force[b, 1] - V[a, 3] * force[a, 1])
                + normal[i, 2] * (V[b, 3] * force[b, 2] - V[a, 3] * force[a, 2])
            )
            guess[k] = F[k] / w if w > 0.0 else INF
            for side in range(2):
                b = body[i, side]
                if V[b, 3] > 0.0:
                    f = F[k] if side == 1 else -F[k]
                    p = first[b] + count[b]
                    count[b] += 1
                    record[p, 0] = f * normal[i, 0]
                    record[p, 1] = f * normal[i, 1]
                    record[p, 2] = f * normal[i, 2]
                    record[p, 3] = guess[k]
                    record_of[p] = k
            end[k] = INF
            awake[k] = 1
        # Couplings W_ij F_j of each contact: those with neighbors that likely end before it first.
        if couplings >= neighbor.size:
            neighbor = np.empty(couplings + couplings // 8 + 8, np.uint32)
            coupling = np.empty(neighbor.size)
        spare = neighbor.size - 1
        row = 0
        start[0] = 0
        for begin in range(0, size, TILE):
            stop = min(begin + TILE, size)
            for k in range(begin, stop):
                i = found[k]
                length = 0
                for side in range(2):
                    b = body[i, side]
                    if V[b, 3] > 0.0:
                        length += count[b] - 1
                early = row
                late = row + length - 1
                own_k = 0.0
                base_k = 0.0
                guess_k = guess[k]
                for side in range(2):
                    b = body[i, side]
                    if V[b, 3] > 0.0:
                        inverse_mass = V[b, 3] if side == 1 else -V[b, 3]
                        x = inverse_mass * normal[i, 0]
                        y = inverse_mass * normal[i, 1]
                        z = inverse_mass * normal[i, 2]
                        for q in range(first[b], first[b] + count[b]):
                            j = record_of[q]
                            c = x * record[q, 0] + y * record[q, 1] + z * record[q, 2]
                            # Selections, no branches; the contact's own record goes to a place that nobody reads.
                            itself = j == k
                            before = record[q, 3] <= guess_k
                            to = spare if itself else (early if before else late)
                            neighbor[to] = j
                            coupling[to] = c
                            own_k += c if itself else 0.0
                            base_k += c if not before else 0.0
                            early += before & (not itself)
                            late -= not before
                own[k] = own_k
                base[k] = own_k + base_k
                middle[k] = early
                row += length
                start[k + 1] = row
            # The tile's rows are still in the cache.
            _sort(begin, stop, guess, key, first_key, order)
            _first_sweep(
                begin, stop, order, F, base, start, middle, neighbor, coupling, end, awake, batch, queue, waiting
            )
        for t in range(touched_count):
            count[touched[t]] = 0
        evaluations = _later_sweeps(size, F, own, base, start, neighbor, coupling, end, awake, batch, queue, waiting)
        if evaluations < 0:
            return impulse, iterations, visits, RESTLESS
        visits += size + evaluations
        # Contacts that never end would leave work behind: this iteration is not applied.
        for k in range(size):
            if not end[k] < INF:
                return impulse, iterations, visits, STALLED
        for k in range(size):
            i = found[k]
            a = body[i, 0]
            b = body[i, 1]
            P = F[k] * end[k]
            impulse[i] += P
            for axis in range(3):
                V[a, axis] -= V[a, 3] * P * normal[i, axis]
                V[b, axis] += V[b, 3] * P * normal[i, axis]
    return impulse, iterations, visits, 0


@kernel
def _solve_sparse(
    J_start: Ints, J_index: Indices, J: Floats, JM_start: Ints, JM_index: Indices, JM: Floats,
    v_pre: Floats, threshold: float, defer: float, max_iterations: int,
) -> tuple[Floats, int, int, int]:  # fmt: skip
    """Outer iterations on sparse matrices."""
    m = J_start.size - 1
    n = v_pre.size
    v = v_pre.copy()
    impulse = np.zeros(m)
    found = np.empty(m + 1, np.uint32)
    F = np.empty(m + 1)
    # Per velocity: how many active contacts, where their records begin, and its acceleration.
    count = np.zeros(n, np.int32)
    first = np.zeros(n, np.int32)
    a = np.zeros(n)
    guess = np.empty(m)
    key = np.empty(m, np.int32)
    order = np.empty(m, np.uint32)
    own = np.empty(m)
    base = np.empty(m)
    end = np.empty(m)
    awake = np.empty(m, np.uint8)
    start = np.empty(m + 1, np.int32)
    middle = np.empty(m, np.int32)
    met = np.empty(m, np.int32)
    record = np.empty(J.size)
    record_of = np.empty(J.size, np.uint32)
    neighbor = np.empty(8 * m + 8, np.uint32)
    coupling = np.empty(8 * m + 8)
    first_key = np.empty(KEYS + 1, np.int32)
    batch = np.zeros(BATCH)
    queue = np.zeros(MOST_NEIGHBORS * LANES, np.uint32)
    waiting = np.zeros(MOST_NEIGHBORS, np.int32)
    visits = 0
    iterations = 0
    while iterations < max_iterations:
        # What approaches, and how fast.
        size = 0
        for i in range(m):
            u = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                u += J[q] * v[J_index[q]]
            found[size] = i
            F[size] = -u
            size += u < -threshold
        visits += m
        if size == 0:
            break
        iterations += 1
        if defer > 0.0:
            size = _keep_fast(size, found, F, defer)
        visits += size
        # Acceleration, and how many contacts read each velocity.
        a[:] = 0.0
        count[:] = 0
        for k in range(size):
            i = found[k]
            for q in range(JM_start[i], JM_start[i + 1]):
                a[JM_index[q]] += JM[q] * F[k]
            for q in range(J_start[i], J_start[i + 1]):
                count[J_index[q]] += 1
        records = 0
        for d in range(n):
            first[d] = records
            records += count[d]
            count[d] = 0
        # The end of each contact if all others went on for ever.
        for k in range(size):
            i = found[k]
            w = 0.0
            for q in range(J_start[i], J_start[i + 1]):
                w += J[q] * a[J_index[q]]
            guess[k] = F[k] / w if w > 0.0 else INF
        for k in range(size):
            i = found[k]
            met[k] = -1
            for q in range(J_start[i], J_start[i + 1]):
                d = J_index[q]
                record[first[d] + count[d]] = J[q] * F[k]
                record_of[first[d] + count[d]] = k
                count[d] += 1
        # Couplings W_ij F_j of each contact: those with neighbors that likely end before it first.
        row = 0
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
            stop = row
            for q in range(JM_start[i], JM_start[i + 1]):
                d = JM_index[q]
                for p in range(first[d], first[d] + count[d]):
                    j = record_of[p]
                    c = JM[q] * record[p]
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
            base_k = own_k
            middle_k = row
            for q in range(row, stop):
                j = neighbor[q]
                c = coupling[q]
                if guess[j] <= guess[k]:
                    neighbor[q] = neighbor[middle_k]
                    coupling[q] = coupling[middle_k]
                    neighbor[middle_k] = j
                    coupling[middle_k] = c
                    middle_k += 1
                else:
                    base_k += c
            base[k] = base_k
            middle[k] = middle_k
            row = stop
        start[size] = row
        end[:size] = INF
        awake[:size] = 1
        for begin in range(0, size, TILE):
            stop = min(begin + TILE, size)
            _sort(begin, stop, guess, key, first_key, order)
            _first_sweep(
                begin, stop, order, F, base, start, middle, neighbor, coupling, end, awake, batch, queue, waiting
            )
        evaluations = _later_sweeps(size, F, own, base, start, neighbor, coupling, end, awake, batch, queue, waiting)
        if evaluations < 0:
            return impulse, iterations, visits, RESTLESS
        visits += size + evaluations
        # Contacts that never end would leave work behind: this iteration is not applied.
        for k in range(size):
            if not end[k] < INF:
                return impulse, iterations, visits, STALLED
        for k in range(size):
            i = found[k]
            P = F[k] * end[k]
            impulse[i] += P
            for q in range(JM_start[i], JM_start[i + 1]):
                v[JM_index[q]] += JM[q] * P
    return impulse, iterations, visits, 0

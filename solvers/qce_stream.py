"""QCE for many contacts: the ends of one outer iteration as a causal fixed point, streamed in tiles.

    e_i(s) = u_i s + ½ Σ_j W_ij F_j [s² - (s - s_j)₊²] = 0      s_i is its first upward crossing

Only neighbors with s_j < s_i matter to contact i, hence the ends are unique and any order of evaluation that runs
until nothing changes gives what `qce_heap` gives, which pops the earliest end first. The speed comes from

- the order: contacts are sorted, coarsely, by the end that they would have if no neighbor ended before them, and what
  an evaluation puts in doubt is evaluated again before long. Most ends are then found after all that they depend on;
- one root: with the neighbors that end before it known, the end is the root of one quadratic about s = 0,

      ½ A s² + (B - F) s - ½ C = 0,   A = Σ_late c_j,  B = Σ_early c_j s_j,  C = Σ_early c_j s_j²,   c_j = W_ij F_j

  It is the end if all early neighbors end before it, all late ones after it, and nothing crosses zero earlier. That
  holds if e(s)/s lies below a rising line through its root: e(s)/s + F = Σ c_j φ_j(s) with φ_j = s/2 up to s_j and
  s_j - s_j²/(2 s) after it, increasing and concave; the tangent of φ_j at the root where c_j > 0 and its chord from 0
  where c_j < 0 make the line, and its slope is positive if

      A s² + Σ_{c_j > 0} c_j s_j² + Σ_{c_j < 0} c_j (2 s s_j - s_j²) > 0        (sums over early neighbors)

  Most evaluations pass. Where only a neighbor is on the wrong side of the root, the root with the others is tried; the
  rest go through time piece by piece, as the heap does;
- no heap, no W: only the couplings of contacts that are active together, for one outer iteration.

No slope is updated by subtraction: the couplings of all neighbors still active are summed anew in each evaluation
(see `quadratic_contact_energy`).

Large layers are cut into strips of contacts. Those of even number share no body and run on several threads, then those
of odd number, which find the ends of their neighbors; what they have to say to contacts of even strips is left to one
thread. The strips are the same for any number of threads, and so are the bits of the result: no random numbers, no
dependence on memory addresses or on who comes first.

Source: Zhang 2015, Algorithm 1, as corrected in `quadratic_contact_energy`; the fixed point is this project's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from solvers import _jit
from solvers._jit import alone, kernel, parallel_kernel, prange
from solvers.problem import ImpactProblem
from solvers.qce_heap import MAX_VISITS
from solvers.solution import Floats
from solvers.sphere_rows import STRIPS, SphereRows

Ints = npt.NDArray[np.int32]
Counts = npt.NDArray[np.int64]
# Unsigned where an entry is itself an index: a signed one costs a test for negative ones at every access.
Indices = npt.NDArray[np.uint32]
Flags = npt.NDArray[np.uint8]
Offsets = npt.NDArray[np.uint64]

# Ends that differ by a few rounding errors are one: symmetric scenes have them always, and each would wake the other.
TIE = 8 * float(np.finfo(np.float64).eps)
# End of a contact that was not evaluated yet, and of one that does not end as long as none of its neighbors does.
PENDING = float(np.inf)
NEVER = float(np.finfo(np.float64).max)
# Sorting keys are the leading bits of a float: its exponent and four bits of its mantissa, 16 keys an octave.
KEY_BITS = 48
KEYS = 512
# The contacts are sorted and evaluated in tiles of so many at most. Smaller ones, which would stay in the second-level
# cache, cost more evaluations than that saves, as neighbors in a later tile are not known.
TILE = 32_768
# So many are evaluated, then those that they woke: what comes later in the order meets ends that are right.
CHUNK = 256
# So many contacts are searched, then those of them that approach are packed: they are still in the cache.
BLOCK = 2048
# Sweeps over what a chunk woke before the next is begun. Without the ends to come two contacts can push each other's
# end on for ever; with all of them, only a contact that never ends does.
CHUNK_SWEEPS = 3
# So many evaluations ahead a contact's own numbers are fetched; and so many, when they are there, its row of couplings.
HEAD_AHEAD = np.uint64(16)
ROW_AHEAD = np.uint64(8)
# Couplings in a line of the cache: a row seldom takes more than two lines.
LINE = np.uint32(8)
# Where fewer than one contact in so many was active, only their neighborhood is searched for approaching contacts.
SEARCH_ALL = 24
# Rounding can make tied contacts wake each other for ever; no problem met here needed 100 sweeps beyond its contacts.
SPARE_SWEEPS = 100

# From this many contacts on sharing a search out pays, and from this many active ones on an outer iteration: below it
# threads wait for one another most of the time.
SHARED_CONTACTS = 15_000
SHARED_ACTIVE = 2_000
ONE = np.uint32(1)

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
    strip = _strips(rows)
    return _solve_spheres(rows.normal, rows.body, rows.V, strip, threshold, defer, max_iterations, max_visits)


def _strips(rows: SphereRows) -> Ints:
    """Where the strips begin that threads share out, with their end; one strip where there is little to do."""
    m = rows.normal.shape[0]
    if m < SHARED_CONTACTS or rows.strip.size < 2:
        return np.array([0, m], dtype=np.int32)
    strips = rows.strip.size - 1
    # Strips that stand together make a strip: those of even number still share no movable body.
    return np.append(rows.strip[: -1 : -(-strips // STRIPS)], np.int32(m))


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
    begin: int, stop: int, first: int, last: int, due: Indices, load: Floats, start: Indices, neighbor: Indices,
    coupling: Floats, end: Floats, awake: Flags, woken: Indices, count: int,
) -> int:  # fmt: skip
    """Evaluate the contacts due at places `first` to `last`, all of them in one strip (from `begin` to `stop`).

    Those that were evaluated before and must be again become awake. Those of the strip are listed in `woken`, which
    holds `count` already; returns how many it holds then.
    """
    size = np.uint64(due.size)
    for place in range(np.uint64(first), np.uint64(last)):
        # Contacts are due in another order than they lie in memory, which is beyond the caches near the core.
        if place + HEAD_AHEAD < size:
            j = due[place + HEAD_AHEAD]
            _jit.prefetch(start, j + j)
            _jit.prefetch(load, j + j)
        if place + ROW_AHEAD < size:
            j = due[place + ROW_AHEAD]
            _jit.prefetch(end, j)
            _jit.prefetch(neighbor, start[j, 0])
            _jit.prefetch(coupling, start[j, 0])
            _jit.prefetch(coupling, start[j, 0] + LINE)
        k = due[place]
        before = end[k]
        row, row_stop = start[k, 0], start[k, 1]
        # Early neighbors are those evaluated already that end before this contact: as far as is known, or guessed.
        limit = min(before, NEVER)
        s = 0.0
        # Whether a neighbor that ends later may not have known this end.
        wakes = False
        for attempt in range(2):
            A = load[k, 1]
            B = C = B_pull = C_pull = 0.0
            latest = 0.0
            following = PENDING
            # Selections, no branches: they would be mispredicted half of the time.
            for q in range(row, row_stop):
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
            v = B - load[k, 0]
            discriminant = v * v + A * C
            sum_of_roots = abs(v) + np.sqrt(max(discriminant, 0.0))
            denominator = sum_of_roots if v > 0.0 else A
            s = (C if v > 0.0 else sum_of_roots) / denominator if denominator > 0.0 else 0.0
            rising = A * s * s + 2.0 * s * B_pull + (C - 2.0 * C_pull)
            wakes = wakes | (latest > s) | (following < PENDING)
            if discriminant >= 0.0 and rising > 0.0:
                if latest <= s and s <= following:
                    break
                if attempt == 0:
                    # Some are on the wrong side of this root: with those that end before it, it is right nearly always.
                    limit = s
                    continue
            s = _end_by_pieces(load[k, 0], load[k, 1], row, row_stop, neighbor, coupling, end)
            wakes = True
            break
        awake[k] = 0
        earlier = min(s, before)
        if s == before or abs(s - before) <= TIE * earlier:
            continue
        end[k] = s
        # What ends after it and did not know this end.
        if wakes or s > before:
            for q in range(row, row_stop):
                j = neighbor[q]
                if earlier < end[j] and end[j] < PENDING and awake[j] == 0:
                    awake[j] = 1
                    # Contacts of other strips are not evaluated here.
                    if begin <= j < stop:
                        woken[count] = j
                        count += 1
    return count


@kernel
def _sort(begin: int, stop: int, guess: Floats, key: Indices, first: Indices, order: Indices) -> None:
    """Counting sort of some active contacts by their likely end; equal keys keep their order."""
    bits = guess.view(np.int64)
    total = 0
    finite = 0
    for k in range(np.uint64(begin), np.uint64(stop)):
        ends = guess[k] < NEVER
        total += (bits[k] >> KEY_BITS) * ends
        finite += ends
    lowest = total // max(finite, 1) - KEYS // 2
    first[:] = 0
    for k in range(np.uint64(begin), np.uint64(stop)):
        c = np.uint32(min(max((bits[k] >> KEY_BITS) - lowest, 0), KEYS - 1))
        key[k] = c
        first[c + ONE] += ONE
    for bucket in range(KEYS):
        first[bucket + 1] += first[bucket]
    for k in range(np.uint64(begin), np.uint64(stop)):
        place = first[key[k]]
        order[place] = k
        first[key[k]] = place + ONE


@kernel
def _settle(
    begin: int, stop: int, tile: int, tile_stop: int, load: Floats, guess: Floats, start: Indices,
    neighbor: Indices, coupling: Floats, end: Floats, awake: Flags, order: Indices, woken: Indices, again: Indices,
    count: int, key: Indices, first_key: Indices,
) -> tuple[int, int]:  # fmt: skip
    """Evaluate a tile of a strip, and what the tiles before it left over, the first `count` entries of `woken`.

    `guess` is the end that a contact would have if none of its neighbors ended before it.

    Returns:
        evaluations, and how many contacts are left over in `woken`.
    """
    _sort(tile, tile_stop, guess, key, first_key, order)
    size = tile_stop - tile
    evaluations = size
    due = woken
    for chunk in range(0, size, CHUNK):
        count = _sweep(
            begin, stop, chunk, min(chunk + CHUNK, size), order[:size], load, start, neighbor, coupling, end, awake,
            due, count,
        )  # fmt: skip
        for _ in range(CHUNK_SWEEPS):
            if count == 0:
                break
            evaluations += count
            count = _sweep(
                begin, stop, 0, count, due[:count], load, start, neighbor, coupling, end, awake, again, 0
            )  # fmt: skip
            due, again = again, due
    for p in range(count):
        woken[p] = due[p]
    return evaluations, count


@kernel
def _finish(
    strip: Ints, size: Counts, load: Floats, start: Indices, neighbor: Indices, coupling: Floats,
    end: Floats, awake: Flags, order: Indices, woken: Indices,
) -> tuple[int, bool]:  # fmt: skip
    """Evaluate what is awake in any strip until nothing changes; returns evaluations, and whether that came about."""
    listed = 0
    total = 0
    for c in range(size.size):
        total += size[c]
        for k in range(strip[c], strip[c] + size[c]):
            if awake[k] == 1:
                order[listed] = k
                listed += 1
    evaluations = 0
    for _ in range(total + SPARE_SWEEPS):
        if listed == 0:
            return evaluations, True
        evaluations += listed
        listed = _sweep(
            0, load.shape[0], 0, listed, order[:listed], load, start, neighbor, coupling, end, awake, woken, 0
        )  # fmt: skip
        order, woken = woken, order
    return evaluations, False


@kernel
def _all_end(begin: int, stop: int, end: Floats) -> bool:
    """False where a contact never ends: it would leave work behind, and the outer iteration is not applied."""
    ended = 0
    for k in range(np.uint64(begin), np.uint64(stop)):
        ended += end[k] < NEVER
    return ended == stop - begin


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
def _search(
    begin: int, stop: int, first: int, normal: Floats, body: Indices, V: Floats, threshold: float,
    found: Indices, F: Floats,
) -> int:  # fmt: skip
    """List those of some contacts that approach, from place `first` on, and how fast; returns where the list ends."""
    size = np.uint64(first)
    # No branch here: one contact in five approaches, at random.
    for i in range(np.uint64(begin), np.uint64(stop)):
        F_i = _approach(normal, body, V, i)
        found[size] = i
        F[size] = F_i
        size += np.uint64(F_i > threshold)
    return int(size)


@kernel
def _search_nearby(
    normal: Floats, body: Indices, V: Floats, threshold: float, found: Indices, F: Floats,
    strip: Ints, size: Counts, pair: Indices, span: Indices, contact_of: Indices, seen: Ints, iteration: int,
) -> tuple[int, int]:  # fmt: skip
    """Search around the bodies that the last outer iteration moved, and list what approaches in the first strip.

    Returns:
        how many approach, and how many were looked at.
    """
    count = 0
    looked = 0
    for c in range(size.size):
        for k in range(strip[c], strip[c] + size[c]):
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
                    found[count] = i
                    F[count] = F_i
                    count += F_i > threshold
    return count, looked


@kernel
def _keep_fast(strip: Ints, size: Counts, found: Indices, F: Floats, defer: float) -> None:
    """Drop the contacts with F < defer · max F."""
    F_max = 0.0
    for c in range(size.size):
        for k in range(strip[c], strip[c] + size[c]):
            F_max = max(F_max, F[k])
    for c in range(size.size):
        kept = strip[c]
        for k in range(strip[c], strip[c] + size[c]):
            f = F[k]
            found[kept] = found[k]
            F[kept] = f
            kept += f >= defer * F_max
        size[c] = kept - strip[c]


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
    begin: int, stop: int, found: Indices, F: Floats, normal: Floats, body: Indices, V: Floats, span: Indices,
    member: Indices, near: Floats, pair: Indices, end: Floats, awake: Flags,
) -> int:  # fmt: skip
    """Pack some active contacts, and list them (twice their number, plus their side) with each movable body.

    Returns:
        how many couplings they have with one another and with those listed before, both ways.
    """
    met = np.uint64(0)
    for k in range(np.uint64(begin), np.uint64(stop)):
        i = found[k]
        for side in range(2):
            b = body[i, side]
            pair[k, side] = b
            # The immovable body is every strip's: threads must not write to it.
            if V[b, 3] > 0.0:
                count = span[b, 1]
                member[span[b, 0] + count] = k + k + np.uint64(side)
                span[b, 1] = count + ONE
                met += np.uint64(count)
        for axis in range(3):
            near[k, axis] = normal[i, axis]
        near[k, 3] = F[k]
        end[k] = PENDING
        awake[k] = 1
    return 2 * int(met)


@kernel
def _list_strip(
    begin: int, stop: int, normal: Floats, body: Indices, V: Floats, threshold: float, found: Indices, F: Floats,
    span: Indices, member: Indices, near: Floats, pair: Indices, end: Floats, awake: Flags,
) -> tuple[int, int]:  # fmt: skip
    """Search a strip and pack what approaches; returns how many, and the couplings that they met (see `_enlist`)."""
    listed = begin
    met = 0
    for block in range(begin, stop, BLOCK):
        grown = _search(block, min(block + BLOCK, stop), listed, normal, body, V, threshold, found, F)
        # What was searched is still in the cache.
        met += _enlist(listed, grown, found, F, normal, body, V, span, member, near, pair, end, awake)
        listed = grown
    return listed - begin, met


@kernel
def _places(met: Counts, place: Offsets) -> None:
    """Where the couplings of each strip begin at the latest, and an end behind the last.

    A coupling between strips was counted, both ways, with the odd one, which was listed later.
    """
    strips = met.size
    for c in range(strips):
        most = met[c]
        if c % 2 == 0:
            most += ((met[c - 1] if c > 0 else 0) + (met[c + 1] if c + 1 < strips else 0)) // 2
        # One place more: what is written behind the last row is not read.
        place[c + 1] = place[c] + np.uint64(most + 1)


@kernel
def _couple(
    begin: int, stop: int, row: np.uint64, near: Floats, pair: Indices, V: Floats, span: Indices, member: Indices,
    start: Indices, neighbor: Indices, coupling: Floats, load: Floats, guess: Floats,
) -> np.uint64:  # fmt: skip
    """Couplings W_ij F_j of some active contacts, written from `row` on; returns where they end."""
    for k in range(np.uint64(begin), np.uint64(stop)):
        start[k, 0] = row
        x, y, z, F = near[k, 0], near[k, 1], near[k, 2], near[k, 3]
        slope = 0.0
        for side in range(2):
            b = pair[k, side]
            w = V[b, 3] if side == 1 else -V[b, 3]
            wx, wy, wz = w * x, w * y, w * z
            for q in range(span[b, 0], span[b, 0] + span[b, 1]):
                j = np.uint32(member[q] >> ONE)
                F_j = near[j, 3] if member[q] & ONE else -near[j, 3]
                c = (wx * near[j, 0] + wy * near[j, 1] + wz * near[j, 2]) * F_j
                # No branch: what a contact does to itself is overwritten, or stands behind the last row.
                neighbor[row] = j
                coupling[row] = c
                slope += c
                row += np.uint64(j != k)
        start[k, 1] = row
        load[k, 0] = F
        load[k, 1] = (x * x + y * y + z * z) * (V[pair[k, 0], 3] + V[pair[k, 1], 3]) * F
        guess[k] = F / slope if slope > 0.0 else NEVER
    return row


@kernel
def _apply(
    begin: int, stop: int, found: Indices, near: Floats, end: Floats, pair: Indices, V: Floats, span: Indices,
    impulse: Floats,
) -> None:  # fmt: skip
    """Apply the impulses of one outer iteration, and take its contacts off the bodies' lists."""
    for k in range(np.uint64(begin), np.uint64(stop)):
        P = near[k, 3] * end[k]
        impulse[found[k]] += P
        for side in range(2):
            b = pair[k, side]
            if V[b, 3] > 0.0:
                span[b, 1] = 0
                dv = (P if side == 1 else -P) * V[b, 3]
                for axis in range(3):
                    V[b, axis] += dv * near[k, axis]


@kernel
def _settle_strip(
    begin: int, stop: int, row: np.uint64, near: Floats, pair: Indices, V: Floats, span: Indices, member: Indices,
    load: Floats, guess: Floats, start: Indices, neighbor: Indices, coupling: Floats, end: Floats,
    awake: Flags, order: Indices, woken: Indices, again: Indices, key: Indices, first_key: Indices,
) -> int:  # fmt: skip
    """Couple and evaluate the active contacts of a strip, tile by tile; returns the number of evaluations."""
    total = 0
    left = 0
    for tile in range(begin, stop, TILE):
        tile_stop = min(tile + TILE, stop)
        row = _couple(
            tile, tile_stop, row, near, pair, V, span, member, start, neighbor, coupling, load, guess
        )  # fmt: skip
        # Its couplings are still in the cache.
        evaluations, left = _settle(
            begin, stop, tile, tile_stop, load, guess, start, neighbor, coupling, end, awake, order, woken, again,
            left, key, first_key,
        )  # fmt: skip
        total += evaluations
    return total


@parallel_kernel
def _list_strips(
    strip: Ints, normal: Floats, body: Indices, V: Floats, threshold: float, found: Indices, F: Floats, span: Indices,
    member: Indices, near: Floats, pair: Indices, end: Floats, awake: Flags, defer: float, size: Counts, met: Counts,
) -> None:  # fmt: skip
    """Search all strips; fill how many contacts approach.

    Pack them, and fill the couplings that they met (see `_enlist`), but where some are to be deferred.
    """
    strips = size.size
    for parity in range(2):
        for half in prange((strips + 1 - parity) // 2):
            c = int(2 * np.int64(half) + parity)
            if defer == 0.0:
                size[c], met[c] = _list_strip(
                    strip[c], strip[c + 1], normal, body, V, threshold, found, F, span, member, near, pair, end, awake
                )  # fmt: skip
            else:
                listed = _search(strip[c], strip[c + 1], strip[c], normal, body, V, threshold, found, F)
                size[c] = listed - strip[c]


@parallel_kernel
def _settle_strips(
    strip: Ints, size: Counts, place: Offsets, near: Floats, pair: Indices, V: Floats, span: Indices, member: Indices,
    load: Floats, guess: Floats, start: Indices, neighbor: Indices, coupling: Floats, end: Floats, awake: Flags,
    order: Indices, woken: Indices, again: Indices, key: Indices, first_key: Indices, evaluated: Counts,
) -> None:  # fmt: skip
    """Couple and evaluate the active contacts of all strips; fill the numbers of evaluations."""
    strips = size.size
    for parity in range(2):
        for half in prange((strips + 1 - parity) // 2):
            c = int(2 * np.int64(half) + parity)
            stop = strip[c] + size[c]
            evaluated[c] = _settle_strip(
                strip[c], stop, place[c], near, pair, V, span, member, load, guess, start, neighbor, coupling,
                end, awake, order[strip[c] : stop], woken[strip[c] : stop], again[strip[c] : stop], key, first_key[c],
            )  # fmt: skip


@parallel_kernel
def _apply_strips(
    strip: Ints, size: Counts, found: Indices, near: Floats, end: Floats, pair: Indices, V: Floats, span: Indices,
    impulse: Floats,
) -> None:  # fmt: skip
    """Apply the impulses of one outer iteration in all strips."""
    strips = size.size
    for parity in range(2):
        for half in prange((strips + 1 - parity) // 2):
            c = int(2 * np.int64(half) + parity)
            _apply(strip[c], strip[c] + size[c], found, near, end, pair, V, span, impulse)


_list_strips_alone = alone(_list_strips)
_settle_strips_alone = alone(_settle_strips)
_apply_strips_alone = alone(_apply_strips)


@kernel
def _solve_spheres(
    normal: Floats, body: Indices, V: Floats, strip: Ints,
    threshold: float, defer: float, max_iterations: int, max_visits: int,
) -> tuple[Floats, int, int, int]:  # fmt: skip
    """Outer iterations on packed contacts (V is changed)."""
    m = normal.shape[0]
    strips = strip.size - 1
    impulse = np.zeros(m)
    # Per body: its span of all contacts, and its active ones.
    span = _spans(body, V.shape[0])
    member = np.empty(2 * m, np.uint32)
    # Per active contact, those of each strip from its first place on; memory that is not needed is never touched.
    found = np.empty(m, np.uint32)
    F = np.empty(m)
    near = np.empty((m, 4))
    pair = np.empty((m, 2), np.uint32)
    # F_i and W_ii F_i, side by side: an evaluation needs both.
    load = np.empty((m, 2))
    guess = np.empty(m)
    end = np.empty(m)
    awake = np.empty(m, np.uint8)
    start = np.empty((m, 2), np.uint32)
    order = np.empty(m, np.uint32)
    woken = np.empty(m, np.uint32)
    again = np.empty(m, np.uint32)
    key = np.empty(m, np.uint32)
    neighbor = np.empty(0, np.uint32)
    coupling = np.empty(0)
    # Per strip: active contacts, couplings that they met when listed, where theirs begin, evaluations.
    size = np.zeros(strips, np.int64)
    met = np.zeros(strips, np.int64)
    place = np.zeros(strips + 1, np.uint64)
    evaluated = np.zeros(strips, np.int64)
    first_key = np.empty((strips, KEYS + 1), np.uint32)
    # What only a search by neighborhood needs.
    contact_of = np.empty(0, np.uint32)
    seen = np.empty(0, np.int32)
    visits = 0
    iterations = 0
    everywhere = True
    while iterations < max_iterations and visits < max_visits:
        if everywhere:
            visits += m
            if strips > 1:
                _list_strips(
                    strip, normal, body, V, threshold, found, F, span, member, near, pair, end, awake, defer, size, met
                )  # fmt: skip
            else:
                _list_strips_alone(
                    strip, normal, body, V, threshold, found, F, span, member, near, pair, end, awake, defer, size, met
                )  # fmt: skip
        else:
            if seen.size == 0:
                contact_of = _contacts_of_bodies(body, span)
                seen = np.zeros(m, np.int32)
            count, looked = _search_nearby(
                normal, body, V, threshold, found, F, strip, size, pair, span, contact_of, seen, iterations
            )
            visits += looked
            size[:] = 0
            met[:] = 0
            size[0] = count
            met[0] = _enlist(0, count, found, F, normal, body, V, span, member, near, pair, end, awake)
        total = int(size.sum())
        if total == 0:
            break
        iterations += 1
        if defer > 0.0:
            _keep_fast(strip, size, found, F, defer)
            for parity in range(2):
                for c in range(parity, strips, 2):
                    met[c] = _enlist(
                        strip[c], strip[c] + size[c], found, F, normal, body, V, span, member, near, pair, end, awake
                    )  # fmt: skip
            total = int(size.sum())
        # Waking a thread up takes as long as some hundred events; and what a neighborhood gave is in one strip.
        shared = strips > 1 and everywhere and total >= SHARED_ACTIVE
        everywhere = defer > 0.0 or total * SEARCH_ALL > m
        visits += total
        _places(met, place)
        if place[strips] > coupling.size:
            neighbor = np.empty(place[strips] + place[strips] // np.uint64(8), np.uint32)
            coupling = np.empty(neighbor.size)
        if shared:
            _settle_strips(
                strip, size, place, near, pair, V, span, member, load, guess, start, neighbor, coupling, end, awake,
                order, woken, again, key, first_key, evaluated,
            )  # fmt: skip
        else:
            _settle_strips_alone(
                strip, size, place, near, pair, V, span, member, load, guess, start, neighbor, coupling, end, awake,
                order, woken, again, key, first_key, evaluated,
            )  # fmt: skip
        evaluations, settled = _finish(
            strip, size, load, start, neighbor, coupling, end, awake, order, woken
        )  # fmt: skip
        visits += int(evaluated.sum()) + evaluations
        if not settled:
            return impulse, iterations, visits, RESTLESS
        for c in range(strips):
            if not _all_end(strip[c], strip[c] + size[c], end):
                return impulse, iterations, visits, STALLED
        if shared:
            _apply_strips(strip, size, found, near, end, pair, V, span, impulse)
        else:
            _apply_strips_alone(strip, size, found, near, end, pair, V, span, impulse)
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
    size: int, found: Indices, F: Floats, JM_start: Ints, JM_index: Indices, JM: Floats, first: Ints, count: Ints,
    record: Floats, record_of: Indices, met: Ints, load: Floats, guess: Floats, end: Floats, awake: Flags,
    start: Indices, neighbor: Indices, coupling: Floats,
) -> tuple[Indices, Floats]:  # fmt: skip
    """Couplings W_ij F_j of all active contacts; returns their arrays, made larger where they were too small."""
    row = 0
    met[:size] = -1
    for k in range(size):
        i = found[k]
        start[k, 0] = row
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
        load[k, 0] = F[k]
        load[k, 1] = own_k
        start[k, 1] = stop
        guess[k] = F[k] / w if w > 0.0 else NEVER
        end[k] = PENDING
        awake[k] = 1
        row = stop
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
    found = np.empty(m, np.uint32)
    F = np.empty(m)
    # F_i and W_ii F_i, side by side: an evaluation needs both.
    load = np.empty((m, 2))
    guess = np.empty(m)
    end = np.empty(m)
    awake = np.empty(m, np.uint8)
    start = np.empty((m, 2), np.uint32)
    met = np.empty(m, np.int32)
    order = np.empty(m, np.uint32)
    woken = np.empty(m, np.uint32)
    again = np.empty(m, np.uint32)
    first_key = np.empty(KEYS + 1, np.uint32)
    neighbor = np.empty(8 * m + 8, np.uint32)
    coupling = np.empty(8 * m + 8)
    # All contacts are one strip.
    strip = np.zeros(1, np.int32)
    sizes = np.zeros(1, np.int64)
    visits = 0
    iterations = 0
    while iterations < max_iterations and visits < max_visits:
        size = _search_sparse(J_start, J_index, J, v, threshold, found, F)
        visits += m
        if size == 0:
            break
        iterations += 1
        sizes[0] = size
        if defer > 0.0:
            _keep_fast(strip, sizes, found, F, defer)
            size = int(sizes[0])
        visits += size
        _enlist_sparse(size, found, F, J_start, J_index, J, first, count, record, record_of)
        neighbor, coupling = _couple_sparse(
            size, found, F, JM_start, JM_index, JM, first, count, record, record_of, met, load, guess, end, awake,
            start, neighbor, coupling,
        )  # fmt: skip
        left = 0
        for tile in range(0, size, TILE):
            # `met` has served: it takes the sorting keys.
            evaluations, left = _settle(
                0, size, tile, min(tile + TILE, size), load, guess, start, neighbor, coupling, end, awake,
                order, woken, again, left, met.view(np.uint32), first_key,
            )  # fmt: skip
            visits += evaluations
        evaluations, settled = _finish(
            strip, sizes, load, start, neighbor, coupling, end, awake, order, woken
        )  # fmt: skip
        visits += evaluations
        if not settled:
            return impulse, iterations, visits, RESTLESS
        if not _all_end(0, size, end):
            return impulse, iterations, visits, STALLED
        _apply_sparse(size, found, F, end, JM_start, JM_index, JM, v, impulse)
    return impulse, iterations, visits, 0

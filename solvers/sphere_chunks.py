"""Packed contacts cut into chunks, and what their geometry says before any velocity is known.

    rate_i = (W K W)_ii / W_ii,   K = diag(k)

Chunks of one parity share no movable body: threads take those of even number, then those of odd number, and what a body
sums up has one order whoever does it. A contact lasts as its own rate says (see `explicit_hertz`).

A problem keeps all this beside its packed rows, 16 bytes a contact and 36 a body: it is made once, by the first solve
that asks for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from solvers._jit import alone, kernel, parallel_kernel, prange
from solvers.solution import Floats

if TYPE_CHECKING:
    from solvers.sphere_rows import SphereRows

# Unsigned as the indices of `sphere_rows`: no test for negative ones.
Indices = npt.NDArray[np.uint32]
Offsets = npt.NDArray[np.uint64]

# From this many contacts on sharing the work out pays: below it threads wait for one another most of the time.
SHARED_CONTACTS = 15_000
# Chunks of contacts that threads share out; the same for any number of threads.
MOST_CHUNKS = 64
# Numba makes a signed index of an unsigned one and a plain number, and tests it for being negative at every access.
ONE, TWO, THREE, FOUR, FIVE = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4), np.uint64(5)


class Rates(NamedTuple):
    """Rates of all contacts in short [1/kg]."""

    lowest: float
    mean: float
    highest: float


@dataclass(frozen=True)
class SphereChunks:
    """Chunks of packed contacts; kernels see flat arrays."""

    normal: Floats
    """n, shape (3m,)."""

    body: Indices
    """Where the rows of bodies a and b begin in velocities, shape (2m,)."""

    at_rest: Floats
    """Velocity 0 and inverse mass [1/kg] of each body, then an immovable body a chunk; shape (4 (bodies + chunks),)."""

    begin: Offsets
    """Where the chunks of contacts begin, shape (chunks + 1,), the last entry their end."""

    bodies_of_chunk: int
    """Bodies whose contacts a chunk takes."""

    @property
    def is_shared(self) -> bool:
        """Whether threads share the work out."""
        return self.body.size >= 2 * SHARED_CONTACTS

    def rates(self, stiffness: Floats) -> Rates:
        """(W K W)_ii / W_ii [1/kg] at a stiffness of shape (m,)."""
        run = _rates if self.is_shared else _rates_alone
        rate = run(self.begin, self.normal, self.body, self.at_rest, stiffness)
        return Rates(float(rate.min()), float(rate.mean()), float(rate.max()))

    @cached_property
    def rates_of_equals(self) -> Rates:
        """`rates` where every stiffness is 1."""
        return self.rates(np.ones(self.body.size // 2))

    @cached_property
    def contacts_of_body(self) -> tuple[Indices, Indices]:
        """Where the contacts of each movable body begin, shape (bodies + 1,), and these contacts."""
        return _contacts_of_body(self.body, self.at_rest.size // 4 - self.begin.size + 1)


def chunks(rows: SphereRows) -> SphereChunks:
    """Cut contacts, sorted by their lower-numbered body, so that a chunk reaches into the next one's bodies at most."""
    bodies = rows.V.shape[0] - 1
    size = max(int(_reach(rows.body, bodies)), -(-bodies // MOST_CHUNKS))
    begin = _cuts(rows.body, size, -(-bodies // size))
    normal = rows.normal.reshape(-1)
    body = _places(rows.body, bodies, begin)
    at_rest = np.zeros((bodies + begin.size - 1, 4))
    at_rest[:bodies, 3] = rows.V[:-1, 3]
    # A kernel is compiled for one kind of array.
    for array in (normal, body):
        array.flags.writeable = False
    return SphereChunks(normal, body, at_rest.reshape(-1), begin, size)


@kernel
def _reach(body: Indices, bodies: int) -> np.uint32:
    """How much higher one movable body of a contact is numbered than the other, at most; all where not sorted."""
    reach = np.uint32(1)
    last = np.uint32(0)
    for i in range(body.shape[0]):
        low = min(body[i, 0], body[i, 1])
        high = max(body[i, 0], body[i, 1])
        if low < last:
            return np.uint32(bodies)
        last = low
        if high < bodies:
            reach = max(reach, high - low)
    return reach


@kernel
def _cuts(body: Indices, size: int, count: int) -> Offsets:
    """Where the contacts of each `size` bodies begin, shape (count + 1,), by bisection."""
    chunk = np.zeros(count + 1, np.uint64)
    chunk[count] = body.shape[0]
    for c in range(1, count):
        low = chunk[c - 1]
        high = chunk[count]
        while low < high:
            middle = (low + high) >> ONE
            if min(body[middle, 0], body[middle, 1]) < c * size:
                low = middle + ONE
            else:
                high = middle
        chunk[c] = low
    return chunk


@kernel
def _places(body: Indices, bodies: int, chunk: Offsets) -> Indices:
    """Where the rows of bodies begin in velocities, shape (2m,); each chunk has a floor of its own.

    Threads must not push the same floor.
    """
    place = np.empty(2 * body.shape[0], np.uint32)
    for c in range(chunk.size - 1):
        floor = np.uint32(4 * (bodies + c))
        for i in range(chunk[c], chunk[c + 1]):
            for side in range(2):
                b = body[i, side]
                place[2 * i + side] = floor if b == bodies else 4 * b
    return place


@kernel
def _contacts_of_body(body: Indices, bodies: int) -> tuple[Indices, Indices]:
    """Where the contacts of each body begin, shape (bodies + 1,), and these contacts; others have none."""
    first = np.zeros(bodies + 2, np.uint32)
    for b in body:
        if b < 4 * bodies:
            first[(b >> 2) + 2] += 1
    for k in range(bodies):
        first[k + 2] += first[k + 1]
    contact = np.empty(first[bodies + 1], np.uint32)
    for q in range(body.size):
        k = body[q] >> 2
        if k < bodies:
            contact[first[k + 1]] = q >> 1
            first[k + 1] += 1
    return first[:-1], contact


@parallel_kernel
def _rates(chunk: Offsets, normal: Floats, body: Indices, V: Floats, stiffness: Floats) -> Floats:
    """(W K W)_ii / W_ii by one tensor Σ k n nᵀ a body, between two bodies that meet once."""
    chunks = chunk.size - 1
    tensor = np.zeros(2 * V.size)
    for parity in range(2):
        for half in prange((chunks + 1 - parity) // 2):
            c = 2 * half + parity
            _add_tensors(chunk[c], chunk[c + 1], normal, body, stiffness, tensor)
    rate = np.empty(stiffness.size)
    for c in prange(chunks):
        _rates_of_chunk(chunk[c], chunk[c + 1], normal, body, stiffness, tensor, V, rate)
    return rate


_rates_alone = alone(_rates)


@kernel
def _add_tensors(
    begin: np.uint64, end: np.uint64, normal: Floats, body: Indices, stiffness: Floats, tensor: Floats
) -> None:
    """Add k n nᵀ of a chunk's contacts to the tensors of their two bodies, eight places each."""
    for i in range(begin, end):
        n0, n1, n2, k = normal[THREE * i], normal[THREE * i + ONE], normal[THREE * i + TWO], stiffness[i]
        for side in range(np.uint64(2)):
            c = TWO * body[TWO * i + side]
            tensor[c] += k * n0 * n0
            tensor[c + ONE] += k * n1 * n1
            tensor[c + TWO] += k * n2 * n2
            tensor[c + THREE] += 2.0 * k * n0 * n1
            tensor[c + FOUR] += 2.0 * k * n0 * n2
            tensor[c + FIVE] += 2.0 * k * n1 * n2


@kernel
def _rates_of_chunk(
    begin: np.uint64, end: np.uint64, normal: Floats, body: Indices, stiffness: Floats, tensor: Floats, V: Floats,
    rate: Floats,
) -> None:  # fmt: skip
    """Fill in a chunk's rates."""
    for i in range(begin, end):
        n0, n1, n2 = normal[THREE * i], normal[THREE * i + ONE], normal[THREE * i + TWO]
        square = n0 * n0 + n1 * n1 + n2 * n2
        for_a, for_b = V[body[TWO * i] + THREE], V[body[TWO * i + ONE] + THREE]
        square_of_row = 2.0 * for_a * for_b * stiffness[i] * square * square
        for side in range(np.uint64(2)):
            c = TWO * body[TWO * i + side]
            w = V[body[TWO * i + side] + THREE]
            square_of_row += w * w * (
                tensor[c] * n0 * n0 + tensor[c + ONE] * n1 * n1 + tensor[c + TWO] * n2 * n2
                + tensor[c + THREE] * n0 * n1 + tensor[c + FOUR] * n0 * n2 + tensor[c + FIVE] * n1 * n2
            )  # fmt: skip
        rate[i] = square_of_row / ((for_a + for_b) * square)

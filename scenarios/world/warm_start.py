"""The last step's impulses as the first guess of the next one's: what lies today lay so a step ago."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.world.checkpoint import Arrays
from scenarios.world.grid import Contacts
from scenarios.world.spheres import Ints
from solvers.solution import Floats

Keys = npt.NDArray[np.int64]


@dataclass(frozen=True)
class LastImpulses:
    """Impulses of one step, known by the bodies that they act on."""

    pair: Ints
    """Labels of the two bodies of each contact, shape (m, 2); the immovable body has the number of spheres."""

    impulse: Floats
    """λ, λ₁ and λ₂ [N s], shape (m, 3)."""

    def at(self, pair: Ints) -> Floats:
        """Impulses at other contacts, shape (m', 3): zero where there was none.

        A sphere in a corner touches two walls that are one body: both get the same guess.
        """
        guess = np.zeros((len(pair), 3))
        if not len(self.pair):
            return guess
        key = _keys(self.pair)
        order = np.argsort(key, kind="stable")
        wanted = _keys(pair)
        place = order[np.minimum(np.searchsorted(key, wanted, sorter=order), key.size - 1)]
        same = key[place] == wanted
        guess[same] = self.impulse[place[same]]
        return guess

    def state(self) -> Arrays:
        """As it is kept in a checkpoint."""
        return {"pair": self.pair, "impulse": self.impulse}


NO_IMPULSES = LastImpulses(np.zeros((0, 2), dtype=np.int32), np.zeros((0, 3)))


def labels_of(contacts: Contacts, label: Ints) -> Ints:
    """Labels of the two bodies of each contact, shape (m, 2)."""
    with_walls = np.append(label, np.int32(label.size))
    pair: Ints = with_walls[contacts.body]
    return pair


def _keys(pair: Ints) -> Keys:
    """One number for a pair, whichever body is first."""
    low, high = pair.min(axis=1).astype(np.int64), pair.max(axis=1).astype(np.int64)
    keys: Keys = (low << 32) | high
    return keys

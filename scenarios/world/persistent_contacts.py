"""Contacts that are the same from one step to the next, so that impulses can go on from the last ones.

A contact is the nearest one of the step before between the same two parts, if that is near enough; it keeps its number
and its impulse. That is kept as one vector in space, as normals and tangents may turn: at an edge on an edge by a large
angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scenarios.world.checkpoint import Arrays
from scenarios.world.collision import Keys, RigidContacts
from solvers._jit import kernel
from solvers.solution import Floats

# A contact of the step before is the same if it lies nearer than this share of the thinnest body's thickness: what is
# slower than a step allows moves no farther, and the corners of a face lie farther apart.
NEAR = 0.5


@dataclass(frozen=True)
class LastContacts:
    """The contacts of one step, sorted by parts, and what they carried."""

    part: Keys
    """As in `RigidContacts`, shape (m,)."""
    number: Keys
    """What names each contact as long as it lasts, shape (m,)."""
    point: Floats
    """[m], shape (m, 3)."""
    impulse: Floats
    """Of normal and friction together, on the second body [N s], shape (m, 3)."""
    next_number: int = 0
    """The first number that no contact has had yet."""

    def match(self, contacts: RigidContacts, near: float) -> LastContacts:
        """The same contacts' impulses, zero for new ones, which get new numbers.

        Args:
            contacts: of the new step.
            near: distance within which a contact is the same [m].
        """
        same = _matched(self.part, self.point, contacts.part, contacts.point, near)
        number = np.where(same >= 0, np.append(self.number, -1)[same], -1)
        new = np.flatnonzero(same < 0)
        number[new] = self.next_number + np.arange(new.size)
        impulse = np.concatenate([self.impulse, np.zeros((1, 3))])[same]
        return LastContacts(contacts.part, number, contacts.point, impulse, self.next_number + new.size)

    def state(self) -> Arrays:
        """As it is kept in a checkpoint."""
        return {
            "last_part": self.part, "last_number": self.number, "last_point": self.point,
            "last_impulse": self.impulse, "last_next_number": np.array(self.next_number),
        }  # fmt: skip

    @classmethod
    def of_state(cls, state: Arrays) -> LastContacts:
        """Back from a checkpoint."""
        return cls(
            state["last_part"], state["last_number"], state["last_point"], state["last_impulse"],
            int(state["last_next_number"]),
        )  # fmt: skip


NOTHING_TOUCHED = LastContacts(
    np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3))
)


@kernel
def _matched(old_part: Keys, old_point: Floats, part: Keys, point: Floats, near: float) -> npt.NDArray[np.int64]:
    """The old contact of each new one, -1 if it is new; both sorted by parts, and no old one is taken twice."""
    same = np.full(part.size, -1, np.int64)
    taken = np.zeros(old_part.size, np.bool_)
    first = 0
    for i in range(part.size):
        while first < old_part.size and old_part[first] < part[i]:
            first += 1
        closest = near * near
        j = first
        while j < old_part.size and old_part[j] == part[i]:
            if not taken[j]:
                square = 0.0
                for axis in range(3):
                    square += (point[i, axis] - old_point[j, axis]) ** 2
                if square < closest:
                    closest = square
                    same[i] = j
            j += 1
        if same[i] >= 0:
            taken[same[i]] = True
    return same

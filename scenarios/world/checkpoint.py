"""A world as the bytes of an .npz file and back: the trajectory goes on bit for bit.

Only the state is kept, with the impulses from which the next step starts: the container's motion is a function of time,
and all else follows. The bytes say which scene they belong to, so that it is not continued as another one.
"""

from __future__ import annotations

import io
import zipfile
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Arrays = dict[str, npt.NDArray[Any]]

FORMAT = 6
"""Changes whenever the same start gives another trajectory, or the file another meaning."""
FORMAT_FIELD = "format"
IDENTITY_FIELD = "identity"


class CheckpointError(ValueError):
    """A checkpoint cannot be read or belongs to something else; the text says which."""


class Resumable(Protocol):
    """A world with a state that is all of it."""

    @property
    def identity(self) -> str:
        """What scene this is, with all that its trajectory depends on."""
        ...

    def state(self) -> Arrays:
        """All that changes from step to step."""
        ...

    def restore(self, state: Arrays) -> None:
        """Go on from a state of the same scene."""
        ...


def checkpoint(world: Resumable) -> bytes:
    """Return the content of a checkpoint file."""
    content: dict[str, Any] = {FORMAT_FIELD: FORMAT, IDENTITY_FIELD: world.identity, **world.state()}
    file = io.BytesIO()
    np.savez(file, **content)
    return file.getvalue()


def resume(world: Resumable, content: bytes) -> None:
    """Let a freshly made world go on from a checkpoint of the same scene.

    Raises:
        CheckpointError: it is no checkpoint, or one of another scene, parameters, solver, seed or version.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            state: Arrays = {name: archive[name] for name in archive.files}
        found, identity = int(state.pop(FORMAT_FIELD)), str(state.pop(IDENTITY_FIELD))
    except (ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"not a checkpoint: {error}") from None
    if found != FORMAT:
        raise CheckpointError(
            f"a checkpoint of format {found}; this version reads format {FORMAT}: start the scene anew"
        )
    if identity != world.identity:
        raise CheckpointError(f"a checkpoint of\n  {identity}\nand not of\n  {world.identity}")
    world.restore(state)

"""A rigid box falls flat on more contact points than it has degrees of freedom: W is singular.

    u_i = v_z + ω_x y_i - ω_y x_i      contact point (x_i, y_i, -height/2) from the center

The impulses are not unique, the velocity of most laws is. Entering each contact twice with half the stiffness is the
same box; a law whose answer changes is sensitive to how contacts were found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import scipy.sparse as sp

from scenarios.parameters import check_count, check_number, given
from scenarios.references import hertz, reversed_velocity
from scenarios.scenario import Invariant, Reference, Scenario, Symmetry
from solvers import ImpactProblem, ProblemError
from solvers.solution import Floats

WIDTH = 2.0
HEIGHT = 1.0


def box_on_floor(
    *,
    points: int = 4,
    copies: int = 1,
    spin: Sequence[float] = (0.0, 0.0, 0.0),
    slide: float = 0.0,
    restitution: float = 1.0,
    friction: float = 0.0,
) -> Scenario:
    """A box of 2 m × 2 m × 1 m and 1 kg falls flat on a floor with speed 1, on a grid of contact points.

    Args:
        points: contact points in the base, a grid as near to square as they allow (1,000: 25 × 40); no prime number.
        copies: how often each contact is entered, with stiffness 1/copies.
        spin: angular velocity (x, y, z) at the impact [rad/s]; x and y make it unsymmetric.
        slide: horizontal velocity along x at the impact [m/s].
        restitution: of all contacts, in [0, 1].
        friction: coefficient of all contacts, ≥ 0.

    Source: chosen here; the rank-deficient case of rigid body contact.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    rows, columns = _grid_shape(points)
    check_count("copies", copies, 1)
    check_number("slide", slide)
    check_number("restitution", restitution, low=0.0, high=1.0)
    check_number("friction", friction, low=0.0)
    v_pre = np.array([slide, 0.0, -1.0, *_spin(spin)])
    corners = np.tile(_grid(rows, columns), (copies, 1))
    problem = ImpactProblem(
        _inverse_mass(),
        _normal_rows(corners),
        v_pre,
        restitution,
        friction,
        _tangent_rows(corners) if friction else None,
        stiffness=1.0 / copies,
    )
    flat = not np.any(v_pre[[0, 1, 3, 4, 5]])
    return Scenario(
        "box-on-floor",
        given(box_on_floor, locals()),
        problem,
        "chosen here: a box on 4 to 1,000 contact points",
        reference_builders=_references(problem, flat),
        symmetries=_symmetries(square=rows == columns),
        invariants=() if friction else _momenta(),
        tags=frozenset({"redundant", "box"} | ({"friction"} if friction else set())),
        dofs_per_body=3,
        positions=np.zeros((1, 3)),
    )


def _grid_shape(points: int) -> tuple[int, int]:
    """Rows and columns of the grid, as near to square as possible."""
    check_count("points", points, 4)
    rows = max(divisor for divisor in range(1, int(np.sqrt(points)) + 1) if points % divisor == 0)
    if rows < 2:
        raise ProblemError(f"points must fill a grid of two rows or more, not the prime number {points}")
    return rows, points // rows


def _spin(spin: Sequence[float]) -> tuple[float, ...]:
    if isinstance(spin, str) or not isinstance(spin, (Sequence, np.ndarray)) or len(spin) != 3:
        raise ProblemError(f"spin must have three entries, not {spin!r}")
    for axis, value in zip("xyz", spin, strict=True):
        check_number(f"spin {axis}", value)
    return tuple(float(value) for value in spin)


def _grid(rows: int, columns: int) -> Floats:
    """Contact points from the center of the box [m], shape (points, 3), from edge to edge of its base."""
    # Whole numbers over whole numbers: the two sides of a mirror are the same to the last bit.
    x = (2 * np.arange(columns) - (columns - 1)) / (columns - 1) * (WIDTH / 2)
    y = (2 * np.arange(rows) - (rows - 1)) / (rows - 1) * (WIDTH / 2)
    across, along = np.meshgrid(x, y)
    return np.column_stack([across.ravel(), along.ravel(), np.full(across.size, -HEIGHT / 2)])


def _inverse_mass() -> Floats:
    """Inverse mass [1/kg] and inverse moments of inertia [1/(kg m²)] of the homogeneous box, as a diagonal."""
    tilting = (WIDTH**2 + HEIGHT**2) / 12.0
    turning = 2.0 * WIDTH**2 / 12.0
    return np.array([1.0, 1.0, 1.0, 1.0 / tilting, 1.0 / tilting, 1.0 / turning])


def _rows_along(direction: Floats, levers: Floats) -> Floats:
    """Rows d · (v + ω × r) for one direction and many levers, shape (points, 6)."""
    return np.hstack([np.tile(direction, (len(levers), 1)), np.cross(levers, direction)])


def _normal_rows(corners: Floats) -> sp.csr_array:
    return sp.csr_array(_rows_along(np.array([0.0, 0.0, 1.0]), corners))


def _tangent_rows(corners: Floats) -> sp.csr_array:
    """Friction pyramid along x and y: rows 2i and 2i + 1 belong to contact i."""
    along_x = _rows_along(np.array([1.0, 0.0, 0.0]), corners)
    along_y = _rows_along(np.array([0.0, 1.0, 0.0]), corners)
    return sp.csr_array(np.stack([along_x, along_y], axis=1).reshape(-1, 6))


def _references(problem: ImpactProblem, flat: bool) -> tuple[Callable[[], Reference], ...]:
    found: list[Callable[[], Reference]] = []
    if flat:
        found.append(
            partial(reversed_velocity, problem, "falls flat: all contact points rebound alike, u_post = -e u_pre")
        )
    if (problem.restitution == 1.0).all() and not problem.has_friction:
        found.append(partial(hertz, problem))
    return tuple(found)


def _momenta() -> tuple[Invariant, ...]:
    """What no vertical impulse on the base changes: motion along the floor and turning about the vertical."""
    rows = np.eye(6)
    return (
        Invariant("linear momentum x", rows[0]),
        Invariant("linear momentum y", rows[1]),
        Invariant("angular momentum z", rows[5]),
    )


def _symmetries(*, square: bool) -> tuple[Symmetry, ...]:
    """Mirrors of the base and, where the grid is square, its quarter turns and diagonal mirrors."""
    turns = {
        "mirror x": ((-1.0, 0.0), (0.0, 1.0)),
        "mirror y": ((1.0, 0.0), (0.0, -1.0)),
        "half turn": ((-1.0, 0.0), (0.0, -1.0)),
    }
    if square:
        turns |= {
            "quarter turn": ((0.0, -1.0), (1.0, 0.0)),
            "three-quarter turn": ((0.0, 1.0), (-1.0, 0.0)),
            "diagonal mirror": ((0.0, 1.0), (1.0, 0.0)),
            "antidiagonal mirror": ((0.0, -1.0), (-1.0, 0.0)),
        }
    found = []
    for name, turn in turns.items():
        R = np.eye(3)
        R[:2, :2] = turn
        # ω is an axial vector: it turns with det(R) R.
        S = np.zeros((6, 6))
        S[:3, :3] = R
        S[3:, 3:] = round(np.linalg.det(R)) * R
        found.append(Symmetry(name, sp.csr_array(S)))
    return tuple(found)

"""Scenes made to break laws: each is simple to say, and hard for some law to end, to keep finite, or to get right.

    long chains, extreme masses, normals that nearly coincide or nearly oppose, boxes without play, resting stacks,
    restitution that differs from contact to contact, impacts that never stop coming, and scenes without any impact

Hard scenes that other families have already (`box-on-floor`, `ball-ring`, `disturbed-cradle`, …) stay there;
`scenarios.tiers.HARD_CASES` puts all of them together. Source: chosen here, unless a family says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import scipy.sparse as sp

from scenarios.contacts import (
    Contacts,
    fixed_contacts,
    line_of_contacts,
    linear_momenta,
    map_of_bodies,
    normal_rows,
    pair_contacts,
    plane_angular_momentum,
)
from scenarios.parameters import check_choice, check_count, check_number, check_positive, given
from scenarios.references import ideal_exchange
from scenarios.scenario import Reference, ReferenceKind, Scenario, Symmetry
from solvers import ImpactProblem, ProblemError
from solvers.solution import Floats

NOTHING_HAPPENS = "nothing happens"
"""Name of the reference of scenes in which no contact approaches: every law must leave them as they are."""

COMES_TO_REST = "comes to rest"
"""Name of the reference of columns without restitution."""

GRAVITY = 9.81
"""Acceleration of free fall [m/s²]."""

IDENTITY = "identity"
"""Tag of scenes in which no contact approaches."""

MIXED = "mixed restitution"
"""Tag of scenes whose restitution differs from contact to contact."""

STACKS = 'chosen here; Guendelman et al. 2003, "Nonconvex rigid bodies with stacking", on why stacks are hard'


def long_chain(*, balls: int = 1000, start: str = "struck", restitution: float = 1.0) -> Scenario:
    """A free chain of equal balls, as long as memory allows, in one of four states of motion.

    Args:
        balls: in the chain, ≥ 1; one ball has no contact at all.
        start: "struck": the first ball comes with speed 1; "converging": all contacts approach alike, the ends with
            speed 1; "separating": all contacts separate alike; "together": all balls move with speed 1, so that every
            contact touches and none approaches.
        restitution: of all contacts, in [0, 1].

    Source: chosen here; laws whose work grows with the square of the length do not end on it.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("balls", balls, 1)
    check_choice("start", start, ("struck", "converging", "separating", "together"))
    check_number("restitution", restitution, low=0.0, high=1.0)
    ramp = np.linspace(1.0, -1.0, balls) if balls > 1 else np.ones(1)
    v_pre = {
        "struck": np.where(np.arange(balls) == 0, 1.0, 0.0),
        "converging": ramp,
        "separating": -ramp,
        "together": np.ones(balls),
    }[start]
    problem = ImpactProblem(np.ones(balls), line_of_contacts(balls), v_pre, restitution)
    idle = bool((problem.u_pre >= 0).all())
    builders: list[Callable[[], Reference]] = []
    if idle:
        builders.append(partial(nothing_happens, problem))
    elif restitution == 1.0:
        builders.append(partial(ideal_exchange, problem))
    mirror = sp.coo_array((np.full(balls, -1.0), (np.arange(balls), np.arange(balls)[::-1])), shape=(balls, balls))
    return Scenario(
        "long-chain",
        given(long_chain, locals()),
        problem,
        "chosen here",
        reference_builders=tuple(builders),
        symmetries=(Symmetry("mirror", sp.csr_array(mirror)),),
        invariants=linear_momenta(balls, 1, "x"),
        tags=frozenset({"chain"} | ({IDENTITY} if idle else set())),
    )


def heavy_and_light(*, mass_ratio: float = 1e6, arrangement: str = "between", restitution: float = 1.0) -> Scenario:
    """A free chain of heavy and light balls, one of them moving with speed 1.

    Args:
        mass_ratio: heavy mass over the light one (1 kg), ≥ 1.
        arrangement: "between": heavy, light, heavy, the first one moving; the light one bounces between them about
            √mass_ratio times. "alternating": light and heavy in turn, six balls, the first heavy one moving.
            "light-striker": one light ball against three heavy ones.
        restitution: of all contacts, in [0, 1].

    Source: chosen here; beside the floor of `mass-ratio-chain`.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_number("mass_ratio", mass_ratio, low=1.0)
    check_choice("arrangement", arrangement, ("between", "alternating", "light-striker"))
    check_number("restitution", restitution, low=0.0, high=1.0)
    heavy, moving = {
        "between": ((True, False, True), 0),
        "alternating": ((False, True, False, True, False, True), 1),
        "light-striker": ((False, True, True, True), 0),
    }[arrangement]
    masses = np.where(heavy, mass_ratio, 1.0)
    v_pre = np.where(np.arange(masses.size) == moving, 1.0, 0.0)
    return Scenario(
        "heavy-and-light",
        given(heavy_and_light, locals()),
        ImpactProblem(1.0 / masses, line_of_contacts(masses.size), v_pre, restitution),
        "chosen here",
        invariants=linear_momenta(masses.size, 1, "x"),
        tags=frozenset({"chain", "mass-ratio"}),
    )


def ball_in_wedge(
    *, angle: float = 1e-6, normals: str = "parallel", planes: int = 2, restitution: float = 1.0
) -> Scenario:
    """A disc meets several planes at once whose normals nearly coincide, or two that nearly oppose each other.

    Args:
        angle: between the outermost normals ("parallel"), or between the two planes of the wedge ("opposed") [rad],
            in (0, π/2].
        normals: "parallel": all planes are nearly the floor, and W is nearly singular; the disc falls on them
            obliquely. "opposed": the disc sits in a narrow upright wedge and moves sideways; about π / (2 angle)
            bounces bring it out.
        planes: number of planes, ≥ 2; exactly 2 where they oppose.
        restitution: of all contacts, in [0, 1].

    Source: chosen here; a point in a wedge is Galperin's billiard.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_positive("angle", angle)
    check_number("angle", angle, low=0.0, high=np.pi / 2)
    check_choice("normals", normals, ("parallel", "opposed"))
    check_count("planes", planes, 2)
    check_number("restitution", restitution, low=0.0, high=1.0)
    if normals == "opposed" and planes != 2:
        raise ProblemError(f"planes must be 2 where they oppose, not {planes}")
    if normals == "parallel":
        tilt = angle * np.linspace(-0.5, 0.5, planes)
        J = np.column_stack([np.sin(tilt), np.cos(tilt)])
        v_pre = np.array([0.3, -1.0])
    else:
        J = np.array([[np.cos(angle / 2), np.sin(angle / 2)], [-np.cos(angle / 2), np.sin(angle / 2)]])
        v_pre = np.array([-1.0, 0.0])
    return Scenario(
        "ball-in-wedge",
        given(ball_in_wedge, locals()),
        ImpactProblem(np.ones(2), J, v_pre, restitution),
        "chosen here; Galperin 2003 for the opposed planes",
        symmetries=(Symmetry("mirror", sp.csr_array(np.diag([-1.0, 1.0]))),),
        tags=frozenset({"billiards", "near-parallel"}),
        dofs_per_body=2,
        positions=np.zeros((1, 2)),
    )


def jammed_box(*, rows: int = 3, columns: int = 3, start: str = "one", restitution: float = 1.0) -> Scenario:
    """Discs of radius 0.5 in a square grid that fills a box with four walls: no motion opens every contact.

    Args:
        rows: of discs, ≥ 1.
        columns: of discs, ≥ 2.
        start: "one": the first disc of the lowest row moves along it with speed 1; "all": all discs do.
        restitution: of all contacts, in [0, 1].

    Source: chosen here; the plane counterpart of `ball-between-walls`.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("rows", rows, 1)
    check_count("columns", columns, 2)
    check_choice("start", start, ("one", "all"))
    check_number("restitution", restitution, low=0.0, high=1.0)
    number = np.arange(rows * columns).reshape(rows, columns)
    across, up = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    centers = np.column_stack([across.ravel(), up.ravel()])
    pairs = np.concatenate([
        np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
        np.column_stack([number[:-1].ravel(), number[1:].ravel()]),
    ])  # fmt: skip
    contacts = pair_contacts(centers, pairs)
    for side, inward in ((number[:, 0], (1.0, 0.0)), (number[:, -1], (-1.0, 0.0)),
                         (number[0], (0.0, 1.0)), (number[-1], (0.0, -1.0))):  # fmt: skip
        contacts = contacts + fixed_contacts(side, np.tile(inward, (side.size, 1)))
    velocity = np.zeros_like(centers)
    velocity[slice(None) if start == "all" else 0, 0] = 1.0
    mirrors = {"mirror x": np.diag([-1.0, 1.0]), "mirror y": np.diag([1.0, -1.0])}
    return Scenario(
        "jammed-box",
        given(jammed_box, locals()),
        ImpactProblem(np.ones(centers.size), normal_rows(contacts, len(centers)), velocity.ravel(), restitution),
        "chosen here",
        symmetries=tuple(map_of_bodies(name, turn, centers) for name, turn in mirrors.items()),
        tags=frozenset({"billiards", "wall", "jammed"}),
        dofs_per_body=2,
        positions=centers,
    )


def resting_stack(*, height: int = 5, shape: str = "column", restitution: float = 1.0, step: float = 1e-3) -> Scenario:
    """A stack that rests on a floor, as a time-stepping scene meets it: one step of free fall, v_pre = -g dt for all.

    Args:
        height: balls of the column, or rows of the pyramid, ≥ 1.
        shape: "column": one ball on the other; "pyramid": discs in rows of height, height - 1, … 1.
        restitution: of all contacts, in [0, 1].
        step: dt [s], > 0.

    Source: chosen here; Guendelman et al. 2003, "Nonconvex rigid bodies with stacking".

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("height", height, 1)
    check_choice("shape", shape, ("column", "pyramid"))
    check_number("restitution", restitution, low=0.0, high=1.0)
    check_positive("step", step)
    speed = -GRAVITY * step
    if shape == "column":
        problem = ImpactProblem(np.ones(height), _column_rows(height), np.full(height, speed), restitution)
        return Scenario(
            "resting-stack",
            given(resting_stack, locals()),
            problem,
            STACKS,
            reference_builders=(partial(_comes_to_rest, problem),) if restitution == 0.0 else (),
            tags=frozenset({"stack", "wall", "chain"}),
        )
    centers, contacts = _pyramid(height)
    velocity = np.tile([0.0, speed], (len(centers), 1))
    return Scenario(
        "resting-stack",
        given(resting_stack, locals()),
        ImpactProblem(np.ones(centers.size), normal_rows(contacts, len(centers)), velocity.ravel(), restitution),
        STACKS,
        symmetries=(map_of_bodies("mirror", np.diag([-1.0, 1.0]), centers),),
        invariants=linear_momenta(len(centers), 2, "x"),
        tags=frozenset({"stack", "wall", "billiards"}),
        dofs_per_body=2,
        positions=centers,
    )


def mixed_restitution(*, scene: str = "struck", balls: int = 6, pattern: Sequence[float] = (1.0, 0.5, 0.0)) -> Scenario:
    """Restitution that differs from contact to contact: elastic, half elastic and plastic ones side by side.

    Args:
        scene: "struck": a free chain, its first ball coming with speed 1; "converging": a free chain in which all
            contacts approach alike; "column": a column that comes down on a floor with speed 1; "triangle":
            a triangle of six discs, struck at its tip by a seventh.
        balls: of the chain or the column, ≥ 2; the triangle has always seven discs.
        pattern: restitution of contacts 0, 1, …, repeated, each in [0, 1].

    Source: chosen here; Newton's restitution law may gain energy where its coefficients differ.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_choice("scene", scene, ("struck", "converging", "column", "triangle"))
    check_count("balls", balls, 2)
    values = _pattern(pattern)
    if scene == "triangle":
        return _mixed_triangle(values, given(mixed_restitution, locals()))
    struck = np.where(np.arange(balls) == 0, 1.0, 0.0)
    J, v_pre = {
        "struck": (line_of_contacts(balls), struck),
        "converging": (line_of_contacts(balls), np.linspace(1.0, -1.0, balls)),
        "column": (_column_rows(balls), np.full(balls, -1.0)),
    }[scene]
    return Scenario(
        "mixed-restitution",
        given(mixed_restitution, locals()),
        ImpactProblem(np.ones(balls), J, v_pre, np.resize(values, J.shape[0])),
        "chosen here",
        invariants=() if scene == "column" else linear_momenta(balls, 1, "x"),
        tags=frozenset({"chain", MIXED} | ({"wall"} if scene == "column" else set())),
    )


def _mixed_triangle(values: Floats, parameters: dict[str, object]) -> Scenario:
    """The triangle of `mixed_restitution`: a pyramid of three rows in free space, struck at its tip by one more."""
    centers, contacts = _pyramid(3)
    free = contacts.first >= 0
    tip, striker = len(centers) - 1, len(centers)
    pairs = np.column_stack([contacts.first[free], contacts.second[free]])
    centers = np.vstack([centers, centers[tip] + np.array([0.0, 1.0])])
    struck = pair_contacts(centers, np.vstack([[tip, striker], pairs]))
    velocity = np.zeros_like(centers)
    velocity[striker, 1] = -1.0
    return Scenario(
        "mixed-restitution",
        parameters,
        ImpactProblem(
            np.ones(centers.size),
            normal_rows(struck, len(centers)),
            velocity.ravel(),
            np.resize(values, struck.m),
        ),
        "chosen here",
        invariants=(*linear_momenta(len(centers), 2, "xy"), plane_angular_momentum(centers)),
        tags=frozenset({"billiards", MIXED}),
        dofs_per_body=2,
        positions=centers,
    )


def inelastic_collapse(*, balls: int = 3, restitution: float = 0.05) -> Scenario:
    """A chain squeezed from both ends: pair by pair, infinitely many impacts follow in a finite time.

    The balls of the left half come with speed 1, those of the right half with -1, an odd one in the middle rests.

    Args:
        balls: in the chain, ≥ 3.
        restitution: of all contacts, in [0, 1]; three balls collapse below 7 - 4√3 = 0.0718, more balls below larger
            values.

    Source: McNamara and Young 1992, "Inelastic collapse and clumping in a one-dimensional granular medium".

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("balls", balls, 3)
    check_number("restitution", restitution, low=0.0, high=1.0)
    v_pre = -np.sign(np.arange(balls) - (balls - 1) / 2.0)
    return Scenario(
        "inelastic-collapse",
        given(inelastic_collapse, locals()),
        ImpactProblem(np.ones(balls), line_of_contacts(balls), v_pre, restitution),
        "McNamara and Young 1992",
        symmetries=(Symmetry("mirror", sp.csr_array(-np.eye(balls)[::-1])),),
        invariants=linear_momenta(balls, 1, "x"),
        tags=frozenset({"chain"}),
    )


def nothing_happens(problem: ImpactProblem) -> Reference:
    """No contact approaches: the velocity stays what it is, to the last bit."""
    return Reference(
        NOTHING_HAPPENS, problem.v_pre, ReferenceKind.CLOSED_FORM, "u_pre ≥ 0: zero impulse, same velocity", 0.0
    )


def _comes_to_rest(problem: ImpactProblem) -> Reference:
    """A column without restitution stops on its floor."""
    return Reference(
        COMES_TO_REST,
        np.zeros(problem.n),
        ReferenceKind.CLOSED_FORM,
        "the inelastic impact of a column: W λ = -u_pre",
        0.0,
    )


def _column_rows(balls: int) -> sp.csr_array:
    """Jacobian of a column on a floor: contact 0 with the floor, contact i between balls i - 1 and i."""
    return sp.csr_array(sp.diags_array([np.ones(balls), -np.ones(balls - 1)], offsets=[0, -1], shape=(balls, balls)))


def _pyramid(height: int) -> tuple[Floats, Contacts]:
    """Centers [m] and contacts of discs of radius 0.5 in rows of height … 1, each in the hollow of two below."""
    start = np.concatenate([[0], np.cumsum(np.arange(height, 0, -1))])
    centers = np.concatenate([
        np.column_stack([np.arange(height - k) - (height - k - 1) / 2, np.full(height - k, 0.5 + k * np.sqrt(0.75))])
        for k in range(height)
    ])  # fmt: skip
    beside = [(start[k] + i, start[k] + i + 1) for k in range(height) for i in range(height - k - 1)]
    below = [(start[k] + i + side, start[k + 1] + i)
             for k in range(height - 1) for i in range(height - k - 1) for side in (0, 1)]  # fmt: skip
    floor = fixed_contacts(np.arange(height), np.tile([0.0, 1.0], (height, 1)))
    return centers, floor + pair_contacts(centers, np.array([*beside, *below], dtype=np.intp).reshape(-1, 2))


def _pattern(pattern: Sequence[float]) -> Floats:
    """Check the restitutions of a pattern."""
    if isinstance(pattern, str) or not isinstance(pattern, (Sequence, np.ndarray)) or len(pattern) == 0:
        raise ProblemError(f"pattern must be a sequence of one number or more, not {pattern!r}")
    for index, value in enumerate(pattern):
        check_number(f"pattern[{index}]", value, low=0.0, high=1.0)
    return np.array(pattern, dtype=np.float64)

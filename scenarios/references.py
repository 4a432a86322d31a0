"""What is known of an outcome: builders of `Reference` objects, each made when first asked for.

Two kinds, never mixed: truths for every law (validation) and a law's own closed form (verification, `laws` names it).
"""

from __future__ import annotations

import hashlib
import math

import numpy as np

from scenarios.scenario import Quantity, Reference, ReferenceKind
from solvers import ImpactProblem
from solvers.solution import Floats

# A closed form is a dozen roundings of numbers of the size of its speeds.
ROUNDING = 16 * float(np.finfo(np.float64).eps)
# π / arctan(1/√M) this close to a whole number is that number: M = 1 and 3 give exactly 4 and 6.
WHOLE = 1e-9

_HERTZ: dict[bytes, Reference] = {}


def ideal_exchange(problem: ImpactProblem) -> Reference:
    """Equal elastic balls on a line pass their velocities on: afterwards the velocities are in rising order.

    Two equal balls exchange their velocities and balls cannot pass one another, so that a sequence of impacts of two
    ends when the velocities are sorted. Source: Payr 2008.
    """
    return Reference(
        "ideal exchange",
        np.sort(problem.v_pre),
        ReferenceKind.CLOSED_FORM,
        "Payr 2008: equal balls pass their velocities on, v_post = sort(v_pre)",
        uncertainty=0.0,
    )


def ideal_exchange_on_wall(problem: ImpactProblem) -> Reference:
    """`ideal_exchange` for a chain whose first ball touches a wall: the wall is a mirror, v_post = sort(|v_pre|).

    The wall doubles the chain by its mirror image with reversed velocities; sorting all of them leaves the magnitudes,
    in rising order, on this side of the mirror.
    """
    return Reference(
        "ideal exchange",
        np.sort(np.abs(problem.v_pre)),
        ReferenceKind.CLOSED_FORM,
        "Payr 2008 with the wall as a mirror, v_post = sort(|v_pre|)",
        uncertainty=0.0,
    )


def hertz(problem: ImpactProblem) -> Reference:
    """Compliant outcome: Hertz springs k δ^(3/2) at all contacts, integrated until nothing presses or approaches.

    Computed once for the same numbers within a process.
    """
    # The integrator is needed only where somebody asks for this reference.
    from solvers.hertz import hertz_reference

    key = _fingerprint(problem)
    if key not in _HERTZ:
        velocity, uncertainty = hertz_reference(problem)
        _HERTZ[key] = Reference(
            "Hertz",
            velocity,
            ReferenceKind.ODE,
            "time integration of M dv/dt = Jᵀ k δ^(3/2) with gap memory",
            float(uncertainty),
        )
    return _HERTZ[key]


def single_contact(problem: ImpactProblem) -> Reference:
    """One contact: the impulse -(1 + e) u_pre / W, if it approaches. Newton's law, and all others' too."""
    impulse = np.maximum(-(1.0 + problem.restitution) * problem.u_pre / problem.W_diagonal, 0.0)
    return Reference(
        "one contact",
        problem.v_after(impulse),
        ReferenceKind.CLOSED_FORM,
        "Newton: u_post = -e u_pre",
        ROUNDING * _largest(problem.v_pre),
    )


def separate_contacts(problem: ImpactProblem) -> Reference:
    """Contacts that share no body, W diagonal: each is an impact of its own (`single_contact`)."""
    outcome = single_contact(problem)
    return Reference("separate contacts", outcome.value, outcome.kind, outcome.source, outcome.uncertainty)


def reversed_velocity(problem: ImpactProblem, source: str) -> Reference:
    """A scene in which every contact is alike by symmetry: each velocity is reversed, times the restitution."""
    return Reference(
        "symmetric rebound",
        -float(problem.restitution[0]) * problem.v_pre,
        ReferenceKind.CLOSED_FORM,
        source,
        ROUNDING * _largest(problem.v_pre),
    )


def qce_three_balls(va: float) -> Reference:
    """QCE for equal balls (va, 0, -1), 0 ≤ va ≤ 1: v_C = va / (2 - va), the others from momentum and energy."""
    v_c = va / (2.0 - va)
    total = va - 1.0 - v_c
    squares = 1.0 + va**2 - v_c**2
    # 2 squares - total² = (v_A - v_B)² is 1 - O(va) ≥ 0 over the whole range.
    difference = math.sqrt(2.0 * squares - total**2)
    return Reference(
        "QCE closed form",
        np.array([(total - difference) / 2.0, (total + difference) / 2.0, v_c]),
        ReferenceKind.CLOSED_FORM,
        "Zhang 2015, Algorithm 1 solved by hand for three equal balls: v_C = va / (2 - va)",
        ROUNDING,
        laws=("qce", "qce-lcp", "qce-blend"),
    )


def lcp_three_balls(va: float, restitution: float) -> Reference:
    """Newton LCP for equal balls (va, 0, -1): impulses (1 + e)/3 · (2 va + 1, va + 2)."""
    at_ab, at_bc = (1.0 + restitution) / 3.0 * np.array([2.0 * va + 1.0, va + 2.0])
    return Reference(
        "LCP closed form",
        np.array([va - at_ab, at_ab - at_bc, at_bc - 1.0]),
        ReferenceKind.CLOSED_FORM,
        "Newton LCP solved by hand; both contacts approach, so that generalized reflections take the same step",
        ROUNDING,
        # At va = 0 only one contact approaches and the reflections go on one after the other.
        laws=("lcp-pgs", "lcp-nnls", "gr") if va > 0 else ("lcp-pgs", "lcp-nnls"),
    )


def reflections_three_balls_at_rest(restitution: float) -> Reference:
    """Generalized reflections for equal balls (0, 0, -1): (-1, 0, 0), blended with the inelastic LCP for e < 1."""
    elastic = np.array([-1.0, 0.0, 0.0])
    inelastic = np.full(3, -1.0 / 3.0)
    return Reference(
        "GR closed form",
        restitution * elastic + (1.0 - restitution) * inelastic,
        ReferenceKind.CLOSED_FORM,
        "Smith 2012: one reflection after the other; (1 - e) inelastic + e elastic",
        ROUNDING,
        laws=("gr",),
    )


def reflection_count(count: int, source: str, laws: tuple[str, ...], kind: ReferenceKind) -> Reference:
    """A known number of outer iterations."""
    return Reference(
        "iteration count",
        np.array([float(count)]),
        kind,
        source,
        uncertainty=0.0,
        quantity=Quantity.ITERATIONS,
        laws=laws,
    )


def two_targets(mass_ratio: float, restitution: float) -> Reference:
    """Bernoulli's problem: a disc of mass 1 and speed 1 hits two touching discs of mass `mass_ratio` at once.

    The normals stand at ±30° to the path. By the mirror symmetry both contacts carry the same impulse p, and the
    targets leave one another at once, so that their contact carries none:

        u(p) = -√3/2 + (1/M + 3/2) p,   u = +e √3/2   gives   p = (1 + e) √3/2 / (1/M + 3/2)

    For M = 1, e = 1: striker -1/5, targets (3/5, ±√3/5). Source: Bernoulli's problem as told by Smith 2012.
    """
    half_root = math.sqrt(3.0) / 2.0
    impulse = (1.0 + restitution) * half_root / (1.0 / mass_ratio + 1.5)
    target = impulse / mass_ratio * np.array([half_root, 0.5])
    return Reference(
        "Bernoulli closed form",
        np.array([1.0 - 2.0 * half_root * impulse, 0.0, target[0], target[1], target[0], -target[1]]),
        ReferenceKind.CLOSED_FORM,
        "mirror symmetry makes it one contact: u_post = -e u_pre",
        ROUNDING,
    )


def billiard_count(mass_ratio: float) -> int:
    """Impacts of a light ball between a floor and a ball `mass_ratio` times heavier: ⌈π / arctan(1/√M)⌉ - 1.

    Source: Galperin 2003, "Playing pool with π".
    """
    turns = math.pi / math.atan(1.0 / math.sqrt(mass_ratio))
    nearest = round(turns)
    return (nearest if abs(turns - nearest) < WHOLE * turns else math.ceil(turns)) - 1


def billiard_velocity(mass_ratio: float) -> Reference:
    """Final velocities (light, heavy) of the light ball on the floor, struck by the heavy one at speed 1.

    In the coordinates √mass · v every impact is a reflection: through a line at angle θ = arctan(1/√M) for the two
    balls, through the axis for the floor. From the angle π, 2k impacts lead to π - 2kθ and 2k - 1 to 2kθ - π.
    """
    count = billiard_count(mass_ratio)
    theta = math.atan(1.0 / math.sqrt(mass_ratio))
    angle = math.pi - count * theta if count % 2 == 0 else (count + 1) * theta - math.pi
    root = math.sqrt(mass_ratio)
    return Reference(
        "billiard closed form",
        np.array([root * math.sin(angle), math.cos(angle)]),
        ReferenceKind.CLOSED_FORM,
        "Galperin 2003: a product of reflections",
        # The angle is rounded at the size of π, and the light ball's velocity is √M times its sine.
        ROUNDING * math.pi * root,
        laws=("qce", "gr", "gauss-seidel"),
    )


def billiard_iterations(mass_ratio: float) -> Reference:
    """Exact number of outer iterations of a law that treats what approaches: one contact each time."""
    return reflection_count(
        billiard_count(mass_ratio),
        "Galperin 2003: ⌈π / arctan(1/√M)⌉ - 1 impacts",
        ("qce", "gr"),
        ReferenceKind.CLOSED_FORM,
    )


def billiard_sweeps(mass_ratio: float) -> Reference:
    """Exact number of Gauss-Seidel sweeps over (floor, heavy ball): one impact in the first, two in each other one."""
    return reflection_count(
        billiard_count(mass_ratio) // 2 + 1,
        "Galperin 2003: ⌈π / arctan(1/√M)⌉ - 1 impacts, two a sweep after the first",
        ("gauss-seidel",),
        ReferenceKind.CLOSED_FORM,
    )


def tapered_chain(masses: Floats) -> Reference:
    """A chain whose masses fall along it, first ball moving at speed 1: one impact of two after the other.

    Ball i + 1 leaves with 2 m_i / (m_i + m_{i+1}) times the velocity that ball i had, ball i keeps
    (m_i - m_{i+1}) / (m_i + m_{i+1}) of it, and follows too slowly to meet it again. Where the masses do not rise,
    only one contact approaches at a time.
    """
    velocity = np.zeros(masses.size)
    velocity[0] = 1.0
    for i in range(masses.size - 1):
        total = masses[i] + masses[i + 1]
        velocity[i + 1] = 2.0 * masses[i] / total * velocity[i]
        velocity[i] *= (masses[i] - masses[i + 1]) / total
    return Reference(
        "sequence of impacts",
        velocity,
        ReferenceKind.CLOSED_FORM,
        "one impact of two balls after the other, along the chain",
        ROUNDING * masses.size * _largest(velocity),
        laws=("qce", "gr", "gauss-seidel"),
    )


def _largest(v: Floats) -> float:
    return float(np.abs(v).max(initial=0.0))


def _fingerprint(problem: ImpactProblem) -> bytes:
    """Digest of all numbers that the compliant outcome depends on."""
    digest = hashlib.sha256()
    for matrix in (problem.J, problem.inverse_mass):
        for array in (matrix.indptr, matrix.indices, matrix.data):
            digest.update(array.tobytes())
            digest.update(b"|")
    for vector in (problem.v_pre, problem.stiffness):
        digest.update(vector.tobytes())
    return digest.digest()

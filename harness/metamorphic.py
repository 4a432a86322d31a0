"""Relations between two solves: the problem is changed in a way that must change the answer in a known way.

    symmetry       v⁺(S v⁻) = S v⁺(v⁻) for a map S of the scene on itself
    renumbering    contacts and bodies in another order: the same answer in that order
    coordinates    v = R v' with R orthogonal (mirror, rotation): v'⁺ = Rᵀ v⁺
    bystander      a body that touches nothing: it and all others move as before
    duplicate      a contact entered twice: nothing changes (with both stiffnesses halved, for compliant laws)
    units          mass, time and length in other units: the same answer in those units

No reference is needed, and no law is exempt: what fails here depends on how the problem was written down.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from harness.checked import Solve, ratio
from harness.desiderata import mismatch
from harness.measurement import Score, shown, upper_bound
from scenarios.scenario import Symmetry
from solvers import ImpactProblem
from solvers.problem import Matrix
from solvers.solution import Floats

Indices: TypeAlias = npt.NDArray[np.intp]

# Mirror and bystander change no rounding at all; a rotation rounds J once more (1e-16), which a law with bounded
# slopes amplifies by less than 1e6 on every scene of the catalog.
COORDINATES_TOLERANCE = 1e-9
# The units change by powers of two, which are exact in binary: only an absolute tolerance inside the law can tell.
SCALE_TOLERANCE = 1e-9
# About 1e12, the nearest power of two.
LARGE = 2.0**40
# An inverse mass that a rotation changes by less than this share of its largest entry commutes with it: the
# difference is rounding, and keeping it would fill the matrix.
COMMUTES = 16 * np.finfo(np.float64).eps


def renumbered(problem: ImpactProblem, contacts: Indices, velocities: Indices) -> ImpactProblem:
    """Return the problem with contacts and velocities in another order: new entry i is the old entry order[i].

    Args:
        problem: m contacts, n velocities.
        contacts: permutation, shape (m,).
        velocities: permutation, shape (n,).
    """
    return ImpactProblem(
        problem.inverse_mass[velocities][:, velocities],
        problem.J[contacts][:, velocities],
        problem.v_pre[velocities],
        problem.restitution[contacts],
        problem.friction[contacts],
        None if problem.D is None else problem.D[_friction_rows(contacts)][:, velocities],
        problem.stiffness[contacts],
        problem.tangential_restitution[contacts],
    )


def _friction_rows(contacts: Indices) -> Indices:
    """Rows of D that belong to some contacts, in their order."""
    rows: Indices = (2 * contacts[:, np.newaxis] + np.arange(2)).ravel()
    return rows


def random_renumbering(rng: np.random.Generator, *, m: int, n: int, dofs_per_body: int) -> tuple[Indices, Indices]:
    """Draw an order of the contacts and one of the bodies; velocities of one body stay together where n allows."""
    block = dofs_per_body if n % dofs_per_body == 0 else 1
    bodies = rng.permutation(n // block)
    return rng.permutation(m), (bodies[:, np.newaxis] * block + np.arange(block)).ravel()


def in_coordinates(problem: ImpactProblem, R: Matrix) -> ImpactProblem:
    """Return the problem in coordinates v' = R v with R orthogonal, shape (n, n)."""
    inverse_mass = sp.csr_array(R @ problem.inverse_mass @ R.T)
    difference = abs(inverse_mass - problem.inverse_mass)
    if difference.nnz == 0 or difference.max() <= COMMUTES * abs(problem.inverse_mass).max():
        inverse_mass = problem.inverse_mass
    return ImpactProblem(
        (inverse_mass + inverse_mass.T) * 0.5,
        problem.J @ R.T,
        R @ problem.v_pre,
        problem.restitution,
        problem.friction,
        None if problem.D is None else problem.D @ R.T,
        problem.stiffness,
        problem.tangential_restitution,
    )


def mirror(*, n: int, dofs_per_body: int) -> Matrix:
    """Reflection of the first coordinate of every body, shape (n, n); all coordinates where bodies have just one."""
    signs = np.ones(n)
    signs[:: dofs_per_body if n % dofs_per_body == 0 else 1] = -1.0
    return sp.csr_array(sp.diags_array(signs))


def random_rotation(rng: np.random.Generator, *, n: int, dofs_per_body: int) -> Matrix:
    """One random rotation of the plane or of space, applied to every body's vectors, shape (n, n)."""
    Q, upper = np.linalg.qr(rng.normal(size=(dofs_per_body, dofs_per_body)))
    Q = Q * np.sign(np.diagonal(upper))
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    return sp.csr_array(sp.kron(sp.eye_array(n // dofs_per_body), Q))


def with_bystander(problem: ImpactProblem, *, velocity: float) -> ImpactProblem:
    """Return the problem with one more unit mass on a line, first in the numbering, that touches nothing."""
    return ImpactProblem(
        sp.block_diag([sp.csr_array([[1.0]]), problem.inverse_mass], format="csr"),
        sp.hstack([sp.csr_array((problem.m, 1)), problem.J], format="csr"),
        np.concatenate([[velocity], problem.v_pre]),
        problem.restitution,
        problem.friction,
        None if problem.D is None else sp.hstack([sp.csr_array((2 * problem.m, 1)), problem.D], format="csr"),
        problem.stiffness,
        problem.tangential_restitution,
    )


def duplicated(problem: ImpactProblem, contact: int, *, stiffness_share: float) -> ImpactProblem:
    """Return the problem with one contact entered twice, each with a share of its stiffness."""
    contacts = np.append(np.arange(problem.m), contact)
    stiffness = problem.stiffness[contacts]
    stiffness[[contact, -1]] *= stiffness_share
    return ImpactProblem(
        problem.inverse_mass,
        problem.J[contacts],
        problem.v_pre,
        problem.restitution[contacts],
        problem.friction[contacts],
        None if problem.D is None else problem.D[_friction_rows(contacts)],
        stiffness,
        problem.tangential_restitution[contacts],
    )


def in_units(problem: ImpactProblem, *, mass: float = 1.0, speed: float = 1.0, gap: float = 1.0) -> ImpactProblem:
    """Return the problem with its numbers in other units.

    Args:
        problem: the impact.
        mass: factor of all masses; velocities stay.
        speed: factor of all velocities: time in another unit, or length where the coordinates are lengths.
        gap: factor of all gaps where the coordinates are angles: J grows with it, inertia with its square; velocities
            stay.
    """
    return ImpactProblem(
        problem.inverse_mass * (1.0 / (mass * gap * gap)),
        problem.J * gap,
        problem.v_pre * speed,
        problem.restitution,
        problem.friction,
        None if problem.D is None else problem.D * gap,
        problem.stiffness,
        problem.tangential_restitution,
    )


def random_approach(problem: ImpactProblem, rng: np.random.Generator) -> Floats:
    """Draw a velocity of the scene's bodies at which contacts approach, shape (n,), as fast as in the scene.

    It is reached by random impulses at the contacts: it respects units, mass ratios and immovable bodies.
    """
    v: Floats = problem.JM.T @ (rng.normal(size=problem.m) / problem.W_diagonal)
    u = problem.J @ v
    fastest = float(np.abs(u).max(initial=0.0))
    scale = (problem.speed or 1.0) / (fastest or 1.0)
    return v * (-scale if u.min(initial=0.0) >= 0.0 else scale)


def symmetry_residuals(
    solve: Solve, symmetries: Sequence[Symmetry], problem: ImpactProblem, v_post: Floats
) -> dict[str, float]:
    """‖S v⁺(v⁻) - v⁺(S v⁻)‖ / ‖v⁻‖ for some symmetries S of the scene, by name.

    Args:
        solve: the law.
        symmetries: maps of the scene on itself.
        problem: the scene's problem, at its own or another v⁻.
        v_post: the law's outcome on `problem`, shape (n,).
    """
    residuals = {}
    for symmetry in symmetries:
        S = symmetry.matrix
        image = solve(problem.replace(v_pre=S @ problem.v_pre))
        residuals[symmetry.name] = mismatch(image.v_post, S @ v_post, problem.v_pre)
    return residuals


def renumbering_residuals(
    solve: Solve, orders: Sequence[tuple[Indices, Indices]], problem: ImpactProblem, v_post: Floats
) -> dict[str, float]:
    """‖P v⁺ - v⁺(P v⁻)‖ / ‖v⁻‖ for some renumberings P, each an order of the contacts and one of the velocities."""
    residuals = {}
    for k, (contacts, velocities) in enumerate(orders):
        image = solve(renumbered(problem, contacts, velocities))
        residuals[f"renumbering {k + 1}"] = mismatch(image.v_post, v_post[velocities], problem.v_pre)
    return residuals


def duplicate(
    solve: Solve, problem: ImpactProblem, v_post: Floats, *, contacts: Indices, stiffness_share: float, metric: str
) -> Score:
    """Invariance: the largest change ‖Δv⁺‖∞ / max|u⁻| when one contact is entered twice. Shown: it judges the law."""
    changes = {}
    for contact in contacts.tolist():
        image = solve(duplicated(problem, contact, stiffness_share=stiffness_share))
        changes[contact] = ratio(float(np.abs(image.v_post - v_post).max(initial=0.0)), problem.speed)
    worst = max(changes, key=lambda contact: changes[contact])
    return shown("invariance", metric, changes[worst], detail={"contact": worst, "tried": len(changes)})


def bystander(solve: Solve, problem: ImpactProblem, v_post: Floats) -> Score:
    """Invariance: nothing changes when a body is added that touches nothing."""
    velocity = 0.5 * (problem.speed or 1.0)
    image = solve(with_bystander(problem, velocity=velocity))
    residual = mismatch(image.v_post, np.concatenate([[velocity], v_post]), problem.v_pre)
    return upper_bound("invariance", "body added", residual, COORDINATES_TOLERANCE)


def coordinates(metric: str, solve: Solve, problem: ImpactProblem, v_post: Floats, maps: Sequence[Matrix]) -> Score:
    """Invariance: the same outcome in coordinates v' = R v, the worst of some orthogonal maps R."""
    residuals = [mismatch(solve(in_coordinates(problem, R)).v_post, R @ v_post, problem.v_pre) for R in maps]
    return upper_bound("invariance", metric, max(residuals), COORDINATES_TOLERANCE, detail={"tried": len(residuals)})


def scale(unit: str, factors: tuple[float, ...], solve: Solve, problem: ImpactProblem, v_post: Floats) -> Score:
    """Scale invariance: the outcome in other units of mass, time ("speed") or length ("gap"), over some factors."""
    residuals = {}
    for factor in factors:
        image = solve(in_units(problem, **{unit: factor}))
        expected = v_post * factor if unit == "speed" else v_post
        residuals[f"{factor:.0e}"] = mismatch(image.v_post, expected, expected if unit == "speed" else problem.v_pre)
    worst = max(residuals, key=lambda factor: residuals[factor])
    return upper_bound("scale", f"{unit} scaled", residuals[worst], SCALE_TOLERANCE, detail={"factor": worst})

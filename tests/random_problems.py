"""Random impact problems for the invariants: chains, clusters of discs and spheres, random Jacobians."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from solvers import ImpactProblem

# Neighbors closer than this gap, in diameters, count as touching; the geometry is frozen anyway.
TOUCHING = 0.05


def chain(rng: np.random.Generator) -> ImpactProblem:
    """A row of 3 to 8 balls, masses within a factor of ten, everything moving."""
    n = int(rng.integers(3, 9))
    J = np.zeros((n - 1, n))
    J[np.arange(n - 1), np.arange(n - 1)] = -1.0
    J[np.arange(n - 1), np.arange(1, n)] = 1.0
    return ImpactProblem(10.0 ** rng.uniform(-0.5, 0.5, n), J, rng.normal(size=n))


def cluster(rng: np.random.Generator, *, dimension: int) -> ImpactProblem:
    """Discs (dimension 2) or spheres (3): a jittered lattice of 6 to 30, contacts between close neighbors."""
    side = 4 if dimension == 2 else 3
    grid = np.stack(np.meshgrid(*[np.arange(side)] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    keep = rng.permutation(len(grid))[: int(rng.integers(6, len(grid) + 1))]
    centers = grid[keep] + rng.uniform(-TOUCHING, TOUCHING, (keep.size, dimension))
    pairs = cKDTree(centers).query_pairs(1.0 + TOUCHING, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    J = np.zeros((len(pairs), centers.size))
    for row, (i, j) in enumerate(pairs):
        normal = centers[j] - centers[i]
        normal /= np.linalg.norm(normal)
        J[row, dimension * i : dimension * i + dimension] = -normal
        J[row, dimension * j : dimension * j + dimension] = normal
    inverse_mass = np.repeat(10.0 ** rng.uniform(-0.5, 0.5, keep.size), dimension)
    return ImpactProblem(inverse_mass, J, rng.normal(size=centers.size))


def random_rows(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Up to twice as many rows as the 2 to 8 velocities; one direction opens every contact: elastic iterations end."""
    n = int(rng.integers(2, 9))
    m = int(rng.integers(1, 2 * n))
    J = rng.normal(size=(m, n))
    opening = rng.normal(size=n)
    return J * np.sign(J @ opening)[:, None]


def random_jacobian(rng: np.random.Generator) -> ImpactProblem:
    """Random rows and a dense mass matrix of condition up to ten."""
    J = random_rows(rng)
    n = J.shape[1]
    # Principal masses within a factor of ten, in random directions: an energy is then known to rounding.
    directions, _ = np.linalg.qr(rng.normal(size=(n, n)))
    inverse_mass = directions @ np.diag(10.0 ** rng.uniform(-0.5, 0.5, n)) @ directions.T
    return ImpactProblem(0.5 * (inverse_mass + inverse_mass.T), J, rng.normal(size=n))


def ill_conditioned(seed: int) -> ImpactProblem:
    """Random rows and a dense mass matrix whose condition has no bound: 1e3 is usual, 1e6 occurs."""
    rng = np.random.default_rng(seed)
    J = random_rows(rng)
    n = J.shape[1]
    root = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
    return ImpactProblem(root @ root.T, J, rng.normal(size=n))


def make(kind: str, seed: int) -> ImpactProblem:
    """One problem of a kind from a seed."""
    rng = np.random.default_rng(seed)
    if kind == "chain":
        return chain(rng)
    if kind == "discs":
        return cluster(rng, dimension=2)
    if kind == "spheres":
        return cluster(rng, dimension=3)
    return random_jacobian(rng)


KINDS = ("chain", "discs", "spheres", "random Jacobian")

problems: st.SearchStrategy[ImpactProblem] = st.builds(
    make, st.sampled_from(KINDS), st.integers(min_value=0, max_value=2**32 - 1)
)


def reordered(problem: ImpactProblem, order: npt.NDArray[np.intp]) -> ImpactProblem:
    """The same problem with its contacts in another order."""
    return ImpactProblem(
        problem.inverse_mass,
        problem.J[order],
        problem.v_pre,
        problem.restitution[order],
        stiffness=problem.stiffness[order],
    )

"""One multi-impact: bodies, contacts and velocities just before the impact.

    u = J v            normal relative velocity (gap rate) of every contact, u < 0 approaches
    W = J M⁻¹ Jᵀ       Delassus operator: what a unit impulse at one contact does to every u
    v_post = v_pre + M⁻¹ (Jᵀ λ + Dᵀ λ_f)

symbol  name                shape     meaning, unit
v       v_pre, v_post       (n,)      generalized velocity [m/s, rad/s]; as many entries as the scene needs
M⁻¹     inverse_mass        (n, n)    inverse generalized mass [1/kg, 1/(kg m²)]; a zero block is an immovable body
J       J                   (m, n)    contact Jacobian, one contact normal a row
W       W                   (m, m)    Delassus operator [1/kg]
u       u_pre, u_post       (m,)      normal relative velocity [m/s]
λ       impulse             (m,)      normal impulse [N s], λ ≥ 0 pushes
D       D                   (2m, n)   friction pyramid directions, rows 2i and 2i + 1 span contact i's tangent plane
λ_f     friction_impulse    (2m,)     friction impulse [N s], |λ_f| ≤ μ λ in each direction
μ       friction            (m,)      coefficient of friction
c_r     restitution         (m,)      coefficient of restitution, in [0, 1]
k       stiffness           (m,)      relative contact stiffness; only ratios matter, read by compliant laws alone
β₀      tangential_restitution  (m,)  what sticks parts with -β₀ D v_pre, in [0, 1] (Walton 1993)
"""

from __future__ import annotations

from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from solvers.solution import Floats
from solvers.sphere_rows import SphereRows, pack

Matrix: TypeAlias = sp.csr_array
MatrixLike: TypeAlias = npt.ArrayLike | sp.sparray | sp.spmatrix

# A product of three rounded matrices is symmetric to a few ulps of its largest entry; input may carry as much.
SYMMETRY_TOLERANCE = 1e-10
# Smallest eigenvalue, relative to a unit diagonal, that still counts as rounding and not as negative mass.
DEFINITE_TOLERANCE = 1e-10
# Up to this block size definiteness is checked at construction: one dense eigenvalue problem, below 0.1 s.
CHECKED_BLOCK = 300
# A dense pseudo-inverse of this size takes about a minute and 128 MB; larger blocks have no kinetic energy here.
LARGEST_BLOCK = 4000


class ProblemError(ValueError):
    """Bad input; the text names the field and the rule."""


class ImpactProblem:
    """One multi-impact, checked once and read-only from then on.

    Args:
        inverse_mass: inverse generalized mass, shape (n,) as a diagonal or (n, n) dense or sparse, symmetric
            positive semidefinite. A zero block is an immovable body.
        J: contact Jacobian, shape (m, n), dense or sparse.
        v_pre: velocity just before the impact [m/s, rad/s], shape (n,).
        restitution: coefficient of restitution in [0, 1], a number or shape (m,).
        friction: coefficient of friction ≥ 0, a number or shape (m,).
        D: friction pyramid directions, shape (2m, n); needed where friction > 0.
        stiffness: relative contact stiffness > 0, a number or shape (m,).
        tangential_restitution: β₀ in [0, 1], a number or shape (m,); it has no effect without friction.

    Raises:
        ProblemError: names the field and the rule that it breaks.
    """

    def __init__(
        self,
        inverse_mass: MatrixLike,
        J: MatrixLike,
        v_pre: npt.ArrayLike,
        restitution: npt.ArrayLike = 1.0,
        friction: npt.ArrayLike = 0.0,
        D: MatrixLike | None = None,
        stiffness: npt.ArrayLike = 1.0,
        tangential_restitution: npt.ArrayLike = 0.0,
    ) -> None:
        self.v_pre: Floats = _vector("v_pre", v_pre)
        self.J: Matrix = _matrix("J", J)
        m, n = self.J.shape[0], self.v_pre.size
        self.restitution: Floats = _restitution(restitution, m)
        self.friction: Floats = _friction(friction, m)
        self.stiffness: Floats = _stiffness(stiffness, m)
        self.tangential_restitution: Floats = _restitution(tangential_restitution, m, "tangential_restitution")
        self.D: Matrix | None = None if D is None else _matrix("D", D)
        if self.D is not None and self.D.shape != (2 * m, n):
            raise ProblemError(f"D must have shape (2m, n) = ({2 * m}, {n}), not {self.D.shape}")
        self._check_together()
        self.inverse_mass: Matrix = _inverse_mass(inverse_mass, n)
        dead = np.flatnonzero(self.W_diagonal <= 0)
        if dead.size:
            raise ProblemError(
                f"J: contact {dead[0]} moves no body: its row is zero or touches immovable bodies only "
                "(the diagonal of J M⁻¹ Jᵀ must be > 0)"
            )

    @classmethod
    def from_delassus(
        cls,
        W: MatrixLike,
        u_pre: npt.ArrayLike,
        restitution: npt.ArrayLike = 1.0,
        stiffness: npt.ArrayLike = 1.0,
    ) -> ImpactProblem:
        """Build a problem that comes without bodies: the contacts' own velocities are the coordinates.

        Args:
            W: Delassus operator [1/kg], shape (m, m), symmetric positive semidefinite, dense or sparse.
            u_pre: normal relative velocity [m/s], shape (m,), u < 0 approaches.
            restitution: coefficient of restitution in [0, 1], a number or shape (m,).
            stiffness: relative contact stiffness > 0, a number or shape (m,).

        Raises:
            ProblemError: names the field and the rule that it breaks.
        """
        delassus = _matrix("W", W)
        u = _vector("u_pre", u_pre)
        if delassus.shape != (u.size, u.size):
            raise ProblemError(f"W must have shape (m, m) = ({u.size}, {u.size}), not {delassus.shape}")
        _check_symmetric("W", delassus)
        return cls(delassus, sp.eye_array(u.size, format="csr"), u, restitution, stiffness=stiffness)

    def replace(
        self,
        *,
        v_pre: npt.ArrayLike | None = None,
        restitution: npt.ArrayLike | None = None,
        friction: npt.ArrayLike | None = None,
        stiffness: npt.ArrayLike | None = None,
        tangential_restitution: npt.ArrayLike | None = None,
    ) -> ImpactProblem:
        """Return the same bodies and contacts with other numbers; nothing that these leave alone is computed again."""
        other = object.__new__(ImpactProblem)
        other.__dict__.update(self.__dict__)
        if v_pre is not None:
            other.v_pre = _vector("v_pre", v_pre)
            other._forget("u_pre", "speed", "slip_target")
        if restitution is not None:
            other.restitution = _restitution(restitution, self.m)
        if friction is not None:
            other.friction = _friction(friction, self.m)
            other._forget("has_friction")
        if stiffness is not None:
            other.stiffness = _stiffness(stiffness, self.m)
        if tangential_restitution is not None:
            other.tangential_restitution = _restitution(tangential_restitution, self.m, "tangential_restitution")
            other._forget("slip_target")
        other._check_together()
        return other

    def _forget(self, *names: str) -> None:
        """Drop cached properties that a new field makes wrong."""
        for name in names:
            self.__dict__.pop(name, None)

    def _check_together(self) -> None:
        """Check what one field asks of another."""
        if self.v_pre.size != self.J.shape[1]:
            raise ProblemError(
                f"J must have one column for each entry of v_pre: {self.J.shape[1]} columns, {self.v_pre.size} entries"
            )
        if self.D is None and self.has_friction:
            raise ProblemError("friction > 0 needs D, the friction pyramid directions of shape (2m, n)")

    @property
    def m(self) -> int:
        """Number of contacts."""
        return int(self.J.shape[0])

    @property
    def n(self) -> int:
        """Number of generalized velocities."""
        return int(self.v_pre.size)

    @cached_property
    def JM(self) -> Matrix:
        """J M⁻¹, shape (m, n): row i is the velocity that a unit impulse at contact i adds."""
        return _read_only(sp.csr_array(self.J @ self.inverse_mass))

    @cached_property
    def DM(self) -> Matrix:
        """D M⁻¹, shape (2m, n), as `JM` for the friction directions; zero rows without friction."""
        if self.D is None:
            return _read_only(sp.csr_array((2 * self.m, self.n)))
        return _read_only(sp.csr_array(self.D @ self.inverse_mass))

    @cached_property
    def JT(self) -> Matrix:
        """Jᵀ as CSR, shape (n, m): row d lists the contacts that velocity d takes part in."""
        return _read_only(sp.csr_array(self.J.T))

    @cached_property
    def MJT(self) -> Matrix:
        """M⁻¹ Jᵀ as CSR, shape (n, m): row d lists the contacts whose impulse changes velocity d."""
        return _read_only(sp.csr_array(self.JM.T))

    @cached_property
    def W(self) -> Matrix:
        """Delassus operator J M⁻¹ Jᵀ [1/kg], shape (m, m), symmetric."""
        product = sp.csr_array(self.JM @ self.J.T)
        return _read_only(sp.csr_array((product + product.T) * 0.5))

    @cached_property
    def W_diagonal(self) -> Floats:
        """Diagonal of W [1/kg], shape (m,), > 0; computed without W."""
        return _frozen(np.asarray(self.JM.multiply(self.J).sum(axis=1), dtype=np.float64).reshape(self.m))

    @cached_property
    def spheres_at_rest(self) -> SphereRows | None:
        """The contacts as packed rows, the bodies at rest (see `sphere_rows`); None where they have another form."""
        return pack(self.J, self.inverse_mass)

    @cached_property
    def mass(self) -> Matrix:
        """Generalized mass M, the block-wise pseudo-inverse of `inverse_mass`; immovable bodies have zero blocks.

        Raises:
            ProblemError: a block of `inverse_mass` is too large for a dense pseudo-inverse.
        """
        return _read_only(_block_inverse(self.inverse_mass))

    @cached_property
    def u_pre(self) -> Floats:
        """Normal relative velocity before the impact [m/s], shape (m,), u < 0 approaches."""
        return _frozen(self.J @ self.v_pre)

    @cached_property
    def speed(self) -> float:
        """Largest |u_pre| [m/s], the scale of relative tolerances; 0 without contacts."""
        return float(np.abs(self.u_pre).max(initial=0.0))

    @cached_property
    def slip_target(self) -> Floats:
        """Velocity along D of what sticks after the impact, -β₀ D v_pre [m/s], shape (2m,) (Walton 1993)."""
        if self.D is None or not self.tangential_restitution.any():
            return _frozen(np.zeros(2 * self.m))
        return _frozen(-np.repeat(self.tangential_restitution, 2) * (self.D @ self.v_pre))

    @cached_property
    def has_friction(self) -> bool:
        """True where any contact has friction > 0."""
        return bool((self.friction > 0).any())

    def kinetic_energy(self, v: npt.ArrayLike) -> float:
        """Kinetic energy ½ vᵀ M v [J] of the movable bodies at velocity v, shape (n,)."""
        velocity = np.asarray(v, dtype=np.float64)
        return float(0.5 * velocity @ (self.mass @ velocity))

    def v_after(self, impulse: npt.ArrayLike, friction_impulse: npt.ArrayLike | None = None) -> Floats:
        """Velocity after an impulse: v_pre + M⁻¹(Jᵀ impulse + Dᵀ friction_impulse), shape (n,)."""
        v: Floats = self.v_pre + self.MJT @ np.asarray(impulse, dtype=np.float64)
        if friction_impulse is not None:
            v = v + self.DM.T @ np.asarray(friction_impulse, dtype=np.float64)
        return v

    def __repr__(self) -> str:
        return f"ImpactProblem({self.m} contacts, {self.n} velocities)"


def _frozen(array: npt.ArrayLike) -> Floats:
    """Return a contiguous float64 array that nobody can write to."""
    out = np.ascontiguousarray(array, dtype=np.float64)
    out.flags.writeable = False
    return out


def _vector(field: str, value: npt.ArrayLike) -> Floats:
    """Check a vector: numbers, one dimension, finite. The result is a copy of its own."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{field} must be an array of real numbers: {error}") from None
    if array.ndim != 1:
        raise ProblemError(f"{field} must have one dimension, not shape {array.shape}")
    _check_finite(field, array)
    return _frozen(array)


def _per_contact(field: str, value: npt.ArrayLike, m: int) -> Floats:
    """Check a number for all contacts or one for each, shape (m,)."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{field} must be a number or an array of shape (m,): {error}") from None
    if array.ndim == 0:
        array = np.full(m, float(array))
    if array.shape != (m,):
        raise ProblemError(f"{field} must be a number or have shape (m,) = ({m},), not {array.shape}")
    _check_finite(field, array)
    return _frozen(array.copy())


def _restitution(value: npt.ArrayLike, m: int, field: str = "restitution") -> Floats:
    restitution = _per_contact(field, value, m)
    if m and (restitution.min() < 0 or restitution.max() > 1):
        raise ProblemError(f"{field} must lie in [0, 1]: {_worst(restitution, 0.0, 1.0)}")
    return restitution


def _friction(value: npt.ArrayLike, m: int) -> Floats:
    friction = _per_contact("friction", value, m)
    if m and friction.min() < 0:
        raise ProblemError(f"friction must be ≥ 0: {_worst(friction, 0.0, np.inf)}")
    return friction


def _stiffness(value: npt.ArrayLike, m: int) -> Floats:
    stiffness = _per_contact("stiffness", value, m)
    if m and stiffness.min() <= 0:
        raise ProblemError(f"stiffness must be > 0: {_worst(stiffness, np.nextafter(0, 1), np.inf)}")
    return stiffness


def _matrix(field: str, value: MatrixLike) -> Matrix:
    """Check a matrix, dense or sparse, and return a CSR copy with sorted 32-bit indices."""
    try:
        matrix = sp.csr_array(value if sp.issparse(value) else np.asarray(value, dtype=np.float64), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{field} must be a matrix of real numbers: {error}") from None
    if matrix.ndim != 2:
        raise ProblemError(f"{field} must have two dimensions, not shape {matrix.shape}")
    _check_finite(field, matrix.data)
    return _read_only(matrix.copy())


def _read_only(matrix: Matrix) -> Matrix:
    """Sort a CSR matrix, drop its zeros, and freeze it; all kernels see the same index type."""
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    matrix.indices = matrix.indices.astype(np.int32)
    matrix.indptr = matrix.indptr.astype(np.int32)
    for array in (matrix.data, matrix.indices, matrix.indptr):
        array.flags.writeable = False
    return matrix


def _inverse_mass(value: MatrixLike, n: int) -> Matrix:
    """Check the inverse mass: a diagonal or a matrix, symmetric positive semidefinite."""
    if not sp.issparse(value) and np.ndim(value) == 1:
        diagonal = _vector("inverse_mass", value)
        if diagonal.size != n:
            raise ProblemError(f"inverse_mass must have one entry for each of the {n} of v_pre, not {diagonal.size}")
        matrix = _read_only(sp.csr_array(sp.diags_array(diagonal)))
    else:
        matrix = _matrix("inverse_mass", value)
        if matrix.shape != (n, n):
            raise ProblemError(f"inverse_mass must have shape (n,) or (n, n) with n = {n}, not {matrix.shape}")
        _check_symmetric("inverse_mass", matrix)
    diagonal = matrix.diagonal()
    if n and diagonal.min() < 0:
        raise ProblemError(f"inverse_mass must have a diagonal ≥ 0: {_worst(diagonal, 0.0, np.inf)}")
    for block in _blocks(matrix):
        if block.size <= CHECKED_BLOCK and _scaled_eigenvalues(matrix, block).min() < -DEFINITE_TOLERANCE:
            raise ProblemError(
                f"inverse_mass must be positive semidefinite: the block of velocities {block[0]}… is not"
            )
    return matrix


def _blocks(matrix: Matrix) -> list[npt.NDArray[np.intp]]:
    """Index sets of the diagonal blocks larger than one."""
    if matrix.nnz <= matrix.shape[0] and (matrix.nonzero()[0] == matrix.nonzero()[1]).all():
        return []
    count, label = connected_components(matrix, directed=False)
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
    return [group for group in groups if group.size > 1]


def _scaled_block(matrix: Matrix, block: npt.NDArray[np.intp]) -> tuple[Floats, Floats]:
    """One diagonal block scaled to a unit diagonal, and the scale: the answer must not depend on units."""
    dense = matrix[block][:, block].toarray()
    diagonal = np.diagonal(dense)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return dense * np.outer(scale, scale), scale


def _scaled_eigenvalues(matrix: Matrix, block: npt.NDArray[np.intp]) -> Floats:
    eigenvalues: Floats = np.linalg.eigvalsh(_scaled_block(matrix, block)[0]).astype(np.float64)
    return eigenvalues


def _block_inverse(matrix: Matrix) -> Matrix:
    """Pseudo-inverse block by block; single entries by division, zeros stay zero."""
    diagonal = matrix.diagonal()
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0)
    blocks = _blocks(matrix)
    rows, columns, values = [], [], []
    for block in blocks:
        if block.size > LARGEST_BLOCK:
            raise ProblemError(
                f"inverse_mass has a block of {block.size} velocities; kinetic energy needs its dense pseudo-inverse, "
                f"which is computed for at most {LARGEST_BLOCK}"
            )
        scaled, scale = _scaled_block(matrix, block)
        block_inverse = np.linalg.pinv(scaled, rcond=DEFINITE_TOLERANCE, hermitian=True) * np.outer(scale, scale)
        inverse[block] = 0.0
        rows.append(np.repeat(block, block.size))
        columns.append(np.tile(block, block.size))
        values.append(block_inverse.ravel())
    off = (
        sp.coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=matrix.shape)
        if blocks
        else sp.coo_array(matrix.shape)
    )
    return sp.csr_array(sp.diags_array(inverse) + off)


def _check_finite(field: str, array: Floats) -> None:
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ProblemError(f"{field} must be finite: entry {bad[0]} is {array[bad[0]]}")


def _check_symmetric(field: str, matrix: Matrix) -> None:
    scale = np.abs(matrix.data).max(initial=0.0)
    difference = np.abs((matrix - matrix.T).data).max(initial=0.0)
    if difference > SYMMETRY_TOLERANCE * scale:
        raise ProblemError(f"{field} must be symmetric: it differs from its transpose by {difference:.3g}")


def _worst(array: Floats, low: float, high: float) -> str:
    """Name the first entry outside [low, high]."""
    bad = np.flatnonzero((array < low) | (array > high))[0]
    return f"entry {bad} is {array[bad]:g}"

"""Shapes of rigid bodies: convex parts for contact, mass properties, triangles for pictures.

    V = ∫ dx,   c = ∫ x dx / V,   I = ∫ (|x|² - x xᵀ) dx about c          for unit density

A body's own frame has its origin at the center of mass and its axes along the principal axes of inertia: the inverse
inertia is diagonal in it. `center` and `axes` say where that frame lies in the one in which the shape was given; for
balls, boxes, cylinders and capsules both are the same.

Balls, boxes, cylinders and capsules have closed forms; hulls and meshes are integrated over their triangles (trimesh;
Mirtich 1996). A mesh that is not convex is split into convex parts (CoACD, Wei 2022) for contact alone.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from scenarios.world.rotation import IDENTITY, inverse, multiply, rotation_matrix, rotation_of
from solvers import ProblemError
from solvers.solution import Floats

Faces = npt.NDArray[np.int32]
Triangles: TypeAlias = tuple[npt.ArrayLike, npt.ArrayLike]
"""Vertices [m], shape (v, 3), and faces as indices into them, shape (f, 3), counterclockwise seen from outside."""

FORMATS = (".glb", ".obj", ".off", ".ply", ".stl")
"""Formats that a mesh is read from."""
# Off-diagonal inertia below this share of the trace is rounding: such axes are principal already.
DIAGONAL = 1e-12
# A body thinner than this share of its extent has no volume that inertia could be formed of.
FLAT = 1e-9
# Corners of a cube with half sizes 1.
CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
# Seed of the decomposition: the same mesh has the same parts.
SEED = 0
# Corners of the ring that stands for a circle in pictures.
RING = 48
PLANE_EXTENT = 1e3
"""Half side of the square that stands for a half space in pictures, as a multiple of 1 m."""


class Kind(Enum):
    """Kinds of convex parts."""

    BALL = "ball"
    BOX = "box"
    CAPSULE = "capsule"
    CYLINDER = "cylinder"
    HALF_SPACE = "half space"
    HULL = "hull"


@dataclass(frozen=True, eq=False)
class Part:
    """A convex part of a shape, placed in the body's frame."""

    kind: Kind
    size: tuple[float, ...]
    """Ball: radius; box: half sizes; capsule, cylinder: radius and half length along z [m]; else empty."""
    position: Floats
    """Its center [m], shape (3,)."""
    orientation: Floats
    """Quaternion, shape (4,)."""
    points: Floats
    """Corners of a hull in the part's frame [m], shape (k, 3); empty for other kinds."""

    @property
    def corners(self) -> Floats:
        """Corners of a hull or a box in the part's frame [m], shape (k, 3)."""
        return CUBE * np.array(self.size) if self.kind is Kind.BOX else self.points


@dataclass(frozen=True, eq=False)
class Shape:
    """What a body looks like; arrays are in the body's frame."""

    parts: tuple[Part, ...]
    volume: float
    """[m³]; inf for a half space."""
    inertia: Floats
    """Principal moments for unit density [m⁵], shape (3,)."""
    center: Floats
    """Center of mass in the frame in which the shape was given [m], shape (3,)."""
    axes: Floats
    """Quaternion of the principal axes in the frame in which the shape was given, shape (4,)."""
    vertices: Floats
    """For pictures [m], shape (v, 3)."""
    faces: Faces
    """Triangles, counterclockwise from outside, shape (f, 3)."""

    @cached_property
    def radius(self) -> float:
        """Distance of the farthest point from the center of mass [m]; inf for a half space."""
        return max(_reach(part) for part in self.parts)

    @cached_property
    def thickness(self) -> float:
        """Half of the smallest extent along the axes of the frame in which the shape was given [m]."""
        if self.is_half_space:
            return np.inf
        given = self.vertices @ rotation_matrix(self.axes).T
        return float(0.5 * np.ptp(given, axis=0).min())

    @property
    def is_ball(self) -> bool:
        """True for a single ball."""
        return len(self.parts) == 1 and self.parts[0].kind is Kind.BALL

    @property
    def is_half_space(self) -> bool:
        """True where a part is a half space."""
        return any(part.kind is Kind.HALF_SPACE for part in self.parts)


def ball(radius: float) -> Shape:
    """A solid ball.

    Raises:
        ProblemError: the radius is not positive and finite.
    """
    _check_sizes("radius", [radius])
    moment = 8.0 / 15.0 * np.pi * radius**5
    triangles = _trimesh().creation.icosphere(subdivisions=3, radius=radius)
    return _simple(Kind.BALL, (radius,), 4.0 / 3.0 * np.pi * radius**3, [moment] * 3, triangles)


def box(half_sizes: Sequence[float]) -> Shape:
    """A solid box.

    Args:
        half_sizes: half of its lengths along x, y and z, > 0 [m].

    Raises:
        ProblemError: a size is not positive and finite.
    """
    _check_sizes("half_sizes", half_sizes, count=3)
    x, y, z = (float(size) for size in half_sizes)
    volume = 8.0 * x * y * z
    moments = volume / 3.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    return _simple(Kind.BOX, (x, y, z), volume, moments, _trimesh().creation.box(extents=(2 * x, 2 * y, 2 * z)))


def cylinder(radius: float, half_length: float) -> Shape:
    """A solid cylinder about the z axis.

    Raises:
        ProblemError: a size is not positive and finite.
    """
    _check_sizes("radius and half_length", [radius, half_length])
    volume = 2.0 * np.pi * radius**2 * half_length
    across = volume * (radius**2 / 4.0 + half_length**2 / 3.0)
    triangles = _trimesh().creation.cylinder(radius=radius, height=2.0 * half_length, sections=RING)
    moments = [across, across, 0.5 * volume * radius**2]
    return _simple(Kind.CYLINDER, (radius, half_length), volume, moments, triangles)


def capsule(radius: float, half_length: float) -> Shape:
    """A cylinder about the z axis with half balls at its ends; `half_length` is the cylinder's.

    Raises:
        ProblemError: a size is not positive and finite.
    """
    _check_sizes("radius and half_length", [radius, half_length])
    middle, ends = 2.0 * np.pi * radius**2 * half_length, 4.0 / 3.0 * np.pi * radius**3
    along = 0.5 * middle * radius**2 + 0.4 * ends * radius**2
    # Half balls have their centers 3/8 r beyond the cylinder's ends.
    across = middle * (radius**2 / 4.0 + half_length**2 / 3.0)
    across += ends * (0.4 * radius**2 + half_length**2 + 0.75 * half_length * radius)
    triangles = _trimesh().creation.capsule(height=2.0 * half_length, radius=radius, count=(RING, RING // 2))
    centered = triangles.vertices - 0.5 * (triangles.bounds[0] + triangles.bounds[1])
    triangles = _trimesh().Trimesh(centered, triangles.faces, process=False)
    return _simple(Kind.CAPSULE, (radius, half_length), middle + ends, [across, across, along], triangles)


def half_space() -> Shape:
    """All that lies below the plane z = 0; for fixed bodies alone."""
    corners = PLANE_EXTENT * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    part = Part(Kind.HALF_SPACE, (), np.zeros(3), np.array(IDENTITY), np.zeros((0, 3)))
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    return Shape((part,), np.inf, np.full(3, np.inf), np.zeros(3), np.array(IDENTITY), corners, faces)


def hull(points: npt.ArrayLike) -> Shape:
    """The convex hull of points [m], shape (k, 3).

    Raises:
        ProblemError: the points are not finite, or span no volume.
    """
    corners = _points("points", points)
    return _solid(_hull_of(corners, "points"), [corners])


def mesh(source: str | Path | Triangles, *, scale: float = 1.0, concavity: float = 0.05) -> Shape:
    """A closed triangle mesh, split into convex parts for contact.

    Args:
        source: a file in one of `FORMATS`, or vertices and faces.
        scale: factor on all lengths, > 0.
        concavity: how far the parts may bridge a hollow, relative to the mesh's size, in [0.01, 1]; 1 is its hull.

    Raises:
        ProblemError: the file is missing, empty, or of an unknown format; the mesh is not closed, its triangles do not
            agree on what is inside, or it has no volume.
    """
    _check_sizes("scale", [scale])
    if not 0.01 <= concavity <= 1.0:
        raise ProblemError(f"concavity must lie in [0.01, 1], not {concavity}")
    name, triangles = _read(source)
    triangles = _closed(name, triangles, scale)
    if triangles.is_convex or concavity == 1.0:
        return _solid(triangles, [np.asarray(triangles.vertices)])
    return _solid(triangles, _convex_pieces(triangles, concavity))


def mesh_of_parts(vertices: npt.ArrayLike, faces: npt.ArrayLike, pieces: Iterable[npt.ArrayLike]) -> Shape:
    """A closed triangle mesh whose convex parts are known; these are for contact alone.

    Args:
        vertices: [m], shape (v, 3).
        faces: counterclockwise from outside, shape (f, 3).
        pieces: points whose hulls are the parts [m], shape (k, 3) each.

    Raises:
        ProblemError: as `mesh`; or a piece spans no volume.
    """
    name, triangles = _read((vertices, faces))
    corners = [np.asarray(_hull_of(_points("pieces", piece), "pieces").vertices) for piece in pieces]
    if not corners:
        raise ProblemError("pieces must have at least one part")
    return _solid(_closed(name, triangles, 1.0), corners)


def union(placed: Sequence[tuple[Shape, npt.ArrayLike, npt.ArrayLike]]) -> Shape:
    """One rigid shape of several, each with its position [m], shape (3,), and orientation, shape (4,).

    Volumes and inertia are added: where parts overlap, matter counts twice.

    Raises:
        ProblemError: there is none, one is a half space, or a placement is not finite.
    """
    if not placed:
        raise ProblemError("a union must have at least one shape")
    if any(shape.is_half_space for shape, _, _ in placed):
        raise ProblemError("a union cannot hold a half space: it has no center of mass")
    own = [_placed(shape, position, orientation) for shape, position, orientation in placed]
    volume = sum(shape.volume for shape, _, _ in own)
    center = np.sum([shape.volume * position for shape, position, _ in own], axis=0) / volume
    inertia = np.zeros((3, 3))
    for shape, position, turn in own:
        arm = position - center
        inertia += rotation_matrix(turn) @ np.diag(shape.inertia) @ rotation_matrix(turn).T
        inertia += shape.volume * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    moments, axes = _principal(inertia)
    parts: list[Part] = []
    vertices: list[Floats] = []
    faces: list[Faces] = []
    for shape, position, turn in own:
        where, how = rotation_matrix(axes).T @ (position - center), multiply(inverse(axes), turn)
        parts.extend(_moved(part, where, how) for part in shape.parts)
        faces.append((shape.faces + sum(len(corners) for corners in vertices)).astype(np.int32))
        vertices.append(shape.vertices @ rotation_matrix(how).T + where)
    return Shape(tuple(parts), volume, moments, center, axes, np.concatenate(vertices), np.concatenate(faces))


def _simple(kind: Kind, size: tuple[float, ...], volume: float, moments: npt.ArrayLike, triangles: Any) -> Shape:
    """A shape of one part whose own frame is the given one."""
    part = Part(kind, tuple(float(s) for s in size), np.zeros(3), np.array(IDENTITY), np.zeros((0, 3)))
    return Shape(
        (part,), float(volume), np.asarray(moments, dtype=np.float64), np.zeros(3), np.array(IDENTITY),
        np.asarray(triangles.vertices, dtype=np.float64), np.asarray(triangles.faces, dtype=np.int32),
    )  # fmt: skip


def _solid(triangles: Any, pieces: Sequence[Floats]) -> Shape:
    """A shape from a closed mesh and the corners of its convex parts, all in the given frame."""
    properties = triangles.mass_properties
    center = np.asarray(properties.center_mass, dtype=np.float64)
    moments, axes = _principal(np.asarray(properties.inertia, dtype=np.float64))
    turn = rotation_matrix(axes)
    parts = tuple(
        Part(Kind.HULL, (), np.zeros(3), np.array(IDENTITY), (np.asarray(piece) - center) @ turn) for piece in pieces
    )
    vertices = (np.asarray(triangles.vertices, dtype=np.float64) - center) @ turn
    faces = np.asarray(triangles.faces, dtype=np.int32)
    return Shape(parts, float(properties.volume), moments, center, axes, vertices, faces)


def _principal(inertia: Floats) -> tuple[Floats, Floats]:
    """Principal moments, shape (3,), and the rotation of their axes; the identity where it is diagonal already."""
    symmetric = 0.5 * (inertia + inertia.T)
    if np.abs(symmetric - np.diag(np.diag(symmetric))).max() <= DIAGONAL * np.trace(symmetric):
        return np.diag(symmetric).copy(), np.array(IDENTITY)
    moments, axes = np.linalg.eigh(symmetric)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] = -axes[:, 0]
    return moments, rotation_of(axes)


def _placed(shape: Shape, position: npt.ArrayLike, orientation: npt.ArrayLike) -> tuple[Shape, Floats, Floats]:
    """A shape with the place of its own frame, from that of the frame in which it was given."""
    where, turn = given_pose("position", position), unit_quaternion(orientation)
    return shape, where + rotation_matrix(turn) @ shape.center, multiply(turn, shape.axes)


def given_pose(field: str, value: npt.ArrayLike) -> Floats:
    """Check a vector in space, shape (3,).

    Raises:
        ProblemError: it has another shape or is not finite; the text begins with the field.
    """
    vector = _numbers(field, value)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ProblemError(f"{field} must be three finite numbers, not {vector.tolist()}")
    return vector


def unit_quaternion(value: npt.ArrayLike) -> Floats:
    """Check an orientation and scale it to unit length, shape (4,).

    Raises:
        ProblemError: it has another shape, is not finite, or zero.
    """
    q = _numbers("orientation", value)
    if q.shape != (4,) or not np.isfinite(q).all() or not q.any():
        raise ProblemError(f"orientation must be a quaternion (w, x, y, z), finite and not zero, not {q.tolist()}")
    scaled: Floats = q / np.linalg.norm(q)
    return scaled


def _moved(part: Part, position: Floats, turn: Floats) -> Part:
    """A part in a frame in which its shape's own frame is placed."""
    where = position + rotation_matrix(turn) @ part.position
    return replace(part, position=where, orientation=multiply(turn, part.orientation))


def _reach(part: Part) -> float:
    """Distance of a part's farthest point from the origin of the body's frame [m], or a bound on it."""
    if part.kind is Kind.HALF_SPACE:
        return np.inf
    if part.kind in (Kind.HULL, Kind.BOX):
        corners = part.corners @ rotation_matrix(part.orientation).T + part.position
        return float(np.linalg.norm(corners, axis=1).max())
    size = sum(part.size) if part.kind is Kind.CAPSULE else float(np.linalg.norm(part.size))
    return float(np.linalg.norm(part.position)) + size


def _read(source: str | Path | Triangles) -> tuple[str, Any]:
    """Name of a mesh for errors, and its triangles."""
    trimesh = _trimesh()
    if not isinstance(source, str | Path):
        vertices, faces = source
        corners, triangles = _points("vertices", vertices), np.asarray(faces)
        if triangles.ndim != 2 or triangles.shape[1:] != (3,) or triangles.dtype.kind not in "iu":
            raise ProblemError(f"faces must be whole numbers of shape (f, 3), not {triangles.shape}")
        if triangles.size == 0 or triangles.min() < 0 or triangles.max() >= len(corners):
            raise ProblemError("faces must name vertices, and there must be some")
        return "the mesh", trimesh.Trimesh(corners, triangles, process=True)
    path = Path(source)
    if path.suffix.lower() not in FORMATS:
        raise ProblemError(f"{path} has an unknown format: a mesh is read from {', '.join(FORMATS)}")
    if not path.is_file():
        raise ProblemError(f"{path} is missing, or no file")
    try:
        return str(path), trimesh.load_mesh(path)
    except (ValueError, IndexError, KeyError, AttributeError, TypeError, UnicodeDecodeError) as error:
        raise ProblemError(f"{path} cannot be read as {path.suffix}: {error}") from error


def _closed(name: str, triangles: Any, scale: float) -> Any:
    """Check that a mesh bounds a volume, and scale it; faces are turned outward."""
    if len(getattr(triangles, "faces", ())) == 0:
        raise ProblemError(f"{name} holds no triangles")
    if not np.isfinite(triangles.vertices).all():
        raise ProblemError(f"{name} must have finite vertices")
    if not triangles.is_watertight:
        raise ProblemError(f"{name} must be closed: each edge must belong to two triangles")
    if not triangles.is_winding_consistent:
        raise ProblemError(f"{name} must have triangles that agree on what is inside")
    # Σ a · (b × c) / 6 over the triangles; trimesh's own sums divide by it.
    a, b, c = np.moveaxis(np.asarray(triangles.triangles, dtype=np.float64), 1, 0)
    volume = float((a * np.cross(b, c)).sum()) / 6.0
    if abs(volume) <= FLAT * float(triangles.extents.max()) ** 3:
        raise ProblemError(f"{name} must have a volume")
    scaled = triangles.copy()
    scaled.apply_scale(scale)
    if volume < 0.0:
        scaled.invert()
    return scaled


def _convex_pieces(triangles: Any, concavity: float) -> list[Floats]:
    """Split a mesh into parts that are nearly convex, and return the corners of their hulls."""
    coacd = extra("coacd")
    coacd.set_log_level("error")
    whole = coacd.Mesh(np.asarray(triangles.vertices), np.asarray(triangles.faces))
    found = coacd.run_coacd(whole, threshold=concavity, seed=SEED)
    return [np.asarray(_hull_of(np.asarray(corners), "parts").vertices) for corners, _ in found]


def _hull_of(points: Floats, field: str) -> Any:
    """Convex hull as a mesh."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[-1] <= FLAT * spread[0]:
        raise ProblemError(f"{field} must span a volume")
    return _trimesh().convex.convex_hull(points)


def _points(field: str, value: npt.ArrayLike) -> Floats:
    """Check points, shape (k, 3)."""
    points = _numbers(field, value)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
        raise ProblemError(f"{field} must have shape (k, 3) with k ≥ 4, not {points.shape}")
    if not np.isfinite(points).all():
        raise ProblemError(f"{field} must be finite")
    return points


def _numbers(field: str, value: npt.ArrayLike) -> Floats:
    """Check that there are numbers, in rows of the same length."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ProblemError(f"{field} must be an array of real numbers, not {value!r}") from None


def _check_sizes(field: str, sizes: Sequence[float], *, count: int | None = None) -> None:
    """Check lengths."""
    if count is not None and len(sizes) != count:
        raise ProblemError(f"{field} must be {count} numbers, not {len(sizes)}")
    if not all(np.isfinite(size) and size > 0.0 for size in sizes):
        raise ProblemError(f"{field} must be finite and > 0, not {', '.join(f'{size:g}' for size in sizes)}")


def _trimesh() -> Any:
    return extra("trimesh")


def extra(name: str) -> Any:
    """A module of the extra `scenes`, or a part of one ("skimage.measure").

    Raises:
        ProblemError: it is not installed.
    """
    package = name.partition(".")[0]
    if importlib.util.find_spec(package) is None:
        raise ProblemError(f"rigid bodies need {package}: pip install 'impactbench[scenes]'")
    return importlib.import_module(name)

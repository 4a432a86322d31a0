"""Shapes of rigid bodies: mass properties, frames, parts, files, errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.world.rotation import about, inverse, multiply, rotation_matrix, rotation_of
from scenarios.world.shapes import (
    Shape,
    ball,
    box,
    capsule,
    cylinder,
    half_space,
    hull,
    mesh,
    mesh_of_parts,
    union,
)
from solvers import ProblemError

ROUNDING = 1e-12
# A sphere or circle of triangles in pictures is smaller than the true one: less than a part in fifty here.
FACETS = 0.02
IDENTITY = (1.0, 0.0, 0.0, 0.0)
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def torus() -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.torus(1.0, 0.4, major_sections=16, minor_sections=8)
    return np.asarray(made.vertices), np.asarray(made.faces)


@pytest.mark.parametrize(
    "shape", [ball(0.5), box((0.1, 0.2, 0.3)), cylinder(0.3, 0.7), capsule(0.3, 0.7)], ids=["ball", "box", "cyl", "cap"]
)
def test_closed_forms_of_volume_and_inertia_are_those_of_the_triangles(shape: Shape) -> None:
    drawn = trimesh.Trimesh(shape.vertices, shape.faces)
    assert drawn.is_volume
    assert drawn.volume == pytest.approx(shape.volume, rel=FACETS)
    assert np.diag(drawn.moment_inertia) == pytest.approx(shape.inertia, rel=2.0 * FACETS)
    assert np.linalg.norm(drawn.vertices, axis=1).max() <= shape.radius * (1.0 + ROUNDING)


def test_a_hull_of_a_boxs_corners_is_the_box() -> None:
    half = np.array([0.5, 1.0, 2.0])
    found, expected = hull(CORNERS * half + [3.0, 4.0, 5.0]), box(tuple(half))
    assert found.volume == pytest.approx(expected.volume, rel=ROUNDING)
    assert found.inertia == pytest.approx(expected.inertia, rel=ROUNDING)
    assert found.center == pytest.approx([3.0, 4.0, 5.0], rel=ROUNDING)
    assert found.thickness == pytest.approx(0.5, rel=ROUNDING)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_a_bodys_frame_is_at_its_center_of_mass_along_its_principal_axes(seed: int) -> None:
    random = np.random.default_rng(seed)
    shape = hull(random.normal(size=(20, 3)) * [1.0, 2.0, 3.0] + random.normal(size=3))
    own = trimesh.Trimesh(shape.vertices, shape.faces)
    size = shape.radius
    assert own.center_mass == pytest.approx([0.0, 0.0, 0.0], abs=ROUNDING * size)
    assert own.moment_inertia == pytest.approx(np.diag(shape.inertia), abs=ROUNDING * own.volume * size**2)
    given_frame = shape.vertices @ rotation_matrix(shape.axes).T + shape.center
    assert trimesh.Trimesh(given_frame, shape.faces).center_mass == pytest.approx(shape.center, abs=ROUNDING * size)


def test_a_union_of_two_halves_is_the_whole() -> None:
    half = box((0.5, 1.0, 2.0))
    whole, expected = (
        union([(half, (0.0, 0.0, 0.0), IDENTITY), (half, (1.0, 0.0, 0.0), IDENTITY)]),
        box((1.0, 1.0, 2.0)),
    )
    assert whole.volume == pytest.approx(expected.volume, rel=ROUNDING)
    assert whole.inertia == pytest.approx(expected.inertia, rel=ROUNDING)
    assert whole.center == pytest.approx([0.5, 0.0, 0.0], abs=ROUNDING)
    assert [part.position[0] for part in whole.parts] == pytest.approx([-0.5, 0.5], abs=ROUNDING)
    assert (whole.radius, whole.thickness) == pytest.approx((expected.radius, 1.0), rel=ROUNDING)


def test_a_union_does_not_depend_on_how_it_is_turned() -> None:
    part, turn = hull(np.random.default_rng(1).normal(size=(12, 3))), about((1.0, 2.0, 3.0), 0.7)
    placed = [
        (part, np.array([0.0, 1.0, 2.0]), about((0.0, 0.0, 1.0), 0.3)),
        (box((1.0, 2.0, 3.0)), np.ones(3), np.array(IDENTITY)),
    ]
    turned = [(shape, rotation_matrix(turn) @ where, multiply(turn, how)) for shape, where, how in placed]
    one, other = union(placed), union(turned)
    assert np.sort(one.inertia) == pytest.approx(np.sort(other.inertia), rel=ROUNDING)
    assert rotation_matrix(turn) @ one.center == pytest.approx(other.center, rel=ROUNDING)


def test_a_mesh_that_is_not_convex_has_convex_parts_that_fill_it() -> None:
    shape = mesh(torus(), concavity=0.2)
    assert len(shape.parts) > 3
    assert shape.volume == pytest.approx(trimesh.Trimesh(*torus()).volume, rel=ROUNDING)
    filled = sum(hull(part.points).volume for part in shape.parts)
    # The parts bridge hollows: never less than the mesh but for what the decomposition cuts.
    assert 0.9 * shape.volume < filled < 1.3 * shape.volume


def test_a_convex_mesh_is_one_part_and_its_hull_if_it_may_be() -> None:
    whole = trimesh.creation.icosphere(subdivisions=1)
    assert len(mesh((whole.vertices, whole.faces)).parts) == 1
    assert len(mesh(torus(), concavity=1.0).parts) == 1


def test_known_parts_are_taken_as_they_are() -> None:
    vertices, faces = torus()
    shape = mesh_of_parts(vertices, faces, [CORNERS * 0.1, CORNERS * 0.1 + [1.0, 0.0, 0.0]])
    assert len(shape.parts) == 2
    assert shape.volume == pytest.approx(trimesh.Trimesh(vertices, faces).volume, rel=ROUNDING)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".off", ".glb"])
def test_a_mesh_is_read_from_a_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cube{suffix}"
    trimesh.creation.box(extents=(1.0, 2.0, 3.0)).export(path)
    shape = mesh(path, scale=0.5)
    # Some formats hold single precision.
    assert shape.volume == pytest.approx(6.0 / 8.0, rel=1e-6)


def written(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


BAD_MESHES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda folder: folder / "no.stl", "is missing"),
    "format": (lambda folder: written(folder / "a.txt", "solid"), "unknown format"),
    "empty": (lambda folder: written(folder / "a.obj", ""), "a.obj"),
    "broken": (lambda folder: written(folder / "a.off", "OFF\n3 1 0\n0 0"), "a.off"),
    "not closed": (lambda folder: (CORNERS, [[0, 1, 2], [1, 2, 3]]), "must be closed"),
    "flat": (lambda folder: (CORNERS[[0, 1, 2, 3]], [[0, 1, 2], [0, 2, 1]]), "must"),
    "no faces": (lambda folder: (CORNERS, np.zeros((0, 3), dtype=int)), "must name vertices"),
    "no such vertex": (lambda folder: (CORNERS, [[0, 1, 99]]), "must name vertices"),
    "faces of another shape": (lambda folder: (CORNERS, [[0, 1]]), "faces must"),
    "NaN": (lambda folder: (CORNERS * np.nan, [[0, 1, 2]]), "finite"),
}


@pytest.mark.parametrize(("source", "rule"), BAD_MESHES.values(), ids=list(BAD_MESHES))
def test_a_bad_mesh_is_refused_with_the_rule_that_it_breaks(
    tmp_path: Path, source: Callable[[Path], object], rule: str
) -> None:
    with pytest.raises(ProblemError, match=rule):
        mesh(source(tmp_path))  # type: ignore[arg-type]


def test_an_open_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "open.stl"
    trimesh.Trimesh(CORNERS, [[0, 1, 2], [1, 2, 3]]).export(path)
    with pytest.raises(ProblemError, match=r"open\.stl must be closed"):
        mesh(path)


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: ball(0.0), "radius"),
        (lambda: ball(np.nan), "radius"),
        (lambda: box((1.0, 1.0, -1.0)), "half_sizes"),
        (lambda: box((1.0, 1.0)), "half_sizes"),
        (lambda: cylinder(1.0, np.inf), "half_length"),
        (lambda: capsule(-1.0, 1.0), "radius"),
        (lambda: hull(CORNERS * [1.0, 1.0, 0.0]), "volume"),
        (lambda: hull([[0.0, 0.0, 0.0]]), "shape"),
        (lambda: hull([[0.0, 0.0, 0.0], [1.0]]), "points must be an array of real numbers"),
        (lambda: union([(ball(1.0), "middle", IDENTITY)]), "position must be an array of real numbers"),
        (lambda: union([]), "at least one"),
        (lambda: union([(half_space(), (0, 0, 0), IDENTITY)]), "half space"),
        (lambda: union([(ball(1.0), (0, 0, np.nan), IDENTITY)]), "position"),
        (lambda: union([(ball(1.0), (0, 0, 0), (0, 0, 0, 0))]), "orientation"),
        (lambda: mesh(torus(), concavity=0.0), "concavity"),
        (lambda: mesh(torus(), scale=0.0), "scale"),
        (lambda: mesh_of_parts(*torus(), []), "pieces"),
    ],
)
def test_a_bad_shape_is_refused_with_the_rule_that_it_breaks(make: Callable[[], Shape], rule: str) -> None:
    with pytest.raises(ProblemError, match=rule):
        make()


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_a_rotation_is_the_same_as_quaternion_and_as_matrix(numbers: list[float]) -> None:
    q = np.array(numbers) / np.linalg.norm(numbers)
    R = rotation_matrix(q)
    assert np.abs(R @ R.T - np.eye(3)).max() <= ROUNDING
    assert abs(rotation_of(R) @ q) == pytest.approx(1.0, abs=ROUNDING)
    assert rotation_matrix(inverse(q)) == pytest.approx(R.T, abs=ROUNDING)
    p = about((1.0, -2.0, 0.5), 0.4)
    assert rotation_matrix(multiply(p, q)) == pytest.approx(rotation_matrix(p) @ R, abs=ROUNDING)

"""Bunnies and pawns: closed bodies of our own, in convex parts that fit them; they fall and nothing is lost."""

from __future__ import annotations

import importlib.util
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import ConvexHull

import impactbench
from scenarios.bunnies import (
    AT_REST,
    OUTLINE,
    SECTIONS,
    STAGES,
    bunnies_and_pawns,
    bunny,
    elastic_energy_error,
    loaded,
    pawn,
)
from scenarios.world.rigid_world import RigidWorld
from scenarios.world.rotation import rotation_matrix
from scenarios.world.shapes import Shape, box
from solvers import ImpactProblem, ProblemError, Status
from solvers.qce_lcp import QceLcp

LAW = QceLcp(tolerance=1e-9, max_sweeps=1000)
# Share of the steps that may end at their bound: the pile is one impact of some 500 contacts, and box friction need not
# have a solution that iterations find.
UNSOLVED = 0.01
# How far a bunny's surface may lie outside of its convex parts, over its height: fillets are bridged by none.
FIT = 0.08


def outside_of_parts(shape: Shape) -> np.ndarray:
    """Distance of each vertex to the nearest part, 0 inside; that of the farthest face plane, a lower bound."""
    distances = []
    for part in shape.parts:
        hull = ConvexHull(part.points @ rotation_matrix(part.orientation).T + part.position)
        planes = shape.vertices @ hull.equations[:, :3].T + hull.equations[:, 3]
        distances.append(np.maximum(planes.max(axis=1), 0.0))
    nearest: np.ndarray = np.min(distances, axis=0)
    return nearest


@pytest.mark.parametrize(("make", "parts"), [(bunny, 6), (pawn, 4)])
def test_the_parts_fit_the_body(make: object, parts: int) -> None:
    shape = make()  # type: ignore[operator]
    assert len(shape.parts) == parts
    assert outside_of_parts(shape).max() < FIT * np.ptp(shape.vertices, axis=0).max()
    volumes = [ConvexHull(part.points).volume for part in shape.parts]
    assert sum(volumes) == pytest.approx(shape.volume, rel=0.15)


def test_a_bunny_is_its_own_mirror_image_from_the_left_and_the_right() -> None:
    # Marching cubes see a grid that is not quite centered: a hundredth of a cell.
    assert bunny().center[1] == pytest.approx(0.0, abs=3e-4)


def test_the_volume_of_a_pawn_is_that_of_its_truncated_cones() -> None:
    # A regular polygon of n corners on a circle of radius r has the area n r² sin(2π/n) / 2.
    ring = 0.5 * SECTIONS * np.sin(2.0 * np.pi / SECTIONS)
    (r, z) = np.array(OUTLINE).T
    exact = ring * float((np.diff(z) * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2)).sum()) / 3.0
    assert pawn().volume == pytest.approx(exact, rel=1e-9)


def fallen(world: RigidWorld, seconds: float) -> None:
    for _ in range(round(seconds / world.settings.step)):
        world.step()


def test_bunnies_fall_and_pawns_follow_at_their_time() -> None:
    scene = bunnies_and_pawns(bunnies=3, pawns=1, pawns_from=0.4)
    world = scene.world(solver=LAW)
    assert isinstance(world, RigidWorld)
    start = world.position[:, 2].copy()
    energy = world.kinetic_energy() + world.potential_energy()
    fallen(world, 0.4)
    assert (world.position[:3, 2] < start[:3] - 0.3).all()
    assert world.position[3, 2] == start[3]
    fallen(world, 0.6)
    assert world.position[3, 2] < start[3] - 1.0
    measures = scene.measure(world)
    assert measures["bodies lost"] == 0.0
    assert list(world.fired) == [STAGES[0]]
    assert world.kinetic_energy() + world.potential_energy() < energy


def test_the_start_is_drawn_by_its_seed() -> None:
    first, again, other = (bunnies_and_pawns(bunnies=2, pawns=0).world(solver=LAW, seed=seed) for seed in (1, 1, 2))
    assert isinstance(first, RigidWorld)
    assert isinstance(again, RigidWorld)
    assert isinstance(other, RigidWorld)
    assert (first.orientation == again.orientation).all()
    assert not (first.orientation == other.orientation).any()


def test_any_closed_mesh_can_fall_instead(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    shape = box((0.2, 0.3, 0.1))
    path = tmp_path / "brick.stl"
    trimesh.Trimesh(shape.vertices, shape.faces).export(path)
    # As large as the bunny, whatever the file's units are.
    assert loaded(str(path)).radius == pytest.approx(bunny().radius, rel=1e-6)
    world = bunnies_and_pawns(bunnies=2, pawns=0, mesh=str(path)).world(solver=LAW)
    world.step()


def test_a_mesh_that_is_not_there_or_not_closed_is_refused(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    # When the scene is described, before a run begins; body and field are named.
    with pytest.raises(ProblemError, match=r"bunny 0: mesh: .*nowhere\.stl is missing"):
        bunnies_and_pawns(bunnies=1, pawns=0, mesh=str(tmp_path / "nowhere.stl"))
    shape = box((0.2, 0.3, 0.1))
    path = tmp_path / "open.stl"
    trimesh.Trimesh(shape.vertices, shape.faces[:-1]).export(path)
    with pytest.raises(ProblemError, match="must be closed"):
        bunnies_and_pawns(bunnies=1, pawns=0, mesh=str(path))


@pytest.mark.parametrize("scene", ["bunnies-and-pawns", "bunnies-and-pawns:mesh=brick.stl", "card-house"])
def test_without_the_extra_a_rigid_scene_says_what_to_install(
    scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "brick.stl").write_bytes(b"solid")
    for shape in (bunny, pawn, loaded):
        shape.cache_clear()
    result = CliRunner().invoke(impactbench.main, ["simulate", scene, "--out", "out"])
    assert result.exit_code == 2, result.output
    assert "pip install 'impactbench[scenes]'" in " ".join(result.output.split())


def test_the_energy_error_is_that_of_the_elastic_step() -> None:
    approaching = ImpactProblem([1.0, 1.0], [[1.0, -1.0]], [-1.0, 0.0], restitution=0.2)
    assert elastic_energy_error(approaching) == pytest.approx(0.0, abs=1e-14)
    assert np.isnan(elastic_energy_error(approaching.replace(v_pre=[1.0, 0.0])))


@pytest.mark.parametrize(
    ("parameters", "rule"), [({"bunnies": 0}, "bunnies"), ({"pawns": -1}, "pawns"), ({"step": 0.0}, "step")]
)
def test_bad_parameters_are_refused_by_name(parameters: dict[str, float], rule: str) -> None:
    with pytest.raises(ProblemError, match=rule):
        bunnies_and_pawns(**parameters)  # type: ignore[arg-type]


@pytest.mark.long
def test_144_bunnies_and_16_pawns_come_to_rest() -> None:
    scene = bunnies_and_pawns()
    world = scene.world(solver=LAW)
    assert isinstance(world, RigidWorld)
    peak = overlap = 0.0
    errors: list[float] = []
    unsolved = 0
    begin = time.process_time()
    while STAGES[1] not in world.fired and world.steps < scene.default_steps:
        unsolved += world.step().status is not Status.CONVERGED
        errors.append(scene.measure(world)["energy error of the QCE step"])
        peak, overlap = max(peak, world.kinetic_energy()), max(overlap, world.overlap)
    error = float(np.nanmean(errors))
    print(f"\n{unsolved} of {world.steps} steps not converged; {time.process_time() - begin:.0f} s of processor time")
    print(f"at rest at {world.fired.get(STAGES[1])} s, deepest overlap {overlap:.2e} m, peak {peak:.0f} J")
    print(f"QCE step: mean |K⁺ - K⁻| / K⁻ = {error:.2e}; Zhang 2015: 2.43e-4")
    assert scene.measure(world)["bodies lost"] == 0.0
    assert unsolved <= UNSOLVED * world.steps
    assert world.kinetic_energy() < AT_REST * peak
    assert error < 2.43e-4

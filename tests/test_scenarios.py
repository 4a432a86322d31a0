"""The catalog: every scene is what it says, and what is known of its outcome is right."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp

from scenarios import CATALOG, TIERS, Quantity, Reference, Scenario, describe
from scenarios.jammed import INTERIOR_TOLERANCE, interior_margin
from scenarios.packs import GAP, RADIUS, cell_width, layer, layer_contacts
from scenarios.references import billiard_count, hertz
from solvers import SOLVERS, ProblemError

# A symmetry or an invariant is a sum of a few products of numbers near 1.
ROUNDING = 1e-12
# Values quoted with six decimals.
SIX_DECIMALS = 6e-7
# A linear program, an ODE or a picture of this many contacts is still quick.
SMALL = 200

Instance = tuple[str, dict[str, object]]
DEFAULTS: list[Instance] = [(name, {}) for name in CATALOG]
EVERY: list[Instance] = [*DEFAULTS, *(instance for instance in TIERS["full"] if instance not in DEFAULTS)]


def name_of(instance: Instance) -> str:
    return f"{instance[0]}-{'-'.join(f'{key}={value}' for key, value in instance[1].items()) or 'default'}"


every_instance = pytest.mark.parametrize("instance", EVERY, ids=name_of)
every_small_instance_with_friction = pytest.mark.parametrize(
    "instance",
    [(name, parameters) for name, parameters in EVERY if "friction" in parameters and name != "sphere-pack"],
    ids=name_of,
)


@pytest.fixture(autouse=True, scope="module")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Layers made by these tests stay out of the user's folder."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("IMPACTBENCH_CACHE", str(folder))
        yield folder


def build(instance: Instance) -> Scenario:
    return _built(EVERY.index(instance))


@cache
def _built(index: int) -> Scenario:
    name, parameters = EVERY[index]
    return CATALOG[name](**parameters)


def sorted_rows(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Rows in an order that does not depend on their last bits."""
    # Adding 0.0 turns -0.0 into 0.0.
    rounded = np.round(matrix, 9) + 0.0
    return np.asarray(matrix[np.lexsort(rounded.T)])


@every_instance
def test_every_instance_builds_and_its_parameters_make_it_again(instance: Instance) -> None:
    scenario = build(instance)
    again = CATALOG[scenario.name](**scenario.parameters)
    assert scenario.name == instance[0]
    assert again.label == scenario.label
    assert np.array_equal(again.problem.v_pre, scenario.problem.v_pre)
    assert (abs(again.problem.J - scenario.problem.J)).max() == 0
    assert scenario.source
    assert scenario.problem.n % scenario.dofs_per_body == 0


def test_something_approaches_at_first_and_no_contact_overlooks_its_body() -> None:
    for instance in EVERY:
        scenario = build(instance)
        assert scenario.problem.u_pre.min() < 0
        assert scenario.problem.W_diagonal.min() > 0


@pytest.mark.parametrize("tier", TIERS)
def test_labels_are_unique_within_a_tier(tier: str) -> None:
    labels = [CATALOG[name](**parameters).label for name, parameters in TIERS[tier]]
    assert len(set(labels)) == len(labels)


def test_the_default_and_the_hard_tier_cover_every_family_and_full_covers_default() -> None:
    assert {name for name, _ in (*TIERS["default"], *TIERS["hard"])} == set(CATALOG)
    assert all(instance in TIERS["full"] for instance in TIERS["default"])


@every_instance
def test_every_symmetry_keeps_the_masses_and_permutes_the_contacts(instance: Instance) -> None:
    scenario = build(instance)
    problem = scenario.problem
    J = problem.J.toarray() if scenario.symmetries else np.zeros((0, 0))
    for symmetry in scenario.symmetries:
        S = symmetry.matrix
        assert S.shape == (problem.n, problem.n)
        assert abs(S @ problem.inverse_mass @ S.T - problem.inverse_mass).max() <= ROUNDING
        assert abs(S @ S.T - sp.eye_array(problem.n)).max() <= ROUNDING
        carried = J @ S
        assert np.abs(sorted_rows(carried) - sorted_rows(J)).max() <= ROUNDING, symmetry.name


@every_small_instance_with_friction
def test_every_symmetry_maps_the_friction_pyramid_on_itself(instance: Instance) -> None:
    scenario = build(instance)
    problem = scenario.problem
    assert problem.D is not None
    both_ways = np.vstack([problem.D.toarray(), -problem.D.toarray()])
    for symmetry in scenario.symmetries:
        carried = both_ways @ symmetry.matrix
        assert np.abs(sorted_rows(carried) - sorted_rows(both_ways)).max() <= ROUNDING, symmetry.name


def test_a_symmetric_scene_has_the_same_parameters_at_every_contact() -> None:
    for instance in EVERY:
        scenario = build(instance)
        if scenario.symmetries:
            for values in (scenario.problem.restitution, scenario.problem.friction, scenario.problem.stiffness):
                assert np.ptp(values) == 0


@every_instance
def test_no_contact_changes_an_invariant(instance: Instance) -> None:
    scenario = build(instance)
    problem = scenario.problem
    for invariant in scenario.invariants:
        assert invariant.direction.shape == (problem.n,)
        assert np.abs(invariant.direction).max() > 0
        assert np.abs(problem.J @ invariant.direction).max() <= ROUNDING, invariant.name
        if problem.D is not None:
            assert np.abs(problem.D @ invariant.direction).max() <= ROUNDING, invariant.name


@every_instance
def test_invariants_are_all_there_are_where_a_scene_is_small(instance: Instance) -> None:
    # As many independent invariants as directions that no impulse changes: the bead of a chain has no other.
    scenario = build(instance)
    problem = scenario.problem
    if problem.n > SMALL or not {"chain", "rack", "circle", "ring"} & scenario.tags or "friction" in scenario.tags:
        return
    free = problem.n - np.linalg.matrix_rank(problem.J.toarray())
    directions = np.array([invariant.direction for invariant in scenario.invariants]).reshape(-1, problem.n)
    assert np.linalg.matrix_rank(directions) == len(scenario.invariants) <= free
    if "chain" in scenario.tags:
        assert len(scenario.invariants) == free


def test_friction_rows_exist_only_where_there_is_friction() -> None:
    for instance in EVERY:
        scenario = build(instance)
        assert (scenario.problem.D is not None) == scenario.problem.has_friction == ("friction" in scenario.tags)


@every_small_instance_with_friction
def test_contacts_stand_at_right_angles_to_their_friction_directions(instance: Instance) -> None:
    problem = build(instance).problem
    assert problem.D is not None
    J, D = problem.J.toarray(), problem.D.toarray()
    for body in range(problem.n // 6):
        linear = slice(6 * body, 6 * body + 3)
        normal, tangent = J[:, linear], D[:, linear].reshape(-1, 2, 3)
        assert np.abs(np.einsum("mi,mki->mk", normal, tangent)).max() <= ROUNDING
        assert np.abs(np.einsum("mi,mi->m", tangent[:, 0], tangent[:, 1])).max() <= ROUNDING


@every_instance
def test_references_fit_the_problem_and_conserve_what_it_conserves(instance: Instance) -> None:
    scenario = build(instance)
    problem = scenario.problem
    if problem.m > SMALL or scenario.parameters.get("mass_ratio", 1.0) == 1e6:
        return
    names = [(reference.name, reference.laws) for reference in scenario.references]
    assert len(set(names)) == len(names)
    for reference in scenario.references:
        assert reference.source
        assert reference.uncertainty >= 0
        if reference.quantity is Quantity.ITERATIONS:
            assert reference.value.shape == (1,)
            continue
        assert reference.value.shape == (problem.n,)
        mass = problem.mass.diagonal()
        tolerance = ROUNDING + reference.uncertainty * float(mass.sum())
        for invariant in scenario.invariants:
            momentum = invariant.direction @ (problem.mass @ (reference.value - problem.v_pre))
            assert abs(momentum) <= tolerance * max(1.0, np.abs(invariant.direction).max()), reference.name
        if (problem.restitution == 1.0).all() and not problem.has_friction:
            change = problem.kinetic_energy(reference.value) - problem.kinetic_energy(problem.v_pre)
            # K changes by M v · δv: the speeds of all scenes are at most 4.
            assert abs(change) <= 4.0 * tolerance, reference.name
        if not reference.laws:
            assert (problem.J @ reference.value).min() >= -ROUNDING - 4.0 * reference.uncertainty, reference.name


@every_instance
def test_the_laws_reach_the_closed_forms_that_are_said_to_be_theirs(instance: Instance) -> None:
    scenario = build(instance)
    # The ODE reference is nobody's closed form and takes time.
    known = [make for make in scenario.reference_builders if cast("partial[Reference]", make).func is not hertz]
    for reference in (make() for make in known):
        for law in reference.laws:
            solution = SOLVERS[law]().solve(scenario.problem)
            if reference.quantity is Quantity.ITERATIONS:
                assert solution.iterations == reference.value[0], (law, reference.name)
            else:
                # The laws' own tolerances are 1e-10 and tighter; a light ball is √M times as fast.
                bound = 1e-9 * max(1.0, np.abs(reference.value).max()) + reference.uncertainty
                assert np.abs(solution.v_post - reference.value).max() <= bound, (law, reference.name)


def value_of(scenario: Scenario, name: str) -> npt.NDArray[np.float64]:
    found = [reference.value for reference in scenario.references if reference.name == name]
    assert len(found) == 1, [reference.name for reference in scenario.references]
    return found[0]


@pytest.mark.parametrize("va", [0.0, 0.25, 0.5, 1.0])
def test_ideal_exchange_of_three_balls_is_that_of_payr_2008(va: float) -> None:
    assert value_of(CATALOG["three-ball-chain"](va=va), "ideal exchange") == pytest.approx([-1.0, 0.0, va], abs=0)


def test_ideal_cradle_sends_off_as_many_balls_as_came() -> None:
    assert value_of(CATALOG["newtons-cradle"](balls=5, moving=2), "ideal exchange") == pytest.approx([0, 0, 0, 1, 1])


def test_a_wall_sends_the_ideal_column_back() -> None:
    assert value_of(CATALOG["bead-column"](beads=3), "ideal exchange") == pytest.approx([1, 1, 1])
    assert value_of(CATALOG["bead-column"](beads=3, start="struck"), "ideal exchange") == pytest.approx([0, 0, 1])


def test_qce_closed_form_of_three_balls_at_one_half() -> None:
    value = value_of(CATALOG["three-ball-chain"](va=0.5), "QCE closed form")
    assert value == pytest.approx([-1.045820, 0.212486, 0.333333], abs=SIX_DECIMALS)


@pytest.mark.parametrize(
    ("va", "expected"),
    [
        (0.0, [-0.994549, -0.076403, 0.070952]),
        (0.25, [-0.997095, -0.013881, 0.260976]),
        (0.5, [-0.999242, -0.002267, 0.501508]),
    ],
)
def test_hertz_outcome_of_three_balls(va: float, expected: list[float]) -> None:
    assert value_of(CATALOG["three-ball-chain"](va=va), "Hertz") == pytest.approx(expected, abs=SIX_DECIMALS)


def test_bernoulli_with_equal_balls_sends_the_striker_back_at_a_fifth() -> None:
    value = value_of(CATALOG["bernoulli"](), "Bernoulli closed form")
    assert value == pytest.approx([-0.2, 0, 0.6, np.sqrt(3) / 5, 0.6, -np.sqrt(3) / 5], abs=ROUNDING)


@pytest.mark.parametrize("mass_ratio", [1.0, 12.1, 23.3])
def test_hertz_agrees_with_the_closed_form_of_bernoulli(mass_ratio: float) -> None:
    scenario = CATALOG["bernoulli"](mass_ratio=mass_ratio)
    assert value_of(scenario, "Hertz") == pytest.approx(value_of(scenario, "Bernoulli closed form"), abs=SIX_DECIMALS)


@pytest.mark.parametrize(
    ("mass_ratio", "count"), [(1, 3), (3, 5), (10, 10), (100, 31), (1e3, 99), (1e4, 314), (1e6, 3141)]
)
def test_a_ball_under_a_heavy_one_counts_the_digits_of_pi(mass_ratio: float, count: int) -> None:
    assert billiard_count(mass_ratio) == count


@pytest.mark.parametrize(
    ("name", "parameters", "field"),
    [
        ("three-ball-chain", {"va": 1.5}, "va"),
        ("three-ball-chain", {"va": float("nan")}, "va"),
        ("three-ball-chain", {"masses": [1.0, 2.0]}, "masses"),
        ("three-ball-chain", {"masses": [1.0, 0.0, 2.0]}, r"masses\[1\]"),
        ("three-ball-chain", {"restitution": 1.1}, "restitution"),
        ("newtons-cradle", {"balls": 1}, "balls"),
        ("newtons-cradle", {"balls": 3, "moving": 3}, "moving"),
        ("newtons-cradle", {"balls": 2.5}, "balls"),
        ("disturbed-cradle", {"size": -1.0}, "size"),
        ("disturbed-cradle", {"seed": -1}, "seed"),
        ("three-ball-bounce", {"speed": -1.0}, "speed"),
        ("bernoulli", {"mass_ratio": 0.0}, "mass_ratio"),
        ("bernoulli", {"friction": -0.1}, "friction"),
        ("pool-break", {"rack": "square"}, "rack"),
        ("pool-break", {"balls": 14}, "balls"),
        ("pool-break", {"rack": "nine-ball", "balls": 15}, "balls"),
        ("pool-break", {"struck": "twice"}, "struck"),
        ("four-ball-circle", {"start": "sideways"}, "start"),
        ("bead-column", {"beads": 0}, "beads"),
        ("bead-column", {"stiffness_ratio": 0.0}, "stiffness_ratio"),
        ("mass-ratio-chain", {"mass_ratio": 0.5}, "mass_ratio"),
        ("mass-ratio-chain", {"variant": "wall"}, "variant"),
        ("mass-ratio-chain", {"balls": 5}, "balls"),
        ("box-on-floor", {"points": 7}, "points"),
        ("box-on-floor", {"points": 2}, "points"),
        ("box-on-floor", {"copies": 0}, "copies"),
        ("box-on-floor", {"spin": [1.0]}, "spin"),
        ("box-on-floor", {"slide": float("inf")}, "slide"),
        ("ball-between-walls", {"balls": 0}, "balls"),
        ("ball-ring", {"balls": 2}, "balls"),
        ("ball-ring", {"start": "none"}, "start"),
        ("sphere-pack", {"spheres": 99}, "spheres"),
        ("sphere-pack", {"start": "cold"}, "start"),
        ("sphere-pack", {"seed": True}, "seed"),
    ],
)
def test_a_wrong_parameter_is_named_with_its_rule(name: str, parameters: dict[str, object], field: str) -> None:
    with pytest.raises(ProblemError, match=f"^{field} must "):
        CATALOG[name](**parameters)


@pytest.mark.parametrize("name", CATALOG)
def test_a_family_describes_itself_in_one_line(name: str) -> None:
    call, summary = describe(name)
    assert call.startswith(f"{name}(")
    assert summary.endswith(".")


@pytest.mark.parametrize("instance", [instance for instance in EVERY if instance[0] != "sphere-pack"], ids=name_of)
def test_a_scene_is_tagged_jammed_where_no_motion_opens_all_contacts(instance: Instance) -> None:
    scenario = build(instance)
    assert (interior_margin(scenario.problem) <= INTERIOR_TOLERANCE) == ("jammed" in scenario.tags)


def test_a_layer_leaves_room_to_open() -> None:
    assert interior_margin(CATALOG["sphere-pack"](spheres=100).problem) > INTERIOR_TOLERANCE


def test_a_contact_entered_twice_has_half_the_stiffness() -> None:
    once, twice = CATALOG["box-on-floor"]().problem, CATALOG["box-on-floor"](copies=2).problem
    assert twice.m == 2 * once.m
    assert np.sum(twice.stiffness) == np.sum(once.stiffness)


@pytest.mark.parametrize(
    ("parameters", "contacts"),
    [
        ({}, 31),
        ({"balls": 55}, 136),
        ({"rack": "nine-ball"}, 17),
        ({"struck": "both"}, 32),
        ({"balls": 55, "struck": "both"}, 138),
        ({"rack": "nine-ball", "struck": "both"}, 18),
    ],
)
def test_racks_touch_where_their_geometry_says(parameters: dict[str, object], contacts: int) -> None:
    scenario = CATALOG["pool-break"](**parameters)
    assert scenario.positions is not None
    distance = np.linalg.norm(scenario.positions[:, None] - scenario.positions[None], axis=2)
    distance = distance[np.triu_indices(len(distance), 1)]
    assert scenario.problem.m == contacts == (distance < 1.0 + ROUNDING).sum()
    assert distance.min() > 1.0 - ROUNDING


def test_balls_of_the_ring_and_the_circle_touch_their_neighbors() -> None:
    for name, diameter in (("ball-ring", 1.0), ("four-ball-circle", 2.0)):
        centers = CATALOG[name]().positions
        assert centers is not None
        gaps = np.linalg.norm(centers - np.roll(centers, -1, axis=0), axis=1) - diameter
        assert np.abs(gaps).max() <= ROUNDING


def test_a_disturbance_is_as_large_as_it_says_and_keeps_the_momentum() -> None:
    calm = CATALOG["newtons-cradle"](balls=6).problem
    for seed in range(5):
        disturbed = CATALOG["disturbed-cradle"](balls=6, size=1e-3, seed=seed).problem
        difference = np.abs(disturbed.u_pre - calm.u_pre)
        assert 0 < difference.max() <= 1e-3 * (1 + ROUNDING)
        assert abs(disturbed.v_pre.sum() - calm.v_pre.sum()) <= ROUNDING


@pytest.mark.parametrize(("spheres", "seed"), [(100, 0), (1000, 0), (1000, 1), (4000, 2)])
def test_spheres_of_a_layer_do_not_overlap_and_rest_on_a_floor(spheres: int, seed: int) -> None:
    centers = layer(spheres, seed)
    contacts = layer_contacts(centers)
    width = cell_width(spheres)
    pairs = contacts.first >= 0
    offset = centers[contacts.second[pairs]] - centers[contacts.first[pairs]]
    offset[:, :2] -= width * np.round(offset[:, :2] / width)
    # Centers are the outcome of up to a few hundred roots: 1e-9 of a diameter is rounding.
    assert np.linalg.norm(offset, axis=1).min() >= 1.0 - 1e-9
    assert centers[:, 2].min() >= RADIUS - 1e-9
    assert np.abs(np.linalg.norm(contacts.normals, axis=1) - 1.0).max() <= ROUNDING
    # 0.13 of all spheres were measured to stand on the floor, and 3.04 contacts a sphere; small layers scatter.
    assert (~pairs).sum() >= spheres / 20
    assert 2.9 <= contacts.m / spheres <= 3.2


def test_every_sphere_lies_on_three_others_or_on_the_floor() -> None:
    centers = layer(1000, 3)
    width = cell_width(1000)
    for index in np.flatnonzero(centers[:, 2] > RADIUS + 1e-9):
        offset = centers[:index] - centers[index]
        offset[:, :2] -= width * np.round(offset[:, :2] / width)
        assert (np.abs(np.linalg.norm(offset, axis=1) - 1.0) <= 1e-9).sum() >= 3


def test_a_layer_is_made_of_its_seed_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("IMPACTBENCH_CACHE", str(tmp_path))
    made, kept = layer(200, 7), layer(200, 7)
    monkeypatch.setenv("IMPACTBENCH_CACHE", str(tmp_path / "other"))
    again, other = layer(200, 7), layer(200, 8)
    assert made.tobytes() == kept.tobytes() == again.tobytes()
    assert made.tobytes() != other.tobytes()


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 half an archive"])
def test_a_spoiled_cache_is_made_anew(content: bytes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("IMPACTBENCH_CACHE", str(tmp_path))
    made = layer(150, 0)
    (file,) = tmp_path.iterdir()
    file.write_bytes(content)
    assert layer(150, 0).tobytes() == made.tobytes()
    assert file.stat().st_size > len(content)


def test_a_cache_with_other_numbers_is_made_anew(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("IMPACTBENCH_CACHE", str(tmp_path))
    made = layer(150, 0)
    (file,) = tmp_path.iterdir()
    with np.load(file) as archive:
        np.savez(file, centers=archive["centers"] + 1e-3, digest=archive["digest"])
    assert layer(150, 0).tobytes() == made.tobytes()


def test_a_cache_that_cannot_be_written_costs_time_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    monkeypatch.setenv("IMPACTBENCH_CACHE", str(in_the_way / "folder"))
    assert layer(150, 0).shape == (150, 3)
    monkeypatch.delenv("IMPACTBENCH_CACHE")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert layer(150, 0).shape == (150, 3)


def test_starts_of_a_pack_differ_as_they_say() -> None:
    velocity = {
        start: CATALOG["sphere-pack"](spheres=1000, start=start).problem.v_pre.reshape(-1, 3)
        for start in ("kick", "hot", "patch")
    }
    assert (velocity["kick"] == [0.0, 0.0, -1.0]).all()
    # Means and deviations of 1,000 Gaussian numbers: five standard errors.
    assert np.abs(velocity["hot"].mean(axis=0) - [0, 0, -1]).max() <= 5 / np.sqrt(1000)
    assert np.abs(velocity["hot"].std(axis=0) - 1).max() <= 5 / np.sqrt(2000)
    moving = velocity["patch"][:, 2] == -1.0
    assert 0 < moving.sum() < 100
    assert (velocity["patch"][~moving] == 0).all()


@pytest.mark.kernels
def test_a_small_layer_is_the_same_everywhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("IMPACTBENCH_CACHE", str(tmp_path))
    centers = layer(100, 5)
    assert (centers[:, 2] < RADIUS + GAP).any()
    # Compiled and interpreted alike; a changed value means that GENERATOR must change too.
    assert centers[99] == pytest.approx([1.4073640698214755, 0.8785896847204486, 4.916522454431575], abs=1e-9)
    assert centers.sum() == pytest.approx(690.0957670779792, abs=1e-7)


@pytest.mark.long
def test_a_thousand_spheres_leave_room_to_open() -> None:
    assert interior_margin(CATALOG["sphere-pack"]().problem) > INTERIOR_TOLERANCE


@pytest.mark.long
def test_a_layer_of_sixty_thousand_has_no_overlap() -> None:
    centers = layer(60_000, 0)
    contacts = layer_contacts(centers)
    pairs = contacts.first >= 0
    offset = centers[contacts.second[pairs]] - centers[contacts.first[pairs]]
    width = cell_width(60_000)
    offset[:, :2] -= width * np.round(offset[:, :2] / width)
    assert np.linalg.norm(offset, axis=1).min() >= 1.0 - 1e-9

"""Records of patterns: small files that say all that the report says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import impactbench
from harness.patterns import EVERY, UNIT, PatternRecord, read_record, record_of_run, write_record
from harness.selection import choose_moving, choose_resolver
from harness.simulation import Schedule, Simulation
from harness.simulation import simulate as run_simulation
from harness.store import StoreError
from harness.trajectory import read_frames
from reports.patterns import patterns_markdown, standing_since
from scenarios.patterns import CELLS, faultless_map, height_map
from solvers.solution import Floats

# Deflated heights of a hundredth of a grain that are all noise take up to 20 kB a map; 100 of them must stay small.
LARGEST = 2_000_000
FACTS = {
    "scene": "extended-pattern:pattern=squares", "side": 100.0, "steps_per_cycle": 400, "solver": "qce-lcp-fast",
    "seed": 0, "steps": 40_000, "iterations": [5.6, 23, 0], "contacts": [1e4, 52104], "sweeps": 9.9, "converged": 0.05,
    "overlap": [0.1, 0.2], "wall_s": [0.05, 0.03, 12.0],
    "machine": {"impactbench": "0", "commit": "c" * 40, "python": "3", "numba": "0", "cpu": "any", "cores": 2},
}  # fmt: skip


def waves(directions: int) -> Floats:
    """A pattern of four waves across, ten grains high."""
    return 10.0 + faultless_map(directions, 4.0)


def record(pattern: str, *maps: Floats) -> PatternRecord:
    return PatternRecord({**FACTS, "pattern": pattern}, EVERY * np.arange(1, len(maps) + 1), np.array(maps))


def test_a_record_comes_back_to_a_hundredth_of_a_grain(tmp_path: Path) -> None:
    heights = waves(2)
    heights[3, 4] = np.nan
    written = record("squares", heights, waves(1))
    again = read_record(write_record(tmp_path / "squares.npz", written))
    assert np.nanmax(np.abs(again.heights - written.heights)) <= 0.5 * UNIT * (1.0 + 1e-9)
    assert np.array_equal(np.isnan(again.heights), np.isnan(written.heights))
    assert again.run == written.run
    assert again.cycles.tolist() == [10, 20]


def test_a_hundred_maps_fit_into_two_megabytes(tmp_path: Path) -> None:
    # As rough as the layer whose squares are tallest: waves of ten grains with noise of one.
    random = np.random.default_rng(0)
    rough = record("squares", *(waves(2) * 5.0 + random.standard_normal((CELLS, CELLS)) for _ in range(100)))
    assert write_record(tmp_path / "squares.npz", rough).stat().st_size < LARGEST


def test_a_last_map_of_the_other_phase_stands_beside_the_others_and_is_not_one_of_them(tmp_path: Path) -> None:
    maps = record("squares", waves(2), waves(2), waves(1))
    odd = PatternRecord(maps.run, np.array([10, 20, 21]), maps.heights)
    again = read_record(write_record(tmp_path / "squares.npz", odd))
    assert again.tenths == 2
    assert standing_since(again) == 10
    page = patterns_markdown([again])
    assert "| squares | here | 20 | 25.0 |" in page
    assert "| here, the other phase | 21 | 25.0 |" in page


def test_a_pattern_stands_from_the_map_on_after_which_none_misses_it() -> None:
    stripes, squares = waves(1), waves(2)
    assert standing_since(record("squares", squares, stripes, squares, squares)) == 30
    assert standing_since(record("squares", squares, squares, stripes)) is None
    assert standing_since(record("stripes", stripes, stripes)) == 10
    assert standing_since(record("hexagons", squares)) is None


def test_the_page_sets_each_run_beside_the_published_panel() -> None:
    page = patterns_markdown([record("squares", waves(2)), record("flat", waves(1))])
    assert "| squares | here | 10 | 25.0 |" in page
    assert "from cycle 10 on" in page
    assert "| Bizon 1998 | 680 | 33.3 | 0.087 | 0.833 | 0.064 |" in page
    assert "| flat | here | 10 | 25.0 |" in page
    assert "none is expected" in page
    assert "| Zhang 2015 | 13 / 46 / 1 | 0.28 / 2.74 |" in page
    assert "| squares | 3.0 | any angle | 0.00 - 0.01 (< 0.1) | 0.58 - 0.85 (> 0.75) |" in page
    assert "| squares, here at cycle 10 |  | 0° | 0.00 |" in page
    assert "## Patterns without a fault" not in patterns_markdown([record("flat", waves(1))])


def test_runs_with_other_settings_stand_beside_each_other_by_what_differs() -> None:
    scene = "extended-pattern:pattern=squares,friction=0.5"
    plain, other = (
        PatternRecord({**FACTS, "pattern": "squares", "scene": text}, np.array(cycles), np.array(maps))
        for text, cycles, maps in (
            (scene, [10], [waves(2)]),
            (f"{scene},tangential_restitution=0.35", [10, 20], [waves(2), waves(1)]),
        )
    )
    page = patterns_markdown([other, record("flat", waves(1))], [plain, record("hexagons", waves(3))])
    assert "| squares | tangential_restitution=0.35 | 10 | 25.0 |" in page
    assert "|  | no tangential_restitution | 10 | 25.0 |" in page
    assert "no; it shows in 1 of 2 maps" in page
    table = page.partition("## Beside other settings")[2].partition("##")[0]
    assert "hexagons" not in table
    assert "flat" not in table
    assert "## Beside other settings" not in patterns_markdown([other])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten cycles of a few grains: the files of a run, whatever it shows."""
    folder = tmp_path_factory.mktemp("run")
    scene = choose_moving("extended-pattern:pattern=flat,side=4,steps_per_cycle=300")
    specification, law = choose_resolver("qce-lcp-fast")
    schedule = Schedule(10 * scene.steps_per_cycle, EVERY * scene.steps_per_cycle, 10_000)
    run_simulation(Simulation(scene, specification, law, 0), folder, schedule, command="test")
    return folder


def test_a_run_is_recorded_with_the_maps_of_its_frames(run: Path) -> None:
    found = record_of_run(run)
    assert found.pattern == "flat"
    assert found.cycles.tolist() == [10]
    (last,) = [frame for frame in read_frames(run) if frame.step == 3000]
    expected = height_map(last.place.astype(np.float64), 4.0)
    assert found.heights[0] == pytest.approx(expected, abs=UNIT, nan_ok=True)
    assert found.run["steps"] == 3000


def command(*words: str) -> tuple[int, str]:
    found = CliRunner().invoke(impactbench.main, ["patterns", *words])
    return found.exit_code, found.output


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_report_is_the_same_from_the_records_alone(run: Path, tmp_path: Path) -> None:
    code, said = command(str(run), "--out", str(tmp_path / "patterns"))
    assert code == 0, said
    first = files(tmp_path / "patterns")
    assert {"flat.npz", "patterns.md", "patterns.png", "pattern_growth.pdf", "pattern_measures.svg"} <= set(first)
    code, said = command("--out", str(tmp_path / "patterns"))
    assert code == 0, said
    assert files(tmp_path / "patterns") == first


def broken(folder: Path) -> None:
    (folder / "squares.npz").write_bytes(b"nonsense")


def cut_off(folder: Path) -> None:
    path = write_record(folder / "squares.npz", record("squares", waves(2)))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("prepare", "said"),
    [
        (lambda _: None, "holds no records of patterns"),
        (broken, "no record of a pattern"),
        (cut_off, "no record of a pattern"),
    ],
)
def test_a_folder_without_sound_records_is_named(prepare: Callable[[Path], None], said: str, tmp_path: Path) -> None:
    prepare(tmp_path)
    code, output = command("--out", str(tmp_path))
    assert code == 2
    assert said in output
    assert "Traceback" not in output


def test_records_beside_are_read_and_a_folder_without_any_is_named(tmp_path: Path) -> None:
    own, other = tmp_path / "own", tmp_path / "other"
    own.mkdir()
    other.mkdir()
    write_record(own / "squares.npz", record("squares", waves(2)))
    code, said = command("--out", str(own), "--beside", str(other))
    assert code == 2
    assert "--beside" in said
    assert "holds no records of patterns" in said
    write_record(other / "squares.npz", record("squares", waves(1)))
    code, said = command("--out", str(own), "--beside", str(other))
    assert code == 0, said
    assert "## Beside other settings" in said


def test_a_run_too_short_for_a_map_is_refused_with_what_to_do(tmp_path: Path) -> None:
    scene = choose_moving("extended-pattern:side=4,steps_per_cycle=300")
    specification, law = choose_resolver("qce-lcp-fast")
    run_simulation(Simulation(scene, specification, law, 0), tmp_path, Schedule(10, 10, 10), command="test")
    with pytest.raises(StoreError, match="run more cycles, with --frames 3000"):
        record_of_run(tmp_path)


def test_a_run_of_another_scene_is_refused(tmp_path: Path) -> None:
    scene = choose_moving("pool-break")
    specification, law = choose_resolver("qce")
    run_simulation(Simulation(scene, specification, law, 0), tmp_path, Schedule(1, 1, 10), command="test")
    with pytest.raises(StoreError, match="a run of pool-break, not of extended-pattern"):
        record_of_run(tmp_path)

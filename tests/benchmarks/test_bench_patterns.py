"""Wavelengths of vibrated layers in boxes smaller than the published one; `pytest -m long -s tests/benchmarks`.

A box of side L tells apart L, L/2, L/3, …: each side is a whole number of published wavelengths to within 1 %, and the
neighbors of that shell are a third of a wavelength off or more.
"""

from __future__ import annotations

from typing import Any

import pytest

from scenarios.granular import PUBLISHED, extended_pattern

pytestmark = pytest.mark.long


@pytest.mark.parametrize(("pattern", "side", "cycles"), [("hexagons", 50, 40), ("squares", 67, 10)])
def test_a_smaller_box_shows_the_published_wavelength(benchmark: Any, pattern: str, side: int, cycles: int) -> None:
    scene = extended_pattern(pattern=pattern, side=side)
    world = scene.world()

    def run() -> list[float]:
        found = []
        for _ in range(cycles):
            for _ in range(scene.steps_per_cycle):
                world.step()
            found.append(scene.measure(world)["wavelength [D]"])
        return found

    wavelengths = benchmark.pedantic(run, rounds=1)
    published = PUBLISHED[pattern].wavelength
    assert published is not None
    benchmark.extra_info.update(wavelengths=wavelengths, published=published)
    print(f"{pattern}, side {side} D: wavelength by cycle {[round(value, 1) for value in wavelengths]}, {published} D")
    assert wavelengths[-1] == pytest.approx(side / round(side / published))

"""Patterns of a layer seen from above: the height map, its wavelength, and Q2, Q4, Q6.

    Q_m = |Σ P(k) exp(i m θ_k)| / Σ P(k)      over the strongest radial shell of the power P = |FFT(h)|²

The map is the highest surface in each of 100 × 100 cells; cells without a grain take the median; then a Gaussian of two
cells, the mean removed, and a Hann window. Stripes have Q2 > 0.8, squares Q4 > 0.75 and Q2 < 0.1, hexagons Q6 about
0.48 and Q2 about 0.05 (measured on the panels of Bizon 1998). Only wavelengths side/1, side/2, … are told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from solvers.solution import Floats

CELLS = 100
"""Cells along each side of the height map."""
# Standard deviation of the Gaussian [cells]: a grain is about a cell wide.
SMOOTHING = 2.0


@dataclass(frozen=True)
class Pattern:
    """What a height map shows."""

    wavelength: float
    """Of the strongest shell, in the unit of `side`."""
    share: float
    """Share of all power that lies in the strongest shell."""
    roughness: float
    """Standard deviation of the smoothed heights, in the unit of the heights."""
    q2: float
    q4: float
    q6: float


def height_map(place: Floats, side: float) -> Floats:
    """Highest surface above each cell of the floor, NaN where there is no grain; shape (CELLS, CELLS).

    Args:
        place: centers and radii, shape (grains, 4).
        side: of the square floor from (0, 0) to (side, side), in the same unit.
    """
    x, y = (np.clip((place[:, k] * (CELLS / side)).astype(np.intp), 0, CELLS - 1) for k in range(2))
    highest = np.full((CELLS, CELLS), -np.inf)
    np.maximum.at(highest, (x, y), place[:, 2] + place[:, 3])
    return np.where(np.isfinite(highest), highest, np.nan)


def measure_pattern(heights: Floats, side: float) -> Pattern:
    """Measure the pattern of a height map, shape (CELLS, CELLS), NaN where there is no grain.

    Args:
        heights: the map.
        side: of the floor.
    """
    filled = np.where(np.isnan(heights), np.nanmedian(heights), heights)
    smooth = gaussian_filter(filled, SMOOTHING)
    window = np.hanning(len(smooth))
    waves = np.fft.fft2((smooth - smooth.mean()) * np.outer(window, window))
    power = np.abs(waves) ** 2
    k = np.fft.fftfreq(len(smooth), 1.0 / len(smooth))
    kx, ky = np.meshgrid(k, k, indexing="ij")
    shell = np.rint(np.hypot(kx, ky)).astype(np.intp)
    power[0, 0] = 0.0
    strength = np.bincount(shell.ravel(), power.ravel())
    strongest = int(np.argmax(strength[1:])) + 1
    inside = shell == strongest
    angle, weight = np.arctan2(ky[inside], kx[inside]), power[inside]
    q2, q4, q6 = (float(np.abs((weight * np.exp(1j * m * angle)).sum() / (weight.sum() or 1.0))) for m in (2, 4, 6))
    total = float(power.sum())
    return Pattern(side / strongest, float(strength[strongest]) / (total or 1.0), float(smooth.std()), q2, q4, q6)

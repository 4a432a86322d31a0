"""Patterns of a layer seen from above: the height map, its wavelength, and Q2, Q4, Q6.

    Q_m = |Σ P(k) exp(i m θ_k)| / Σ P(k)      over the strongest radial shell of the power P = |FFT(h)|²

The map is the highest surface in each of 100 × 100 cells; cells without a grain take the median; then a Gaussian of two
cells, the mean removed, and a Hann window. Stripes have Q2 > 0.8, squares Q4 > 0.75 and Q2 < 0.1, hexagons Q6 about
0.48 and Q2 about 0.05 (measured on the panels of Bizon 1998). Only wavelengths side/1, side/2, … are told apart.

A box of a few wavelengths holds few peaks, some of them held by the walls, and one row that is out of step turns the
phases of all waves: Q_m of a lattice with defects says little. Two more measures look at what does not need order far
and wide. Each peak's neighbors (Delaunay triangulation, the bonds that are much longer than most left out) give

    ψ_m = mean of |Σ_j exp(i m θ_j)| / bonds     over the peaks that do not lie at a wall

1 for m = 6 on a triangular lattice, 1 for m = 4 on a square one (Nelson and Halperin 1979), about 0.5 both for 18 peaks
at random (`tests/test_patterns.py`). And the skewness of the
heights tells peaks (> 0) from cells with walls (< 0): hexagons show one in one cycle and the other in the next, as what
is up has another symmetry than what is down, while squares and stripes show the same in both, displaced.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import center_of_mass, gaussian_filter, label, maximum_filter
from scipy.spatial import Delaunay, QhullError
from scipy.stats import skew

from solvers.solution import Floats

CELLS = 100
"""Cells along each side of the height map."""
# Standard deviation of the Gaussian [cells]: a grain is about a cell wide.
SMOOTHING = 2.0
# Heights that differ by less than this share of the largest are the same but for rounding.
FLAT = 1e-9
# A peak is the highest cell in a square of this share of the wavelength, on a map smoothed by another share of it: a
# grain that flies above all others is none.
PEAK, PEAK_SMOOTHING = 0.6, 0.15
# Closer to a wall than this share of the wavelength, a peak has neighbors on one side alone.
WALL = 0.75
# Bonds longer than this many times their lower quartile are none: the diagonals of squares are √2 times as long as the
# sides.
LONGEST_BOND = 1.3
# Fewer peaks than this away from the walls say nothing.
FEWEST_PEAKS = 3


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
    skewness: float
    """Of the smoothed heights: > 0 for peaks, < 0 for cells with walls."""
    psi4: float
    """ψ4, order of four neighbors about the peaks (or the cells); NaN where there are too few."""
    psi6: float
    """ψ6, of six neighbors."""
    mean_wavelength: float = np.nan
    """Of the mean wave number of the strongest shell and its two neighbors: finer than side/1, side/2, …"""
    turns: Mapping[int, float] = field(default_factory=dict)
    """m → how far waves of m-fold order are turned against the first axis [rad], in [0, 2π/m)."""


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


def faultless_map(directions: int, waves: float, turn: float = 0.0, shift: float = 0.0) -> Floats:
    """Height map of standing waves without a fault, shape (CELLS, CELLS): what the measures can reach at most.

    Args:
        directions: 1 for stripes, 2 for squares, 3 for hexagons.
        waves: wavelengths across the floor.
        turn: of the first wave against the walls [rad].
        shift: of the pattern along the first axis [wavelengths].
    """
    x, y = np.meshgrid(*2 * [waves * (np.arange(CELLS) + 0.5) / CELLS], indexing="ij")
    angles = turn + np.pi * np.arange(directions) / directions
    return np.asarray(sum(np.cos(2.0 * np.pi * (np.cos(a) * (x + shift) + np.sin(a) * y)) for a in angles))


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
    length = np.hypot(kx, ky)
    shell = np.rint(length).astype(np.intp)
    power[0, 0] = 0.0
    strength = np.bincount(shell.ravel(), power.ravel())
    strongest = int(np.argmax(strength[1:])) + 1
    inside, near = shell == strongest, np.abs(shell - strongest) <= 1
    mean_number = float((power[near] * length[near]).sum() / (power[near].sum() or 1.0)) or np.nan
    angle, weight = np.arctan2(ky[inside], kx[inside]), power[inside]
    order = {m: (weight * np.exp(1j * m * angle)).sum() / (weight.sum() or 1.0) for m in (2, 4, 6)}
    q2, q4, q6 = (float(np.abs(of_m)) for of_m in order.values())
    turns = {m: float(np.angle(of_m) % (2.0 * np.pi) / m) for m, of_m in order.items()}
    total = float(power.sum())
    skewness = float(skew(smooth, axis=None)) if np.ptp(smooth) > FLAT * np.abs(smooth).max() else 0.0
    psi4, psi6 = _bond_order(filled if skewness >= 0.0 else -filled, len(filled) / strongest)
    share = float(strength[strongest]) / (total or 1.0)
    return Pattern(
        side / strongest, share, float(smooth.std()), q2, q4, q6, skewness, psi4, psi6, side / mean_number, turns
    )


def _bond_order(heights: Floats, wavelength: float) -> tuple[float, float]:
    """ψ4 and ψ6 of the peaks of a map, with a wavelength in cells; NaN where there are too few."""
    smooth = gaussian_filter(heights, PEAK_SMOOTHING * wavelength)
    high = smooth > smooth.mean() + FLAT * np.abs(smooth).max()
    # Cells of the same height side by side are one peak.
    peak, count = label((smooth == maximum_filter(smooth, max(round(PEAK * wavelength), 1))) & high, np.ones((3, 3)))
    place = np.array(center_of_mass(peak > 0, peak, np.arange(1, count + 1))).reshape(-1, 2)
    inner = ((place > WALL * wavelength) & (place < len(heights) - WALL * wavelength)).all(axis=1)
    if inner.sum() < FEWEST_PEAKS:
        return np.nan, np.nan
    try:
        starts, neighbor = Delaunay(place).vertex_neighbor_vertices
    except QhullError:
        # All peaks on a line: there are no triangles.
        return np.nan, np.nan
    owner = np.repeat(np.arange(len(place)), np.diff(starts))
    bond = (place[neighbor] - place[owner]).astype(np.float64)
    length = np.hypot(bond[:, 0], bond[:, 1])
    kept = length <= LONGEST_BOND * np.quantile(length, 0.25)
    owner, angle = owner[kept], np.arctan2(bond[kept, 1], bond[kept, 0])
    bonds = np.bincount(owner, minlength=len(place))
    found = []
    for m in (4, 6):
        along, across = (np.bincount(owner, part(m * angle), len(place)) for part in (np.cos, np.sin))
        found.append(float((np.hypot(along, across) / np.maximum(bonds, 1))[inner & (bonds > 0)].mean()))
    return found[0], found[1]

"""Tracks for balls: a gutter swept along a smooth curve, with contacts in closed form instead of facets.

    sheet   p(t, φ) = c(t) + a (cos φ d + sin φ s),   |φ| ≤ φ₀      d: down, at a right angle to c'; s = c' × d / |c'|
    ball    gap = |x - p| - r,   n = (x - p) / |x - p|              at the point p of the sheet nearest to x

A ball of radius r < a rolls inside with its center a - r below the axis c. The axis is a cubic spline through given
points, so that direction and curvature have no jump, and neither has the normal: no ball is shaken by edges of facets.
The sheet is thin and holds from both sides; past its ends and rims a ball touches the edge and rolls over it.

The nearest point of a tube lies in the plane across the axis' nearest point while a is less than the radius of
curvature; on the rims of a bent gutter this holds to first order in a times the curvature only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from scenarios.parameters import check_number, check_positive
from scenarios.world.spheres import Ints
from solvers import ProblemError
from solvers._jit import kernel
from solvers.solution import Floats

# A direction steeper than this leaves no "down" across it: sine of its angle to the horizontal.
STEEPEST = 0.99
# Newton from the nearest knot doubles its digits with every pass; the knots lie close beside the radius of curvature.
NEWTON_PASSES = 6
# Points of the surface that is drawn across the gutter.
DRAWN_ACROSS = 13


@dataclass(frozen=True, eq=False)
class Gutter:
    """A round channel, open above, that does not move.

    Raises:
        ProblemError: names the field and the rule.
    """

    points: Floats
    """Points of the axis, in order [m], shape (points, 3), at least 4; see `straight`, `helix`, `joined`."""

    radius: float
    """a, of the inner surface about the axis [m]."""

    half_opening: float = 1.4
    """φ₀: half the angle that the channel covers, from its bottom to a rim, in [0.1, π] [rad]."""

    friction: float = 0.5
    """μ of its surface, combined with the ball's as that of two bodies."""

    restitution: float = 0.0
    """c_r of its surface, combined with the ball's."""

    name: str = "gutter"

    def __post_init__(self) -> None:
        check_positive("radius", self.radius)
        check_number("friction", self.friction, low=0.0)
        check_number("restitution", self.restitution, low=0.0, high=1.0)
        check_number("half_opening", self.half_opening, low=0.1, high=float(np.pi))
        points = np.ascontiguousarray(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4 or not np.isfinite(points).all():
            raise ProblemError(f"{self.name}: points must be at least 4 finite points in space, not {points.shape}")
        chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if chords.min() <= 0.0:
            raise ProblemError(
                f"{self.name}: points must differ from their neighbors: point {chords.argmin()} is twice"
            )
        object.__setattr__(self, "points", points)
        along = self.curve(self.knots, 1)
        if (np.abs(along[:, 2]) > STEEPEST * np.linalg.norm(along, axis=1)).any():
            raise ProblemError(f"{self.name}: points must not go straight up or down: there is no bottom")

    @cached_property
    def knots(self) -> Floats:
        """Parameter of each point: length of the chords up to it [m], shape (points,)."""
        chords = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(chords)])

    @cached_property
    def curve(self) -> CubicSpline:
        """The axis c(t), for t from 0 to the last knot."""
        return CubicSpline(self.knots, self.points)

    @cached_property
    def length(self) -> float:
        """Greatest parameter, the length of the chords [m]."""
        return float(self.knots[-1])

    def rest(self, along: float, ball: float) -> Floats:
        """Center of a ball that lies at the bottom [m], shape (3,).

        Args:
            along: parameter t of the axis, from 0 to `length`.
            ball: radius of the ball, < radius.
        """
        down, _ = self._across(np.array([along]))
        center: Floats = self.curve(along) + (self.radius - ball) * down[0]
        return center

    def direction(self, along: float) -> Floats:
        """Unit vector along the axis, shape (3,)."""
        tangent: Floats = self.curve(along, 1)
        return tangent / np.linalg.norm(tangent)

    def passed(self, center: Floats) -> float:
        """Parameter of the point of the axis nearest to a point of space: how far along a ball is [m]."""
        return float(_nearest(self.knots, self._coefficients, np.ascontiguousarray(center, dtype=np.float64)))

    def contacts(self, centers: Floats, radii: Floats, reach: float) -> tuple[Ints, Floats, Floats, Floats]:
        """Find the balls that touch the gutter, or are nearer than `reach`; each at one point.

        Args:
            centers: of the balls [m], shape (balls, 3).
            radii: of the balls [m], shape (balls,).
            reach: largest gap that counts [m].

        Returns:
            index of each ball found; point of contact [m], on the sheet; unit normal from the sheet to the ball; gap
            [m], < 0 penetrates. Shapes (m,), (m, 3), (m, 3), (m,).
        """
        near = np.flatnonzero(
            ((centers + (radii + reach)[:, None] > self._low) & (centers - (radii + reach)[:, None] < self._high))
            .all(axis=1)
        ).astype(np.int32)  # fmt: skip
        point, normal, distance = _touch(
            self.knots, self._coefficients, np.ascontiguousarray(centers[near]), self.radius, self.half_opening
        )
        gap = distance - radii[near]
        touching = gap <= reach
        return near[touching], point[touching], normal[touching], gap[touching]

    def mesh(self) -> tuple[Floats, Ints]:
        """The sheet as triangles, to be drawn.

        Returns:
            points [m], shape (points, 3); corners of each triangle, shape (triangles, 3).
        """
        along, rows = self.knots, self.knots.size
        down, side = self._across(along)
        angle = np.linspace(-self.half_opening, self.half_opening, DRAWN_ACROSS)
        outward = np.cos(angle)[None, :, None] * down[:, None] + np.sin(angle)[None, :, None] * side[:, None]
        points = (self.curve(along)[:, None] + self.radius * outward).reshape(-1, 3)
        first = (np.arange(rows - 1)[:, None] * DRAWN_ACROSS + np.arange(DRAWN_ACROSS - 1)).reshape(-1)
        right, above = first + 1, first + DRAWN_ACROSS
        corners = np.concatenate([np.column_stack([first, right, above]), np.column_stack([right, above + 1, above])])
        return points, corners.astype(np.int32)

    @cached_property
    def _coefficients(self) -> Floats:
        """Of the cubic of each interval, highest power first; shape (4, points - 1, 3)."""
        return np.ascontiguousarray(self.curve.c, dtype=np.float64)

    @cached_property
    def _low(self) -> Floats:
        """Lowest corner of a box around the sheet; the spline leaves the box of its points by less than a chord."""
        low: Floats = self.points.min(axis=0) - self.radius - float(np.diff(self.knots).max())
        return low

    @cached_property
    def _high(self) -> Floats:
        high: Floats = self.points.max(axis=0) + self.radius + float(np.diff(self.knots).max())
        return high

    def _across(self, along: Floats) -> tuple[Floats, Floats]:
        """Unit vectors down and sideways, at right angles to the axis; shape (along, 3) each."""
        tangent = self.curve(along, 1)
        tangent /= np.linalg.norm(tangent, axis=1)[:, None]
        down = tangent[:, 2:] * tangent - np.array([0.0, 0.0, 1.0])
        down /= np.linalg.norm(down, axis=1)[:, None]
        return down, np.cross(tangent, down)


def straight(start: Sequence[float], end: Sequence[float], *, spacing: float) -> Floats:
    """Points of a straight axis, both ends among them.

    Args:
        start: first point [m].
        end: last point [m].
        spacing: largest distance of two points, > 0 [m].
    """
    check_positive("spacing", spacing)
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    intervals = max(int(np.ceil(np.linalg.norm(last - first) / spacing)), 3)
    return first + np.linspace(0.0, 1.0, intervals + 1)[:, None] * (last - first)


def helix(
    center: Sequence[float], radius: float, *, angles: tuple[float, float], heights: tuple[float, float], spacing: float
) -> Floats:
    """Points of a helix about a vertical line.

    Args:
        center: x and y of the line [m].
        radius: distance from it [m].
        angles: of the first and the last point about it, from +x to +y [rad].
        heights: z of both [m]; falls evenly in between.
        spacing: largest distance of two points, > 0 [m].
    """
    check_positive("spacing", spacing)
    turned = angles[1] - angles[0]
    intervals = max(int(np.ceil(np.hypot(radius * turned, heights[1] - heights[0]) / spacing)), 3)
    share = np.linspace(0.0, 1.0, intervals + 1)
    angle = angles[0] + share * turned
    z = heights[0] + share * (heights[1] - heights[0])
    return np.column_stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle), z])


def ramp(start: Sequence[float], end: Sequence[float], *, spacing: float) -> Floats:
    """Points of an axis that is level at both ends and falls in between: z goes by half a cosine.

    Args:
        start: first point [m].
        end: last point [m].
        spacing: largest distance of two points, seen from above, > 0 [m].
    """
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    level = straight((first[0], first[1], 0.0), (last[0], last[1], 0.0), spacing=spacing)
    share = np.linspace(0.0, 1.0, len(level))
    level[:, 2] = last[2] + (first[2] - last[2]) * 0.5 * (1.0 + np.cos(np.pi * share))
    return level


def joined(*pieces: Floats) -> Floats:
    """One axis of several: where a piece begins where the last one ends, the point is taken once."""
    points = [pieces[0]]
    for piece in pieces[1:]:
        points.append(piece[1:] if np.allclose(piece[0], points[-1][-1]) else piece)
    return np.concatenate(points)


@kernel
def _nearest(knots: Floats, coefficients: Floats, center: Floats) -> float:
    """Parameter of the nearest point of a cubic spline: Newton for (c - x) · c' = 0 from the nearest knot."""
    intervals = knots.size - 1
    nearest = 0
    least = np.inf
    for k in range(intervals):
        distance = 0.0
        for axis in range(3):
            distance += (coefficients[3, k, axis] - center[axis]) ** 2
        if distance < least:
            least = distance
            nearest = k
    t = knots[nearest]
    k = nearest
    for _ in range(NEWTON_PASSES):
        s = t - knots[k]
        first = 0.0
        second = 0.0
        for axis in range(3):
            a = coefficients[0, k, axis]
            b = coefficients[1, k, axis]
            c = coefficients[2, k, axis]
            offset = ((a * s + b) * s + c) * s + coefficients[3, k, axis] - center[axis]
            slope = (3.0 * a * s + 2.0 * b) * s + c
            first += offset * slope
            second += slope * slope + offset * (6.0 * a * s + 2.0 * b)
        # Beyond the center of curvature there is no minimum nearby: stay.
        if second <= 0.0:
            break
        t = min(max(t - first / second, knots[0]), knots[intervals])
        while k > 0 and t < knots[k]:
            k -= 1
        while k < intervals - 1 and t > knots[k + 1]:
            k += 1
    return float(t)


@kernel
def _touch(
    knots: Floats, coefficients: Floats, centers: Floats, radius: float, half_opening: float
) -> tuple[Floats, Floats, Floats]:
    """Point of the sheet nearest to each center, unit vector from it to the center, and their distance."""
    count = centers.shape[0]
    point = np.empty((count, 3))
    normal = np.empty((count, 3))
    distance = np.empty(count)
    offset = np.empty(3)
    tangent = np.empty(3)
    down = np.empty(3)
    side = np.empty(3)
    for i in range(count):
        t = _nearest(knots, coefficients, centers[i])
        k = 0
        while k < knots.size - 2 and t > knots[k + 1]:
            k += 1
        s = t - knots[k]
        square = 0.0
        for axis in range(3):
            a = coefficients[0, k, axis]
            b = coefficients[1, k, axis]
            c = coefficients[2, k, axis]
            point[i, axis] = ((a * s + b) * s + c) * s + coefficients[3, k, axis]
            tangent[axis] = (3.0 * a * s + 2.0 * b) * s + c
            square += tangent[axis] ** 2
        # The plane across the axis.
        steepness = tangent[2] / square
        square = np.sqrt(square)
        level = 0.0
        for axis in range(3):
            offset[axis] = centers[i, axis] - point[i, axis]
            down[axis] = steepness * tangent[axis]
            tangent[axis] /= square
        down[2] -= 1.0
        for axis in range(3):
            level += down[axis] ** 2
        level = np.sqrt(level)
        for axis in range(3):
            down[axis] /= level
        side[0] = tangent[1] * down[2] - tangent[2] * down[1]
        side[1] = tangent[2] * down[0] - tangent[0] * down[2]
        side[2] = tangent[0] * down[1] - tangent[1] * down[0]
        below = 0.0
        aside = 0.0
        for axis in range(3):
            below += offset[axis] * down[axis]
            aside += offset[axis] * side[axis]
        angle = min(max(np.arctan2(aside, below), -half_opening), half_opening)
        # The sheet's point in that direction.
        distance[i] = 0.0
        for axis in range(3):
            outward = radius * (np.cos(angle) * down[axis] + np.sin(angle) * side[axis])
            point[i, axis] += outward
            normal[i, axis] = offset[axis] - outward
            distance[i] += normal[i, axis] ** 2
        distance[i] = np.sqrt(distance[i])
        for axis in range(3):
            normal[i, axis] /= distance[i]
    return point, normal, distance

"""Pictures of moving bodies: stills and short videos, colored by a number of each body or by what it is.

With the extra `render` spheres are drawn by PyVista (VTK) off-screen, one shaded point each with its true radius: a
mesh for every sphere takes a minute for 60,000 of them. Bodies of other shapes are drawn as one mesh of all their
triangles. Without the extra matplotlib draws discs or triangles from far to near, seen from the same side without
perspective.
"""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from reports.files import write_whole
from reports.scorecard import ReportError
from scenarios.world.rotation import rotation_matrix
from scenarios.world.spheres import Ints
from solvers.solution import Floats

Pixels = npt.NDArray[np.uint8]

DPI = 100
# Frames a second of a video.
RATE = 25
# Angle that the eye sees, from the lower to the upper edge of the picture [degrees].
VIEW_ANGLE = 22.0
# Share of the picture's width and height that the stage may fill; the scale of colors stands beside it.
FILLED = 0.92
KIND = "kind"
"""Name of a color that shows what a body is, not a number."""
# Share of all places, on each side, that a stage of solid bodies need not hold.
STRAYS = 0.03
# Scenery longer than this goes on without end [m].
ENDLESS = 500.0
# How far such scenery goes on beyond the stage and all that moves, as a share of the stage.
RIM = 0.1
# Shade of a triangle that the light grazes, over one that faces it (matplotlib).
SHADOW = 0.55
EDGE = 0.15
"""Width of a disc's dark rim, in points: it tells neighbors of the same color apart."""


@dataclass(frozen=True)
class View:
    """From where, how large, and in which colors."""

    elevation: float = 25.0
    """Angle of the eye above the horizon [degrees]; 90 looks down."""

    azimuth: float = -60.0
    """Angle of the eye about the vertical, from +x [degrees]."""

    width: int = 960
    """[pixels]; even, as video wants it."""

    height: int = 720
    """[pixels]; even."""

    colors: str = "viridis"
    """Name of a matplotlib color map."""

    def axes(self) -> tuple[Floats, Floats, Floats]:
        """Unit vectors to the right, up in the picture, and to the eye, each of shape (3,)."""
        elevation, azimuth = np.radians(self.elevation), np.radians(self.azimuth)
        eye = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )  # fmt: skip
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        return right, np.cross(eye, right), eye


@dataclass(frozen=True)
class Frame:
    """One picture's content."""

    place: Floats
    """Centers and radii [m], shape (bodies, 4)."""

    color: Floats
    """What the color shows, shape (bodies,)."""

    title: str = ""

    turn: Floats = field(default_factory=lambda: np.zeros((0, 4)))
    """Orientations of solid bodies as quaternions (w, x, y, z), shape (bodies, 4); empty for spheres."""


@dataclass(frozen=True)
class Solid:
    """A body that is no sphere, or a part of the scenery."""

    vertices: Floats
    """In the body's frame, or in the world's where it does not move [m], shape (v, 3)."""

    faces: Ints
    """Triangles, shape (f, 3)."""

    body: int
    """Which body of the frames it is; -1 for what does not move."""

    color: str
    """Of what does not move, and of all where the color shows the kind."""


@dataclass(frozen=True)
class Stage:
    """What all frames of a scene have in common, so that nothing jumps from frame to frame."""

    low: Floats
    """Lowest corner of what is seen [m], shape (3,)."""
    high: Floats
    """Highest corner [m], shape (3,)."""
    color_range: tuple[float, float]
    color_name: str
    """What the color shows, with its unit; or `KIND`."""
    solids: tuple[Solid, ...] = ()
    """What is drawn in place of spheres, if there is any."""

    def corners(self) -> Floats:
        """Of the box that is seen [m], shape (8, 3)."""
        corners: Floats = np.array(np.meshgrid(*zip(self.low, self.high, strict=True))).reshape(3, -1).T
        return corners


def stage_of(frames: Iterable[Frame], color_name: str) -> Stage:
    """Make a stage on which all spheres of all frames can be seen."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    coldest, hottest = np.inf, -np.inf
    for frame in frames:
        radius = frame.place[:, 3:]
        low = np.minimum(low, (frame.place[:, :3] - radius).min(axis=0))
        high = np.maximum(high, (frame.place[:, :3] + radius).max(axis=0))
        coldest, hottest = min(coldest, float(frame.color.min())), max(hottest, float(frame.color.max()))
    return Stage(low, high, (coldest, hottest if hottest > coldest else coldest + 1.0), color_name)


def stage_of_solids(frames: Iterable[Frame], color_name: str, solids: Sequence[Solid]) -> Stage:
    """Make a stage around the start of solid bodies and where most of them come to: a few may roll out of sight.

    Scenery without end, such as the ground, is cut a little outside of the stage and of all that ever moves.
    """
    places, colors = [], []
    for frame in frames:
        places.append(frame.place)
        colors.append(frame.color)
    centers = np.concatenate(places)[:, :3]
    radius = places[0][:, 3:]
    low = np.minimum((places[0][:, :3] - radius).min(axis=0), np.quantile(centers, STRAYS, axis=0))
    high = np.maximum((places[0][:, :3] + radius).max(axis=0), np.quantile(centers, 1.0 - STRAYS, axis=0))
    for solid in solids:
        if solid.body < 0 and np.ptp(solid.vertices, axis=0).max() < ENDLESS:
            low, high = np.minimum(low, solid.vertices.min(axis=0)), np.maximum(high, solid.vertices.max(axis=0))
    rim = RIM * (high - low)
    least, most = np.minimum(low, centers.min(axis=0)) - rim, np.maximum(high, centers.max(axis=0)) + rim
    cut = [
        replace(solid, vertices=np.clip(solid.vertices, least, most)) if solid.body < 0 else solid for solid in solids
    ]
    hottest = max(float(np.concatenate(colors).max()), np.finfo(np.float64).tiny)
    return Stage(low, high, (0.0, hottest), color_name, tuple(cut))


def has_renderer() -> bool:
    """Tell whether the extra `render` is installed."""
    return importlib.util.find_spec("pyvista") is not None


def write_still(path: Path, frame: Frame, stage: Stage, view: View) -> Path:
    """Draw one frame into a PNG file, whole or not at all."""
    import matplotlib.image

    buffer = io.BytesIO()
    matplotlib.image.imsave(buffer, draw(frame, stage, view), format="png")
    return write_whole(path, buffer.getvalue())


def write_video(path: Path, frames: Iterable[Frame], stage: Stage, view: View) -> Path:
    """Draw frames into an MP4 file.

    Raises:
        ReportError: the extra `render` is not installed.
    """
    if importlib.util.find_spec("imageio_ffmpeg") is None or not has_renderer():
        raise ReportError("a video needs the extra: pip install 'impactbench[render]'")
    import imageio_ffmpeg

    partial = path.with_name(f".{path.stem}.partial.mp4")
    # The size of a macro block is left at 2: it keeps the picture's own size.
    writer = imageio_ffmpeg.write_frames(
        str(partial), (view.width, view.height), fps=RATE, macro_block_size=2, ffmpeg_log_level="error"
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(draw(frame, stage, view)))
    writer.close()
    partial.replace(path)
    return path


def draw(frame: Frame, stage: Stage, view: View) -> Pixels:
    """Draw one frame; shape (height, width, 3)."""
    return _draw_by_vtk(frame, stage, view) if has_renderer() else _draw_by_matplotlib(frame, stage, view)


def _draw_by_vtk(frame: Frame, stage: Stage, view: View) -> Pixels:
    """Spheres as shaded points that hide one another, or solid bodies as one mesh."""
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=[view.width, view.height])
    if stage.solids:
        points, faces, colors = _triangles(frame, stage, view)
        mesh = pyvista.PolyData.from_regular_faces(points, faces)
        mesh["color"] = colors
        plotter.add_mesh(mesh, scalars="color", rgb=True, show_scalar_bar=False)
    else:
        _add_points(plotter, frame, stage, view)
    if frame.title:
        plotter.add_text(frame.title, font_size=10, color="black")
    plotter.set_background("white")
    _aim(plotter.camera, stage, view)
    pixels = np.asarray(plotter.screenshot(return_img=True), dtype=np.uint8)
    plotter.close()
    return pixels[:, :, :3]


def _add_points(plotter: Any, frame: Frame, stage: Stage, view: View) -> None:
    """Spheres, and the scale of their colors."""
    import pyvista

    points = pyvista.PolyData(np.ascontiguousarray(frame.place[:, :3], dtype=np.float32))
    points["color"] = frame.color.astype(np.float32)
    points["radius"] = frame.place[:, 3].astype(np.float32)
    actor = plotter.add_mesh(
        points, style="points_gaussian", scalars="color", emissive=False, render_points_as_spheres=True,
        cmap=view.colors, clim=stage.color_range, show_scalar_bar=False,
    )  # fmt: skip
    actor.mapper.SetScaleFactor(1.0)
    actor.mapper.SetScaleArray("radius")
    plotter.add_scalar_bar(title=stage.color_name, color="black", vertical=True, height=0.5, position_x=0.88)


def _aim(camera: Any, stage: Stage, view: View) -> None:
    """Put the eye where the stage just fits into the picture."""
    right, up, eye = view.axes()
    middle = 0.5 * (stage.low + stage.high)
    from_middle = np.abs(stage.corners() - middle)
    half_width, half_height = (
        np.abs((stage.corners() - middle) @ axis).max() / FILLED for axis in (right, up)
    )  # fmt: skip
    half = max(half_height, half_width * view.height / view.width)
    depth = float(np.linalg.norm(from_middle, axis=1).max())
    # Near things look larger: room is left for what stands before the middle.
    distance = half / np.tan(np.radians(0.5 * VIEW_ANGLE)) + 0.3 * depth
    camera.position = tuple(middle + distance * eye)
    camera.focal_point = tuple(middle)
    camera.up = tuple(up)
    camera.view_angle = VIEW_ANGLE
    camera.clipping_range = (max(distance - 2.0 * depth, 1e-3 * distance), distance + 2.0 * depth)


def _triangles(frame: Frame, stage: Stage, view: View) -> tuple[Floats, Ints, Pixels]:
    """All solid bodies where they are: points (p, 3), triangles (f, 3), and the color of each (f, 3)."""
    import matplotlib as mpl
    from matplotlib.colors import Normalize, to_rgb

    turns = rotation_matrix(frame.turn)
    shades = mpl.colormaps[view.colors](Normalize(*stage.color_range)(frame.color))[:, :3]
    points, faces, colors = [], [], []
    start = 0
    for solid in stage.solids:
        moved = solid.vertices
        if solid.body >= 0:
            moved = moved @ turns[solid.body].T + frame.place[solid.body, :3]
        points.append(moved)
        faces.append(solid.faces + start)
        painted = solid.body < 0 or stage.color_name == KIND
        color = np.array(to_rgb(solid.color)) if painted else shades[solid.body]
        colors.append(np.tile(color, (len(solid.faces), 1)))
        start += len(moved)
    rgb = np.round(255.0 * np.concatenate(colors)).astype(np.uint8)
    return np.concatenate(points), np.concatenate(faces), rgb


def _draw_by_matplotlib(frame: Frame, stage: Stage, view: View) -> Pixels:
    """Discs or triangles, the far ones first."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    right, up, _ = view.axes()
    figure = Figure(figsize=(view.width / DPI, view.height / DPI), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    if stage.solids:
        axes.add_collection(_flat_triangles(frame, stage, view))
    else:
        discs = _discs(frame, stage, view, axes.transData)
        axes.add_collection(discs)
        figure.colorbar(discs, ax=axes, label=stage.color_name, shrink=0.6)
    corners = stage.corners()
    axes.set_xlim((corners @ right).min(), (corners @ right).max())
    axes.set_ylim((corners @ up).min(), (corners @ up).max())
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(frame.title)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba(), dtype=np.uint8)  # type: ignore[no-untyped-call]
    return pixels[:, :, :3].copy()


def _discs(frame: Frame, stage: Stage, view: View, on_axes: Any) -> Any:
    """Spheres as discs."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import Normalize

    right, up, eye = view.axes()
    centers = frame.place[:, :3]
    order = np.argsort(centers @ eye, kind="stable")
    diameter = 2.0 * frame.place[order, 3]
    discs = EllipseCollection(
        diameter, diameter, np.zeros(diameter.size), units="xy", transOffset=on_axes,
        offsets=np.column_stack([centers[order] @ right, centers[order] @ up]),
        cmap=view.colors, norm=Normalize(*stage.color_range), edgecolors="black", linewidths=EDGE,
    )  # fmt: skip
    discs.set_array(frame.color[order])
    return discs


def _flat_triangles(frame: Frame, stage: Stage, view: View) -> Any:
    """Solid bodies as triangles, darker where they turn away from the eye."""
    from matplotlib.collections import PolyCollection

    right, up, eye = view.axes()
    points, faces, colors = _triangles(frame, stage, view)
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    # Tracks are seen from both sides.
    facing = np.abs(normal @ eye) / np.where(length > 0.0, length, 1.0)
    shade = (SHADOW + (1.0 - SHADOW) * facing)[:, None] * colors / 255.0
    # Scenery first: its triangles are too large for one depth to say what they hide.
    moves = np.repeat([solid.body >= 0 for solid in stage.solids], [len(solid.faces) for solid in stage.solids])
    order = np.lexsort(((corners @ eye).mean(axis=1), moves))
    flat = np.stack([corners[order] @ right, corners[order] @ up], axis=-1)
    return PolyCollection(list(flat), facecolors=shade[order], edgecolors="face", linewidths=EDGE)

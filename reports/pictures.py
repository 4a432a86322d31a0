"""Pictures of spheres: stills and short videos, colored by a number of each sphere.

With the extra `render` spheres are drawn by PyVista (VTK) off-screen, one shaded point each with its true radius: a
mesh for every sphere takes a minute for 60,000 of them. Without it matplotlib draws discs from far to near, seen from
the same side without perspective.
"""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from reports.files import write_whole
from reports.scorecard import ReportError
from solvers.solution import Floats

Pixels = npt.NDArray[np.uint8]

DPI = 100
# Frames a second of a video.
RATE = 25
# Eye's distance over the diagonal of the stage, and the angle it sees [degrees]: the diagonal just fits.
DISTANCE, VIEW_ANGLE = 1.9, 30.0
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


@dataclass(frozen=True)
class Stage:
    """What all frames of a scene have in common, so that nothing jumps from frame to frame."""

    low: Floats
    """Lowest corner of what is seen [m], shape (3,)."""
    high: Floats
    """Highest corner [m], shape (3,)."""
    color_range: tuple[float, float]
    color_name: str
    """What the color shows, with its unit."""


def stage_of(frames: Iterable[Frame], color_name: str) -> Stage:
    """Make a stage on which all frames can be seen."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    coldest, hottest = np.inf, -np.inf
    for frame in frames:
        radius = frame.place[:, 3:]
        low = np.minimum(low, (frame.place[:, :3] - radius).min(axis=0))
        high = np.maximum(high, (frame.place[:, :3] + radius).max(axis=0))
        coldest, hottest = min(coldest, float(frame.color.min())), max(hottest, float(frame.color.max()))
    return Stage(low, high, (coldest, hottest if hottest > coldest else coldest + 1.0), color_name)


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
    """Spheres as shaded points that hide one another."""
    import pyvista

    _, up, eye = view.axes()
    plotter = pyvista.Plotter(off_screen=True, window_size=[view.width, view.height])
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
    if frame.title:
        plotter.add_text(frame.title, font_size=10, color="black")
    plotter.set_background("white")
    middle, size = 0.5 * (stage.low + stage.high), float(np.linalg.norm(stage.high - stage.low))
    plotter.camera.position = tuple(middle + DISTANCE * size * eye)
    plotter.camera.focal_point = tuple(middle)
    plotter.camera.up = tuple(up)
    plotter.camera.view_angle = VIEW_ANGLE
    plotter.camera.clipping_range = ((DISTANCE - 1.0) * size, (DISTANCE + 1.0) * size)
    pixels = np.asarray(plotter.screenshot(return_img=True), dtype=np.uint8)
    plotter.close()
    return pixels[:, :, :3]


def _draw_by_matplotlib(frame: Frame, stage: Stage, view: View) -> Pixels:
    """Spheres as discs, the far ones first."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    right, up, eye = view.axes()
    centers = frame.place[:, :3]
    order = np.argsort(centers @ eye, kind="stable")
    diameter = 2.0 * frame.place[order, 3]
    figure = Figure(figsize=(view.width / DPI, view.height / DPI), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    discs = EllipseCollection(
        diameter, diameter, np.zeros(diameter.size), units="xy", transOffset=axes.transData,
        offsets=np.column_stack([centers[order] @ right, centers[order] @ up]),
        cmap=view.colors, norm=Normalize(*stage.color_range), edgecolors="black", linewidths=EDGE,
    )  # fmt: skip
    discs.set_array(frame.color[order])
    axes.add_collection(discs)
    corners = np.array(np.meshgrid(*zip(stage.low, stage.high, strict=True))).reshape(3, -1).T
    axes.set_xlim((corners @ right).min(), (corners @ right).max())
    axes.set_ylim((corners @ up).min(), (corners @ up).max())
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(frame.title)
    figure.colorbar(discs, ax=axes, label=stage.color_name, shrink=0.6)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba(), dtype=np.uint8)  # type: ignore[no-untyped-call]
    return pixels[:, :, :3].copy()

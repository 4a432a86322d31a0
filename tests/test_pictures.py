"""Pictures of spheres and of solid bodies: what is drawn where, with and without the renderer."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from reports import pictures
from reports.pictures import KIND, Frame, Solid, Stage, View
from reports.scorecard import ReportError

VIEW = View(width=320, height=240)
# A red ball in front of a blue one, seen along -y; a green one to the right of both.
PLACE = np.array([[0.0, -2.0, 0.0, 1.0], [0.0, 2.0, 0.0, 1.0], [4.0, 0.0, 0.0, 1.0]])
FRONT = View(elevation=0.0, azimuth=-90.0, width=320, height=240, colors="brg")
COLOR = np.array([0.5, 0.0, 1.0])


def drawn(draw: object, place: np.ndarray = PLACE, color: np.ndarray = COLOR) -> np.ndarray:
    frame = Frame(place, color)
    stage = Stage(np.array([-1.0, -3.0, -1.0]), np.array([5.0, 3.0, 1.0]), (0.0, 1.0), "number")
    return draw(frame, stage, FRONT)  # type: ignore[operator, no-any-return]


def pixels_like(picture: np.ndarray, channel: int) -> int:
    """Pixels in which one channel is far brighter than the others: discs, not the scale beside them."""
    left = picture[:, : picture.shape[1] * 3 // 4].astype(int)
    others = [k for k in range(3) if k != channel]
    return int(((left[..., channel] > 100) & (left[..., others].max(axis=-1) < 60)).sum())


RENDERERS = [
    pytest.param(pictures._draw_by_matplotlib, id="matplotlib"),
    pytest.param(
        pictures._draw_by_vtk,
        id="vtk",
        marks=pytest.mark.skipif(not pictures.has_renderer(), reason="the extra `render` is not installed"),
    ),
]


@pytest.mark.parametrize("draw", RENDERERS)
def test_the_near_sphere_hides_the_far_one(draw: object) -> None:
    picture = drawn(draw)
    assert picture.shape == (FRONT.height, FRONT.width, 3)
    red, green, blue = (pixels_like(picture, k) for k in range(3))
    assert red > 500
    assert green > 500
    # Perspective shows a rim of the far one: the eye does not look along the line of the two.
    assert blue < red / 20


@pytest.mark.parametrize("draw", RENDERERS)
def test_a_sphere_of_twice_the_radius_covers_four_times_the_area(draw: object) -> None:
    small = pixels_like(drawn(draw, PLACE[:1] * np.array([1, 1, 1, 0.5]), COLOR[:1]), 0)
    large = pixels_like(drawn(draw, PLACE[:1], COLOR[:1]), 0)
    # Rim, perspective and shading take some of it.
    assert 3.0 < large / small < 5.0


# A cube about its own origin: corners, and two triangles a side.
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
SIDES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]],
    dtype=np.int32,
)  # fmt: skip
# No turn, and an eighth of a turn about the eye's axis.
STRAIGHT, ASKEW = [1.0, 0.0, 0.0, 0.0], [np.cos(np.pi / 8), 0.0, np.sin(np.pi / 8), 0.0]


def cubes(draw: object, turn: list[list[float]], size: float = 1.0) -> np.ndarray:
    """A red cube in front of a blue one, a green one to the right of both, seen along -y."""
    solids = tuple(Solid(size * CORNERS, SIDES, k, color) for k, color in enumerate(("red", "blue", "lime")))
    stage = Stage(np.array([-1.5, -3.0, -1.5]), np.array([5.5, 3.0, 1.5]), (0.0, 1.0), KIND, solids)
    frame = Frame(PLACE, np.zeros(3), turn=np.array(turn))
    return draw(frame, stage, FRONT)  # type: ignore[operator, no-any-return]


@pytest.mark.parametrize("draw", RENDERERS)
def test_the_near_body_hides_the_far_one(draw: object) -> None:
    picture = cubes(draw, [STRAIGHT] * 3)
    red, green, blue = (pixels_like(picture, k) for k in range(3))
    assert red > 500
    assert green > 500
    assert blue < red / 20


@pytest.mark.parametrize("draw", RENDERERS)
def test_a_body_is_drawn_as_it_is_turned(draw: object) -> None:
    # On its edge a cube is √2 wide: its corners cover what was free beside it.
    upright, askew = cubes(draw, [STRAIGHT] * 3), cubes(draw, [ASKEW, STRAIGHT, STRAIGHT])
    rows = [np.flatnonzero((picture[..., 0] > 100) & (picture[..., 1:].max(axis=-1) < 60)) // FRONT.width
            for picture in (upright, askew)]  # fmt: skip
    heights = [np.ptp(found) for found in rows]
    assert heights[1] / heights[0] == pytest.approx(np.sqrt(2.0), rel=0.1)


def test_a_stage_of_bodies_is_not_stretched_by_the_few_that_roll_away() -> None:
    still = [Frame(np.tile(PLACE, (40, 1)), np.ones(120)) for _ in range(2)]
    rolled = np.tile(PLACE, (40, 1))
    rolled[0, 0] = 500.0
    ground = Solid(1e3 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]), SIDES[:1] * 0, -1, "gray")
    table = Solid(np.array([[7.0, 0.0, 0.0], [8.0, 0.0, 0.0], [7.0, 1.0, 0.0]]), SIDES[:1] * 0, -1, "gray")
    stage = pictures.stage_of_solids([*still, Frame(rolled, np.ones(120))], KIND, [ground, table])
    assert list(stage.low) == [-1.0, -3.0, -1.0]
    assert list(stage.high) == [8.0, 3.0, 1.0]
    # The ground carries also what rolled away, and goes on beyond it by a tenth of the stage's length of 9.
    assert stage.solids[0].vertices.max() == pytest.approx(500.9)
    assert stage.solids[0].vertices.min() == pytest.approx(-3.6)


def test_the_axes_of_a_view_are_right_handed_and_the_eye_is_above() -> None:
    right, up, eye = View(elevation=30.0, azimuth=20.0).axes()
    assert np.cross(right, up) == pytest.approx(eye)
    assert eye[2] == pytest.approx(0.5)
    assert up[2] > 0


def test_a_stage_holds_all_frames_whole() -> None:
    frames = [Frame(PLACE, COLOR), Frame(PLACE + np.array([0, 0, 5, 0]), 3 * COLOR)]
    stage = pictures.stage_of(frames, "number")
    assert list(stage.low) == [-1.0, -3.0, -1.0]
    assert list(stage.high) == [5.0, 3.0, 6.0]
    assert stage.color_range == (0.0, 3.0)


def test_a_still_is_a_png_of_the_size_asked_for(tmp_path: Path) -> None:
    frame = Frame(PLACE, COLOR, "three spheres")
    path = pictures.write_still(tmp_path / "still.png", frame, pictures.stage_of([frame], "number"), VIEW)
    assert matplotlib.image.imread(path).shape[:2] == (VIEW.height, VIEW.width)
    assert [p.name for p in tmp_path.iterdir()] == ["still.png"]


def test_a_video_without_the_renderer_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "has_renderer", lambda: False)
    frame = Frame(PLACE, COLOR)
    with pytest.raises(ReportError, match=r"impactbench\[render\]"):
        pictures.write_video(tmp_path / "v.mp4", [frame], pictures.stage_of([frame], "number"), VIEW)


@pytest.mark.skipif(not pictures.has_renderer(), reason="the extra `render` is not installed")
def test_a_video_has_all_its_frames(tmp_path: Path) -> None:
    import imageio_ffmpeg

    frames = [Frame(PLACE + np.array([0, 0, k, 0]), COLOR) for k in range(5)]
    path = pictures.write_video(tmp_path / "v.mp4", frames, pictures.stage_of(frames, "number"), VIEW)
    count, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert count == len(frames)

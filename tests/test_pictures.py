"""Pictures of spheres: what is drawn where, with and without the renderer."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from reports import pictures
from reports.pictures import Frame, Stage, View
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

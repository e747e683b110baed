"""Pictures: everything is in the frame, at its place and to scale; what is in front hides what is behind."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
import pytest
from numpy.typing import NDArray

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.viewer.picture import (
    OBLIQUE,
    TOP,
    DrawnRun,
    draw_apart,
    draw_runs,
    fit_frame,
    save_picture,
)
from lidarslam.viewer.view import INK, START, View, draw_layer, fit_view, round_length

UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
WIDTH = 400


class Picture(NamedTuple):
    pixels: NDArray[np.uint8]
    view: View


def draw(runs: list[DrawnRun], elevation_deg: float = TOP, width: int = WIDTH, **given: Any) -> Picture:
    """A picture and its frame's view."""
    frame = fit_frame(runs, elevation_deg, width=width, **given)
    return Picture(draw_runs(runs, frame, given.get("reference")), frame.view)


def cloud(points: FloatArray) -> PointCloud:
    return PointCloud(points, np.tile(UP, (len(points), 1)))


def plane(z: float, half_m: float = 10.0, count: int = 200) -> FloatArray:
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-half_m, half_m, count)]))
    return np.stack([x, y, np.full_like(x, z)], axis=1)


def line(y: float, reach_m: float = 9.0) -> FloatArray:
    return np.column_stack([np.linspace(-reach_m, reach_m, 400), np.full(400, y), np.zeros(400)])


NOTHING = cloud(np.empty((0, 3)))


def near(picture: Picture, point: FloatArray, reach: int = 1) -> NDArray[np.int64]:
    """The colours (K, 3) about the pixel of a point."""
    column, row = np.round(picture.view.project(point[None])[0]).astype(int)
    window = picture.pixels[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
    return window.reshape(-1, 3).astype(np.int64)


def is_like(colours: NDArray[np.int64], colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(colours - colour).max(axis=1) < 40).any())


@pytest.mark.parametrize("elevation_deg", [TOP, OBLIQUE])
@pytest.mark.parametrize("scale", [0.3, 30.0, 3_000.0])
def test_every_point_is_drawn_at_its_pixel(rng, scale, elevation_deg):
    points = scale * rng.uniform(-1.0, 1.0, (60, 3)) * [1.0, 0.5, 0.2] + 5.0 * scale
    picture = draw([DrawnRun("", cloud(points))], elevation_deg)
    pixels = picture.view.project(points)
    assert (pixels > 5).all()
    assert (pixels < [picture.view.width - 5, picture.view.height - 5]).all()
    covered = (picture.pixels[: picture.view.height] < 250).any(axis=2)  # of the map; the rest is paper
    for column, row in np.round(pixels).astype(int):
        assert covered[row - 1 : row + 2, column - 1 : column + 2].any()
    # And nothing elsewhere: a point covers a few pixels, whatever the scale.
    assert covered.sum() <= len(points) * 8**2


def test_pixels_are_to_scale():
    corners = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [30.0, 10.0, 0.0], [0.0, 10.0, 0.0]])
    for elevation_deg in (OBLIQUE, TOP):
        view = draw([DrawnRun("", cloud(corners))], elevation_deg).view
        along, across = (view.project(corners[[1, 3]]) - view.project(corners[:1])) * view.pixel_m
        np.testing.assert_allclose(along, [30.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(across, [0.0, -10.0], atol=1e-9)
    np.testing.assert_allclose(view.size_m, [30.0, 10.0])


@pytest.mark.parametrize("size_m", [3.0, 47.0, 800.0])
def test_the_scale_bar_is_as_long_as_it_says(size_m):
    pixels, view = draw([DrawnRun("", cloud(np.array([[0.0, 0.0, 0.0], [size_m, 0.3 * size_m, 0.0]])))], width=1600)
    ink = (pixels[view.height :] == INK).all(axis=2)
    longest = max(len(run) for row in ink for run in "".join("x" if dark else " " for dark in row).split())
    assert longest == round(round_length(0.2 * 1600 * view.pixel_m) / view.pixel_m)
    assert 0.07 * 1600 < longest <= 0.2 * 1600


def test_the_frame_holds_the_thin_ends_of_a_long_drive_but_no_stray_point(rng):
    dense = rng.normal(0.0, 5.0, (50_000, 3)) * [1.0, 1.0, 0.1]
    thin = np.column_stack([np.linspace(-300.0, 300.0, 2_000), np.zeros((2_000, 2))])
    columns = fit_view(np.concatenate([dense, thin]), np.empty((0, 3)), width=WIDTH).project(thin)[:, 0]
    assert 0 < columns.min() < columns.max() < WIDTH
    stray = np.array([[5_000.0, 0.0, 0.0]])
    view = fit_view(np.concatenate([plane(0.0), stray]), np.empty((0, 3)), turn_deg=0.0, width=WIDTH)
    assert view.size_m[0] < 3 * 20.0


def test_the_path_is_drawn_above_everything_with_its_ends_and_its_lost_stretch():
    positions = np.column_stack([np.linspace(-8.0, 8.0, 41), np.zeros((41, 2))])
    statuses = [Status.OK] * 14 + [Status.DEGRADED] * 13 + [Status.LOST] * 14
    picture = draw([DrawnRun("", cloud(plane(5.0)), positions, statuses)], width=800)
    colours = {-6.0: (15, 15, 15), 0.0: (255, 140, 0), 6.0: (225, 0, 60), -8.0: START, 8.0: INK}
    for x, colour in colours.items():
        assert is_like(near(picture, np.array([x, 0.0, 0.0])), colour), x
    assert not is_like(near(picture, np.array([0.0, 3.0, 0.0])), (255, 140, 0))


def test_what_is_in_front_hides_what_is_behind_unless_it_is_a_ceiling_seen_from_its_back():
    low, high = plane(0.0), plane(1.0)[20_000:]
    picture = draw([DrawnRun("", cloud(np.concatenate([low, high])))])
    assert near(picture, np.array([0.0, -5.0, 0.0])).mean() > near(picture, np.array([0.0, 5.0, 1.0])).mean() + 50.0
    both = np.concatenate([plane(0.0), plane(1.0)])
    view = fit_view(both, np.empty((0, 3)), width=WIDTH)
    assert (draw_layer(both, np.repeat([UP, DOWN], len(low), axis=0), view).points < len(low)).all()


@pytest.mark.parametrize("elevation_deg", [TOP, OBLIQUE])
def test_a_plane_is_closed_and_evenly_lit(elevation_deg):
    floor = cloud(plane(0.0, count=120))
    layer = draw_layer(floor.points, floor.normals, view := fit_view(floor.points, np.empty((0, 3)), elevation_deg))
    covered = np.zeros(view.height * view.width, dtype=bool)
    covered[layer.pixels] = True
    row, column = (side // 2 for side in (view.height, view.width))
    assert covered.reshape(view.height, view.width)[row - 50 : row + 50, column - 50 : column + 50].all()
    assert np.median(layer.brightness) > 0.75
    assert (np.abs(layer.brightness - np.median(layer.brightness)) < 0.15).mean() > 0.9


def test_several_runs_have_a_colour_each_and_mix_where_they_agree():
    shifted = plane(0.0) + np.array([10.0, 0.0, 0.0])
    runs = [DrawnRun("a", cloud(plane(0.0))), DrawnRun("b", cloud(shifted))]
    picture = draw(runs)
    first, both, second = (near(picture, np.array([x, 0.0, 0.0])).mean(axis=0) for x in (-5.0, 5.0, 15.0))
    assert first[2] > first[0] + 50, "blue"
    assert second[0] > second[2] + 50, "vermilion"
    np.testing.assert_allclose(both, (first + second) / 2, atol=6)


def test_a_picture_is_written_as_png(tmp_path):
    pixels = draw([DrawnRun("", cloud(np.eye(3)))]).pixels
    save_picture(tmp_path / "map.png", pixels)
    np.testing.assert_array_equal(np.asarray(o3d.io.read_image(str(tmp_path / "map.png"))), pixels)
    with pytest.raises(OutputError, match=r"\.png or \.jpg"):
        save_picture(tmp_path / "map.tiff", pixels)


def test_paths_that_coincide_are_all_seen_and_have_no_gaps():
    arc = np.column_stack([9.0 * np.sin(a := np.linspace(-1.0, 1.0, 700)), 9.0 * np.cos(a), np.zeros(700)])
    picture = draw([DrawnRun(name, NOTHING, arc) for name in "abc"], width=1600)
    colours = [(0, 114, 178), (213, 94, 0), (0, 158, 115)]
    for place in arc[50:-50:7]:
        column, row = np.round(picture.view.project(place[None])[0]).astype(int)
        across = picture.pixels[row - 12 : row + 13, column].astype(np.int64)
        assert all(is_like(across, colour) for colour in colours), place
    for position in arc[[0, -1]]:
        assert not any(is_like(near(picture, position, 0), colour) for colour in colours[:2])
    assert not any(np.abs(np.subtract(START, colour)).max() < 60 for colour in colours)


def test_a_run_that_diverges_leaves_the_picture_and_is_named():
    good, also = line(0.0), line(1.0)
    wild = np.column_stack([np.linspace(-9.0, 300.0, 400), np.zeros((400, 2))])
    runs = [DrawnRun("good", cloud(plane(0.0)), good), DrawnRun("also", NOTHING, also), DrawnRun("wild", NOTHING, wild)]
    view = fit_frame(runs).view
    assert view.size_m[0] < 25.0
    assert fit_frame([runs[0], replace(runs[2], name="near", positions=line(2.0, 20.0))]).view.size_m[0] > 35.0
    heights = [draw(of).pixels.shape[0] for of in (runs[:2], runs)]
    assert heights[1] > heights[0], "a row of the legend more"
    assert draw([DrawnRun("wild", NOTHING, wild)], reference=good).view.size_m[0] < 25.0


def test_pictures_of_one_frame_are_the_same_but_for_the_run(tmp_path):
    street = np.column_stack([a := np.linspace(0.0, 50.0, 500), a, 0.02 * a])
    runs = [DrawnRun("a", cloud(street), street), DrawnRun("b", cloud(0.5 * street), street[:250])]
    frame = fit_frame(runs, width=WIDTH)
    assert abs(frame.view.turn_deg) > 30.0
    assert fit_frame(runs, OBLIQUE).view.turn_deg == frame.view.turn_deg, "turned the same way from every elevation"
    files = draw_apart(runs, tmp_path / "apart", frame)
    assert [file.name for file in files] == ["a.png", "b.png"]
    first, second = (np.asarray(o3d.io.read_image(str(file))) for file in files)
    column, row = np.round(frame.view.project(street[100:101])[0]).astype(int)
    np.testing.assert_array_equal(first[row, column], second[row, column])
    with pytest.raises(InputError, match="one name"):
        draw_apart([runs[0], runs[0]], tmp_path, frame)

"""Pictures: everything is in the frame, at its place and to scale; what is in front hides what is behind."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from numpy.typing import NDArray

from lidarslam.core.errors import OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.global_map.global_map import PointCloud
from lidarslam.viewer.drawing.annotations import INK, START, round_length
from lidarslam.viewer.drawing.shading import draw_layer, spacing_m
from lidarslam.viewer.drawing.view import fit_view
from lidarslam.viewer.picture import OBLIQUE, TOP, DrawnRun, Picture, draw_runs, height_colours, save_picture

UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
WIDTH = 400


def cloud(points: FloatArray, normal: tuple[float, float, float] = UP) -> PointCloud:
    return PointCloud(points, np.tile(normal, (len(points), 1)))


def plane(z: float, half_m: float = 10.0, count: int = 200) -> FloatArray:
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-half_m, half_m, count)]))
    return np.stack([x, y, np.full_like(x, z)], axis=1)


def drawn(picture: Picture) -> NDArray[np.bool_]:
    """(height, width) which pixels of the map are not paper."""
    return (picture.pixels[: picture.view.height] < 250).any(axis=2)


def near(picture: Picture, point: FloatArray, reach: int = 1) -> NDArray[np.int64]:
    """The colours (K, 3) about the pixel of a point."""
    column, row = np.round(picture.view.project(point[None])[0]).astype(int)
    window = picture.pixels[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
    return window.reshape(-1, 3).astype(np.int64)


def is_like(colours: NDArray[np.int64], colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(colours - colour).max(axis=1) < 40).any())


@pytest.mark.parametrize("elevation_deg", [TOP, OBLIQUE])
@pytest.mark.parametrize("scale", [0.3, 30.0, 3_000.0])
def test_every_point_is_drawn_at_its_pixel(rng: np.random.Generator, scale: float, elevation_deg: float) -> None:
    points = scale * rng.uniform(-1.0, 1.0, (60, 3)) * [1.0, 0.5, 0.2] + 5.0 * scale
    picture = draw_runs([DrawnRun("", cloud(points))], elevation_deg, width=WIDTH)
    pixels = picture.view.project(points)
    assert (pixels > 5).all()
    assert (pixels < [picture.view.width - 5, picture.view.height - 5]).all()
    covered = drawn(picture)
    for column, row in np.round(pixels).astype(int):
        assert covered[row - 1 : row + 2, column - 1 : column + 2].any()
    # And nothing elsewhere: a point covers a few pixels, whatever the scale.
    assert covered.sum() <= len(points) * 8**2


def test_pixels_are_to_scale() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [30.0, 10.0, 0.0], [0.0, 10.0, 0.0]])
    for elevation_deg in (TOP, OBLIQUE):
        view = draw_runs([DrawnRun("", cloud(corners))], elevation_deg, width=WIDTH).view
        pixels = view.project(corners)
        np.testing.assert_allclose((pixels[1] - pixels[0]) * view.pixel_m, [30.0, 0.0], atol=1e-9)
    view = draw_runs([DrawnRun("", cloud(corners))], TOP, width=WIDTH).view
    pixels = view.project(corners)
    np.testing.assert_allclose((pixels[3] - pixels[0]) * view.pixel_m, [0.0, -10.0], atol=1e-9)
    np.testing.assert_allclose(view.size_m, [30.0, 10.0])


@pytest.mark.parametrize("size_m", [3.0, 47.0, 800.0])
def test_the_scale_bar_is_as_long_as_it_says(size_m: float) -> None:
    view = fit_view(np.array([[0.0, 0.0, 0.0], [size_m, 0.3 * size_m, 0.0]]), np.empty((0, 3)), width=1600)
    picture = draw_runs([DrawnRun("", cloud(np.array([[0.0, 0.0, 0.0], [size_m, 0.3 * size_m, 0.0]])))])
    ink = (picture.pixels[view.height :] == INK).all(axis=2)
    longest = max(len(run) for row in ink for run in "".join("x" if dark else " " for dark in row).split())
    metres = round_length(0.2 * 1600 * view.pixel_m)
    assert longest == round(metres / view.pixel_m)
    assert 0.07 * 1600 < longest <= 0.2 * 1600


@pytest.mark.parametrize(
    ("longest_m", "expected_m"), [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (49.0, 20.0), (777.0, 500.0), (0.06, 0.05)]
)
def test_scale_bars_have_round_lengths(longest_m: float, expected_m: float) -> None:
    assert round_length(longest_m) == pytest.approx(expected_m)


def test_the_thin_ends_of_a_long_drive_are_in_the_frame(rng: np.random.Generator) -> None:
    dense = rng.normal(0.0, 5.0, (50_000, 3)) * [1.0, 1.0, 0.1]
    thin = np.column_stack([np.linspace(-300.0, 300.0, 2_000), np.zeros((2_000, 2))])
    view = fit_view(np.concatenate([dense, thin]), np.empty((0, 3)), width=WIDTH)
    pixels = view.project(thin)
    assert pixels[:, 0].min() > 0
    assert pixels[:, 0].max() < WIDTH


def test_a_tower_is_in_the_frame_seen_obliquely() -> None:
    tower = np.column_stack([np.zeros((500, 2)), np.linspace(0.0, 60.0, 500)])
    view = fit_view(np.concatenate([plane(0.0), tower]), np.empty((0, 3)), OBLIQUE, width=WIDTH)
    assert view.project(tower)[:, 1].min() > 0


def test_a_stray_point_does_not_shrink_the_scene() -> None:
    stray = np.array([[5_000.0, 0.0, 0.0]])
    view = fit_view(np.concatenate([plane(0.0), stray]), np.empty((0, 3)), turn_deg=0.0, width=WIDTH)
    assert view.size_m[0] < 3 * 20.0


def test_the_whole_path_is_in_the_frame_even_far_from_the_map() -> None:
    path = np.array([[0.0, 0.0, 0.0], [400.0, 3.0, 0.0]])
    picture = draw_runs([DrawnRun("", cloud(plane(0.0)), path)], width=WIDTH)
    pixels = picture.view.project(path)
    assert (pixels > 0).all()
    assert (pixels < [picture.view.width, picture.view.height]).all()


def test_a_long_drive_lies_across_whatever_its_direction() -> None:
    along = np.linspace(0.0, 500.0, 5_000)
    for heading_deg in (0.0, 40.0, 90.0, -60.0):
        heading = np.deg2rad(heading_deg)
        street = np.column_stack([along * np.cos(heading), along * np.sin(heading), np.zeros_like(along)])
        pixels = fit_view(street, np.empty((0, 3)), width=WIDTH).project(street)
        assert np.ptp(pixels[:, 0]) > 10 * np.ptp(pixels[:, 1])


def test_the_path_is_drawn_above_everything_with_its_ends_and_its_lost_stretch() -> None:
    positions = np.column_stack([np.linspace(-8.0, 8.0, 41), np.zeros((41, 2))])
    statuses = [Status.OK] * 14 + [Status.DEGRADED] * 13 + [Status.LOST] * 14
    roof = cloud(plane(5.0), UP)
    picture = draw_runs([DrawnRun("", roof, positions, statuses)], width=800)
    for x, colour in (
        (-6.0, (15, 15, 15)),
        (0.0, (255, 140, 0)),
        (6.0, (225, 0, 60)),
        (-8.0, START),
        (8.0, INK),
    ):
        assert is_like(near(picture, np.array([x, 0.0, 0.0])), colour), x
    assert not is_like(near(picture, np.array([0.0, 3.0, 0.0])), (255, 140, 0))


def test_what_is_in_front_hides_what_is_behind() -> None:
    low, high = plane(0.0), plane(1.0)[20_000:]
    picture = draw_runs([DrawnRun("", cloud(np.concatenate([low, high])))], width=WIDTH)
    assert near(picture, np.array([0.0, -5.0, 0.0])).mean() > near(picture, np.array([0.0, 5.0, 1.0])).mean() + 50.0


def test_a_ceiling_seen_from_below_does_not_hide_the_floor() -> None:
    floor, ceiling = cloud(plane(0.0)), cloud(plane(1.0), DOWN)
    both = PointCloud(np.concatenate([floor.points, ceiling.points]), np.concatenate([floor.normals, ceiling.normals]))
    view = fit_view(both.points, np.empty((0, 3)), width=WIDTH)
    assert (draw_layer(both.points, both.normals, view).points < len(floor)).all()


@pytest.mark.parametrize("elevation_deg", [TOP, OBLIQUE])
def test_a_plane_is_closed_and_evenly_lit(elevation_deg: float) -> None:
    floor = cloud(plane(0.0, count=120))
    layer = draw_layer(floor.points, floor.normals, view := fit_view(floor.points, np.empty((0, 3)), elevation_deg))
    covered = np.zeros(view.height * view.width, dtype=bool)
    covered[layer.pixels] = True
    row, column = (side // 2 for side in (view.height, view.width))
    assert covered.reshape(view.height, view.width)[row - 50 : row + 50, column - 50 : column + 50].all()
    assert np.median(layer.brightness) > 0.75
    inner = np.abs(layer.brightness - np.median(layer.brightness)) < 0.15
    assert inner.mean() > 0.9


def test_the_ground_beside_a_wall_is_darker() -> None:
    step = np.concatenate([plane(0.0), plane(3.0)[20_000:]])
    view = fit_view(step, np.empty((0, 3)), turn_deg=0.0, width=WIDTH)
    layer = draw_layer(step, np.tile(UP, (len(step), 1)), view)
    brightness = np.ones(view.height * view.width)
    brightness[layer.pixels] = layer.brightness
    beside, away = (
        brightness.reshape(view.height, view.width)[
            tuple(np.round(view.project(np.array([place]))[0][::-1]).astype(int))
        ]
        for place in ((2.0, -0.1, 0.0), (2.0, -5.0, 0.0))
    )
    assert beside < away - 0.1


def test_the_spacing_of_a_grid_is_its_constant(rng: np.random.Generator) -> None:
    grid = plane(0.0, half_m=9.95, count=200)
    assert spacing_m(rng.permutation(grid)) == pytest.approx(0.1)


def test_several_runs_have_a_colour_each_and_mix_where_they_agree() -> None:
    shifted = plane(0.0) + np.array([10.0, 0.0, 0.0])
    runs = [DrawnRun("a", cloud(plane(0.0))), DrawnRun("b", cloud(shifted))]
    picture = draw_runs(runs, width=WIDTH)
    first, both, second = (near(picture, np.array([x, 0.0, 0.0])).mean(axis=0) for x in (-5.0, 5.0, 15.0))
    assert first[2] > first[0] + 50, "blue"
    assert second[0] > second[2] + 50, "vermilion"
    np.testing.assert_allclose(both, (first + second) / 2, atol=6)


def test_several_paths_have_their_run_s_colour() -> None:
    paths = [np.column_stack([np.linspace(-9.0, 9.0, 9), np.full(9, y), np.zeros(9)]) for y in (-4.0, 4.0)]
    picture = draw_runs([DrawnRun(str(y), cloud(plane(0.0)), y) for y in paths], width=800)
    assert is_like(near(picture, np.array([0.0, -4.0, 0.0])), (0, 114, 178))
    assert is_like(near(picture, np.array([0.0, 4.0, 0.0])), (213, 94, 0))


def test_a_run_without_a_map_or_with_one_pose_is_drawn() -> None:
    nothing = PointCloud(np.empty((0, 3)), np.empty((0, 3)))
    assert not drawn(draw_runs([DrawnRun("", nothing)], width=WIDTH)).any()
    assert drawn(draw_runs([DrawnRun("", nothing, np.zeros((1, 3)))], width=WIDTH)).any()


def test_colours_rise_from_dark_to_light() -> None:
    points = np.column_stack([np.zeros((101, 2)), np.linspace(0.0, 1.0, 101)])
    brightness = height_colours(points).astype(int).sum(axis=1)
    assert (np.diff(brightness) >= 0).all()
    assert brightness[-1] - brightness[0] > 300


def test_a_picture_is_written_as_png(tmp_path: Path) -> None:
    pixels = draw_runs([DrawnRun("", cloud(np.eye(3)))], width=WIDTH).pixels
    save_picture(tmp_path / "map.png", pixels)
    np.testing.assert_array_equal(np.asarray(o3d.io.read_image(str(tmp_path / "map.png"))), pixels)
    with pytest.raises(OutputError, match=r"\.png or \.jpg"):
        save_picture(tmp_path / "map.tiff", pixels)


def test_a_picture_in_no_folder_says_so(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"map\.png: cannot be written \(No such file"):
        save_picture(tmp_path / "none" / "map.png", np.zeros((2, 2, 3), dtype=np.uint8))

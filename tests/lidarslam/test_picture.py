"""Pictures of clouds: what is in front hides what is behind, and everything is in view."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from lidarslam.core.errors import OutputError
from lidarslam.viewer.picture import Camera, draw, height_colours, save_picture

FROM_ABOVE = Camera(azimuth_deg=-90.0, elevation_deg=90.0, width=200, height=100)


def test_what_is_in_front_hides_what_is_behind() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 300), np.linspace(-1, 1, 300)))
    low, high = np.stack([x, y, np.zeros_like(x)], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    colours = np.repeat(np.array([[200, 0, 0], [0, 0, 200]], dtype=np.uint8), len(low), axis=0)
    picture = draw(np.concatenate([low, high]), colours, camera=FROM_ABOVE)
    np.testing.assert_array_equal(picture[50, 100], [0, 0, 200])
    np.testing.assert_array_equal(picture[0, 0], [255, 255, 255])


def test_a_ceiling_seen_from_below_does_not_hide_the_floor() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 300), np.linspace(-1, 1, 300)))
    floor, ceiling = np.stack([x, y, np.zeros_like(x)], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    colours = np.repeat(np.array([[200, 0, 0], [0, 0, 200]], dtype=np.uint8), len(floor), axis=0)
    normals = np.repeat(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), len(floor), axis=0)
    picture = draw(np.concatenate([floor, ceiling]), colours, normals, FROM_ABOVE)
    np.testing.assert_array_equal(picture[50, 100], [200, 0, 0])


@pytest.mark.parametrize("scale", [0.1, 1.0, 1_000.0])
def test_nearly_all_points_are_in_view_at_every_scale(rng: np.random.Generator, scale: float) -> None:
    points = scale * rng.uniform(-1.0, 1.0, (50, 3)) + 5.0 * scale
    picture = draw(points, np.zeros((50, 3), dtype=np.uint8), camera=FROM_ABOVE)
    covered = (picture != 255).any(axis=2)
    assert np.count_nonzero(covered) > 4 * 45
    rows = np.flatnonzero(covered.any(axis=1))
    assert np.ptp(rows) > 70, "they fill the picture"


def test_colours_rise_from_dark_to_light() -> None:
    points = np.column_stack([np.zeros((101, 2)), np.linspace(0.0, 1.0, 101)])
    brightness = height_colours(points).astype(int).sum(axis=1)
    assert (np.diff(brightness) >= 0).all()
    assert brightness[-1] - brightness[0] > 300


def test_an_empty_cloud_gives_an_empty_picture() -> None:
    picture = draw(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8), camera=FROM_ABOVE)
    assert (picture == 255).all()


def test_a_picture_is_written_as_png(tmp_path: Path) -> None:
    picture = draw(np.eye(3), np.full((3, 3), 10, dtype=np.uint8), camera=FROM_ABOVE)
    save_picture(tmp_path / "map.png", picture)
    np.testing.assert_array_equal(np.asarray(o3d.io.read_image(str(tmp_path / "map.png"))), picture)
    with pytest.raises(OutputError, match=r"\.png or \.jpg"):
        save_picture(tmp_path / "map.tiff", picture)


def test_a_picture_in_no_folder_says_so(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"map\.png: cannot be written \(No such file"):
        save_picture(tmp_path / "none" / "map.png", np.zeros((2, 2, 3), dtype=np.uint8))

"""The merged map: means and normals, and what its voxels say of intensity, colour, ring and time."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import PointAttributes
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map import global_map as module
from lidarslam.mapping.global_map.global_map import GlobalMap, drawn_map, voxel_size_for
from lidarslam.mapping.global_map.moved_points import Views
from lidarslam.mapping.global_map.voxels import COUNT
from lidarslam.mapping.surfels.voxel_hash import reach_m

from .shapes import across_x, attributes

VOXEL_M = 0.5


def some(rng: np.random.Generator, count: int, number: int, names: str = "intensity rgb ring time") -> PointAttributes:
    """Attributes of a scan's points; every fifth has no intensity."""
    known = attributes(rng, count, 0.1 * number)
    known.intensity[::5] = np.nan
    return known.only(names.split())


def cells(points: FloatArray) -> list[tuple[int, ...]]:
    return [tuple(cell) for cell in np.floor(points / VOXEL_M).astype(int).tolist()]


def test_equals_a_dictionary_of_voxels(rng, monkeypatch):
    """Scans with all, some and none of the attributes, merged many times; later ones bring new attributes."""
    monkeypatch.setattr(module, "_MIN_PENDING", 500)
    grid, plain = GlobalMap(VOXEL_M), GlobalMap(VOXEL_M)
    intensities: dict[tuple[int, ...], list[float]] = {}
    colours: dict[tuple[int, ...], list[FloatArray]] = {}
    firsts: dict[tuple[int, ...], tuple[float, int]] = {}
    for number in rng.permutation(30):  # so that the earliest point may come last
        points, T = rng.normal(0.0, 1.5, (200, 3)), exp(rng.normal(0.0, 0.3, 6))
        wanted = "" if number < 5 else "intensity" if number < 10 else "intensity rgb ring time"
        known = some(rng, len(points), int(number), wanted)
        grid.add(points, T, known)
        plain.add(points, T)
        for n, cell in enumerate(cells(points @ T[:3, :3].T + T[:3, 3])):
            if known.intensity is not None and np.isfinite(known.intensity[n]):
                intensities.setdefault(cell, []).append(float(known.intensity[n]))
            if known.rgb is not None:
                colours.setdefault(cell, []).append(known.rgb[n].astype(float))
            if known.time is not None and known.ring is not None:
                first = float(known.time[n]), int(known.ring[n])
                firsts[cell] = min(firsts.get(cell, (np.inf, -1)), first)
    cloud = grid.cloud()
    np.testing.assert_array_equal(cloud.points, plain.cloud().points)
    np.testing.assert_array_equal(cloud.normals, plain.cloud().normals)
    found = cloud.attributes
    kinds = set()
    for n, cell in enumerate(cells(cloud.points)):
        kinds.add((cell in intensities, cell in colours))
        np.testing.assert_allclose(found.intensity[n], np.mean(intensities.get(cell, [np.nan])), rtol=1e-5)
        np.testing.assert_allclose(found.rgb[n], np.mean(colours.get(cell, [np.zeros(3)]), axis=0), atol=0.501)
        time, ring = firsts.get(cell, (np.inf, -1))
        assert found.ring[n] == ring
        assert found.time[n] == time or abs(found.time[n] - time) < 1e-5
    assert kinds >= {(True, True), (True, False), (False, False)}


def test_a_map_of_submaps_has_the_attributes_of_their_scans(rng):
    poses = [exp([0.0, 0.0, 0.0, x, 0.0, 0.0]) for x in (0.0, 2.0, 4.0)]  # whole voxels, so that they are cut alike
    direct, drawn, without = GlobalMap(VOXEL_M), GlobalMap(VOXEL_M), GlobalMap(VOXEL_M)
    for number, (pose, names) in enumerate(zip(poses, ("", "intensity", "intensity rgb ring time"), strict=True)):
        submap, plain = GlobalMap(VOXEL_M), GlobalMap(VOXEL_M)
        for half in range(2):
            points = rng.uniform(-3.0, 3.0, (1000, 3))
            known = some(rng, len(points), 2 * number + half, names)
            submap.add(points, np.eye(4), known)
            plain.add(points, np.eye(4))
            direct.add(points, pose, known)
        drawn.add_means(submap.means(), pose)
        without.add_means(plain.means(), pose)
    np.testing.assert_array_equal(drawn.points(), without.points())
    np.testing.assert_array_equal(drawn.cloud().normals, without.cloud().normals)
    np.testing.assert_allclose(drawn.points(), direct.points(), atol=1e-5)
    np.testing.assert_array_equal(drawn.means().rows[:, COUNT], direct.means().rows[:, COUNT])
    np.testing.assert_allclose(drawn.cloud().normals, direct.cloud().normals, atol=1e-3)
    expected = dict(direct.cloud().attributes.present())
    assert len(expected) == 4
    for name, values in drawn.cloud().attributes.present():
        np.testing.assert_allclose(values, expected[name], rtol=1e-5, atol=1.0 if name == "rgb" else 1e-5)


def test_precision_does_not_suffer_far_from_the_origin():
    grid = GlobalMap(0.1)
    far = np.array([[12_345.678, -9_876.543, 210.987]])
    grid.add(far, np.eye(4))
    np.testing.assert_allclose(grid.points(), far, atol=1e-6)


def test_normals_face_the_sensor(rng):
    grid = GlobalMap(0.2)
    wall, floor = across_x(rng, 3.0, 2.0, 4_000), across_x(rng, -1.0, 2.0, 4_000)[:, [1, 2, 0]]
    grid.add(np.concatenate([wall, floor]), np.eye(4))
    cloud = grid.cloud()
    on_wall = cloud.points[:, 0] > 2.9
    inner = (np.abs(cloud.points[:, 1]) < 1.5) & (on_wall | (np.abs(cloud.points[:, 0]) < 1.5))
    np.testing.assert_allclose(cloud.normals[on_wall & inner] @ [-1.0, 0.0, 0.0], 1.0, atol=1e-3)
    np.testing.assert_allclose(cloud.normals[~on_wall & inner] @ [0.0, 0.0, 1.0], 1.0, atol=1e-3)


@pytest.mark.parametrize(("half_size", "voxel"), [(1.0, 0.05), (5.0, 0.12), (60.0, 0.25)])
def test_the_voxel_size_follows_the_scene(rng, half_size, voxel):
    directions = rng.normal(size=(2_000, 3))
    sphere = 1.2 * half_size * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert voxel_size_for(sphere) == pytest.approx(voxel)


def test_views_turn_with_the_submap():
    """A floor seen from above is seen from the side once the submap is tipped over."""
    grid = np.stack(np.meshgrid(np.arange(0.05, 3.0, 0.1), np.arange(0.05, 3.0, 0.1), [-1.0]), axis=-1).reshape(-1, 3)
    submap = GlobalMap(0.1)
    submap.add(grid, np.eye(4))
    for tip, expected in ((0.0, [0.0, 0.0, 1.0]), (0.5 * np.pi, [0.0, -1.0, 0.0])):
        drawn = GlobalMap(0.1)
        drawn.add_means(submap.means(), exp([tip, 0.0, 0.0, 0.0, 0.0, 0.0]))
        np.testing.assert_allclose(drawn.cloud().normals.mean(axis=0), expected, atol=1e-6)


def test_a_map_holds_what_its_voxels_reach_and_leaves_out_the_rest(rng):
    points = rng.uniform(-5.0, 5.0, (500, 3))
    whole, moved, far = GlobalMap(0.05), GlobalMap(0.05), GlobalMap(0.05)
    whole.add(points, np.eye(4))
    far.add(points, exp([0.0, 0.0, 0.0, reach_m(0.05) - 6.0, 0.0, 0.0]))
    assert far.beyond == 0
    assert len(far.points()) == pytest.approx(len(whole.points()), rel=0.1)
    moved.add(points, np.eye(4))
    for distance_m in (-1e7, 60_000.0, 1e12):
        moved.add(points, exp([0.0, 0.0, 0.0, 0.0, distance_m, 0.0]))
    moved.add_means(whole.means(), exp([0.0, 0.0, 0.0, 1e7, 0.0, 0.0]))
    np.testing.assert_array_equal(moved.points(), whole.points())
    assert moved.beyond == 1500 + len(whole.points())
    drawn = drawn_map(moved, Views().placed(np.empty((0, 4, 4))), GlobalMapConfig())
    assert "52 km" in drawn.warning

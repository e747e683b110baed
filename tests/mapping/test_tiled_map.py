"""A map whose tiles lie on disk is the map in one piece: the same points, normals and attributes."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp
from lidarslam.core.scan import PointAttributes
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map import global_map as module
from lidarslam.mapping.global_map import voxels
from lidarslam.mapping.global_map.global_map import GlobalMap, drawn_map
from lidarslam.mapping.global_map.moved_points import PlacedViews, Views
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.mapping.global_map.voxels import Tile, TileStore, Tiling
from lidarslam.mapping.surfels.voxel_hash import cell_keys, key_cells, point_keys

VOXEL_M, MOST = 0.1, 6_000
CONFIG = GlobalMapConfig(voxel_size_m=VOXEL_M, most_points=MOST, fields=("intensity", "rgb", "ring", "time"))


@pytest.fixture(autouse=True)
def _small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxels, "_EDGE_M", 4.03)  # no whole number of voxels
    monkeypatch.setattr(module, "NORMALS_MARGIN_M", 1.5)


def street(number: int) -> tuple[FloatArray, FloatArray, PointAttributes]:
    """Scan `number` of 40 on a way out and back: a ground and a wall around the sensor, and a box that passes."""
    rng = np.random.default_rng(number)
    x = 0.8 * (number if number < 20 else 39.5 - number)
    sensor = np.array([x - 7.0, -1.0 + 0.05 * x, 1.5])
    ground = np.column_stack([rng.uniform(-4.0, 4.0, (1500, 2)), np.full(1500, -1.5)])
    wall = np.column_stack([rng.uniform(-4.0, 4.0, 700), np.full(700, 3.0), rng.uniform(-1.5, 1.0, 700)])
    box = rng.uniform([1.0, -1.3, -1.3], [1.4, -0.9, 0.3], (30 if number % 7 == 0 else 0, 3))
    points = np.vstack([ground, wall, box])
    known = PointAttributes(
        intensity=rng.uniform(0.0, 50.0 if x > 4.0 else 0.9, len(points)).astype(np.float32),
        rgb=rng.integers(0, 256, (len(points), 3)).astype(np.uint8) if number > 30 else None,
        ring=np.full(len(points), number, dtype=np.int32),
        time=np.full(len(points), 1e9 + 0.1 * number),
    )
    pose = exp(np.array([0.0, 0.0, 0.02 * number, 0.0, 0.0, 0.0]))
    pose[:3, 3] = sensor
    return points @ pose[:3, :3], pose, known


def walked(built: GlobalMap, numbers: range = range(40)) -> GlobalMap:
    for number in numbers:
        built.add(*street(number))
    return built


@pytest.fixture(scope="module")
def views() -> PlacedViews:
    """Range images of all scans."""
    seen, poses = Views(every=1), []
    for number in range(40):
        points, pose, _ = street(number)
        seen.add(points, number)
        poses.append(pose)
    return seen.placed(np.array(poses))


def test_every_voxel_lies_in_one_tile(rng):
    tiling = Tiling(VOXEL_M)
    assert tiling.cells == 40
    points = rng.uniform(-30.0, 30.0, (5000, 3))
    points[:200, :2] = 4.0 * rng.integers(-5, 6, (200, 2))  # on the edges
    keys = np.unique(np.concatenate([point_keys(points, VOXEL_M), cell_keys(np.array([[-1, 40, 3], [-41, -40, 0]]))]))
    cells = key_cells(keys)
    expected = {(int(x), int(y)) for x, y in np.floor(cells[:, :2] / 40.0)}
    assert tiling.tiles(keys) == sorted(expected)
    for tile in expected:
        low, high = tiling.bounds(tile)
        inside = ((cells[:, :2] >= low) & (cells[:, :2] < high)).all(axis=1)
        assert {(int(x), int(y)) for x, y in np.floor(cells[inside, :2] / 40.0)} == {tile}
        assert tiling.around(low, high) == [tile]
        assert len(tiling.around(*tiling.bounds(tile, 0.05))) == 9


def in_tiles(built: GlobalMap, views: PlacedViews, config: GlobalMapConfig = CONFIG) -> dict[Tile, PointCloud]:
    tiles: dict[Tile, PointCloud] = {}
    drawn = drawn_map(built, views, config, lambda tile, cloud, _: tiles.__setitem__(tile, cloud))
    assert drawn.tiled.points == {tile: len(cloud) for tile, cloud in tiles.items()}
    return tiles


def test_tiles_together_are_the_map_in_one_piece(views):
    whole, built = walked(GlobalMap(VOXEL_M)), walked(GlobalMap(VOXEL_M, MOST))
    assert whole.is_whole
    assert not built.is_whole
    expected = drawn_map(whole, views, CONFIG)
    assert expected.tiled is None
    assert expected.moved > 10
    drawn = drawn_map(built, views, CONFIG)
    assert drawn.moved == expected.moved
    assert drawn.tiled.total == len(expected.cloud)
    tiles = in_tiles(built, views)
    assert len(tiles) > 8
    for (x, y), cloud in tiles.items():
        low = np.array([x, y]) * drawn.tiled.tiling.edge_m
        assert (cloud.points[:, :2] > low - 1e-6).all()
        assert (cloud.points[:, :2] < low + drawn.tiled.tiling.edge_m + 1e-6).all()
    points, normals = (np.vstack([getattr(cloud, name) for cloud in tiles.values()]) for name in ("points", "normals"))
    off_m, rows = cKDTree(points).query(expected.cloud.points)
    assert off_m.max() < 1e-6
    assert len(points) == len(rows) == len(np.unique(rows))
    turned = np.einsum("ij,ij->i", normals[rows], expected.cloud.normals)
    assert np.mean(turned > 1.0 - 1e-6) > 0.999  # the rest has two sets of nearest points, equally far
    for name, values in expected.cloud.attributes.present():
        found = np.concatenate([getattr(cloud.attributes, name) for cloud in tiles.values()])[rows]
        np.testing.assert_allclose(found, values, rtol=1e-5, atol=1.0 if name == "rgb" else 1e-5)


def test_the_overview_has_no_more_points_than_it_may(views):
    built = walked(GlobalMap(VOXEL_M, MOST))
    drawn = drawn_map(built, views, CONFIG)
    assert drawn.tiled.total > MOST
    assert 0.6 * MOST < len(drawn.cloud) <= MOST
    assert len(np.unique(point_keys(drawn.cloud.points, drawn.voxel_size_m))) > 0.99 * len(drawn.cloud)
    whole = np.vstack([cloud.points for cloud in in_tiles(built, views).values()])
    extent = drawn.cloud.points.min(axis=0), drawn.cloud.points.max(axis=0)
    np.testing.assert_allclose(extent, (whole.min(axis=0), whole.max(axis=0)), atol=drawn.voxel_size_m)
    assert drawn.tiled.brightest > 1.0


def test_normals_of_many_points_are_those_of_few(monkeypatch):
    built = walked(GlobalMap(VOXEL_M))
    expected = built.cloud(left_out=np.arange(len(built.points())) % 5 == 0)
    monkeypatch.setattr(module, "_MANY_POINTS", 1000)
    found = built.cloud(left_out=np.arange(len(built.points())) % 5 == 0)
    np.testing.assert_array_equal(found.points, expected.points)
    assert np.mean(np.einsum("ij,ij->i", found.normals, expected.normals) > 1.0 - 1e-6) > 0.999


def test_memory_is_bounded(tmp_path):
    built = GlobalMap(VOXEL_M, MOST, TileStore(tmp_path))
    for number in range(40):
        built.add(*street(number))
        assert len(built._merged) <= MOST
        assert built._pending_size <= MOST
        assert len(built.points()) <= MOST
    assert not list(tmp_path.iterdir())  # the file has no name
    assert len(built._store) > len(built._store.tiles)  # some were visited again


def test_a_map_that_just_fits_stays_in_one_piece(views):
    size = len(walked(GlobalMap(VOXEL_M)).points())
    fits, bursts = walked(GlobalMap(VOXEL_M, size)), walked(GlobalMap(VOXEL_M, size - 1))
    assert fits.is_whole
    assert not bursts.is_whole
    assert drawn_map(fits, views, CONFIG).tiled is None


def test_tiles_that_are_cut_off_are_refused(tmp_path, through_disk):
    file = tmp_path / "tiles.bin"
    saved = through_disk(walked(GlobalMap(VOXEL_M, MOST, TileStore(file=file))).state())
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"tiles.bin: is damaged"):
        GlobalMap(1.0, MOST, TileStore(file=file)).restore(saved)


@pytest.mark.parametrize(("count", "reach"), [(0, 1), (1, 1), (5_000, 1), (5_000, 40), (5_000, 500_000)])
def test_voxels_are_sorted_in_their_order(rng, count, reach):
    keys = cell_keys(rng.integers(-reach, reach, (count, 3)))
    np.testing.assert_array_equal(voxels.radix_order(keys), np.argsort(keys, kind="stable"))

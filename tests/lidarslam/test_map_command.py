"""Maps that are joined, cleaned, levelled, cropped: clouds whose points are known."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.core.scan import PointAttributes
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.edits import moved
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud
from lidarslam.storage.finished_run import load_map

from ..conftest import lidarslam, succeeds, write_run
from ..mapping.shapes import l_shaped_room

TILT = exp([np.deg2rad(7.0), 0.0, 0.0, 0.0, 0.0, 0.0])
POSES = TILT @ exp(np.linspace(0.0, 1.0, 41)[:, None] * [0.0, 0.0, 0.5, 4.0, 0.0, 0.0])
GROUND_M = -1.5
FLOATERS = 40
BACKWARDS, OUTSIDE = ("1", "-1", "0", "1", "0", "1"), ("90", "91", "0", "1", "0", "1")


def edited(out: Path, *arguments: object) -> tuple[PointCloud, str]:
    said = succeeds("map", *arguments, "--out", out, "--overwrite")
    return load_map(out), said


def hall() -> PointCloud:
    """A floor of 20 x 12 m on a grid of 0.1 m, a larger ceiling that faces down, and a wall."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-10.0, 10.0, 0.1), np.arange(-6.0, 6.0, 0.1)))
    floor = np.column_stack([x, y, np.full(len(x), GROUND_M)])
    ceiling = np.column_stack([1.3 * x, 1.3 * y, np.full(len(x), 2.0)])
    wall = np.column_stack([np.full(len(y), 10.0), y, np.linspace(GROUND_M, 2.0, len(y))])
    parts = ((floor, [0.0, 0.0, 1.0]), (ceiling, [0.0, 0.0, -1.0]), (wall, [-1.0, 0.0, 0.0]))
    normals = np.concatenate([np.tile(normal, (len(points), 1)) for points, normal in parts])
    return PointCloud(np.concatenate([points for points, _ in parts]), normals)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run in it, tilted, 4 m along its middle, with an IMU in its recording."""
    stamps, source = np.arange(41) / 10.0, tmp_path / "room"
    source.mkdir()
    np.save(source / "000000.npy", np.eye(3))
    accelerations = np.gradient(np.gradient(POSES[:, :3, 3], 0.1, axis=0), 0.1, axis=0)
    force = np.einsum("nji,nj->ni", POSES[:, :3, :3], accelerations + TILT[:3, :3] @ [0.0, 0.0, 9.81])
    rows = np.column_stack([stamps, np.zeros((41, 3)), force])
    np.savetxt(source / "imu.csv", rows, delimiter=",", header="T_lidar_imu: 1 0 0 0 0 1 0 0 0 0 1 0")
    return write_run(tmp_path / "run", Trajectory(stamps, POSES), moved(hall(), TILT), source=str(source))


@pytest.mark.parametrize("by", ["ground", "gravity"])
def test_a_tilted_map_is_levelled(run, tmp_path, by):
    cloud, said = edited(tmp_path / "level.ply", run, "--level", by, "--ground-at-zero")
    assert float(said.split()[2]) == pytest.approx(7.0, abs=0.03)
    assert "from z = -1.50 m to 0" in said
    expected = hall().points - [0.0, 0.0, GROUND_M]
    np.testing.assert_allclose(cloud.points, expected, atol=0.02)
    np.testing.assert_allclose(cloud.normals, hall().normals, atol=2e-3)


def test_crops_keep_exactly_what_lies_inside(run, tmp_path):
    whole = load_map(run / "map.ply").points
    box = np.array([[-2.05, 3.0], [-1.0, 1.05], [-3.0, 0.0]])
    cloud, said = edited(tmp_path / "box.ply", run, "--box", *box.ravel())
    inside = ((whole >= box[:, 0]) & (whole <= box[:, 1])).all(axis=1)
    assert f"cropped: {inside.sum():,} of {len(whole):,} points kept" in said
    np.testing.assert_array_equal(cloud.points, whole[inside])
    distance = np.linalg.norm(whole[:, None] - POSES[:, :3, 3], axis=2).min(axis=1)
    cloud, _ = edited(tmp_path / "near.ply", run, "--within", 3.0)
    np.testing.assert_array_equal(cloud.points, whole[distance < 3.0])
    both, _ = edited(tmp_path / "both.ply", run, "--within", 3.0, "--box", *box.ravel())
    np.testing.assert_array_equal(both.points, whole[inside & (distance < 3.0)])


@pytest.mark.parametrize("method", [("--statistical", 8, 3.0), ("--radius", 3, 0.5)])
def test_floaters_are_removed_and_nothing_else(tmp_path, method):
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(*[np.arange(-3.0, 3.0, 0.1)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    floaters = np.column_stack([3.0 * rng.permutation(FLOATERS), rng.uniform(5.0, 9.0, FLOATERS), np.full(FLOATERS, 8)])
    points = np.concatenate([grid, floaters])
    known = PointAttributes(intensity=np.arange(len(points), dtype=np.float32))
    write_cloud(tmp_path / "cloud.ply", PointCloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), known))
    cloud, said = edited(tmp_path / "clean.ply", tmp_path / "cloud.ply", *method)
    assert f"outliers: {FLOATERS} points of {len(points):,} removed" in said
    np.testing.assert_allclose(cloud.points, grid, atol=1e-6)
    np.testing.assert_array_equal(cloud.attributes.intensity, np.arange(len(grid)))


@pytest.mark.long
def test_clouds_are_joined_where_they_lie(tmp_path):
    room, again = (l_shaped_room(np.random.default_rng(seed), 6_000) for seed in (5, 6))
    T, other = exp([0.02, -0.03, 2.4, 2.0, -1.0, 0.3]), PointCloud(again, np.tile([0.0, 0.0, 1.0], (len(again), 1)))
    write_cloud(tmp_path / "first.ply", PointCloud(room, np.tile([0.0, 0.0, 1.0], (len(room), 1))))
    write_cloud(tmp_path / "other.ply", moved(other, inverse(T)))
    np.savetxt(tmp_path / "T.txt", T)
    sources = tmp_path / "first.ply", tmp_path / "other.ply"
    expected = np.concatenate([room, again])
    cloud, _ = edited(tmp_path / "given.ply", *sources, "--transform", tmp_path / "T.txt")
    np.testing.assert_allclose(cloud.points, expected, atol=1e-5)
    cloud, said = edited(tmp_path / "registered.ply", *sources, "--register")
    assert "other.ply: registered, from everywhere; 100 % of it within 0.20 m" in said
    np.testing.assert_allclose(cloud.points, expected, atol=0.03)
    cloud, _ = edited(tmp_path / "plain.ply", *sources)
    np.testing.assert_allclose(cloud.points[len(room) :], transform_points(inverse(T), again), atol=1e-5)


def test_survey_coordinates_stay_exact_and_no_normals_are_invented(tmp_path, rng):
    utm = np.array([691_000.0, 5_334_000.0, 520.0]) + rng.uniform(0.0, 10.0, (500, 3))
    write_cloud(tmp_path / "utm.ply", PointCloud(utm, np.tile([0.0, 0.0, 1.0], (500, 1))))
    for name in ("cut.ply", "cut.pcd"):
        cloud, _ = edited(tmp_path / name, tmp_path / "utm.ply", "--box", 0, 1e7, 0, 1e7, 0, 1e4)
        np.testing.assert_allclose(cloud.points, utm, atol=1e-9)
        assert not cloud.normals.any()


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["{run}", "-o", "{out}.obj"], 2, "expected a file .ply, .pcd, .laz, .e57"),
        (["{run}", "-o", "{out}.ply", "--box", *BACKWARDS], 2, "expected each from less than its to"),
        (["{run}", "-o", "{out}.ply", "--box", *OUTSIDE], 1, "no point is left of the map"),
        (["{run}", "-o", "{out}.ply", "--transform", "{run}/config.yaml"], 2, "each of the 0 further sources"),
        (["{run}/map.ply", "-o", "{out}.ply", "--within", "3"], 1, "--within needs the path of a run"),
        (["{run}/map.ply", "-o", "{out}.ply", "--level", "gravity"], 1, "use --level ground"),
        (["{run}/map.ply", "-o", "{out}.ply", "--moved", "3"], 1, "found in the scans of a run"),
        (["{run}/map.ply", "-o", "{run}/map.ply"], 1, "exists; name another file"),
        (["{run}/none.ply", "-o", "{out}.ply"], 1, "no such file"),
        (["{wall}", "-o", "{out}.ply", "--level", "ground"], 1, "no ground within 45 degrees of level"),
        (["{run}", "{wall}", "-o", "{out}.ply", "--register"], 1, "wall.ply: could not be registered"),
    ],
)
def test_mistakes_get_one_line(run, tmp_path, arguments, status, said):
    wall: FloatArray = np.random.default_rng(0).uniform([40.0, 0.0, 0.0], [40.01, 9.0, 9.0], (2000, 3))
    write_cloud(tmp_path / "wall.ply", PointCloud(wall, np.tile([1.0, 0.0, 0.0], (len(wall), 1))))
    places = {"run": run, "out": tmp_path / "out", "wall": tmp_path / "wall.ply"}
    ended = lidarslam("map", *(argument.format(**places) for argument in arguments))
    assert ended.exit_code == status, ended.output
    assert said in ended.stderr
    assert status == 2 or len(ended.stderr.splitlines()) == 1
    assert not list(tmp_path.glob("out*"))

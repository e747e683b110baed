"""A run placed in UTM by the NavSatFix of its bag."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from lidarslam.core.geometry import FloatArray, exp, make_transform
from lidarslam.core.scan import PointAttributes
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.exports.bag import RosTopics
from lidarslam.mapping.global_map.point_cloud import PointCloud

from ..conftest import lidarslam, succeeds, write_run
from .conftest import FAST, refused

pyproj = pytest.importorskip("pyproj")

ANTENNA = np.array([-0.5, 0.2, 1.0])
PLACE = (-33.8568, 151.2153, 25.0)  # Sydney, zone 56 south
FIRST_STAMP = 1_700_000_000.0
SCANS = 120


def in_utm(T: FloatArray) -> FloatArray:
    """Poses in UTM of those in a world that heads south-east."""
    east, north = pyproj.Transformer.from_crs(4326, 32756, always_xy=True).transform(PLACE[1], PLACE[0])
    return make_transform(exp([0.0, 0.0, -0.8, 0.0, 0.0, 0.0])[:3, :3], [east, north, PLACE[2]]) @ T


@pytest.fixture(scope="module")
def truth() -> FloatArray:
    """Poses in UTM of a curve of 110 m."""
    return in_utm(exp(np.multiply.outer(np.arange(SCANS) * 0.1, [0.0, 0.0, 0.12, 9.0, 0.0, 0.1])))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, truth: FloatArray) -> Path:
    """A run without error, its recording a bag whose antenna is not at the LiDAR and has no fix at first."""
    folder = tmp_path_factory.mktemp("geo")
    stamps = FIRST_STAMP + 0.1 * np.arange(SCANS)
    scale = pyproj.Proj(32756).get_factors(PLACE[1], PLACE[0]).meridional_scale
    T = np.linalg.inv(truth[0]) @ truth
    T[:, :3, 3] /= scale
    write_bag(folder / "drive.bag", stamps, truth)
    cloud = PointCloud(T[:, :3, 3] + [0.0, 5.0, 0.0], np.tile([0.0, 1.0, 0.0], (SCANS, 1)))
    return write_run(folder / "run", Trajectory(stamps, T), cloud, source=str(folder / "drive.bag"))


def write_bag(path: Path, stamps: FloatArray, T_utm_lidar: FloatArray, clouds=None, T_utm_fix=None, variance=0.01):
    T = T_utm_lidar if T_utm_fix is None else T_utm_fix
    antenna = T[:, :3, :3] @ ANTENNA + T[:, :3, 3]
    longitude, latitude = pyproj.Transformer.from_crs(32756, 4326, always_xy=True).transform(*antenna[:, :2].T)
    with Writer(path) as bag:
        topics = RosTopics(bag)
        types = topics.store.types
        fixed = topics.transforms(stamps[0], ("lidar", "gps", make_transform(np.eye(3), ANTENNA)))
        topics.write("/tf_static", stamps[0], fixed)
        for n, stamp in enumerate(stamps):
            points = np.eye(3) + n if clouds is None else clouds[n]
            topics.write("/points", stamp, topics.cloud(stamp, "lidar", points, PointAttributes()))
            status = types["sensor_msgs/msg/NavSatStatus"](status=-1 if n < 5 else 0, service=1)
            at = (0.0, 0.0, 0.0) if n < 5 else (latitude[n], longitude[n], antenna[n, 2])
            covariance = (variance * np.diag([1.0, 1.0, 4.0])).ravel()
            header = topics.header(stamp, "gps")
            topics.write("/fix", stamp, types["sensor_msgs/msg/NavSatFix"](header, status, *at, covariance, 2))


def test_trajectory_and_map_are_in_utm(run, truth, tmp_path):
    import laspy

    assert "WGS 84 / UTM zone 56S, EPSG:32756" in succeeds("export-geo", run, "--out", tmp_path / "utm")
    written = read_tum(tmp_path / "utm" / "trajectory_utm.tum")
    np.testing.assert_allclose(written.positions, truth[:, :3, 3], atol=0.02)
    about = json.loads((tmp_path / "utm" / "georeference.json").read_text())
    assert about["residual_rms_m"] < 0.01
    assert about["gnss_positions"] == SCANS - 5
    assert about["lidar_antenna_m"] == pytest.approx(ANTENNA)
    las = laspy.read(tmp_path / "utm" / "map.laz")
    assert las.header.parse_crs().to_epsg() == 32756
    np.testing.assert_allclose(las.xyz, truth[:, :3, 3] + truth[0, :3, :3] @ [0.0, 5.0, 0.0], atol=0.02)
    normals = np.column_stack([las[name] for name in ("NormalX", "NormalY", "NormalZ")])
    np.testing.assert_allclose(normals, np.tile(truth[0, :3, 1], (SCANS, 1)), atol=1e-3)


def test_the_path_for_maps_on_the_web(run, tmp_path):
    succeeds("export-geo", run, "--out", tmp_path)
    (feature,) = json.loads((tmp_path / "trajectory.geojson").read_text())["features"]
    first = feature["geometry"]["coordinates"][0]
    assert first[2] == pytest.approx(PLACE[2], abs=0.02)
    assert first[:2] == pytest.approx([PLACE[1], PLACE[0]], abs=1e-6)
    assert len(feature["properties"]["times"]) == len(feature["geometry"]["coordinates"]) == SCANS
    line = ElementTree.parse(tmp_path / "trajectory.kml").find(".//{http://www.opengis.net/kml/2.2}coordinates")
    points = [[float(number) for number in point.split(",")] for point in line.text.split()]
    np.testing.assert_allclose(points, np.array(feature["geometry"]["coordinates"])[:, :2], atol=1e-9)


def test_what_cannot_be_placed_is_refused(run, small_recording, tmp_path, monkeypatch):
    """GNSS needs positions and the graph."""
    assert "has no GNSS positions" in refused("run", small_recording, "--out", tmp_path / "run", "--gnss")
    assert lidarslam("run", small_recording, "--gnss", "--no-pose-graph").exit_code == 2
    succeeds("export-geo", run, "--out", tmp_path / "utm")
    assert "--overwrite" in refused("export-geo", run, "--out", tmp_path / "utm")
    few = read_tum(run / "trajectory.tum").select(slice(0, 12))
    short = write_run(tmp_path / "short", few, source=str(run.parent / "drive.bag"))
    assert "too short to determine the heading" in refused("export-geo", short, "--out", tmp_path / "other")
    assert not (tmp_path / "other").exists()
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert "pip install 'lidarslam[geo]'" in refused("export-geo", run, "--out", tmp_path / "other")


def test_a_run_is_held_by_gnss_and_written_in_utm(tmp_path, room):
    def walk(times: FloatArray) -> FloatArray:
        t = np.asarray(times, dtype=np.float64)
        places = np.stack([2.5 * np.sin(0.6 * t), 1.5 * np.cos(0.9 * t) - 1.5, 0.0 * t], axis=-1)
        return make_transform(exp(np.multiply.outer(0.1 * t, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))[..., :3, :3], places)

    times = 0.1 * np.arange(1, 61)
    truth = in_utm(walk(times))
    still = replace(room, points=4000, period_s=0.001)
    clouds = [still.sweep(walk, float(time)).points for time in times]
    fixes = truth.copy()
    fixes[30:36, :3, 3] += [4.0, -3.0, 5.0]  # of a reflection
    write_bag(tmp_path / "walk.bag", FIRST_STAMP + times, truth, clouds, fixes, variance=1e-4)
    out = tmp_path / "run"
    succeeds("run", tmp_path / "walk.bag", "--out", out, "--gnss", *FAST, "--set", "mapping.keypoints=800")
    written = read_tum(out / "utm" / "trajectory_utm.tum")
    np.testing.assert_allclose(written.positions, truth[:, :3, 3], atol=0.05)
    assert (out / "utm" / "map.laz").exists()

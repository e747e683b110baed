"""Recordings whose axes are not x forward, z up: as set, and as the ground shows; KITTI's elevation."""

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.spin_axis import image_axes
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets import mounting as mountings
from lidarslam.datasets.recording import RecordingInfo

QUARTERS = {"left": (90, 0, 0), "right": (-90, 0, 0), "backward": (0, 90, 0), "forward": (0, -90, 0)}
HEIGHT_M = 1.7
# Corners of boxes: two rows of houses, parked cars, a wall across.
BOXES = [
    ((-60.0, 9.0, -HEIGHT_M), (12.0, 15.0, 7.0)),
    ((16.0, 8.0, -HEIGHT_M), (60.0, 15.0, 5.0)),
    ((-60.0, -17.0, -HEIGHT_M), (60.0, -11.0, 9.0)),
    ((4.0, 4.0, -HEIGHT_M), (8.0, 6.0, -0.2)),
    ((-9.0, -7.0, -HEIGHT_M), (-5.0, -5.2, 0.1)),
    ((45.0, -11.0, -HEIGHT_M), (46.0, 9.0, 3.0)),
]


def turn(roll: float, pitch: float, yaw: float) -> FloatArray:
    return np.asarray(Rotation.from_euler("xyz", (roll, pitch, yaw), degrees=True).as_matrix())


def rays(low_deg: float = -25.0, high_deg: float = 10.0, rings: int = 32) -> FloatArray:
    elevations, azimuths = np.meshgrid(np.deg2rad(np.linspace(low_deg, high_deg, rings)), np.linspace(0.0, 6.27, 720))
    across = np.cos(elevations)
    parts = across * np.cos(azimuths), across * np.sin(azimuths), np.sin(elevations)
    return np.stack(parts, axis=-1).reshape(-1, 3)


def cast(
    directions: FloatArray, x: float, boxes: list, ceiling_m: float = np.inf, height_m: float = HEIGHT_M
) -> FloatArray:
    """Points (N, 3) that a sensor at x along a street, or in a room, measures."""
    origin = np.array([x, 0.0, 0.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(directions[:, 2] < 0.0, -height_m / directions[:, 2], ceiling_m / directions[:, 2])
        for low, high in boxes:
            near, far = (np.array(corner) - origin for corner in (low, high))
            enter = np.minimum(near / directions, far / directions).max(axis=1)
            leave = np.maximum(near / directions, far / directions).min(axis=1)
            ranges = np.where((enter > 0.0) & (enter < leave), np.minimum(ranges, enter), ranges)
    noise = np.random.default_rng(round(1e3 * x)).normal(0.0, 0.01, len(ranges))
    seen = ranges < 70.0
    return (ranges + noise)[seen, None] * directions[seen]


def drive_past(directions: FloatArray, step_m: float, boxes: list, **surroundings: float) -> list[FloatArray]:
    """Five scans, each so far along the street or the room."""
    return [cast(directions, step_m * number, boxes, **surroundings) for number in range(5)]


@cache
def street() -> list[FloatArray]:
    return drive_past(rays(), 0.8, BOXES)


class Recorded:
    """A recording in memory, with all that a mounting turns."""

    name = "memory"
    warnings = ("old",)
    T_cam_lidar = make_transform(turn(10, 20, 30), np.array([0.1, 0.2, 0.3]))
    ground_truth = Trajectory(np.arange(3.0), np.stack([make_transform(turn(0, 0, a), [1, 1, 1]) for a in (0, 30, 60)]))
    imu = ImuSamples(np.arange(3.0), np.ones((3, 3)), np.ones((3, 3)), T_cam_lidar)

    def __init__(self, clouds: list[FloatArray]) -> None:
        self._scans = [Scan(points, float(number)) for number, points in enumerate(clouds)]
        self.passes = 0

    def __len__(self) -> int:
        return len(self._scans)

    def scans(self, start=0, stop=None, step=1, faults=None) -> Iterator[Scan]:  # noqa: ARG002
        self.passes += 1
        return iter(self._scans[start:stop:step])

    def describe(self) -> RecordingInfo:
        return RecordingInfo("memory", len(self), self._scans[0], 1.0, None, None)


@pytest.mark.parametrize(("mounting", "z", "x"), [
    ("upright", (0, 0, 1), (1, 0, 0)), ("upside-down", (0, 0, -1), (1, 0, 0)), ("left", (0, 1, 0), (1, 0, 0)),
    ("right", (0, -1, 0), (1, 0, 0)), ("forward", (1, 0, 0), (0, 0, -1)), ("backward", (-1, 0, 0), (0, 0, 1)),
    ("camera", (1, 0, 0), (0, -1, 0)),
])  # fmt: skip
def test_a_name_says_where_the_recorded_z_axis_points(mounting, z, x):
    R = mountings.transform_of(mounting)[:3, :3]
    np.testing.assert_array_equal(R @ [0, 0, 1], z)
    np.testing.assert_array_equal(R @ [1, 0, 0], x)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_angles_are_those_of_the_recorded_axes():
    np.testing.assert_allclose(mountings.transform_of((10.0, 20.0, 30.0))[:3, :3], turn(10, 20, 30), atol=1e-15)
    odd = turn(70, 25, 110)
    mounting = mountings.mounting_with_up(odd.T[:, 2])
    assert mountings.guess_mounting(points @ odd.T for points in street()).warning is not None
    assert not isinstance(mounting, str)
    np.testing.assert_allclose((mountings.transform_of(mounting)[:3, :3] @ odd.T)[:, 2], [0, 0, 1], atol=0.02)
    assert mountings.written(mounting).count(",") == 2


def test_scans_truth_and_extrinsics_are_turned_together():
    clouds = [points[::50] @ turn(*QUARTERS["left"]).T for points in street()[:2]]
    recorded = Recorded(clouds)
    mounted = mountings.MountedRecording(recorded, "left")
    T = mountings.transform_of("left")
    for scan, points in zip(mounted.scans(), clouds, strict=True):
        np.testing.assert_allclose(scan.points, points @ T[:3, :3].T)
    # What a point of the recorded axes is in the truth's world, and the camera and the LiDAR of the IMU, stay.
    np.testing.assert_allclose(mounted.ground_truth.T_world_lidar @ T, recorded.ground_truth.T_world_lidar, atol=1e-12)
    np.testing.assert_allclose(mounted.T_cam_lidar @ T, recorded.T_cam_lidar, atol=1e-12)
    np.testing.assert_allclose(mounted.imu.T_lidar_imu, T @ recorded.imu.T_lidar_imu, atol=1e-12)
    assert mounted.warnings == ("old",)
    assert "reader.mounting=left" in mounted.describe().notes[-1]
    assert recorded.passes == 1, "nothing is to be guessed"


def test_an_upright_recording_is_left_alone():
    recorded = Recorded(street()[:2])
    mounted = mountings.MountedRecording(recorded, "auto")
    assert all(scan.points is own.points for scan, own in zip(mounted.scans(), recorded.scans(), strict=True))
    np.testing.assert_array_equal(mounted.ground_truth.T_world_lidar, recorded.ground_truth.T_world_lidar)
    assert mounted.warnings == recorded.warnings


@pytest.mark.parametrize("name", [*QUARTERS, "upside-down"])
def test_the_ground_shows_a_turned_sensor(name):
    R = turn(*QUARTERS.get(name, (180, 0, 0)))
    guess = mountings.guess_mounting(points @ R.T for points in street())
    assert guess.mounting == name
    assert guess.warning is not None
    assert f"--set reader.mounting={name}" in guess.warning


@cache
def scene(name: str) -> list[FloatArray]:
    """Scans that show no ground, or the ground where it should be."""
    gallery = [((-60.0, 2.5, -9.0), (60.0, 3.0, 9.0)), ((-60.0, -2.2, -1.6), (60.0, 2.5, -1.5))]
    opposite = ((-3.0, -16.1, -4.0), (3.0, -16.0, 3.0))
    match name:
        case "street":
            return street()
        case "corridor":  # two metres wide and 2.6 high
            walls = [((-40.0, 1.0, -2.0), (40.0, 1.2, 2.0)), ((-40.0, -1.2, -2.0), (40.0, -1.0, 2.0))]
            return drive_past(rays(-15.0, 15.0), 0.2, walls, ceiling_m=0.9)
        case "dome that sees the ceiling and not the floor":
            walls = [((-6.0, 4.0, -2.0), (6.0, 4.2, 9.0)), ((-6.0, -3.2, -2.0), (6.0, -3.0, 9.0))]
            walls += [((6.0, -4.0, -2.0), (6.2, 5.0, 9.0)), ((-6.2, -4.0, -2.0), (-6.0, 5.0, 9.0))]
            return drive_past(rays(-7.0, 52.0), 0.1, walls, ceiling_m=1.2)
        case "gallery":  # the floor of the hall is beyond that of the gallery, nothing is beyond the wall
            return drive_past(rays(-45.0, 45.0, 64), 0.2, gallery, ceiling_m=4.6, height_m=7.0)
        case "gallery with a wall opposite":
            return drive_past(rays(-45.0, 45.0, 64), 0.2, [*gallery, opposite], ceiling_m=4.6, height_m=7.0)
    facade = ((-20.0, 2.5, -7.0), (20.0, 12.0, 12.0))
    return drive_past(rays(-15.0, 15.0, 16), 0.2, [facade], height_m=7.0)


LEFT_ALONE = {
    "street": [(0, 0, 0), (25, 0, 0), (0, -35, 0), (45, 0, 0), (30, 30, 120), (0, 55, 0)],
    "corridor": [(0, 0, 0), (180, 0, 0), (25, 0, 0)],
    "dome that sees the ceiling and not the floor": [(0, 0, 0), (25, 0, 0), (0, 90, 0), (180, 0, 0)],
    "gallery": [(0, 0, 0), (25, 0, 0), (0, -30, 0)],
    "gallery with a wall opposite": [(0, 0, 0), (25, 0, 0), (0, -30, 0)],
    "flight along a facade": [(0, 0, 0), (25, 0, 0), (0, -30, 0)],
}


@pytest.mark.parametrize(("name", "angles"), [(name, angles) for name in LEFT_ALONE for angles in LEFT_ALONE[name]])
def test_walls_and_ceilings_are_no_ground_and_a_tilt_is_left_alone(name, angles):
    assert mountings.guess_mounting(points @ turn(*angles).T for points in scene(name)) == mountings.UPRIGHT


def test_what_only_some_scans_show_is_a_warning_and_no_more():
    R, grass = turn(*QUARTERS["left"]), np.random.default_rng(0).normal(0.0, 5.0, (4000, 3))
    guess = mountings.guess_mounting([street()[0] @ R.T, street()[1] @ R.T, grass, grass, grass])
    assert guess.mounting == "upright"
    assert guess.warning is not None
    assert "--set reader.mounting=left" in guess.warning


@pytest.mark.parametrize(
    "points", [np.empty((0, 3)), np.ones((3, 3)), np.ones((500, 3)), np.eye(3).repeat(400, axis=0)]
)
def test_scans_without_surfaces_show_nothing(points):
    assert mountings.guess_mounting([points] * 5) == mountings.UPRIGHT


@pytest.mark.parametrize("angles", [(90, 0, 0), (0, 90, 0), (45, 0, 0), (30, 40, 110)])
def test_the_axis_that_a_sensor_spins_about_is_found(angles):
    R = turn(*angles)
    found = image_axes(street()[0] @ R.T)
    np.testing.assert_allclose(np.abs(found[2] @ R), [0.0, 0.0, 1.0], atol=0.01)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    "directions",
    [rays(), rays(-45.0, 45.0), rays(0.0, 89.0), rays()[rays()[:, 0] > 0.6], np.empty((0, 3)), np.full((9, 3), np.nan)],
    ids=["spinning", "wide", "dome", "forward", "none", "invalid"],
)
def test_images_of_other_sensors_keep_their_axes(directions):
    np.testing.assert_array_equal(image_axes(5.0 * directions), np.eye(3))


def _cloud(rng: np.random.Generator, count: int = 20_000) -> np.ndarray:
    return rng.uniform([-80.0, -80.0, -5.0], [80.0, 80.0, 10.0], size=(count, 3))


def test_equals_kiss_icp(rng):
    pybind = pytest.importorskip("kiss_icp.pybind.kiss_icp_pybind")
    points = _cloud(rng)
    expected = np.asarray(pybind._correct_kitti_scan(pybind._Vector3dVector(points)))
    assert np.abs(expected - points).max() > 0.3  # the oracle does something
    np.testing.assert_allclose(mountings.correct_elevation(points, 0.205), expected, rtol=0.0, atol=1e-9)


def test_raises_elevation_and_keeps_range_azimuth_and_its_input(rng):
    given = _cloud(rng).astype(np.float32)
    points = given.astype(np.float64)
    raised = mountings.correct_elevation(given, 1.5)
    assert raised.dtype == np.float64
    np.testing.assert_array_equal(given, points)
    elevation = [np.rad2deg(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))) for p in (points, raised)]
    np.testing.assert_allclose(elevation[1] - elevation[0], 1.5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), np.linalg.norm(points, axis=1), rtol=1e-12)
    azimuth = [np.arctan2(p[:, 1], p[:, 0]) for p in (points, raised)]
    np.testing.assert_allclose(azimuth[1], azimuth[0], atol=1e-12)


def test_invalid_points_stay_recognisable():
    raised = mountings.correct_elevation(np.array([[0.0, 0.0, 0.0], [np.nan, 1.0, 2.0], [np.inf, 1.0, np.inf]]), 0.205)
    np.testing.assert_array_equal(raised[0], 0.0)
    assert not np.isfinite(raised[1:]).all(axis=1).any()

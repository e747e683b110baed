"""Samples of the simulated IMU integrate to the true motion; their errors are of the stated size."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import inverse, rotation_angle
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.imu import EXACT_IMU, GRAVITY, MEMS_IMU, InertialErrors, bias_paths
from lidarslam.simulation.motion import motion_along, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import find_sensor


def simulation(yard, carrier="handheld", mount="tilted", scans=150, imu_model=EXACT_IMU):
    motion = motion_along_route(carrier, yard, seed=3)
    T_body_lidar = mount_pose(mount, motion.sensor_height_m)
    return Simulation(yard, find_sensor("vlp-16"), motion, T_body_lidar, scans, 4, imu_model)


def integrate(imu, T_world_imu, velocity):
    """Poses (N, 4, 4) of the IMU from its samples, by the trapezoidal rule, from the first pose and velocity."""
    poses, velocity = [T_world_imu], velocity.copy()
    dt = np.diff(imu.stamps)
    turns = Rotation.from_rotvec(0.5 * (imu.angular_velocities[1:] + imu.angular_velocities[:-1]) * dt[:, None])
    g = np.array([0.0, 0.0, -GRAVITY])
    for k, turn in enumerate(turns.as_matrix()):
        T = poses[-1].copy()
        T[:3, :3] = poses[-1][:3, :3] @ turn
        before = poses[-1][:3, :3] @ imu.accelerations[k] + g
        after = T[:3, :3] @ imu.accelerations[k + 1] + g
        T[:3, 3] += dt[k] * velocity + dt[k] ** 2 * (before / 3.0 + after / 6.0)
        velocity = velocity + 0.5 * dt[k] * (before + after)
        poses.append(T)
    return np.stack(poses)


@pytest.mark.parametrize(
    ("carrier", "mount"),
    [("handheld", "tilted"), ("tracked-harsh", "upright"), ("drone", "upside-down"), ("car", "tilted")],
)
def test_exact_samples_integrate_to_the_true_poses(carrier, mount, yard):
    """Through the lever arm and the turned mounting, for 15 s; without gravity upwards at rest they would run away."""
    simulated = simulation(yard, carrier, mount)
    imu = simulated.imu
    assert len(imu) == 15 * 200 + 1
    true = simulated.T_world_lidar_at(imu.stamps) @ imu.T_lidar_imu
    found = integrate(imu, true[0], np.zeros(3))
    assert rotation_angle(inverse(true[-1]) @ found[-1]) < 1e-3
    assert np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.05
    assert np.linalg.norm(true[-1, :3, 3] - true[0, :3, 3]) > 2.0


@pytest.mark.parametrize("carrier", ["car-fast", "given"])
def test_a_start_and_an_end_at_speed_are_no_blows(carrier, yard):
    if carrier == "given":
        stamps = np.linspace(0.0, 10.0, 101)
        poses = np.tile(np.eye(4), (101, 1, 1))
        poses[:, 0, 3] = 5.0 * stamps
        motion = motion_along(Trajectory(stamps, poses))
    else:
        motion = motion_along_route(carrier, yard, seed=3)
    simulated = Simulation(yard, find_sensor("vlp-16"), motion, np.eye(4), 100, imu_model=EXACT_IMU)
    assert simulated.imu.stamps[[0, -1]].tolist() == [0.0, 10.0]
    ends = np.linalg.norm(simulated.imu.accelerations[[0, -1]], axis=1)
    assert np.abs(ends - GRAVITY).max() < 5.0
    if carrier == "given":
        np.testing.assert_allclose(np.linalg.norm(simulated.imu.accelerations, axis=1), GRAVITY, atol=1e-3)


def test_errors_are_white_noise_and_biases(yard):
    exact, noisy = (simulation(yard, imu_model=model).imu for model in (EXACT_IMU, MEMS_IMU))
    biases = bias_paths(MEMS_IMU, len(noisy), 4)
    parts = {"angular_velocities": MEMS_IMU.gyroscope, "accelerations": MEMS_IMU.accelerometer}
    for k, (name, errors) in enumerate(parts.items()):
        bias = biases[:, 3 * k : 3 * k + 3]
        white = getattr(noisy, name) - getattr(exact, name) - bias
        # One-sided density times the square root of the band, 100 Hz, as data sheets mean it.
        np.testing.assert_allclose(white.std(axis=0), errors.density * np.sqrt(100.0), rtol=0.05)
        assert np.abs(white.mean(axis=0)).max() < 5.0 * errors.density / np.sqrt(15.0)
        assert np.abs(bias[0]).max() > 0.1 * errors.bias


def test_biases_walk_as_a_random_walk():
    model = replace(MEMS_IMU, gyroscope=InertialErrors(0.0, 0.0, 1e-3), accelerometer=InertialErrors(0.0, 0.1, 0.0))
    ends = np.stack([bias_paths(model, 2001, seed) for seed in range(200)])
    walked = ends[:, -1, :3] - ends[:, 0, :3]
    np.testing.assert_allclose(walked.std(), 1e-3 * np.sqrt(10.0), rtol=0.1)
    assert (ends[:, -1, 3:] == ends[:, 0, 3:]).all()
    np.testing.assert_allclose(ends[:, 0, 3:].std(), 0.1, rtol=0.1)

"""Scans of a room of 10 x 8 x 3 m with a box before one wall: simulated, without noise, from where one stands."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.motion import Motion, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import RangeModel, find_sensor
from lidarslam.simulation.world import Boxes, Route, World

EXACT = RangeModel(0.05, 100.0, 0.0, 0.0, 0.0, 1e-9, dropout=0.0)
STAND = (0.7, -0.4, 1.3)

Scanner = Callable[..., Scan]


def _room() -> World:
    walls = [((5.1, 0, 1.5), (0.1, 5, 2)), ((-5.1, 0, 1.5), (0.1, 5, 2)), ((0, 4.1, 1.5), (6, 0.1, 2))]
    walls += [((0, -4.1, 1.5), (6, 0.1, 2)), ((0, 0, -0.1), (6, 5, 0.1)), ((0, 0, 3.1), (6, 5, 0.1))]
    box = [((3.25, 0.5, 1.5), (0.25, 0.5, 1.5))]
    centres, halves = (np.array(rows, dtype=np.float64) for rows in zip(*walls, *box, strict=True))
    boxes = Boxes(centres, halves, np.tile(np.eye(3), (len(centres), 1, 1)))
    corners = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    return World("room", 0, Route(corners, 0.5, 0.3, 2.0, 1.0), boxes)


@pytest.fixture(scope="session")
def scan_room() -> Scanner:
    """Makes a scan of the room: by sensor, mount, and the deviation of the range's noise."""
    world = _room()
    base = np.zeros((3, 7))
    base[:, :3] = STAND
    still = Motion("still", np.array([0.0, 1.0, 2.0]), base, 0.0, repeats=False)

    def scan(sensor: str, mount: str = "upright", sigma_m: float = 0.0) -> Scan:
        model = replace(find_sensor(sensor), ranging=replace(EXACT, sigma_m=sigma_m))
        return Simulation(world, model, still, mount_pose(mount, 0.0), 5).scan(1).scan

    return scan


@pytest.fixture(scope="session")
def ring_scans(room: Any, drive: Callable[[FloatArray], FloatArray], room_truth: Trajectory) -> list[Scan]:
    """Twenty rolling sweeps along the drive by a scanner with rings."""
    return [room.ring_sweep(drive, float(stamp)) for stamp in room_truth.stamps]

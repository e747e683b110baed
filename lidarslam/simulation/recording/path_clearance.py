"""Clearance of a given trajectory in a world that was not made around it."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.motion.carriers import Carrier
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.world import World

_TIME_STEP_S = 0.02
_LOWEST_M = 0.3  # kerbs and bumps under a carrier are not in its way


def check_clearance(simulation: Simulation, carrier: Carrier, name: str) -> None:
    """Refuse a trajectory on which the carrier's body meets a static surface, from the first scan to the last.

    The body is a ball of the carrier's half width round the sensor; on the ground, one above the wheels as well.

    Args:
        simulation: whose motion follows the trajectory.
        carrier: moves along it.
        name: of the trajectory, for the message.

    Raises:
        InputError: the way leads through something solid or off the world's ground; says where and when.
    """
    world = simulation.world
    times = np.arange(0.0, simulation.scan_count / simulation.sensor.rate_hz + _TIME_STEP_S, _TIME_STEP_S)
    positions = simulation.motion.pose_at(times)[:, :3, 3]
    on_ground = [carrier.half_width_m + _LOWEST_M, carrier.sensor_height_m]
    is_blocked = np.zeros(len(times), dtype=bool)
    for height in on_ground if carrier.leans_with_ground else [0.0]:
        body = positions + np.array([0.0, 0.0, height])
        is_blocked |= simulation.distance_to_surfaces(body) < carrier.half_width_m
        # A surface cannot be crossed without coming near it, so that only the start can be deep inside something.
        is_blocked[0] |= is_inside(world, body[0])
    for refused, whither in (
        (is_blocked, "through something solid"),
        (_is_off_ground(world, positions), "off the ground"),
    ):
        if refused.any():
            x, y, z = positions[refused.argmax()]
            raise InputError(
                f"{name}: leads {whither} in {world.name}, seed {world.seed}, at x {x:.1f}, y {y:.1f}, z {z:.1f} m,"
                f" {times[refused.argmax()]:.1f} s after its start; only --world street is built around a trajectory"
            )


def is_inside(world: World, point: FloatArray) -> bool:
    """Whether a point (3,) is inside a box or a cylinder, under the ground, or above the ceiling of a tunnel."""
    boxes, cylinders = world.boxes, world.cylinders
    local = np.einsum("nji,nj->ni", boxes.R_world_box, point - boxes.centres)
    in_box = (np.abs(local) < boxes.half_sizes).all(axis=1).any()
    axis = cylinders.ends - cylinders.starts
    along = np.einsum("ni,ni->n", point - cylinders.starts, axis) / np.einsum("ni,ni->n", axis, axis)
    aside = np.linalg.norm(point - cylinders.starts - along[:, None] * axis, axis=1)
    in_cylinder = ((along > 0.0) & (along < 1.0) & (aside < cylinders.radii)).any()
    levels = [float(field.height_at(point[None, :2])[0]) for field in world.height_fields]
    is_in_rock = bool(levels) and (point[2] < levels[0] or any(point[2] > level for level in levels[1:]))
    return bool(in_box or in_cylinder or is_in_rock)


def _is_off_ground(world: World, positions: FloatArray) -> NDArray[np.bool_]:
    if not world.height_fields:
        return np.zeros(len(positions), dtype=bool)
    ground = world.height_fields[0]
    far = ground.origin_xy + ground.cell_m * (np.array(ground.heights.shape) - 1.0)
    return np.asarray(((positions[:, :2] < ground.origin_xy) | (positions[:, :2] > far)).any(axis=1))

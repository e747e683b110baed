"""The scans of a recording, one after another or side by side: each depends on the request and its number alone."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

from lidarslam.core.tasks.start import open_tasks
from lidarslam.core.tasks.tasks import SERIAL
from lidarslam.simulation.motion.carriers import find_carrier, mount_pose
from lidarslam.simulation.recorder import SimulatedScan, Simulation
from lidarslam.simulation.recording.motion import given_path, plan_motion
from lidarslam.simulation.recording.path_clearance import check_clearance
from lidarslam.simulation.recording.reference_map import KeyArray, SeenSurfaces
from lidarslam.simulation.recording.request import RecordRequest
from lidarslam.simulation.sensors.table import find_sensor
from lidarslam.simulation.worlds.registry import build_world
from lidarslam.simulation.worlds.street.along import build_along

# Scans of a task.
_CHUNK = 10


def make_simulation(request: RecordRequest) -> Simulation:
    """The simulation that was asked for; a street is built along the trajectory, if there is one."""
    sensor = find_sensor(request.sensor)
    if request.world == "street" and request.trajectory is not None:
        world = build_along(given_path(request.trajectory, request.motion), request.seed)
    else:
        world = build_world(request.world, request.seed)
    motion, scans = plan_motion(request, world, sensor)
    T_body_lidar = mount_pose(request.mount, motion.sensor_height_m)
    simulation = Simulation(world, sensor, motion, T_body_lidar, scans, request.seed)
    if request.trajectory is not None:
        check_clearance(simulation, find_carrier(request.motion), str(request.trajectory))
    return simulation


def make_scans(request: RecordRequest, simulation: Simulation, seen: SeenSurfaces) -> Iterator[SimulatedScan]:
    """The scans of a simulation of the request, in order; the surfaces they saw are added."""
    if request.where.is_serial:
        for index in range(len(simulation)):
            yield _sweep(simulation, index, seen)
        return
    alone, count = replace(request, where=SERIAL), len(simulation)
    chunks = [(alone, range(first, min(first + _CHUNK, count))) for first in range(0, count, _CHUNK)]
    with open_tasks(request.where) as tasks:
        for made, keys in tasks.run(_chunk, chunks, ahead=2 * tasks.slots):
            seen.add_keys(keys)
            yield from made


def _sweep(simulation: Simulation, index: int, seen: SeenSurfaces) -> SimulatedScan:
    echoes = simulation.echoes(index)
    seen.add_sweep(echoes, simulation.sensor.ranging.min_range_m)
    return simulation.scan(index, echoes)


def _chunk(task: tuple[RecordRequest, range]) -> tuple[list[SimulatedScan], KeyArray]:
    """Some scans, as far as they are written, and the keys of what they saw."""
    request, indices = task
    simulation, seen = _simulation_of_process(request), SeenSurfaces()
    made = [replace(_sweep(simulation, index, seen), true_ranges=None, moving=None) for index in indices]
    return made, seen.keys()


@lru_cache(maxsize=1)
def _simulation_of_process(request: RecordRequest) -> Simulation:
    """Built once in each process."""
    return make_simulation(request)

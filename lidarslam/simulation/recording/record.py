"""One recording on disk: the scans in files of a format, the exact trajectory, the exact map, a README."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import write_tum
from lidarslam.simulation.casting.mesh import world_mesh
from lidarslam.simulation.motion.carriers import find_carrier
from lidarslam.simulation.motion.mounts import mount_pose
from lidarslam.simulation.motion.path_clearance import check_clearance
from lidarslam.simulation.recording.folder import GROUND_TRUTH, README, REFERENCE_MAP, new_folder
from lidarslam.simulation.recording.motion import given_path, plan_motion
from lidarslam.simulation.recording.recorder import Echoes, SimulatedScan, Simulation
from lidarslam.simulation.recording.reference_map import ReferenceMap, SeenSurfaces, add_sweep, sample_seen
from lidarslam.simulation.recording.request import RecordingSummary, RecordRequest
from lidarslam.simulation.recording.text import format_readme
from lidarslam.simulation.sensors.registry import find_sensor
from lidarslam.simulation.world import World
from lidarslam.simulation.worlds.registry import build_world
from lidarslam.simulation.worlds.street.along import build_along
from lidarslam.simulation.writers.clock import clock_s
from lidarslam.simulation.writers.interface import Rig
from lidarslam.simulation.writers.ply import write_ply
from lidarslam.simulation.writers.registry import find_format, load_writer

Progress = Callable[[int, int], None]
"""Called after every scan with its number from 1 and how many there will be."""


@dataclass(frozen=True, eq=False)
class _Recorder(Simulation):
    """A simulation that keeps the rays of the sweep it made last: its scan and the map both ask for them."""

    _last: dict[int, Echoes] = field(default_factory=dict)

    def echoes(self, index: int) -> Echoes:
        if index not in self._last:
            self._last.clear()
            self._last[index] = super().echoes(index)
        return self._last[index]


@dataclass
class _Tally:
    """What the scans that went by add up to."""

    points: int = 0
    seen: SeenSurfaces = field(default_factory=SeenSurfaces)

    def watch(self, recorder: _Recorder, progress: Progress) -> Iterator[SimulatedScan]:
        """Pass on the scans, one at a time."""
        for index in range(len(recorder)):
            simulated = recorder.scan(index)
            self.points += len(simulated.scan)
            add_sweep(self.seen, recorder, index)
            yield simulated
            del simulated  # before the next one is made
            progress(index + 1, len(recorder))


def record(request: RecordRequest, progress: Progress) -> RecordingSummary:
    """Make the recording's folder; it appears when everything in it is complete.

    Raises:
        InputError: no world, sensor, motion, mount or format has that name, or the trajectory cannot be followed
            or leads through something solid.
        OutputError: the folder holds something already, or cannot be written.
    """
    chosen = find_format(request.format)
    with new_folder(request.out, request.overwrite) as folder:
        recorder = _recorder(request)
        rig = Rig(recorder.sensor.driver, recorder.sensor.period_s, recorder.T_world_lidar_at)
        tally = _Tally()
        load_writer(request.format)(folder, tally.watch(recorder, progress), rig)
        truth = recorder.ground_truth
        stamps = np.array([clock_s(stamp, chosen.clock_start_ns) for stamp in truth.stamps])
        write_tum(folder / GROUND_TRUTH, Trajectory(stamps, truth.T_world_lidar))
        true_map = sample_seen(world_mesh(recorder.world), tally.seen, recorder.world.map_spacing_m)
        _write_map(folder / REFERENCE_MAP, true_map)
        summary = RecordingSummary(
            source=chosen.source_in(request.out),
            rate_hz=recorder.sensor.rate_hz,
            scans=len(recorder),
            points_per_scan=tally.points // len(recorder),
            duration_s=truth.duration_s,
            length_m=truth.length_m,
            map_points=len(true_map.points),
            map_spacing_m=recorder.world.map_spacing_m,
            size_mb=sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6,
        )
        (folder / README).write_text(format_readme(request, summary), encoding="utf-8")
    return summary


def _recorder(request: RecordRequest) -> _Recorder:
    sensor = find_sensor(request.sensor)
    world = _world(request)
    motion, scans = plan_motion(request, world, sensor)
    T_body_lidar = mount_pose(request.mount, motion.sensor_height_m)
    recorder = _Recorder(world, sensor, motion, T_body_lidar, scans, request.seed)
    if request.trajectory is not None:
        check_clearance(recorder, find_carrier(request.motion), str(request.trajectory))
    return recorder


def _world(request: RecordRequest) -> World:
    """The world of that name; a street is built along the trajectory, if there is one."""
    if request.world == "street" and request.trajectory is not None:
        return build_along(given_path(request.trajectory, request.motion), request.seed)
    return build_world(request.world, request.seed)


def _write_map(path: Path, true_map: ReferenceMap) -> None:
    vertices = np.empty(len(true_map.points), [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
    for column, axis in enumerate("xyz"):
        vertices[axis] = true_map.points[:, column]
        vertices[f"n{axis}"] = true_map.normals[:, column]
    write_ply(path, vertices)

"""One recording on disk: the scans in files of a format, the exact trajectory, the exact map, a README."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.text.trajectory_io import write_tum
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.casting.mesh import world_mesh
from lidarslam.simulation.recorder import SimulatedScan
from lidarslam.simulation.recording.folder import GROUND_TRUTH, README, REFERENCE_MAP, new_folder
from lidarslam.simulation.recording.reference_map import ReferenceMap, SeenSurfaces, sample_seen
from lidarslam.simulation.recording.request import RecordingSummary, RecordRequest
from lidarslam.simulation.recording.sweeps import make_scans, make_simulation
from lidarslam.simulation.recording.text import format_readme
from lidarslam.simulation.writers.interface import Rig, clock_s
from lidarslam.simulation.writers.ply import as_records, write_ply
from lidarslam.simulation.writers.registry import find_format

Progress = Callable[[int, int], None]
"""Called after every scan with its number from 1 and how many there will be."""


def record(request: RecordRequest, progress: Progress) -> RecordingSummary:
    """Make the recording's folder; it appears when everything in it is complete.

    Raises:
        InputError: no world, sensor, motion, mount or format has that name, the format holds no IMU, or the
            trajectory cannot be followed or leads through something solid.
        OutputError: the folder holds something already, or cannot be written.
    """
    chosen = find_format(request.format)
    if request.imu and not chosen.imu:
        raise InputError(f"the format {request.format} has no place for an IMU; choose another, or leave out --imu")
    with new_folder(request.out, request.overwrite) as folder:
        simulation = make_simulation(request)
        sensor, spacing_m = simulation.sensor, simulation.world.map_spacing_m
        seen = SeenSurfaces()
        counts: list[int] = []

        def scans() -> Iterator[SimulatedScan]:
            for simulated in make_scans(request, simulation, seen):
                counts.append(len(simulated.scan))
                yield simulated
                progress(len(counts), len(simulation))

        imu = simulation.imu if request.imu else None
        chosen.writer()(folder, scans(), Rig(sensor.driver, sensor.period_s, simulation.T_world_lidar_at, imu))
        truth = simulation.ground_truth
        stamps = np.array([clock_s(stamp, chosen.clock_start_ns) for stamp in truth.stamps])
        write_tum(folder / GROUND_TRUTH, Trajectory(stamps, truth.T_world_lidar))
        true_map = sample_seen(world_mesh(simulation.world), seen, spacing_m)
        _write_map(folder / REFERENCE_MAP, true_map)
        summary = RecordingSummary(
            source=chosen.source_in(request.out),
            rate_hz=sensor.rate_hz,
            scans=len(simulation),
            points_per_scan=sum(counts) // len(simulation),
            duration_s=truth.duration_s,
            length_m=truth.length_m,
            map_points=len(true_map.points),
            map_spacing_m=spacing_m,
            size_mb=sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6,
        )
        (folder / README).write_text(format_readme(request, summary), encoding="utf-8")
    return summary


def _write_map(path: Path, true_map: ReferenceMap) -> None:
    columns = zip(("x", "y", "z", "nx", "ny", "nz"), np.hstack(true_map).T, strict=True)
    write_ply(path, as_records({name: ("<f4", values) for name, values in columns}))

"""Localisation in a finished map from many starts: scans until it is found, accuracy, and wrong poses.

    python benchmarks/localise.py
    python benchmarks/localise.py --worlds office street --starts 12 --scans 60
    python benchmarks/localise.py --run runs/loop --source vlp16_loop --starts 16 --scans 50

A simulated world is mapped in one round from the true poses (one point per voxel, as `lidarslam run` writes maps).
Recordings then begin at `--starts` places of the round, with other seeds of sway and noise: with the sensor and carrier
of the map, in the opposite direction, with another sensor, and in another world of the same kind (other seed), where
every pose found is wrong. With `--run`, the map is that of a run, and the recording its own source; errors are then
relative to the poses of the run.

Prints a Markdown table with a row per case. Found: recordings that were found and confirmed. Scans: number until the
confirmation, median and largest. Errors: of all scans with status ok, median / largest. Wrong: scans that are ok or
degraded, or placed afterwards, and off by more than 0.5 m or 3 degrees. Lost: scans after the first confirmation.
Milliseconds: wall time of a tracked scan (median), and of a search (largest scan).
"""

import argparse
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from mapping_accuracy import in_world, make_parser, print_header, print_row

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, inverse, rotation_angle
from lidarslam.core.scan import Scan
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import read_tum
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.global_map.global_map import GlobalMap, voxel_size_for
from lidarslam.mapping.localization.map_localiser import MapLocaliser
from lidarslam.mapping.localization.place_search import FixedMap
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.odometry.config import OdometryConfig
from lidarslam.pipeline.estimates import SweepMotion
from lidarslam.pipeline.localisation import ScanToMap
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run.run import open_odometry
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.world import WORLDS, build_world
from lidarslam.storage.finished_run import load_map

WRONG_M, WRONG_DEG = 0.5, 3.0
_MOTIONS = {"street": "car", "terrace": "car", "fields": "car", "tunnel": "tracked", "hall": "tracked"}
# Every n-th scan of the round is in the map.
_MAP_EVERY = 5


def simulate(world: str, seed: int, motion_seed: int, sensor: str = "vlp-16", is_reversed: bool = False) -> Simulation:
    """A round of a world from the simulator."""
    place = build_world(world, seed)
    if is_reversed:
        place = replace(place, route=replace(place.route, waypoints=place.route.waypoints[::-1].copy()))
    return in_world(place, _MOTIONS.get(world, "handheld"), sensor, None, motion_seed)


def draw_map(simulation: Simulation) -> FixedMap:
    """Map of the scans at their true poses, in the simulator's world."""
    truth, merged = simulation.ground_truth.T_world_lidar, None
    for index in range(0, len(simulation) - 1, _MAP_EVERY):
        velocity = body_velocity(inverse(truth[index]) @ truth[index + 1], simulation.sensor.period_s)
        points = SweepMotion(velocity, velocity).compensate(simulation.scan(index).scan)
        if merged is None:
            merged = GlobalMap(voxel_size_for(points))
        points = points[one_per_cell(points, merged.voxel_size_m)]
        merged.add(points[np.linalg.norm(points, axis=1) < 80.0], truth[index])
    assert merged is not None
    cloud = merged.cloud()
    return FixedMap(cloud.points, cloud.normals)


@dataclass(eq=False)
class Outcome:
    """All recordings of a case."""

    recordings: int = 0
    confirmed: list[int] = field(default_factory=list)
    errors_m: list[float] = field(default_factory=list)
    errors_deg: list[float] = field(default_factory=list)
    wrong: int = 0
    lost: int = 0
    tracked_ms: list[float] = field(default_factory=list)
    search_ms: list[float] = field(default_factory=list)

    def add(self, localiser: MapLocaliser, scans: list[Scan], config: Config, truth: FloatArray | None) -> None:
        """Localise a recording; truth (N, 4, 4) in the map's frame, None if the map is of another place."""
        with closing(open_odometry(config, None)) as odometry:
            pipeline = Pipeline(odometry, ScanToMap(localiser), config.global_map)
            results = list(pipeline.run(scans))
        self.recordings += 1
        poses = np.array([result.T_world_lidar for result in results])
        statuses = [result.status for result in results]
        ms = np.array([result.stage_ms["refine"] for result in results])
        self.tracked_ms += [one for one, status in zip(ms, statuses, strict=True) if status is Status.OK]
        self.search_ms.append(float(ms.max()))
        placed = np.array([status is not Status.LOST for status in statuses])
        if localiser.found:
            for number, pose in localiser.corrections.items():
                poses[number] = pose
            placed[localiser.placed_afterwards] = True
            self.confirmed.append(localiser.found[0].confirmed + 1)
            self.lost += int((~placed[localiser.found[0].confirmed :]).sum())
        placed[localiser.unconfirmed()] = False
        if truth is None:
            self.wrong += int(placed.sum())
            return
        off = inverse(truth) @ poses
        off_m, off_deg = np.linalg.norm(off[:, :3, 3], axis=1), np.rad2deg(rotation_angle(off))
        self.wrong += int((placed & ((off_m > WRONG_M) | (off_deg > WRONG_DEG))).sum())
        ok = np.array([status is Status.OK for status in statuses])
        self.errors_m += off_m[ok].tolist()
        self.errors_deg += off_deg[ok].tolist()

    def cells(self) -> list[str]:
        found, none = len(self.confirmed), "-"
        return [
            f"{found} of {self.recordings}",
            f"{np.median(self.confirmed):.0f}, {max(self.confirmed)}" if found else none,
            f"{100 * np.median(self.errors_m):.1f} / {100 * max(self.errors_m):.1f}" if self.errors_m else none,
            f"{np.median(self.errors_deg):.2f} / {max(self.errors_deg):.2f}" if self.errors_deg else none,
            str(self.wrong),
            str(self.lost),
            f"{np.median(self.tracked_ms):.0f}" if self.tracked_ms else none,
            f"{max(self.search_ms):.0f}",
        ]


def cases(world: str) -> Iterator[tuple[str, Simulation, bool]]:
    """Name, recording, and whether it is of the mapped world."""
    yield "same way", simulate(world, 0, 1), True
    yield "other way", simulate(world, 0, 2, is_reversed=True), True
    yield "os1-64", simulate(world, 0, 3, "os1-64"), True
    yield "other world", simulate(world, 1, 4), False


def starts(count: int, scans: int, available: int) -> list[int]:
    """First scans of recordings, evenly spaced."""
    return [int(first) for first in np.linspace(0, max(0, available - scans), count)]


def of_worlds(arguments: argparse.Namespace, config: Config) -> None:
    """Print the rows of simulated worlds."""
    for world in arguments.worlds:
        fixed_map = draw_map(simulate(world, 0, 0))
        for name, recording, is_there in cases(world):
            outcome = Outcome()
            for first in starts(arguments.starts, arguments.scans, len(recording)):
                scans = list(recording.scans(first, first + arguments.scans))
                truth = recording.ground_truth.T_world_lidar[first : first + arguments.scans] if is_there else None
                outcome.add(MapLocaliser(config.mapping, fixed_map), scans, config, truth)
            print_row([world, f"vlp-16, {name}", *outcome.cells()])


def of_run(arguments: argparse.Namespace, config: Config) -> None:
    """Print the row of a run, whose own recording is localised."""
    cloud, trajectory = load_map(arguments.run), read_tum(arguments.run / "trajectory.tum")
    fixed_map, recording, outcome = (
        FixedMap(cloud.points, cloud.normals), open_recording(arguments.source, config.reader), Outcome(),
    )  # fmt: skip
    for first in starts(arguments.starts, arguments.scans, len(recording)):
        scans = list(recording.scans(first, first + arguments.scans))
        truth = trajectory.T_world_lidar[first : first + arguments.scans]
        outcome.add(MapLocaliser(config.mapping, fixed_map), scans, config, truth)
    print_row([arguments.run.name, arguments.source.name, *outcome.cells()])


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--worlds", nargs="*", default=list(WORLDS), choices=WORLDS)
    parser.add_argument("--starts", type=int, default=8)
    parser.add_argument("--scans", type=int, default=50)
    parser.add_argument("--odometry", default="learned", choices=["learned", "constant-velocity", "kiss-icp"])
    parser.add_argument("--run", type=Path, help="run directory, instead of simulated worlds")
    parser.add_argument("--source", type=Path, help="recording of that run")
    arguments = parser.parse_args()
    config = Config(odometry=OdometryConfig(method=arguments.odometry))
    print_header(
        ["map", "recording", "found", "scans", "error cm", "error deg", "wrong", "lost", "ms tracked", "ms search"]
    )
    if arguments.run is not None:
        of_run(arguments, config)
    else:
        of_worlds(arguments, config)


if __name__ == "__main__":
    main()

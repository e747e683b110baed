"""Accuracy of scan-to-map registration compared with KISS-ICP, by ground truth on the same scans.

    python benchmarks/mapping_accuracy.py KITTI/sequences/04 2011_09_26/2011_09_26_drive_0005_sync
    python benchmarks/mapping_accuracy.py --worlds office tunnel --motions handheld tracked

Prints a Markdown table with a row per recording: ATE in metres after SE(3) alignment, over all scans, of

- KISS-ICP with its defaults;
- KISS-ICP with the voxel size, of `--voxels`, that minimises its ATE on this recording;
- scan-to-map registration without an odometry;
- the same with an odometry that is wrong by 2 degrees and 0.1 m at every scan, in random directions: the true motions
  with these errors, given as an external odometry; its own ATE has a column, too.

Ours have the numbers of lost and degraded scans with the ATE. All methods run in the pipeline of `lidarslam run` with
its defaults. Sources are recordings that `lidarslam run` reads, with ground truth; simulated recordings are passed in
memory.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import exp
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory, chain
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.metrics import TrajectoryErrors, evaluate_trajectory
from lidarslam.mapping.config import MappingConfig
from lidarslam.odometry.config import KissConfig, OdometryConfig, OdometryName
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.odometry_gate import where_needed
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import in_order
from lidarslam.simulation.motion import CARRIERS, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import SENSORS, find_sensor
from lidarslam.simulation.world import WORLDS, World, build_world

T = TypeVar("T")
# Maximum extrapolation of the ground truth beyond its own stamps.
BEYOND_TRUTH_S = 0.2
# Errors of the wrong odometry at every scan.
WRONG_DEG, WRONG_M = 2.0, 0.1


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recording in memory, so that every method has the same scans without waiting for them."""

    name: str
    scans: Sequence[Scan]
    truth: Trajectory
    imu: ImuSamples | None = None


@dataclass(frozen=True)
class Outcome:
    """Result of a method on a recording; `refine_ms` is the median time of registration to the map, if any."""

    ate_m: float
    length_m: float
    lost: int
    degraded: int
    refine_ms: float | None

    def text(self) -> str:
        """ATE with lost and degraded scans."""
        return f"{self.ate_m:.3f} ({self.lost} lost, {self.degraded} degraded)"


def read(source: Path) -> Recorded:
    """A recording from disk.

    Raises:
        InputError: it cannot be read, or has no ground truth.
    """
    recording = open_recording(source)
    truth = recording.ground_truth
    if truth is None:
        raise InputError(f"{source}: has no ground truth to measure against")
    return Recorded(recording.name, list(in_order(recording.scans())), truth)


def simulate(world: str, motion: str, sensor: str, scans: int, seed: int) -> Recorded:
    """A recording from the simulator."""
    simulation = make_simulation(world, motion, sensor, scans, seed)
    return Recorded(f"{world}, {motion}", list(simulation.scans()), simulation.ground_truth)


def make_simulation(world: str, motion: str, sensor: str, scans: int, seed: int) -> Simulation:
    """An upright sensor on a world's route."""
    return in_world(build_world(world, seed), motion, sensor, scans, seed)


def in_world(place: World, motion: str, sensor: str, scans: int | None, seed: int, laps: float = 1.0) -> Simulation:
    """The same in a given world; without a number of scans, for a number of laps."""
    carried, model = motion_along_route(motion, place, seed), find_sensor(sensor)
    scans = int(laps * carried.duration_s * model.rate_hz) if scans is None else scans
    return Simulation(place, model, carried, mount_pose("upright", carried.sensor_height_m), scans, seed)


def true_trajectory(recorded: Recorded) -> Trajectory:
    """Ground truth at the scans' stamps."""
    stamps = np.array([scan.stamp for scan in recorded.scans])
    return Trajectory(stamps, recorded.truth.at(stamps, BEYOND_TRUTH_S))


def wrong_odometry(recorded: Recorded, seed: int) -> Trajectory:
    """Ground truth at the scans' stamps, each motion perturbed by a rotation and a translation in random directions."""
    rng = np.random.default_rng(seed)
    truth = true_trajectory(recorded)
    stamps = truth.stamps
    errors = rng.normal(size=(len(stamps) - 1, 2, 3))
    errors *= np.array([np.deg2rad(WRONG_DEG), WRONG_M])[:, None] / np.linalg.norm(errors, axis=2, keepdims=True)
    wrong = truth.relative_motions() @ exp(errors.reshape(-1, 6))
    return Trajectory(stamps, chain(truth.T_world_lidar[0], wrong))


def localise(recorded: Recorded, config: Config, prior: Trajectory | None = None) -> Outcome:
    """Run the pipeline on a recording and evaluate the trajectory."""
    results = pipeline_results(recorded.scans, config, prior)
    errors = errors_of(trajectory_of(results), recorded)
    statuses = [result.status for result in results]
    refine_ms = [result.stage_ms["refine"] for result in results if "refine" in result.stage_ms]
    return Outcome(
        ate_m=errors.ate_rmse_m,
        length_m=errors.length_m,
        lost=statuses.count(Status.LOST),
        degraded=statuses.count(Status.DEGRADED),
        refine_ms=float(np.median(refine_ms)) if refine_ms else None,
    )


def pipeline_results(scans: Sequence[Scan], config: Config, prior: Trajectory | None = None) -> list[ScanEstimate]:
    """Run the pipeline of `lidarslam run` on scans."""
    with closing(where_needed(make_odometry(config.odometry, prior), config)) as odometry:
        return list(Pipeline(odometry, make_localiser(config), config.global_map).run(scans))


def trajectory_of(results: Sequence[ScanEstimate]) -> Trajectory:
    """The poses as registered."""
    return Trajectory(np.array([one.stamp for one in results]), np.array([one.T_world_lidar for one in results]))


def errors_of(estimate: Trajectory, recorded: Recorded) -> TrajectoryErrors:
    """Errors of a trajectory by a recording's ground truth."""
    return evaluate_trajectory(estimate, recorded.truth).errors


def config_of(odometry: OdometryName, mapping: MappingConfig) -> Config:
    """Configuration of scan-to-map registration with an odometry."""
    return Config(odometry=OdometryConfig(method=odometry), mapping=mapping)


METHODS = {
    "learned+map": config_of("learned", MappingConfig()),
    "learned+loam": config_of("learned", MappingConfig(method="loam")),
    "constant-velocity+map": config_of("constant-velocity", MappingConfig()),
    "constant-velocity+loam": config_of("constant-velocity", MappingConfig(method="loam")),
    "KISS-ICP": config_of("kiss-icp", MappingConfig(method="off")),
}
DEFAULT_METHODS = ("learned+map", "constant-velocity+map", "KISS-ICP")


def run_kiss(recorded: Recorded, kiss: KissConfig) -> Outcome:
    """KISS-ICP alone."""
    odometry = OdometryConfig(method="kiss-icp", kiss_icp=kiss)
    return localise(recorded, Config(odometry=odometry, mapping=MappingConfig(method="off")))


def row(recorded: Recorded, voxels: Sequence[float], seed: int) -> list[str]:
    kiss = run_kiss(recorded, KissConfig())
    outcomes = [(run_kiss(recorded, KissConfig(voxel_size_m=voxel_m)), voxel_m) for voxel_m in voxels]
    tuned, voxel_m = min(outcomes, key=lambda one: one[0].ate_m)
    prior = wrong_odometry(recorded, seed)
    alone = localise(recorded, config_of("constant-velocity", MappingConfig()))
    helped = localise(recorded, config_of("external", MappingConfig()), prior)
    percents = [100.0 * outcome.ate_m / outcome.length_m for outcome in (alone, helped)]
    return [
        recorded.name,
        str(len(recorded.scans)),
        f"{kiss.length_m:.0f}",
        f"{kiss.ate_m:.3f}",
        f"{tuned.ate_m:.3f} (at {voxel_m:g} m)",
        alone.text(),
        f"{errors_of(prior, recorded).ate_rmse_m:.1f}",
        helped.text(),
        " / ".join(f"{percent:.2f}" for percent in percents),
    ]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth")
    add_simulation_arguments(parser)
    parser.add_argument("--voxels", nargs="+", type=float, default=[0.25, 0.5, 1.0, 2.0], help="metres, for KISS-ICP")
    arguments = parser.parse_args()
    wrong = f"{WRONG_DEG:g} deg, {WRONG_M:g} m per scan"
    header = ["recording", "scans", "path, m", "KISS-ICP", "KISS-ICP, best voxel", "ours, no odometry"]
    header += [f"odometry wrong by {wrong}", "ours with it", "ours, % of the path: without / with it"]
    print_header(header)
    for recorded in recordings(arguments):
        print_row(row(recorded, arguments.voxels, arguments.seed))


def in_process(call: Callable[..., T], *arguments: object) -> T:
    """Result of a call in a separate process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(call, *arguments).result()


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Parser of a benchmark's command line, with the module's docstring as help."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_simulation_arguments(
    parser: argparse.ArgumentParser, worlds: Sequence[str] = (), motions: Sequence[str] = tuple(CARRIERS)
) -> None:
    """Arguments that choose simulated recordings."""
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=worlds)
    parser.add_argument("--motions", nargs="+", choices=list(CARRIERS), default=motions)
    parser.add_argument("--sensor", choices=list(SENSORS), default="vlp-16")
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)


def simulated_recordings(arguments: argparse.Namespace) -> Iterator[Recorded]:
    """Every world with every motion, one in memory at a time."""
    for world in arguments.worlds:
        for motion in arguments.motions:
            yield simulate(world, motion, arguments.sensor, arguments.scans, arguments.seed)


def recordings(arguments: argparse.Namespace, most: int | None = None) -> Iterator[Recorded]:
    """Chosen recordings, by default of all worlds, one in memory at a time; at most `most` scans of those on disk."""
    if not arguments.sources and not arguments.worlds:
        arguments.worlds = list(WORLDS)
    for source in arguments.sources:
        recorded = read(source)
        yield replace(recorded, scans=recorded.scans[:most])
    yield from simulated_recordings(arguments)


def print_row(cells: Sequence[str]) -> None:
    """Print a row of a Markdown table."""
    print(f"| {' | '.join(cells)} |", flush=True)


def print_header(cells: Sequence[str]) -> None:
    """Print the header of a Markdown table."""
    print_row(cells)
    print_row(["---"] * len(cells))


if __name__ == "__main__":
    main()

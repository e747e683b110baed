"""Loop closures on simulated laps: how many are found, how many are false, how exact they are, and what they cost.

    python benchmarks/loop_closures.py
    python benchmarks/loop_closures.py --worlds office rooms --motions handheld --drift 2

A sensor goes round every world a time and a third. Keyframes and their submaps are made with the true motion; the
estimates that the detector is given drift away from the truth, as no graph corrects them here. `rooms` is a world of
this benchmark: a corridor round a block, along it rooms that are all the same.

Prints a Markdown table, a row for each recording. A closure is false when its relative pose is off the truth by more
than 0.5 m or 3 degrees. A keyframe is a revisit when the truth was within half the median range of it before, a loop's
least way ago; it is found when a closure was accepted within 5 m of way of it.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log, rotation_angle, transform_points
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.trajectory import chain
from lidarslam.localisation import SweepMotion
from lidarslam.simulation.carriers import CARRIERS
from lidarslam.simulation.mounts import MOUNTS, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensor_table import SENSORS
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import Boxes, Route, World
from lidarslam.simulation.worlds.registry import WORLDS, build_world
from mapping.deskew import body_velocity
from mapping.loop_closure import LoopClosure, LoopDetector, Submap
from mapping.loop_config import LoopConfig

ROOMS = "rooms"
FALSE_M, FALSE_DEG = 0.5, 3.0
_FOUND_WITHIN_M = 5.0
_TURN_DEG = 30.0
_STEP_PER_RANGE, _STEP_BOUNDS_M = 0.4, (1.0, 5.0)
_VOXELS_PER_RANGE, _VOXEL_BOUNDS_M = 50.0, (0.05, 0.25)
# Errors of the estimate stay the same for so much of the way.
_DRIFT_CHANGES_M = 50.0
_MOTIONS = {"street": "car", "tunnel": "tracked", "hall": "tracked"}


@dataclass(frozen=True, eq=False)
class Lap:
    """Keyframes of a recording: submaps, true poses (K, 4, 4), and the median range."""

    name: str
    submaps: Sequence[Submap]
    truth: FloatArray
    range_m: float

    @property
    def way_m(self) -> FloatArray:
        """(K,) path length up to each keyframe."""
        return np.array([submap.way_m for submap in self.submaps])


@dataclass(frozen=True, eq=False)
class Found:
    """What the detector made of a lap; milliseconds (K,) for each keyframe."""

    closures: Sequence[LoopClosure]
    milliseconds: FloatArray
    bytes_per_keyframe: float


def build_rooms(seed: int) -> World:
    """A corridor of 2 m round a block of 36 x 10 m, with seven like rooms on either long side."""
    walls = [(0.0, 0.0, 17.9, 4.9)]  # x, y and half sizes of what fills the storey's height
    walls += [(side * 20.1, 0.0, 0.1, 7.0) for side in (-1.0, 1.0)]
    for side in (-1.0, 1.0):
        walls.append((0.0, side * 11.1, 20.2, 0.1))
        for room in range(8):
            walls.append((-17.5 + 5.0 * room, side * 9.05, 0.1, 1.95))
        walls += [(-17.5 - 1.3, side * 7.1, 1.3, 0.1), (17.5 + 1.3, side * 7.1, 1.3, 0.1)]
        for room in range(7):
            x = -15.0 + 5.0 * room
            walls += [(x - 1.55, side * 7.1, 0.95, 0.1), (x + 1.55, side * 7.1, 0.95, 0.1)]
            walls += [(x + 1.9, side * 10.6, 0.4, 0.3), (x - 2.0, side * 9.0, 0.35, 0.6)]
    boxes = [((x, y, 1.35), (a, b, 1.35)) for x, y, a, b in walls]
    boxes += [((0.0, 0.0, -0.1), (21.0, 12.0, 0.1)), ((0.0, 0.0, 2.8), (21.0, 12.0, 0.1))]
    centres, halves = (np.array(rows) for rows in zip(*boxes, strict=True))
    corners = []
    for side in (-1.0, 1.0):
        for room in (0, 2, 5):
            x = side * (15.0 - 5.0 * room)
            corners += [(x, side * 6.0), (x, side * 8.8), (x, side * 6.0)]
        corners += [(-side * 19.0, side * 6.0), (-side * 19.0, -side * 6.0)]
    route = Route(np.array([(x, y, 0.0) for x, y in corners]), 0.5, 0.4, 2.4, 1.2)
    return World(ROOMS, seed, route, Boxes(centres, halves, np.tile(np.eye(3), (len(centres), 1, 1))))


def simulate(world: str, motion: str, sensor: str, mount: str, seed: int, laps: float, every: int) -> Lap:
    """The keyframes of a recording straight from the simulator, of every so manieth scan."""
    place = build_rooms(seed) if world == ROOMS else build_world(world, seed)
    carried = motion_along_route(motion, place, seed)
    T_body_lidar = mount_pose(mount, carried.sensor_height_m)
    model = find_sensor(sensor)
    count = int(laps * carried.duration_s * model.rate_hz)
    simulation = Simulation(place, model, carried, T_body_lidar, count, seed)
    return make_lap(f"{world}, {motion}", simulation, every)


def make_lap(name: str, simulation: Simulation, every: int) -> Lap:
    """Keyframes wherever the sensor has gone or turned far enough, each with the scans since the one before it."""
    truth = simulation.ground_truth.T_world_lidar
    way = simulation.ground_truth.distances
    period_s = simulation.sensor.period_s
    range_m = float(np.median(np.linalg.norm(simulation.scan(0).scan.points, axis=1)))
    voxel_m = float(np.clip(range_m / _VOXELS_PER_RANGE, *_VOXEL_BOUNDS_M))
    gathered: list[FloatArray] = []
    submaps: list[Submap] = []
    kept: list[FloatArray] = []
    last = 0
    for index in range(0, len(truth) - 1, every):
        velocity = body_velocity(inverse(truth[index]) @ truth[index + 1], period_s)
        points = SweepMotion(velocity, velocity).compensate(simulation.scan(index).scan)
        gathered.append(transform_points(truth[index], points))
        turned = np.rad2deg(rotation_angle(inverse(truth[last]) @ truth[index]))
        step_m = np.clip(_STEP_PER_RANGE * range_m, *_STEP_BOUNDS_M)
        if index and (way[index] - way[last] < step_m and turned < _TURN_DEG):
            continue
        there = transform_points(inverse(truth[index]), np.concatenate(gathered))
        submaps.append(Submap(len(submaps), 0, float(way[index]), there[one_per_cell(there, voxel_m)]))
        kept.append(truth[index])
        last, gathered = index, []
    ranges = [float(np.median(np.linalg.norm(submap.points, axis=1))) for submap in submaps]
    return Lap(name, submaps, np.stack(kept), float(np.median(ranges)))


def drifting(lap: Lap, factor: float, seed: int) -> FloatArray:
    """Estimates (K, 4, 4) with 1 % of the way and, mostly in heading, 2 degrees in 100 m of error, times a factor."""
    rng = np.random.default_rng([seed, 77])
    motions = inverse(lap.truth[:-1]) @ lap.truth[1:]
    steps = np.diff(lap.way_m)
    stretch = (lap.way_m[1:] / _DRIFT_CHANGES_M).astype(np.intp)
    sigmas = np.array([np.deg2rad(0.3) / 100.0] * 2 + [np.deg2rad(2.0) / 100.0] + [0.01 / np.sqrt(3.0)] * 3)
    rates = factor * sigmas * rng.normal(size=(int(stretch.max()) + 1, 6))
    return chain(lap.truth[0], motions @ exp(rates[stretch] * steps[:, None]))


def detect(lap: Lap, estimates: FloatArray, config: LoopConfig) -> Found:
    """Give the detector keyframe after keyframe."""
    detector = LoopDetector(config)
    closures: list[LoopClosure] = []
    milliseconds = []
    for submap in lap.submaps:
        started = time.perf_counter()
        closures += detector.add(submap, estimates[: submap.index + 1])
        milliseconds.append(1e3 * (time.perf_counter() - started))
    closures += detector.finish()
    return Found(closures, np.array(milliseconds), detector.nbytes / len(lap.submaps))


def errors_of(closures: Sequence[LoopClosure], truth: FloatArray) -> FloatArray:
    """(N, 2) how far closures are off, in metres and degrees."""
    errors = [inverse(truth[c.first]) @ truth[c.second] for c in closures]
    off = [inverse(true) @ c.T_first_second for true, c in zip(errors, closures, strict=True)]
    return np.array([[np.linalg.norm(T[:3, 3]), np.rad2deg(rotation_angle(T))] for T in off]).reshape(-1, 2)


def revisits(lap: Lap, config: LoopConfig) -> list[int]:
    """Keyframes that are close to where the sensor was before."""
    position, way = lap.truth[:, :3, 3], lap.way_m
    least = max(config.min_way_m, config.min_way_ranges * lap.range_m)
    found = []
    for index in range(len(way)):
        before = way < way[index] - least
        near = np.linalg.norm(position[before] - position[index], axis=1) < 0.5 * lap.range_m
        if near.any():
            found.append(index)
    return found


def row(lap: Lap, found: Found, config: LoopConfig) -> list[str]:
    """The cells of one recording."""
    accepted = [closure for closure in found.closures if closure.verdict == "accepted"]
    errors = errors_of(accepted, lap.truth)
    false = (errors[:, 0] > FALSE_M) | (errors[:, 1] > FALSE_DEG)
    right = errors[~false]
    again = revisits(lap, config)
    ways = lap.way_m[[closure.second for closure in accepted]]
    covered = [i for i in again if (np.abs(ways - lap.way_m[i]) < _FOUND_WITHIN_M).any()]
    nees = [_squared(c, lap.truth) for c, wrong in zip(accepted, false, strict=True) if not wrong]

    def pair(column: int, unit: str) -> str:
        values = right[:, column]
        return f"{np.median(values):.3f} / {values.max():.3f} {unit}" if len(values) else "-"

    return [
        lap.name,
        str(len(lap.submaps)),
        f"{lap.way_m[-1]:.0f}",
        str(len(again)),
        str(len(accepted)),
        str(sum(closure.found_by == "appearance" for closure in accepted)),
        str(int(false.sum())),
        pair(0, "m"),
        pair(1, "deg"),
        f"{np.median(nees):.1f}" if nees else "-",
        f"{100.0 * len(covered) / len(again):.0f}" if again else "-",
        f"{np.median(found.milliseconds):.0f} / {np.percentile(found.milliseconds, 95):.0f}"
        f" / {found.milliseconds.mean():.0f}",
        f"{found.bytes_per_keyframe / 1e3:.0f}",
    ]


def _squared(closure: LoopClosure, truth: FloatArray) -> float:
    """The error against its covariance; 5.3 in the median if that were right."""
    xi = log(inverse(closure.T_first_second) @ inverse(truth[closure.first]) @ truth[closure.second])
    return float(xi @ np.linalg.solve(closure.covariance, xi))


def print_row(cells: Sequence[str]) -> None:
    """One row of a Markdown table."""
    print(f"| {' | '.join(cells)} |", flush=True)


def laps(arguments: argparse.Namespace) -> Iterator[Lap]:
    """Every world, with one motion or those that were asked for."""
    for world in arguments.worlds:
        for motion in arguments.motions or [_MOTIONS.get(world, "handheld")]:
            yield simulate(
                world, motion, arguments.sensor, arguments.mount, arguments.seed, arguments.laps, arguments.every
            )


def main() -> None:
    """Parse the command line and print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", choices=[*WORLDS, ROOMS], default=[*WORLDS, ROOMS])
    parser.add_argument("--motions", nargs="+", choices=list(CARRIERS), help="default: one that suits the world")
    parser.add_argument("--sensor", choices=list(SENSORS), default="vlp-16")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mount", choices=list(MOUNTS), default="upright")
    parser.add_argument("--laps", type=float, default=1.34)
    parser.add_argument("--every", type=int, default=3, help="scans are taken one in so many")
    parser.add_argument("--drift", type=float, default=1.0, help="times 1 %% of the way and 2 degrees in 100 m")
    arguments = parser.parse_args()
    config = expecting(arguments.drift)
    header = ["recording", "keyframes", "path, m", "revisits", "closures", "by appearance", "false"]
    header += ["off by, median / max", "degrees", "squared over covariance", "revisits found, %"]
    header += ["ms a keyframe, median / 95 % / mean", "kB a keyframe"]
    print_row(header)
    print_row(["---"] * len(header))
    for lap in laps(arguments):
        print_row(row(lap, detect(lap, drifting(lap, arguments.drift, arguments.seed), config), config))


def expecting(factor: float) -> LoopConfig:
    """The defaults, told of more drift where there is more."""
    default, larger = LoopConfig(), max(1.0, factor)
    return LoopConfig(
        drift_percent=larger * default.drift_percent, drift_deg_per_100m=larger * default.drift_deg_per_100m
    )


if __name__ == "__main__":
    main()

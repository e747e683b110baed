"""The pose graph on simulated laps: reduction of drift, loops found and their accuracy, and time.

    python benchmarks/loop_closures.py
    python benchmarks/loop_closures.py --worlds office rooms --drift 2

A sensor travels one and a third laps of every world. The whole graph of `lidarslam run --pose-graph` is given the
scans, compensated with the true motion and thinned, at poses that drift from the ground truth; there is no odometry
edge. `rooms` is a world of this benchmark: a corridor around a block, along identical rooms.

Prints a Markdown table with a row per recording. ATE is of all scans, after SE(3) alignment. A closure is false if its
relative pose is off by more than 0.5 m or 3 degrees; the first number is of those accepted by the detector, the second
of those kept by the optimiser. A keyframe is a revisit if, by ground truth, a keyframe within half the median range is
earlier by the minimum length of a loop or more; it is found if a closure was kept within 5 m of it along the path.
Milliseconds are CPU time.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mapping_accuracy import in_world, make_parser, print_header, print_row
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, exp, inverse, log, rotation_angle
from lidarslam.core.thinning import one_per_cell
from lidarslam.core.trajectory import Trajectory, chain
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.mapping.config import LoopConfig, PoseGraphConfig
from lidarslam.mapping.global_map.global_map import voxel_size_for
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.pose_graph.correction import Corrected
from lidarslam.mapping.pose_graph.keyframe_graph import GraphScan
from lidarslam.mapping.pose_graph.slam_graph import SlamGraph
from lidarslam.pipeline.estimates import SweepMotion
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.world import WORLDS, Boxes, Route, World, build_world

ROOMS = "rooms"
FALSE_M, FALSE_DEG = 0.5, 3.0
_FOUND_WITHIN_M = 5.0
# Distance travelled over which the drift rate is constant.
_DRIFT_CHANGES_M = 50.0
# Laps of a world, and the step between used scans.
_LAPS, _EVERY = 1.34, 3
_MOTIONS = {"street": "car", "tunnel": "tracked", "hall": "tracked"}
# Covariance of a registered pose.
_REGISTERED = np.diag(np.array([np.deg2rad(0.05)] * 3 + [0.005] * 3) ** 2)


@dataclass(frozen=True, eq=False)
class Lap:
    """A recording of which every third scan is used."""

    name: str  # world and motion
    simulation: Simulation
    scans: NDArray[np.intp]  # (M,) indices of the used ones
    truth: FloatArray  # (M, 4, 4) T_world_lidar
    way_m: FloatArray  # (M,) distance travelled

    def points(self) -> Iterator[FloatArray]:
        """(N, 3) of each scan, compensated with the true motion."""
        every = self.simulation.ground_truth.T_world_lidar
        for index in self.scans:
            velocity = body_velocity(inverse(every[index]) @ every[index + 1], self.simulation.sensor.period_s)
            yield SweepMotion(velocity, velocity).compensate(self.simulation.scan(index).scan)


@dataclass(frozen=True, eq=False)
class Followed:
    """Result of the graph for a lap; CPU milliseconds (K,) per keyframe."""

    result: Corrected
    milliseconds: FloatArray
    range_m: float


def build_rooms(seed: int) -> World:
    """A corridor 2 m wide around a block of 36 x 10 m, with seven identical rooms on either long side."""
    walls = [(0.0, 0.0, 17.9, 4.9)]  # x, y and half sizes of boxes of the storey's height
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


def simulate(world: str, motion: str, seed: int) -> Lap:
    """A recording from the simulator."""
    place = build_rooms(seed) if world == ROOMS else build_world(world, seed)
    simulation = in_world(place, motion, "vlp-16", None, seed, _LAPS)
    truth = simulation.ground_truth
    used = np.arange(0, len(simulation) - 1, _EVERY)
    return Lap(f"{world}, {motion}", simulation, used, truth.T_world_lidar[used], truth.distances[used])


def drifting(truth: FloatArray, way_m: FloatArray, factor: float, seed: int) -> FloatArray:
    """Poses (M, 4, 4) that drift by 1 % of the distance and, mostly in heading, 2 degrees per 100 m, times a factor."""
    rng = np.random.default_rng([seed, 77])
    motions = inverse(truth[:-1]) @ truth[1:]
    steps = np.diff(way_m)
    stretch = (way_m[1:] / _DRIFT_CHANGES_M).astype(np.intp)
    sigmas = np.array([np.deg2rad(0.3) / 100.0] * 2 + [np.deg2rad(2.0) / 100.0] + [0.01 / np.sqrt(3.0)] * 3)
    rates = factor * sigmas * rng.normal(size=(int(stretch.max()) + 1, 6))
    return chain(truth[0], motions @ exp(rates[stretch] * steps[:, None]))


def follow(lap: Lap, estimates: FloatArray, config: PoseGraphConfig) -> Followed:
    """Add all scans to the graph."""
    graph = SlamGraph(config)
    milliseconds: list[float] = []
    ranges: list[float] = []
    voxel_m: float | None = None
    for pose, points in zip(estimates, lap.points(), strict=True):
        voxel_m = voxel_size_for(points) if voxel_m is None else voxel_m
        thinned = points[one_per_cell(points, voxel_m)]
        ranges.append(float(np.median(np.linalg.norm(points, axis=1))))
        before, started = len(graph.keyframe_ms), time.thread_time()
        graph.add(GraphScan(pose, thinned, _REGISTERED, None, None, lost=False, belongs_in_map=True))
        if len(graph.keyframe_ms) > before:
            milliseconds.append(1e3 * (time.thread_time() - started))
        graph.draw(thinned, pose, voxel_m)
    result = graph.finish()
    graph.close()
    assert result is not None  # the first scan is a keyframe
    return Followed(result, np.array(milliseconds), float(np.median(ranges)))


def errors_of(closures: Sequence[LoopClosure], truth: FloatArray) -> FloatArray:
    """(N, 2) errors of closures in metres and degrees."""
    errors = [inverse(truth[c.first]) @ truth[c.second] for c in closures]
    off = [inverse(true) @ c.T_first_second for true, c in zip(errors, closures, strict=True)]
    return np.array([[np.linalg.norm(T[:3, 3]), np.rad2deg(rotation_angle(T))] for T in off]).reshape(-1, 2)


def revisits(position: FloatArray, way_m: FloatArray, range_m: float) -> list[int]:
    """Keyframes (K,) close to an earlier position of the sensor."""
    least = max(10.0, 3.0 * range_m)
    found = []
    for index in range(len(way_m)):
        near = np.linalg.norm(position[way_m < way_m[index] - least] - position[index], axis=1) < 0.5 * range_m
        if near.any():
            found.append(index)
    return found


def ate_m(lap: Lap, T_world_lidar: FloatArray) -> float:
    """ATE of all scans after SE(3) alignment."""
    stamps = np.arange(len(lap.truth), dtype=np.float64)
    return evaluate_trajectory(Trajectory(stamps, T_world_lidar), Trajectory(stamps, lap.truth)).errors.ate_rmse_m


def is_false(errors: FloatArray) -> NDArray[np.bool_]:
    """(N,) of `errors_of`."""
    return np.asarray((errors[:, 0] > FALSE_M) | (errors[:, 1] > FALSE_DEG))


def row(lap: Lap, estimates: FloatArray, followed: Followed) -> list[str]:
    result = followed.result
    truth, way_m = lap.truth[result.keyframe_scans], lap.way_m[result.keyframe_scans]
    accepted = [closure for closure in result.closures if closure.accepted]
    kept = [closure for closure, kept in zip(result.closures, result.inliers, strict=True) if kept]
    errors = errors_of(kept, truth)
    false = is_false(errors)
    right = errors[~false]
    again = revisits(truth[:, :3, 3], way_m, followed.range_m)
    ways = way_m[[closure.second for closure in kept]]
    covered = [i for i in again if (np.abs(ways - way_m[i]) < _FOUND_WITHIN_M).any()]
    nees = [_squared(c, truth) for c, wrong in zip(kept, false, strict=True) if not wrong]
    before, after = ate_m(lap, estimates), ate_m(lap, result.T_world_lidar)

    def pair(column: int, unit: str) -> str:
        values = right[:, column]
        return f"{np.median(values):.3f} / {values.max():.3f} {unit}" if len(values) else "-"

    return [
        lap.name,
        f"{way_m[-1]:.0f}",
        f"{before:.2f} / {after:.3f}",
        f"{after / before:.2f}",
        str(len(way_m)),
        str(len(again)),
        str(len(kept)),
        str(sum(closure.by_appearance for closure in kept)),
        f"{is_false(errors_of(accepted, truth)).sum()} / {false.sum()}",
        pair(0, "m"),
        pair(1, "deg"),
        f"{np.median(nees):.1f}" if nees else "-",
        f"{100.0 * len(covered) / len(again):.0f}" if again else "-",
        f"{np.median(followed.milliseconds):.0f} / {np.percentile(followed.milliseconds, 95):.0f}"
        f" / {followed.milliseconds.mean():.0f}",
    ]


def _squared(closure: LoopClosure, truth: FloatArray) -> float:
    """Squared error over covariance; its median is 5.3 for a correct covariance."""
    xi = log(inverse(closure.T_first_second) @ inverse(truth[closure.first]) @ truth[closure.second])
    return float(xi @ np.linalg.solve(closure.covariance, xi))


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--worlds",
        nargs="+",
        choices=[*WORLDS, ROOMS],
        default=[*(world for world in WORLDS if world != "town"), ROOMS],
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drift", type=float, default=1.0, help="factor of 1 %% of the distance and 2 deg per 100 m")
    arguments = parser.parse_args()
    drift_percent = max(1.0, arguments.drift) * LoopConfig().drift_percent
    config = PoseGraphConfig(enabled=True, loops=LoopConfig(drift_percent=drift_percent))
    header = ["recording", "path, m", "ATE before / after, m", "ratio", "keyframes", "revisits", "closures"]
    header += ["by appearance", "false, accepted / kept"]
    header += ["off by, median / max", "degrees", "squared over covariance", "revisits found, %"]
    header += ["ms per keyframe, median / 95 % / mean"]
    print_header(header)
    for world in arguments.worlds:
        lap = simulate(world, _MOTIONS.get(world, "handheld"), arguments.seed)
        estimates = drifting(lap.truth, lap.way_m, arguments.drift, arguments.seed)
        followed = follow(lap, estimates, config)
        print_row(row(lap, estimates, followed))


if __name__ == "__main__":
    main()

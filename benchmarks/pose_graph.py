"""The pose graph on KITTI 00 with true and false loops, and its time.

    python benchmarks/pose_graph.py --kitti-00 kiss_icp_kitti_00
    python benchmarks/pose_graph.py --keyframes 10000 --loops 1000

Prints a Markdown table for each:

- KISS-ICP's trajectory on KITTI 00 with synthetic loops: pairs of keyframes that are near one another by ground truth
  but not in time, with their true relative pose and random errors. ATE in metres after SE(3) alignment, over all scans,
  without and with false loops between random pairs. The folder holds `estimate_kitti.txt` and
  `ground_truth_kitti.txt`;
- a simulated drive around the blocks of a town, added keyframe by keyframe.

Seconds and milliseconds are CPU time.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mapping_accuracy import make_parser, print_header, print_row
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, exp, inverse, rotation_angle
from lidarslam.core.trajectory import Trajectory, chain, read_kitti_poses
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.mapping.loops.closure import LoopClosure, RelativePose
from lidarslam.mapping.pose_graph.correction import corrected
from lidarslam.mapping.pose_graph.optimizer import Optimised, RelaxSchedule, optimise, relax

SCAN_S = 0.1
# KISS-ICP's drift on KITTI 00, 0.53 % and 0.0019 degrees per metre, mostly over about 300 m, as a random walk.
DRIFT_M, DRIFT_DEG = 0.05, 0.033  # per square root of a metre
# Ratio of the drift of two thousand learned pairs to that of registration to the map.
LOOSER = 5.0
LOOP_M, LOOP_DEG = 0.1, 0.5
# Spacing of keyframes on KITTI 00, and false loops there in % of the true ones.
STEP_M, FALSE_PERCENTS = 2.0, (0.0, 10.0, 30.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """Keyframes at the poses of an odometry, and their true poses."""

    poses: FloatArray  # (N, 4, 4)
    truth: FloatArray  # (N, 4, 4)
    covariances: FloatArray  # (N - 1, 6, 6) of the motions from each keyframe to the next

    def chain_edges(self, looser: float | None = None) -> list[RelativePose]:
        """Motions between neighbours; with `looser`, also those of a less accurate odometry."""
        motions = inverse(self.poses[:-1]) @ self.poses[1:]
        edges = []
        for key, (motion, covariance) in enumerate(zip(motions, self.covariances, strict=True)):
            edges.append(RelativePose(key, key + 1, motion, covariance))
            if looser is not None:
                edges.append(RelativePose(key, key + 1, motion, looser**2 * covariance))
        return edges


def covariance(rotation_deg: float, translation_m: float) -> FloatArray:
    """(6, 6) with one deviation about all axes, and one along all."""
    return np.diag(np.square([np.deg2rad(rotation_deg)] * 3 + [translation_m] * 3))


def true_loops(scene: Scene, pairs: NDArray[np.intp], rng: np.random.Generator) -> list[RelativePose]:
    """Loops between the pairs (L, 2) of keyframes: true motions with noise."""
    noise = covariance(LOOP_DEG, LOOP_M)
    errors = exp(rng.normal(size=(len(pairs), 6)) * np.sqrt(np.diag(noise)))
    motions = inverse(scene.truth[pairs[:, 0]]) @ scene.truth[pairs[:, 1]] @ errors
    return [RelativePose(int(a), int(b), motion, noise) for (a, b), motion in zip(pairs, motions, strict=True)]


def false_loops(keyframes: int, count: int, rng: np.random.Generator) -> list[RelativePose]:
    """Loops between random pairs of keyframes, a few metres apart with a random heading."""
    pairs = np.sort(np.array([rng.choice(keyframes, 2, replace=False) for _ in range(count)]).reshape(-1, 2), axis=1)
    xi = rng.normal(size=(count, 6)) * [0.05, 0.05, 1.0, 2.0, 2.0, 0.2]
    return [
        RelativePose(int(a), int(b), motion, covariance(LOOP_DEG, LOOP_M))
        for (a, b), motion in zip(pairs, exp(xi), strict=True)
    ]


def revisits(truth: FloatArray, scans: NDArray[np.intp], within_m: float, apart_s: float) -> NDArray[np.intp]:
    """The nearest earlier keyframe of each one that revisits a place (L, 2), earlier first."""
    pairs = cKDTree(truth[:, :3, 3]).query_pairs(within_m, output_type="ndarray")
    pairs = pairs[(scans[pairs[:, 1]] - scans[pairs[:, 0]]) * SCAN_S > apart_s]
    distances = np.linalg.norm(truth[pairs[:, 0], :3, 3] - truth[pairs[:, 1], :3, 3], axis=1)
    pairs = pairs[np.lexsort((distances, pairs[:, 1]))]
    return pairs[np.unique(pairs[:, 1], return_index=True)[1]]


def every(poses: FloatArray, step_m: float) -> NDArray[np.intp]:
    """Rows of poses (M, 4, 4) about `step_m` apart along the path, including the first."""
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    return np.unique(np.searchsorted(path, np.arange(0.0, path[-1], step_m)))


def timed_optimise(
    poses: FloatArray, edges: Sequence[RelativePose], loops: Sequence[RelativePose]
) -> tuple[Optimised, float]:
    """The optimised graph, and its seconds."""
    start = time.process_time()
    optimised = optimise(poses, edges, loops)
    return optimised, time.process_time() - start


def close_kitti(folder: Path) -> None:
    """KITTI 00 with loops from ground truth."""
    estimate, truth = (read_kitti_poses(folder / f"{name}_kitti.txt") for name in ("estimate", "ground_truth"))
    scans = every(estimate, STEP_M)
    poses = estimate[scans]
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    scene = Scene(poses, truth[scans], lengths[:, None, None] * covariance(DRIFT_DEG, DRIFT_M))
    pairs = revisits(scene.truth, scans, within_m=4.0, apart_s=30.0)
    print_header(["loops", "of these false", "ATE before", "online", "optimised", "s", "true kept", "false kept"])
    for percent in FALSE_PERCENTS:
        rng = np.random.default_rng(0)
        loops = true_loops(scene, pairs, rng)
        false = false_loops(len(scans), round(percent / 100.0 * len(loops)), rng)
        every_loop = sorted([(e, True) for e in loops] + [(e, False) for e in false], key=lambda pair: pair[0].second)
        edges = [edge for edge, _ in every_loop]
        poses, chain_edges, _ = grow(scene, edges, looser=None)
        online = ate(corrected(estimate, scans, poses), truth)
        optimised, seconds = timed_optimise(poses, chain_edges, edges)
        is_true = np.array([true for _, true in every_loop])
        print_row([
            str(len(edges)), str(len(false)), f"{ate(estimate, truth):.3f}", f"{online:.3f}",
            f"{ate(corrected(estimate, scans, optimised.poses), truth):.3f}", f"{seconds:.1f}",
            f"{optimised.inliers[is_true].sum():.0f}", f"{optimised.inliers[~is_true].sum():.0f}",
        ])  # fmt: skip


def ate(poses: FloatArray, truth: FloatArray) -> float:
    """ATE in metres after SE(3) alignment."""
    stamps = SCAN_S * np.arange(len(poses), dtype=np.float64)
    return evaluate_trajectory(Trajectory(stamps, poses), Trajectory(stamps, truth)).errors.ate_rmse_m


def grow(
    scene: Scene, loops: Sequence[RelativePose], looser: float | None
) -> tuple[FloatArray, list[RelativePose], FloatArray]:
    """Poses (N, 4, 4) added keyframe by keyframe and relaxed as in a run, their edges, and the seconds (N,) of each."""
    edges, schedule = scene.chain_edges(looser), RelaxSchedule()
    first_edges = {edge.second: edge for edge in reversed(edges)}
    ends = np.array([edge.second for edge in edges])
    closing: dict[int, list[LoopClosure]] = {}
    for edge in loops:
        closure = LoopClosure(**vars(edge), overlap=1.0, residual_m=0.0, inlier_ratio=1.0, by_appearance=False,
                              consistent=2, reason="")  # fmt: skip
        closing.setdefault(edge.second, []).append(closure)
    poses, seconds = [scene.poses[0]], np.zeros(len(scene.poses))
    closed: list[LoopClosure] = []
    for key in range(1, len(scene.poses)):
        start = time.process_time()
        poses.append(poses[-1] @ first_edges[key].T_first_second)
        closed += (found := closing.get(key, []))
        if schedule.is_due(found, poses):
            poses = list(relax(np.array(poses), edges[: np.searchsorted(ends, key, side="right")], closed))
        seconds[key] = time.process_time() - start
    return np.array(poses), edges, seconds


def drive_round_town(keyframes: int, rng: np.random.Generator) -> Scene:
    """Keyframes 2 m apart on a grid of streets with blocks of 60 m, with a left or right turn at random corners."""
    block, half = 30, 5
    turns = np.zeros((keyframes - 1, 6))
    turns[:, 3] = 2.0
    place, heading = np.zeros(2), 0
    for corner in range(block, keyframes - 1, block):
        place = place + _ahead(heading)
        choices = [turn for turn in (-1, 0, 1) if np.abs(place + _ahead(heading + turn)).max() <= half]
        turn = int(rng.choice(choices))
        heading += turn
        turns[corner, 2] = turn * np.pi / 2
        turns[corner, 3:5] = 0.0 if turn else turns[corner, 3:5]
    truth = chain(np.eye(4), exp(turns))
    noise = covariance(0.05, 0.02)
    wrong = exp(turns) @ exp(rng.normal(size=turns.shape) * np.sqrt(np.diag(noise)))
    return Scene(chain(np.eye(4), wrong), truth, np.tile(noise, (keyframes - 1, 1, 1)))


def _ahead(heading: int) -> FloatArray:
    return np.array([np.cos(heading * np.pi / 2), np.sin(heading * np.pi / 2)]).round()


def measure_time(keyframes: int, loops: int) -> None:
    """Time of the parts of a simulated graph."""
    rng = np.random.default_rng(0)
    scene = drive_round_town(keyframes, rng)
    pairs = revisits(scene.truth, 20 * np.arange(keyframes), within_m=3.0, apart_s=30.0)
    pairs = pairs[np.sort(rng.choice(len(pairs), min(loops, len(pairs)), replace=False))]
    loop_edges = true_loops(scene, pairs, rng)
    online, edges, seconds = grow(scene, loop_edges, LOOSER)
    optimised, batch_s = timed_optimise(online, edges, loop_edges)
    apart = inverse(online) @ optimised.poses
    cells = {
        "keyframes": str(keyframes),
        "edges": str(2 * (keyframes - 1) + len(pairs)),
        "loops": str(len(pairs)),
        "online in total, s": f"{seconds.sum():.1f}",
        "online optimisations": f"{(seconds > 1e-2).sum()}",
        "each, ms: median, max": f"{1e3 * np.median(seconds[seconds > 1e-2]):.1f}, {1e3 * seconds.max():.1f}",
        "optimise, s": f"{batch_s:.1f}",
        "loops kept": f"{optimised.inliers.sum():.0f}",
        "error before, m": f"{rms(scene.poses, scene.truth):.2f}",
        "after": f"{rms(optimised.poses, scene.truth):.3f}",
        "online from that, m / deg": f"{np.linalg.norm(apart[:, :3, 3], axis=1).max():.1e}"
        f" / {np.rad2deg(rotation_angle(apart).max()):.1e}",
    }
    print_header(list(cells))
    print_row(list(cells.values()))


def rms(poses: FloatArray, truth: FloatArray) -> float:
    """RMSE of positions without alignment: both begin at the same pose."""
    return float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1))))


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--kitti-00", type=Path, metavar="DIR", help="KISS-ICP's trajectory and the ground truth")
    parser.add_argument("--keyframes", type=int, default=0, help="of the simulated drive")
    parser.add_argument("--loops", type=int, default=500, help="of the simulated drive")
    arguments = parser.parse_args()
    if arguments.kitti_00:
        close_kitti(arguments.kitti_00)
    if arguments.keyframes:
        measure_time(arguments.keyframes, arguments.loops)


if __name__ == "__main__":
    main()

"""The running local map after loop closures: misalignment between two rounds, and time of the correction.

    python benchmarks/local_map_correction.py recordings/streets --radius-m 40
    python benchmarks/local_map_correction.py recordings/loop --pairs loop_pairs.txt --radius-m 25

Prints a Markdown table with two rows per recording, the second with the local map rebuilt after loop closures:

- apart: each scan of a later round is compared with the nearest scan of the first round by ground truth: distance
  between their surfaces, at the median range, in the local map of that moment; RMS and 95 %, over the scans after the
  first accepted loop closure;
- ATE in metres after SE(3) alignment, of the poses as registered and of the final poses of the graph;
- closing error, instead of both where there is no ground truth but known relative poses (`--pairs`, rows of `i j` and
  3 x 4 numbers of T_i_j for scans i and j): median and maximum, metres;
- loop closures; times that the map was rebuilt; CPU milliseconds of rebuilding it (on the graph's thread) and of the
  exchange (on the registration's thread): median and maximum.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mapping_accuracy import BEYOND_TRUTH_S, make_parser, print_header, print_row, trajectory_of
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, displacement_m, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.mapping.config import MappingConfig, PoseGraphConfig
from lidarslam.mapping.pose_graph.slam_graph import SlamGraph
from lidarslam.mapping.pose_graph.submap_placement import SCANS_LATER
from lidarslam.mapping.registration.sampled_scan import CellSizes
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.config import OdometryConfig
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.localisation import ScanToMap
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import in_order

# Scans of different rounds: maximum distance in median ranges, and minimum distance travelled between them.
_SAME_PLACE_RANGES, _LATER_M = 0.5, 30.0


class _Graph(SlamGraph):
    """Records when the local map was rebuilt, and the poses of submaps in it."""

    def __init__(self, config: PoseGraphConfig, radius_m: float, redraws: bool) -> None:
        super().__init__(config, local_radius_m=radius_m)
        self._redraws = redraws
        self.drawn_ms: list[float] = []
        self.laid: list[tuple[int, FloatArray]] = []  # first scan registered to it, poses of the keyframes so far
        self.first_closure: int | None = None  # number of scans before it

    def redrawn_local_map(self, cells_m: CellSizes) -> SurfelMap | None:
        if self.first_closure is None and any(closure.accepted for closure in self._closures):
            self.first_closure = len(self.scan_poses)
        if not self._redraws:
            return None
        started = time.thread_time()
        drawn = super().redrawn_local_map(cells_m)
        if drawn is not None:
            self.drawn_ms.append(1e3 * (time.thread_time() - started))
            self.laid.append((len(self.scan_poses) - 1 + SCANS_LATER, np.array(self._laid._poses)))
        return drawn

    def place_in_map(self, scan: int, at: int) -> FloatArray:
        """(4, 4) pose of a scan's surfaces in the map that scan `at` was registered to."""
        T, keys = self.scan_poses[scan], [keyframe.scan for keyframe in self.keyframes]
        laid = [poses for since, poses in self.laid if since <= at]
        key = int(np.searchsorted(keys, scan, side="right")) - 1
        if not laid or not 0 <= key < len(laid[-1]):
            return T
        return np.asarray(laid[-1][key] @ inverse(self.scan_poses[keys[key]]) @ T)


class _Mapper(Mapper):
    def redraw(self, drawn: SurfelMap, scans: int) -> bool:
        started = time.thread_time()
        done = super().redraw(drawn, scans)
        self.exchange_ms = [*getattr(self, "exchange_ms", []), 1e3 * (time.thread_time() - started)]
        return done


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result with or without the correction."""

    trajectory: Trajectory
    corrected: Trajectory
    graph: _Graph
    closures: int
    exchange_ms: list[float] = field(default_factory=list)


def take(scans: Sequence[Scan], config: Config, redraws: bool) -> Outcome:
    """Run the pipeline on all scans."""
    odometry = make_odometry(config.odometry)
    graph = _Graph(config.pose_graph, config.mapping.radius_m, redraws)
    mapper = _Mapper(config.mapping, kept_scans=SCANS_LATER)
    results = list(Pipeline(odometry, ScanToMap(mapper), config.global_map, graph).run(scans))
    odometry.close()
    trajectory, final = trajectory_of(results), graph.finish()
    assert final is not None
    graph.close()
    return Outcome(
        trajectory,
        Trajectory(trajectory.stamps, final.T_world_lidar),
        graph,
        sum(final.inliers),
        getattr(mapper, "exchange_ms", []),
    )


def rounds(truth: Trajectory, range_m: float) -> NDArray[np.intp]:
    """(L, 2) pairs of scans: the nearest of the first visit, and one of a later visit."""
    positions, travelled = truth.positions, truth.distances
    tree, pairs = cKDTree(positions), []
    for late, position in enumerate(positions):
        near = tree.query_ball_point(position, _SAME_PLACE_RANGES * range_m)
        early = [scan for scan in near if travelled[late] - travelled[scan] > _LATER_M]
        early = [scan for scan in early if travelled[scan] - travelled[min(early)] < _LATER_M]  # of the first visit
        if early:
            pairs.append((min(early, key=lambda s: float(np.linalg.norm(positions[s] - position))), late))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def apart_m(outcome: Outcome, truth: Trajectory, pairs: NDArray[np.intp], range_m: float, since: int) -> FloatArray:
    """(L,) distances between surfaces of both rounds in the running local map."""
    apart = []
    for early, late in pairs[pairs[:, 1] >= since]:
        T = inverse(outcome.graph.place_in_map(early, late)) @ outcome.trajectory.T_world_lidar[late]
        true = inverse(truth.T_world_lidar[early]) @ truth.T_world_lidar[late]
        apart.append(displacement_m(log(inverse(true) @ T), range_m))
    return np.array(apart)


def closing_errors_m(trajectory: Trajectory, pairs: FloatArray) -> FloatArray:
    """(P,) errors of the relative positions, one per row of `--pairs`."""
    first, second = pairs[:, :2].astype(np.intp).T
    T = inverse(trajectory.T_world_lidar[first]) @ trajectory.T_world_lidar[second]
    known = np.tile(np.eye(4), (len(pairs), 1, 1))
    known[:, :3] = pairs[:, 2:].reshape(-1, 3, 4)
    return np.asarray(np.linalg.norm((inverse(known) @ T)[:, :3, 3], axis=1), dtype=np.float64)


def measure_pairs(name: str, scans: Sequence[Scan], pairs: FloatArray, config: Config) -> None:
    """Print the rows of a recording with known relative poses."""
    for label, redraws in (("unchanged", False), ("rebuilt", True)):
        outcome = take(scans, config, redraws)
        errors = [closing_errors_m(one, pairs) for one in (outcome.trajectory, outcome.corrected)]
        shown = (f"{np.median(error):.3f}, {error.max():.3f}" for error in errors)
        print_row([
            f"{name}, {config.odometry.method}, radius {config.mapping.radius_m:g} m", label, str(len(pairs)), "-",
            *shown, str(outcome.closures), str(len(outcome.graph.drawn_ms)),
            _most(outcome.graph.drawn_ms), _most(outcome.exchange_ms),
        ])  # fmt: skip


def measure(name: str, scans: Sequence[Scan], truth: Trajectory, config: Config) -> None:
    """Print the rows of a recording with ground truth."""
    stamps = np.array([scan.stamp for scan in scans])
    true = Trajectory(stamps, truth.at(stamps, BEYOND_TRUTH_S))
    range_m = float(np.median(np.linalg.norm(scans[0].points, axis=1)))
    pairs = rounds(true, range_m)
    outcomes = [take(scans, config, redraws) for redraws in (False, True)]
    since = (outcomes[0].graph.first_closure or len(scans)) + SCANS_LATER
    for outcome, label in zip(outcomes, ("unchanged", "rebuilt"), strict=True):
        apart = apart_m(outcome, true, pairs, range_m, since)
        errors = [evaluate_trajectory(one, true).errors.ate_rmse_m for one in (outcome.trajectory, outcome.corrected)]
        print_row([
            f"{name}, {true.distances[-1]:.0f} m", label, str(len(apart)),
            f"{np.sqrt((apart**2).mean()):.3f}, {np.percentile(apart, 95):.3f}" if len(apart) else "-",
            *(f"{error:.3f}" for error in errors), str(outcome.closures), str(len(outcome.graph.drawn_ms)),
            _most(outcome.graph.drawn_ms), _most(outcome.exchange_ms),
        ])  # fmt: skip


def _most(milliseconds: Sequence[float]) -> str:
    return f"{np.median(milliseconds):.0f}, {max(milliseconds):.0f}" if milliseconds else "-"


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth, or the one of --pairs")
    parser.add_argument("--pairs", type=Path, metavar="FILE", help="known relative poses of the recording's scans")
    parser.add_argument("--scans", type=int, default=1000)
    parser.add_argument("--odometry", default="constant-velocity")
    parser.add_argument("--radius-m", type=float, default=100.0, help="of the local map")
    options = parser.parse_args()
    config = Config(
        odometry=OdometryConfig(method=options.odometry),
        mapping=MappingConfig(radius_m=options.radius_m),
        pose_graph=PoseGraphConfig(enabled=True),
    )
    print_header([
        "recording", "local map", "scans of later rounds", "apart, RMS / 95 %, m",
        "ATE as registered, m", "final ATE, m", "closures", "rebuilt", "rebuilding, ms", "exchange, ms",
    ])  # fmt: skip
    for source in options.sources:
        recording = open_recording(source)
        scans = list(in_order(recording.scans(stop=options.scans)))
        if options.pairs is not None:
            measure_pairs(recording.name, scans, np.loadtxt(options.pairs, ndmin=2), config)
            continue
        truth = recording.ground_truth
        assert truth is not None, f"{source}: has no ground truth"
        measure(recording.name, scans, truth, config)


if __name__ == "__main__":
    main()

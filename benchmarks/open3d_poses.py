"""Poses of pairs of keyframes by our methods and by Open3D's: rows of the tables of `open3d_parts.py`.

Keyframes and their submaps are from simulated laps and recordings; the keyframes of a pair are at the same place.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import open3d_methods as theirs
from loop_closures import drifting, is_false, simulate
from mapping_accuracy import METHODS, pipeline_results, trajectory_of

from lidarslam.core.geometry import FloatArray, exp, inverse, log, rotation_angle, transform_points
from lidarslam.core.thinning import one_per_cell
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import KeyframeConfig, LoopConfig
from lidarslam.mapping.global_map.global_map import GlobalMap, means_points, voxel_size_for
from lidarslam.mapping.loops.birds_eye_view import BirdsEyeView, align, compare
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.loops.detection import KeyframeDatabase
from lidarslam.mapping.loops.verification import DenseSubmap, refine, register, verify
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeSelector, drift_covariance
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.budget import complete
from lidarslam.pipeline.threads import in_order
from lidarslam.simulation.recorder import Simulation

Calls = dict[str, Callable[[], Any]]
Rows = Iterator[list[str]]

# Gates and scales of the kernels of `register` and of `refine`, in cells.
_COARSE = ((12.0, 4.0), (6.0, 2.0), (4.0, 1.0), (3.0, 0.5))
_FINE = ((2.0, 0.3), (1.0, 0.3))
_ICP = (theirs.POINT_TO_PLANE, theirs.GENERALISED, theirs.MULTI_SCALE)
_FEATURES = {"FPFH, RANSAC": False, "FPFH, FGR": True}
_FEATURE_CELLS = 2.0
# Maximum per recording.
_PAIRS = 20
# As in relocalisation.
_VIEW_CELLS, _VIEW_RANGES, _PLACES = 4.0, 3.0, 24


@dataclass(frozen=True, eq=False)
class Keyframes:
    """Keyframes of a recording."""

    name: str
    database: KeyframeDatabase  # at the estimates
    submaps: list[FloatArray]  # (N, 3) each
    scans: list[FloatArray]  # (N, 3) each keyframe's own scan, compensated
    truth: FloatArray  # (K, 4, 4) T_world_lidar
    pairs: list[tuple[int, int]]  # the later keyframe revisits the place of the earlier
    global_map: GlobalMap  # of all scans at the reference
    simulation: Simulation | None  # None for a recording

    def true_pose(self, first: int, second: int) -> FloatArray:
        """`T_first_second` (4, 4)."""
        return np.asarray(inverse(self.truth[first]) @ self.truth[second])

    def before(self, index: int) -> list[int]:
        """Keyframes at least a loop's minimum length before one."""
        way_m, least_m = self.database.track.way_m, max(10.0, 3.0 * self.database.submaps[index].range_m)
        return np.flatnonzero(way_m < way_m[index] - least_m).tolist()

    def map_before(self, index: int) -> FloatArray:
        """Points (N, 3) of their submaps in the world, half a cell apart."""
        parts = [transform_points(self.truth[k], self.submaps[k]) for k in self.before(index)]
        points = np.concatenate(parts)
        return points[one_per_cell(points, 0.5 * self.database.submaps[index].cell_m)]

    def dense(self, index: int, cell_m: float, max_range_m: float) -> tuple[FloatArray, FloatArray]:
        """Points (N, 3) of a submap and its two neighbours, as in refinement, and their drift (6, 6)."""
        track = self.database.track
        around = range(max(0, index - 1), min(len(self.submaps), index + 2))
        parts = [(track.between(index, k), self.submaps[k]) for k in around]
        away_m = max(abs(track.way_m[k] - track.way_m[index]) for k in around)
        return DenseSubmap.join(parts, max_range_m, cell_m).points, drift_covariance(float(away_m)) / 3.0


def simulated(world: str) -> Keyframes:
    """One and a third laps with a VLP-16, at poses that drift."""
    lap = simulate(world, "car" if world == "street" else "handheld", seed=1)
    estimates = drifting(lap.truth, lap.way_m, 1.0, seed=1)
    return _keyframes(lap.name, list(lap.points()), lap.truth, estimates, lap.simulation)


def recorded(path: Path) -> Keyframes:
    """A recording; its reference is the trajectory of `learned+map`."""
    scans = list(in_order(open_recording(path).scans()))
    results = pipeline_results(scans, METHODS["learned+map"])
    truth = trajectory_of(results).T_world_lidar
    return _keyframes(path.name, [result.points for result in results], truth, truth, None)


def _keyframes(
    name: str,
    points: Sequence[FloatArray],
    truth: FloatArray,
    estimates: FloatArray,
    simulation: Simulation | None,
) -> Keyframes:
    selector, voxel_m = KeyframeSelector(KeyframeConfig()), voxel_size_for(points[0])
    merged, growing, chosen = GlobalMap(voxel_m), list[GlobalMap](), list[int]()
    for index, scan in enumerate(points):
        thinned = scan[one_per_cell(scan, voxel_m)]
        if selector.is_due(estimates[index], thinned):
            selector.take(estimates[index], thinned)
            chosen.append(index)
            growing.append(GlobalMap(voxel_m))
        growing[-1].add(thinned, inverse(estimates[chosen[-1]]) @ estimates[index])
        merged.add(thinned, truth[index])
    steps_m = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    way_m = np.append(0.0, np.cumsum(steps_m))[chosen]
    database, submaps = KeyframeDatabase(LoopConfig()), [means_points(submap.means()) for submap in growing]
    for k, submap in enumerate(submaps):
        database.add(submap, float(way_m[k]), 0, estimates[chosen[: k + 1]])
    scans = [points[index] for index in chosen]
    found = Keyframes(name, database, submaps, scans, truth[chosen], [], merged, simulation)
    for k in range(len(chosen)):
        earlier = np.array(found.before(k), dtype=np.intp)
        if len(earlier):
            away_m = np.linalg.norm(found.truth[earlier, :3, 3] - found.truth[k, :3, 3], axis=1)
            if away_m.min() < 0.5 * database.submaps[k].range_m:
                found.pairs.append((int(earlier[away_m.argmin()]), k))
    found.pairs[:] = found.pairs[:: max(1, -(-len(found.pairs) // _PAIRS))]
    return found


def timed(call: Callable[[], Any], repeats: int = 1) -> tuple[Any, float]:
    """Result of a call, and its median CPU milliseconds."""
    times = []
    for _ in range(repeats):
        started = time.process_time()
        found = call()
        times.append(1e3 * (time.process_time() - started))
    return found, float(np.median(times))


def off(T: FloatArray | None, true: FloatArray) -> tuple[float, float]:
    """Errors of a pose in metres and degrees; infinity and 180 degrees for none."""
    if T is None:
        return np.inf, 180.0
    error = inverse(true) @ T
    return float(np.linalg.norm(error[:3, 3])), float(np.rad2deg(rotation_angle(error)))


def two(values: FloatArray, digits: int) -> str:
    """Median and 95th percentile."""
    return " / ".join(f"{value:.{digits}f}" for value in np.percentile(values, [50, 95])) if len(values) else "-"


def over_pairs(
    k: Keyframes, of_pair: Callable[[int, int], tuple[Calls, Callable[[Any], Sequence[float]]] | None]
) -> Iterator[tuple[str, FloatArray]]:
    """(P, E + 1) of every method: the judge's errors of each pair, and milliseconds."""
    rows: dict[str, list[list[float]]] = {}
    for made in (of_pair(*pair) for pair in k.pairs):
        if made is None:
            continue
        calls, judge = made
        for method, call in calls.items():
            found, ms = timed(call)
            rows.setdefault(method, []).append([*judge(found), ms])
    return ((method, np.array(found)) for method, found in rows.items())


def registration_rows(k: Keyframes) -> Rows:
    """Coarse registration."""
    rng = np.random.default_rng(0)

    def of_pair(first: int, second: int) -> Any:
        true, target, source = k.true_pose(first, second), k.database.cloud(first), k.database.cloud(second)
        shift = rng.normal(size=3) * [0.1, 0.1, 0.02] * source.submap.range_m
        guess, cell_m = true @ exp([0.0, 0.0, rng.normal(0.0, 0.1), *shift]), target.submap.cell_m
        calls: Calls = {"ours": lambda: register(target, source, guess)}
        clouds = theirs.planes_of(target), theirs.planes_of(source)
        return calls | {kind: partial(theirs.icp, kind, *clouds, guess, _COARSE, cell_m) for kind in _ICP}, (
            lambda T: off(T, true)
        )

    for method, found in over_pairs(k, of_pair):
        right = found[~is_false(found[:, :2])]
        cells = [two(right[:, 0], 3), two(right[:, 1], 3), f"{np.median(found[:, 2]):.0f}"]
        yield [k.name, method, f"{len(right)} of {len(found)}", *cells]


def refinement_rows(k: Keyframes) -> Rows:
    """Fine registration."""

    def of_pair(first: int, second: int) -> Any:
        true, config = k.true_pose(first, second), LoopConfig()
        verified = verify(k.database.cloud(first), k.database.cloud(second), true)
        if verified is None or verified.objection(config.min_overlap):
            return None
        T, covariance = verified.T_target_source, verified.covariance
        closure = LoopClosure(first, second, T, covariance, verified.overlap, 0.0, 1.0, False, 0, "")
        cell_m = max(k.database.submaps[index].cell_m for index in (first, second))
        (a, of_a), (b, of_b) = (k.dense(index, cell_m, config.max_range_m) for index in (first, second))

        def ours() -> Any:
            target, source = (DenseSubmap.join([(np.eye(4), points)], np.inf, cell_m) for points in (a, b))
            refined = refine(target, source, closure, of_a + of_b) or closure
            return refined.T_first_second, refined.covariance

        def by_open3d(kind: str) -> Any:
            clouds = theirs.dense_clouds(a, b, kind)
            found = theirs.icp(kind, *clouds, T, _FINE, cell_m)
            hessian = theirs.information(*clouds, found, _FINE[-1][0] * cell_m) + np.linalg.inv(covariance)
            return found, np.linalg.inv(hessian) + of_a + of_b

        def judge(found: Any) -> list[float]:
            xi = log(inverse(found[0]) @ true)
            return [*off(found[0], true), float(xi @ np.linalg.solve(found[1], xi))]

        calls: Calls = {"verified": lambda: (T, covariance), "ours": ours}
        return calls | {kind: partial(by_open3d, kind) for kind in _ICP}, judge

    for method, found in over_pairs(k, of_pair):
        cells = [two(found[:, 0], 3), f"{found[:, 0].max():.3f}", two(found[:, 1], 3), two(found[:, 2], 1)]
        yield [k.name, method, str(len(found)), *cells, f"{np.median(found[:, 3]):.0f}"]


def alignment_rows(k: Keyframes) -> Rows:
    """Registration of two keyframes without a guess."""
    radius_m = k.database.radius_m

    def of_pair(first: int, second: int) -> Any:
        true, target, source = k.true_pose(first, second), k.database.cloud(first), k.database.cloud(second)

        def views() -> FloatArray:
            there, here = (BirdsEyeView.of(k.database.submaps[index]) for index in (first, second))
            _, turn = compare(here.descriptor(radius_m), there.descriptor(radius_m)[None])
            return align(there, here, turn[0] + np.array([0.0, np.pi]), radius_m)[0]

        clouds, cell_m = (k.submaps[first], k.submaps[second]), _FEATURE_CELLS * target.submap.cell_m
        calls: Calls = {"bird's-eye views (ours)": views}
        calls |= {name: partial(theirs.match_features, *clouds, cell_m, fast) for name, fast in _FEATURES.items()}
        return calls, lambda guess: (*off(guess, true), *off(register(target, source, guess), true))

    for method, found in over_pairs(k, of_pair):
        right = ~is_false(found[:, 2:4])
        cells = [two(found[:, 0], 2), two(found[:, 1], 1), f"{np.median(found[:, 4]):.0f}"]
        yield [k.name, method, f"{right.sum()} of {len(found)}", *cells]


def relocalisation_rows(k: Keyframes) -> Rows:
    """Places of a scan in a map."""
    rng = np.random.default_rng(0)

    def of_pair(_: int, index: int) -> Any:
        mapped, scan, true, submap = k.map_before(index), k.scans[index], k.truth[index], k.database.submaps[index]
        turned, cell_m = true @ exp([0.0, 0.0, rng.uniform(-np.pi, np.pi), 0.0, 0.0, 0.0]), _VIEW_CELLS * submap.cell_m
        up, reach_m = np.array([0.0, 0.0, 1.0]), _VIEW_RANGES * submap.range_m

        def judge(poses: FloatArray) -> list[float]:
            errors = np.array([off(T, true) for T in poses.reshape(-1, 4, 4)])
            right = (errors[:, 0] < 1.5 * cell_m) & (errors[:, 1] < 10.0)
            return [float(right[0]), float(right.any())]

        calls: Calls = {
            "bird's-eye map (ours)": lambda: complete(
                BirdsEyeMap.of(mapped, up, cell_m).find(scan, turned, reach_m, _PLACES)
            )
        }
        size_m = _FEATURE_CELLS * submap.cell_m
        return calls | {
            name: partial(theirs.match_features, mapped, scan, size_m, fast) for name, fast in _FEATURES.items()
        }, judge

    for method, found in over_pairs(k, of_pair):
        counts = [f"{found[:, column].sum():.0f} of {len(found)}" for column in (0, 1)]
        yield [k.name, method, *counts, f"{np.median(found[:, 2]):.0f}"]

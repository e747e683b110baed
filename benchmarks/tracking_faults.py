"""Tracking under faults, compared with KISS-ICP on the same scans.

    python benchmarks/tracking_faults.py
    python benchmarks/tracking_faults.py --faults carried traffic --places office

Prints a Markdown table with a row per fault, place and method. Every recording is simulated in memory, with the fault
in the middle, and processed by the pipeline of `lidarslam run` with its defaults. The world is that of the first scan,
and errors are those of the poses as registered, without alignment:

- concerned: lost and degraded scans among those affected by the fault;
- elsewhere: lost and degraded scans among all others;
- ok but wrong: scans with status ok whose position is off by more than 0.2 m;
- worst, after: the largest error from the tenth scan after the fault on, whatever the status;
- shape, after: RMSE of the same scans, after SE(3) alignment of these alone;
- polluted: share of the map's points farther than 0.2 m from all true surfaces, when the map is aligned with the ground
  truth by the true pose of the first scan. Moved points are removed, as by `lidarslam run`, except with `--keep-moved`.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from mapping_accuracy import DEFAULT_METHODS, METHODS, make_parser, make_simulation, print_header, print_row
from simulated_faults import (
    Cover,
    Faulty,
    carried_off,
    covered,
    dropped,
    even_tunnel,
    index_back,
    open_plain,
    passing_by,
    standing_still,
    straight_drive,
)

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, inverse, rotation_angle, transform_points
from lidarslam.core.text import count
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map.moved_points import seen_through
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run.run import open_odometry
from lidarslam.simulation.motion import motion_along, mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import build_world

_POLLUTED_M, _WRONG_M = 0.2, 0.2
# Scans after a fault in which tracking may still recover.
_BACK_AFTER = 10

# World, sensor, carrier, number of scans; first scan of the fault.
_PLACES = {
    "office": ("office", "vlp-16", "tracked", 150, 90),
    "tunnel": ("tunnel", "vlp-16", "legged", 150, 90),
    "street": ("street", "os1-64", "car", 150, 90),
    "forest": ("forest", "vlp-16", "handheld", 150, 90),
}


@dataclass(frozen=True, eq=False)
class Case:
    """A recording with a fault, and the distance of points from the true surfaces of its world."""

    fault: str
    place: str
    recorded: Faulty
    distances: Callable[[FloatArray], FloatArray]


def in_motion(place: str, kind: str) -> Iterator[Case]:
    """Faults of a kind during motion through a world."""
    world, sensor, carrier, scans, at = _PLACES[place]
    simulation = make_simulation(world, carrier, sensor, scans, 0)
    name = f"{world}, {sensor}, {carrier}"
    for fault, recorded in _FAULTS[kind](simulation, at):
        yield Case(fault, name, recorded, simulation.distance_to_surfaces)


def _covered(simulation: Simulation, at: int) -> Iterator[tuple[str, Faulty]]:
    covers: tuple[Cover, ...] = ("empty", "near", "stray")
    for cover in covers:
        yield f"covered for 2 s: {cover}", covered(simulation, at, at + 20, cover)


def _carried(simulation: Simulation, at: int) -> Iterator[tuple[str, Faulty]]:
    back = index_back(simulation, at, 5.0)
    for turned_deg in (0.0, 90.0):
        yield f"carried 5 m back, turned {turned_deg:g} deg", carried_off(simulation, at, back, turned_deg)


def _dropped(simulation: Simulation, at: int) -> Iterator[tuple[str, Faulty]]:
    for number in (1, 3, 10):
        yield f"{count(number, 'scan')} dropped", dropped(simulation, range(at, at + number))


def _gap(simulation: Simulation, at: int) -> Iterator[tuple[str, Faulty]]:
    longer = replace(simulation, scan_count=len(simulation) + 50)
    yield "gap of 5 s", dropped(longer, range(at, at + 50))


_FAULTS: dict[str, Callable[[Simulation, int], Iterator[tuple[str, Faulty]]]] = {
    "covered": _covered,
    "carried": _carried,
    "dropped": _dropped,
    "gap": _gap,
}


def _still(place: str, scans: int, crowded: bool) -> Case:
    """At rest where the carrier begins; crowded by vehicles outdoors and by people indoors."""
    world_name, sensor, carrier, _, _ = _PLACES[place]
    moving = make_simulation(world_name, carrier, sensor, 1, 0)
    T_world_body = moving.motion.pose_at(np.zeros(1))[0]
    yaw = float(np.arctan2(T_world_body[1, 0], T_world_body[0, 0]))
    world = build_world(world_name, 0)
    if crowded:
        outdoors = world_name in ("street", "park")
        size = np.array([9.0, 2.5, 3.4] if outdoors else [0.4, 0.6, 1.8])
        beside = np.array([3.0, -3.0, 3.2, -3.2, 6.0]) if outdoors else np.array([0.8, -0.8, 0.9, -0.9, 1.0, -1.1, 1.2])
        movers = passing_by(T_world_body[:3, 3], yaw, size, beside, *((6.0, 25.0) if outdoors else (1.2, 2.0)))
        world = replace(world, movers=(*world.movers, *movers))
    motion = standing_still(T_world_body[:3, 3], yaw, moving.motion.sensor_height_m)
    mount = mount_pose("upright", motion.sensor_height_m)
    simulation = Simulation(world, find_sensor(sensor), motion, mount, scans, 0)
    shown = np.full(scans, crowded)
    recorded = Faulty(tuple(simulation.scans()), simulation.ground_truth, shown, 0)
    fault = f"standing still for {scans} scans" + (" amid traffic" if crowded else "")
    return Case(fault, f"{world_name}, {sensor}", recorded, simulation.distance_to_surfaces)


def _featureless(kind: str) -> Case:
    """From structure through a featureless stretch to structure."""
    begin_m, end_m, length_m = 20.0, 95.0, 120.0
    world = (even_tunnel if kind == "tunnel" else open_plain)(begin_m, end_m, length_m)
    motion = motion_along(straight_drive(length_m, 5.0, 1.5))
    sensor = find_sensor("vlp-16")
    reach_m = 25.0  # dust, or dark walls: no end in view
    sensor = replace(sensor, ranging=replace(sensor.ranging, max_range_m=reach_m))
    scans = int((motion.duration_s - 0.2) * sensor.rate_hz)
    simulation = Simulation(world, sensor, motion, mount_pose("upright", 0.0), scans, 0)
    x = simulation.ground_truth.positions[:, 0]
    nothing = (x > begin_m + reach_m) & (x < end_m - reach_m)
    after = int(np.flatnonzero(x > end_m)[0])
    recorded = Faulty(tuple(simulation.scans()), simulation.ground_truth, nothing, after)
    return Case("featureless for 25 m", f"{world.name}, vlp-16", recorded, simulation.distance_to_surfaces)


def run(case: Case, config: Config) -> tuple[list[ScanEstimate], FloatArray]:
    """Results of the pipeline, and the points (M, 3) of the map."""
    with closing(open_odometry(config, None)) as odometry:
        pipeline = Pipeline(odometry, make_localiser(config), config.global_map)
        results = list(pipeline.run(case.recorded.scans))
    if pipeline.map.global_map is None:
        return results, np.empty((0, 3))
    points = pipeline.map.global_map.points()
    views = pipeline.map.views.placed(np.array([result.T_world_lidar for result in results]))
    return results, points[~seen_through(points, views, pipeline.map.global_map.voxel_size_m)]


def row(case: Case, name: str, keep_moved: bool) -> list[str]:
    kept = GlobalMapConfig(leave_out_moved=not keep_moved)
    results, points = run(case, METHODS[name].model_copy(update={"global_map": kept}))
    recorded, truth = case.recorded, case.recorded.truth.T_world_lidar
    poses = np.array([result.T_world_lidar for result in results])
    true = inverse(truth[0]) @ truth
    off = inverse(true) @ poses
    distance, angle = np.linalg.norm(off[:, :3, 3], axis=1), np.rad2deg(rotation_angle(off))
    status = np.array([result.status.value for result in results])
    after = np.arange(len(results)) >= min(recorded.after + _BACK_AFTER, len(results) - 5)
    estimate = Trajectory(truth_stamps := recorded.truth.stamps[after], poses[after])
    shape = evaluate_trajectory(estimate, Trajectory(truth_stamps, truth[after])).errors.ate_rmse_m
    polluted = case.distances(transform_points(truth[0], points)) > _POLLUTED_M
    there, elsewhere = status[recorded.concerned], status[~recorded.concerned]
    wrong = (status == Status.OK.value) & (distance > _WRONG_M)
    return [
        case.fault,
        case.place,
        name,
        _counts(there),
        _counts(elsewhere),
        str(int(wrong.sum())),
        f"{distance[after].max():.3f} m, {angle[after].max():.2f} deg",
        f"{shape:.3f}",
        f"{100.0 * polluted.mean():.2f}" if len(points) else "no map",
    ]


def _counts(status: np.ndarray[tuple[int, ...], np.dtype[np.str_]]) -> str:
    lost, degraded = int((status == "lost").sum()), int((status == "degraded").sum())
    return f"{lost} lost, {degraded} degraded of {len(status)}"


def cases(arguments: argparse.Namespace) -> Iterator[Case]:
    """The chosen cases, one recording in memory at a time."""
    for kind in arguments.faults:
        if kind == "featureless":
            yield from map(_featureless, ("tunnel", "plain"))
            continue
        for place in arguments.places:
            if kind in ("traffic", "still"):
                yield _still(place, 200, kind == "traffic")
            else:
                yield from in_motion(place, kind)


def main() -> None:
    parser = make_parser(__doc__)
    kinds = [*_FAULTS, "traffic", "still", "featureless"]
    parser.add_argument("--faults", nargs="+", choices=kinds, default=kinds)
    parser.add_argument("--places", nargs="+", choices=list(_PLACES), default=["office", "tunnel", "street"])
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=DEFAULT_METHODS)
    parser.add_argument("--keep-moved", action="store_true", help="keep moved points in the map")
    arguments = parser.parse_args()
    header = ["fault", "place", "method", "concerned", "elsewhere", "ok but wrong", "worst, after"]
    header += ["shape, after, m", "polluted, %"]
    print_header(header)
    for case in cases(arguments):
        for method in arguments.methods:
            print_row(row(case, method, arguments.keep_moved))


if __name__ == "__main__":
    main()

"""What a run leaves in its directory, and what it came to."""

from dataclasses import dataclass

from evaluation.trajectory_metrics import TrajectoryMetrics
from lidarslam import run_directory as files
from lidarslam.config import dump_yaml
from lidarslam.loop_closing import GraphOutcome
from lidarslam.run_directory import RunDirectory
from lidarslam.run_request import RunRequest, describe_run
from lidarslam.run_tracking import Tracked
from lidarslam.summary import RunSummary, WrittenMap, summarise
from lidarslam.trajectory_files import write_trajectories
from mapping.config import GlobalMapConfig
from mapping.g2o import format_g2o
from mapping.global_map import GlobalMap
from mapping.map_io import write_cloud
from mapping.visibility import PlacedViews, seen_through


@dataclass(frozen=True)
class RunOutcome:
    """What a run came to.

    Attributes:
        summary: the run in numbers.
        metrics: its errors, when the recording came with ground truth for it.
        stopped: why it ended before its last scan, None when it did not.
    """

    summary: RunSummary
    metrics: TrajectoryMetrics | None
    stopped: str | None = None


def write_results(
    directory: RunDirectory, request: RunRequest, tracked: Tracked, closed: GraphOutcome | None
) -> RunOutcome:
    """Write everything but the log of the scans: their poses are final by now, and a graph has drawn its map."""
    config, log = request.config, tracked.log
    directory.write_text(files.CONFIG, dump_yaml(config, describe_run(request)))
    global_map = tracked.global_map if closed is None else closed.global_map
    if closed is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(closed.graph))
    metrics = write_trajectories(directory, tracked.recording, tracked.truth, log)
    views = tracked.views.placed(log.trajectory.T_world_lidar)
    written = write_map(directory, global_map, views, config.global_map, request.pcd)
    log.warnings.extend(tracked.faults.warnings())
    skipped = 0 if tracked.stopped else tracked.asked - len(log) - tracked.faults.left_out
    summary = summarise(log, tracked.total_ms, written, skipped, closed)
    directory.write_json(files.SUMMARY, summary.to_json())
    return RunOutcome(summary, metrics, tracked.stopped)


def write_map(
    directory: RunDirectory, global_map: GlobalMap | None, views: PlacedViews, config: GlobalMapConfig, pcd: bool
) -> WrittenMap:
    """Write the map without what the views see through, unless it is empty."""
    if global_map is None:
        return WrittenMap(0, None, 0)
    moved = seen_through(global_map.points(config.min_hits), views, global_map.voxel_size_m)
    cloud = global_map.cloud(config.normal_neighbours, config.min_hits, moved)
    written = WrittenMap(len(cloud), global_map.voxel_size_m, int(moved.sum()))
    if not len(cloud):
        return written
    for name in (files.MAP_PLY, files.MAP_PCD) if pcd else (files.MAP_PLY,):
        with directory.replacing(name) as path:
            write_cloud(path, cloud)
    return written

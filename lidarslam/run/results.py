"""What a run leaves in its directory, and what it came to."""

from dataclasses import dataclass

from evaluation.map.entropy import sampled_map_entropy
from evaluation.trajectory.metrics import TrajectoryMetrics
from lidarslam.config.settings import dump_yaml
from lidarslam.pipeline.loop_closing import GraphOutcome
from lidarslam.run import directory as files
from lidarslam.run.directory import RunDirectory
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.run.summary import RunSummary, WrittenMap, summarise
from lidarslam.run.tracking import Tracked
from lidarslam.run.trajectory_files import write_trajectories
from mapping.config import GlobalMapConfig
from mapping.global_map.global_map import GlobalMap, PointCloud
from mapping.global_map.map_io import write_cloud
from mapping.global_map.moved_points import PlacedViews, seen_through
from mapping.pose_graph.g2o import format_g2o
from mapping.slides.slides import find_contradictions


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


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """A map as it is written.

    Attributes:
        cloud: its points; None when no scan was drawn.
        voxel_size_m: it has one point in each of these; None when no scan was drawn.
        moved: points that are left out, of what has moved.
    """

    cloud: PointCloud | None
    voxel_size_m: float | None
    moved: int = 0


def final_map(tracked: Tracked, closed: GraphOutcome | None, config: GlobalMapConfig) -> DrawnMap:
    """The map of a run whose poses are final; a graph has drawn it anew."""
    views = tracked.views.placed(tracked.log.trajectory.T_world_lidar)
    return drawn_map(tracked.global_map if closed is None else closed.global_map, views, config)


def drawn_map(global_map: GlobalMap | None, views: PlacedViews, config: GlobalMapConfig) -> DrawnMap:
    """A map without what the views see through."""
    if global_map is None:
        return DrawnMap(None, None)
    moved = seen_through(global_map.points(config.min_hits), views, global_map.voxel_size_m)
    cloud = global_map.cloud(config.min_hits, moved)
    return DrawnMap(cloud, global_map.voxel_size_m, int(moved.sum()))


def write_results(
    directory: RunDirectory, request: RunRequest, tracked: Tracked, closed: GraphOutcome | None, drawn: DrawnMap
) -> RunOutcome:
    """Write everything but the log of the scans: their poses are final by now."""
    config, log = request.config, tracked.log
    directory.write_text(files.CONFIG, dump_yaml(config, describe_run(request)))
    if closed is not None:
        directory.write_text(files.POSE_GRAPH, format_g2o(closed.keyframe_poses, closed.edges))
    metrics = write_trajectories(directory, tracked.recording, tracked.truth, log)
    written = write_map(directory, drawn, request.pcd)
    log.warnings.extend(tracked.faults.warnings())
    skipped = 0 if tracked.stopped else tracked.asked - len(log) - tracked.faults.left_out
    contradictions = find_contradictions(tracked.slides, log.trajectory.T_world_lidar)
    summary = summarise(log, tracked.total_ms, written, skipped, closed, contradictions)
    directory.write_json(files.SUMMARY, summary.to_json())
    return RunOutcome(summary, metrics, tracked.stopped)


def write_map(directory: RunDirectory, drawn: DrawnMap, pcd: bool) -> WrittenMap:
    """Write a map, unless it is empty."""
    cloud = drawn.cloud
    if cloud is None or not len(cloud):
        return WrittenMap(0, drawn.voxel_size_m, drawn.moved)
    for name in (files.MAP_PLY, files.MAP_PCD) if pcd else (files.MAP_PLY,):
        with directory.replacing(name) as path:
            write_cloud(path, cloud)
    entropy = sampled_map_entropy(cloud.points)
    return WrittenMap(len(cloud), drawn.voxel_size_m, drawn.moved, None if entropy is None else entropy.mean)

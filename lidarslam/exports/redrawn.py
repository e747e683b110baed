"""The map of a run drawn again from its recording, with other settings for the removal of moving objects."""

from pathlib import Path

import numpy as np

from lidarslam.config.settings import load_config
from lidarslam.core.errors import InputError
from lidarslam.exports.run_scans import read_run_scans
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.global_map.moved_points import Views, seen_through
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.storage.directory import CONFIG
from lidarslam.storage.finished_run import read_summary


def redrawn(run: Path, least_through: int) -> tuple[PointCloud, int]:
    """The map, in one piece, and how many points were left out.

    Scans are deskewed along the final trajectory; those on which tracking was lost are left out.

    Args:
        run: its directory.
        least_through: range images that see through a moved point, at least; 0: none is left out.

    Raises:
        InputError: there is no run, or its recording is not there any more or cannot be read.
    """
    scans, summary = read_run_scans(run), read_summary(run)
    voxel_size_m = (summary.get("map_tiles") or {}).get("voxel_size_m") or summary.get("map_voxel_size_m")
    config = load_config(run / CONFIG).global_map.model_copy(update={"voxel_size_m": voxel_size_m, "most_points": None})
    builder, views, drawn = MapBuilder(config), Views(), None
    poses = scans.trajectory.T_world_lidar
    for index, scan in scans.deskewed():
        if scans.lost[index]:
            continue
        thinned = builder.thin(scan)
        if builder.voxel_size_m is not None:
            drawn = drawn or GlobalMap(builder.voxel_size_m)
            drawn.add(thinned.points, poses[index], thinned.attributes(config.fields))
            views.add(thinned.points, index)
    if drawn is None:
        raise InputError(f"{run}: no scan of its recording has points")
    moved = np.zeros(len(drawn.points(config.min_hits)), dtype=np.bool_)
    if least_through:
        moved = seen_through(drawn.points(config.min_hits), views.placed(poses), drawn.voxel_size_m, least_through)
    cloud = drawn.cloud(config.min_hits, moved)
    return PointCloud(cloud.points, cloud.normals, cloud.attributes.only(config.fields)), int(moved.sum())

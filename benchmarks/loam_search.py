"""Search of five neighbours in LOAM's map: Open3D's nearest-neighbour search compared with our voxel hash.

    python benchmarks/loam_search.py KITTI/sequences/04 office_spin --scans 60

Prints a Markdown table with a row per recording, in median milliseconds per scan (ours on one thread, Open3D on all):

- Open3D, index: building the index of the map's voxels, which change with every scan;
- Open3D, search: five neighbours of the scan's planar keypoints, once;
- ours, insert: the scan's planar points into the finest grid of the map;
- ours, search: five neighbours and their plane, once.

Our search is limited to the 27 voxels around a point: neighbours farther than a voxel's edge may be missed.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
from mapping_accuracy import make_parser, print_header, print_row

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.scan import Scan
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam.feature_map import NEIGHBOURS, VoxelGrid, match_features
from lidarslam.mapping.loam.features import PLANE
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.local_map import Surfaces
from lidarslam.mapping.surfels.surfel_kernels import views_of
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.pipeline.threads import in_order


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="+", type=Path, help="recordings")
    parser.add_argument("--scans", type=int, default=60, help="maximum per recording")
    arguments = parser.parse_args()
    print_header(["recording", "voxels", "Open3D, index", "Open3D, search", "ours, insert", "ours, search"])
    for source in arguments.sources:
        recording = open_recording(source)
        print_row([recording.name, *_cells(list(in_order(recording.scans(0, arguments.scans))))])


def _cells(scans: list[Scan]) -> list[str]:
    mapper, grid, rows = Mapper(MappingConfig(method="loam")), None, []
    for scan in scans:
        sampled = mapper.sample(scan)
        state = mapper.process(sampled, Prior()).state
        assert sampled.sweep.kinds is not None
        assert sampled.keypoints.kinds is not None
        planes, keypoints = (
            transform_points(state.T_world_lidar, sweep.compensated(state.velocity)[sweep.kinds == PLANE])
            for sweep in (sampled.sweep, sampled.keypoints)
        )
        if grid is not None and grid.cell_m == sampled.cell_m:
            rows.append(_times(grid, planes, keypoints, state.T_world_lidar[:3, 3]))
        else:
            grid = VoxelGrid(sampled.cell_m)
            grid.insert(planes, views_of(planes, state.T_world_lidar[:3, 3]), np.zeros(len(planes)))
    assert grid is not None
    return [f"{len(grid):,}", *(f"{value:.1f}" for value in np.median(rows[1:], axis=0))]


def _times(grid: VoxelGrid, planes: FloatArray, keypoints: FloatArray, sensor: FloatArray) -> list[float]:
    means, found, given = grid.means, Surfaces.none(len(keypoints)), (grid.voxels, sensor, False)
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(means), o3d.core.int32)
    index_ms = _timed(search.knn_index)
    theirs_ms = _timed(lambda: search.knn_search(o3d.core.Tensor.from_numpy(keypoints), NEIGHBOURS))
    ours_ms = _timed(lambda: match_features(keypoints, np.arange(len(keypoints)), False, *given, found))
    insert_ms = _timed(lambda: grid.insert(planes, views_of(planes, sensor), np.zeros(len(planes))))
    return [index_ms, theirs_ms, insert_ms, ours_ms]


def _timed(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - started)


if __name__ == "__main__":
    main()

"""LOAM's mapping with the choices of the published program in place of our own.

    python benchmarks/loam_variants.py KITTI/sequences/04 --worlds office --motions tracked --scans 200
    python benchmarks/loam_variants.py RECORDING --odometry constant-velocity

Prints a Markdown table, a row for each recording: ATE in metres after SE(3) alignment, with lost and degraded scans, of

- ours;
- published edges: curvature above 0.1 square metres, whatever the noise of the scan;
- averaged voxels: Open3D's voxel grid over map and new scan together, instead of the first point of a voxel;
- both.
"""

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
import open3d as o3d
from mapping_accuracy import add_simulation_arguments, localise, print_row, recordings

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam import features
from lidarslam.mapping.loam.feature_map import FeatureMap
from lidarslam.odometry.config import OdometryConfig

_VARIANTS = {
    "ours": (False, False),
    "published edges": (True, False),
    "averaged voxels": (False, True),
    "both": (True, True),
}


def insert_averaged(self: FeatureMap, points: FloatArray, sensor: FloatArray, spacing_m: float) -> None:
    """`FeatureMap.insert` with one mean a voxel."""
    points = np.concatenate([self.points, points])
    near = points[np.linalg.norm(points - sensor, axis=1) < self._radius_m]
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(near))
    self.points = np.asarray(cloud.voxel_down_sample(spacing_m).points) if len(near) else near
    self._search = None


@contextmanager
def variant(published_edges: bool, averaged: bool) -> Iterator[None]:
    """The published choices for a while."""
    with ExitStack() as stack:
        if published_edges:
            stack.enter_context(patch.object(features, "_ABOVE_NOISE", 0.0))
        if averaged:
            stack.enter_context(patch.object(FeatureMap, "insert", insert_averaged))
        yield


def main() -> None:
    """Parse the command line and print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth")
    parser.add_argument("--odometry", choices=("learned", "constant-velocity"), default="learned")
    add_simulation_arguments(parser, (), ("tracked",))
    arguments = parser.parse_args()
    config = Config(odometry=OdometryConfig(method=arguments.odometry), mapping=MappingConfig(method="loam"))
    print_row(["recording", "scans", *_VARIANTS])
    print_row(["---"] * (2 + len(_VARIANTS)))
    for recorded in recordings(arguments):
        cells = []
        for choices in _VARIANTS.values():
            with variant(*choices):
                cells.append(localise(recorded, config).text())
        print_row([recorded.name, str(len(recorded.scans)), *cells])


if __name__ == "__main__":
    main()

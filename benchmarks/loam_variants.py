"""LOAM's mapping with the choices of the published program instead of our own.

    python benchmarks/loam_variants.py KITTI/sequences/04 --worlds office --motions tracked --scans 200
    python benchmarks/loam_variants.py RECORDING --odometry constant-velocity

Prints a Markdown table with a row per recording: ATE in metres after SE(3) alignment, with lost and degraded scans, of

- ours;
- published edges: curvature above 0.1 square metres, independent of the scan's noise;
- published planes: fitted to the means of five voxels, not to all points in them;
- discrete: the sweep compensated with the odometry's velocity instead of one estimated with the pose.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from unittest.mock import patch

import numpy as np
from mapping_accuracy import (
    add_simulation_arguments,
    config_of,
    localise,
    make_parser,
    print_header,
    print_row,
    recordings,
)
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam import feature_map, features
from lidarslam.mapping.loam.feature_map import add_moments
from lidarslam.mapping.surfels.symmetric import SYMMETRIC
from lidarslam.mapping.surfels.voxel_hash import Rows


@contextmanager
def published_edges() -> Iterator[None]:
    """Use the published threshold for edges."""
    with patch.object(features, "_ABOVE_NOISE", 0.0):
        yield


@contextmanager
def published_planes() -> Iterator[None]:
    """Use one point per voxel, the mean of all."""

    def add_mean(
        points: FloatArray, views: NDArray[np.float32], elevations: FloatArray, rows: Rows, sums: FloatArray
    ) -> None:
        add_moments(points, views, elevations, rows, sums)
        means = sums[:, 1:4] / sums[:, :1]
        products = [means[:, i] * means[:, j] for i, j in SYMMETRIC]
        sums[:, 4:10] = sums[:, :1] * np.stack(products, axis=1)

    with patch.object(feature_map, "add_moments", add_mean):
        yield


_LOAM = MappingConfig(method="loam")
_VARIANTS: dict[str, tuple[Callable[[], AbstractContextManager[None]], MappingConfig]] = {
    "ours": (nullcontext, _LOAM),
    "published edges": (published_edges, _LOAM),
    "published planes": (published_planes, _LOAM),
    "discrete": (nullcontext, MappingConfig(method="loam", continuous_time=False)),
}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings with ground truth")
    parser.add_argument("--odometry", choices=("learned", "constant-velocity"), default="learned")
    add_simulation_arguments(parser, (), ("tracked",))
    arguments = parser.parse_args()
    print_header(["recording", "scans", *_VARIANTS])
    for recorded in recordings(arguments):
        cells = []
        for variant, mapping in _VARIANTS.values():
            with variant():
                cells.append(localise(recorded, config_of(arguments.odometry, mapping)).text())
        print_row([recorded.name, str(len(recorded.scans)), *cells])


if __name__ == "__main__":
    main()

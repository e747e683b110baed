"""Open3D's registration, alignment, thinning, normals and neighbour searches compared with ours, on the same input.

    python benchmarks/open3d_parts.py --worlds street office --recordings VLP16_DRIVE --scans KITTI/sequences/04
    python benchmarks/open3d_parts.py --worlds office --parts normals neighbours

The input is one and a third laps of a world with a VLP-16, at poses that drift by 1 % of the distance travelled and 2
degrees per 100 m, or a recording, whose reference is the trajectory of `learned+map`. Submaps and keyframes are those
of the pose graph; the later keyframe of a pair revisits the place of the earlier. Milliseconds are CPU time of all
threads.

- registration: sparse submaps, from the reference with an error of a tenth of the median range and of 0.1 rad in yaw,
  by `register`, and by Open3D's ICP on the points on planes, with the same normals, gates and kernels;
- refinement: dense submaps, from the verified pose, by `refine`, and by Open3D's ICP with the same gates, kernel and
  number of residuals; NEES (median 5.3 for exact covariances) has the same prior and drift for all;
- alignment: keyframes without a guess, by correlation of bird's-eye views, and by FPFH with RANSAC or fast global
  registration (FGR), before `register`; a pose is right within 0.5 m and 3 degrees;
- relocalisation: a keyframe's scan in the map of those at least a loop's length before it, at an unknown heading; a
  place is right within one and a half of the view's cells and 10 degrees; `any` counts all proposals;
- thinning: the first scan of each of `--scans`, by default of a simulated street, to cells of 0.25 m;
- normals: of the map of all scans at the reference, against the nearest true surface;
- neighbours: one half of that map's points in the other: distances to the nearest, and all within 0.3 m.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import open3d_methods as theirs
from mapping_accuracy import make_parser, make_simulation, print_row
from open3d_poses import (
    Calls,
    Keyframes,
    Rows,
    alignment_rows,
    recorded,
    refinement_rows,
    registration_rows,
    relocalisation_rows,
    simulated,
    timed,
)
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import central_per_cell, one_per_cell
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.loops.sparse_submap import principal_components
from lidarslam.simulation.reference_map import reference_map
from lidarslam.simulation.world import WORLDS

_THINNED_M, _RADIUS_M, _NEAR_M, _FEW = 0.25, 0.3, 0.1, 20_000


def thinning_rows(name: str, points: FloatArray) -> Rows:
    """Thinning of a scan (N, 3)."""
    exact = len(np.unique(np.floor(points / _THINNED_M), axis=0))
    calls: Calls = {
        "`one_per_cell` (ours)": lambda: one_per_cell(points, _THINNED_M),
        "`central_per_cell` (ours)": lambda: central_per_cell(points, _THINNED_M),
        "means, `geometry`": lambda: theirs.thinned(points, _THINNED_M),
        "means, `t.geometry`": lambda: theirs.thinned_tensor(points, _THINNED_M),
    }
    for method, call in calls.items():
        found, ms = timed(call, 11)
        yield [name, method, f"{len(points):,}", f"{100.0 * len(found) / exact:.1f}", f"{ms:.1f}"]


def normals_rows(k: Keyframes) -> Rows:
    """Normals of a map."""
    if k.simulation is None:
        return
    points, voxel_m, true = k.global_map.points(), k.global_map.voxel_size_m, reference_map(k.simulation, step=6)
    away_m, nearest = cKDTree(true.points).query(points, distance_upper_bound=_NEAR_M)
    near, nearest = np.isfinite(away_m), np.asarray(nearest)
    calls: Calls = {f"Open3D, {count} nearest": partial(theirs.normals, points, count, None) for count in (10, 20, 30)}
    calls |= {
        f"Open3D, 30 nearest in {radius} voxels": partial(theirs.normals, points, 30, radius * voxel_m)
        for radius in (2, 3, 4)
    }
    calls["ours, 20 nearest"] = lambda: principal_components(points, cKDTree(points), points, 20)[2][:, :, 0]
    for method, call in calls.items():
        found, ms = timed(call)
        cosines = np.abs(np.einsum("ij,ij->i", found[near], true.normals[nearest[near]]))
        degrees = np.rad2deg(np.arccos(np.clip(cosines, 0.0, 1.0)))
        wrong = f"{100.0 * (degrees > 15.0).mean():.1f}"
        yield [k.name, method, f"{near.sum():,}", f"{np.median(degrees):.2f}", wrong, f"{ms:.0f}"]


def neighbours_rows(k: Keyframes) -> Rows:
    """Neighbour searches in a map."""
    points = k.global_map.points()
    here, there = points[::2], points[1::2]
    few = here[:: max(1, len(here) // _FEW)]

    def tree() -> Any:
        return cKDTree(there, balanced_tree=False, compact_nodes=False)

    nearest: Calls = {"SciPy": lambda: tree().query(here)[0], "`core.nns`": lambda: theirs.distances(here, there)}
    nearest["`compute_point_cloud_distance`"] = lambda: theirs.cloud_distances(here, there)
    around: Calls = {"SciPy": lambda: np.array([len(one) for one in tree().query_ball_point(few, _RADIUS_M)])}
    around["`core.nns`"] = lambda: theirs.neighbours(few, there, _RADIUS_M)[1]
    for search, calls, count in (("nearest", nearest, len(here)), (f"within {_RADIUS_M} m", around, len(few))):
        expected = calls["SciPy"]()
        for method, call in calls.items():
            found, ms = timed(call, 3)
            yield [k.name, search, method, f"{count:,}", f"{np.abs(found - expected).max():.0e}", f"{ms:.0f}"]


_PARTS = {
    "registration": (registration_rows, ["right", "off by, m: median / 95 %", "degrees", "ms"]),
    "refinement": (
        refinement_rows,
        ["pairs", "off by, m: median / 95 %", "largest", "degrees: median / 95 %", "NEES: median / 95 %", "ms"],
    ),
    "alignment": (alignment_rows, ["right", "guess off by, m: median / 95 %", "degrees", "ms"]),
    "relocalisation": (relocalisation_rows, ["first right", "any right", "ms"]),
    "normals": (normals_rows, ["points", "off by, degrees: median", "more than 15, %", "ms"]),
    "neighbours": (neighbours_rows, ["method", "points", "largest difference", "ms"]),
}
_THINNING = ["points", "cells with a point, %", "ms"]


def scans(paths: list[Path]) -> list[tuple[str, FloatArray]]:
    """Names and points (N, 3) of the first scans of recordings, by default of a simulated street."""
    found = [(path.name, next(iter(open_recording(path).scans())).points) for path in paths]
    sensors = () if paths else ("hdl-64e", "vlp-16")
    made = [(sensor, make_simulation("street", "car", sensor, 1, 1).scan(0).scan.points) for sensor in sensors]
    return found + made


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--parts", nargs="+", choices=[*_PARTS, "thinning"], default=[*_PARTS, "thinning"])
    parser.add_argument("--worlds", nargs="*", choices=list(WORLDS), default=["street", "office"])
    parser.add_argument("--recordings", nargs="*", type=Path, default=[])
    parser.add_argument("--scans", nargs="*", type=Path, default=[], help="recordings whose first scan is thinned")
    options = parser.parse_args()
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    o3d.utility.random.seed(0)
    rows: dict[str, list[list[str]]] = {part: [] for part in options.parts}
    if "thinning" in rows:
        rows["thinning"] = [row for scan in scans(options.scans) for row in thinning_rows(*scan)]
    made = [partial(simulated, world) for world in options.worlds]
    for make in [*made, *(partial(recorded, path) for path in options.recordings)]:
        keyframes = make()
        for part in (part for part in rows if part != "thinning"):
            rows[part] += _PARTS[part][0](keyframes)
    for part, found in rows.items():
        header = ["recording", "search" if part == "neighbours" else "method"]
        header += _THINNING if part == "thinning" else _PARTS[part][1]
        print(f"\n{part.capitalize()}\n")
        for cells in (header, ["---"] * len(header), *found):
            print_row(cells)


if __name__ == "__main__":
    main()

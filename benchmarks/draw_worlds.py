r"""Pictures of the exact maps of the simulated worlds, as seen along one lap of the route.

    python benchmarks/draw_worlds.py --out docs/pictures --worlds street office tunnel forest hall park
    python benchmarks/draw_worlds.py --out docs/pictures --worlds terrace --scans 40 --width 800
    python benchmarks/draw_worlds.py --out docs/pictures --worlds fields --motion car-fast --sensor hdl-64e \
        --scans 150 --width 800
"""

from pathlib import Path

from mapping_accuracy import in_world, make_parser

from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.simulation.reference_map import reference_map
from lidarslam.simulation.world import WORLDS, build_world
from lidarslam.viewer.picture import OBLIQUE, DrawnRun, draw_runs, fit_frame, save_picture


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    parser.add_argument("--motion", default="car")
    parser.add_argument("--sensor", default="os0-64")
    parser.add_argument("--scans", type=int, help="number of scans; default: one lap")
    parser.add_argument("--width", type=int, default=1600, help="pixels")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.worlds:
        path = arguments.out / f"{name}.png"
        simulation = in_world(build_world(name, 0), arguments.motion, arguments.sensor, arguments.scans, 0)
        seen = reference_map(simulation, step=max(1, len(simulation) // 200))
        runs = [DrawnRun(name, PointCloud(seen.points, seen.normals))]
        save_picture(path, draw_runs(runs, fit_frame(runs, OBLIQUE, width=arguments.width)))
        print(f"{path}: {len(seen.points):,} points", flush=True)


if __name__ == "__main__":
    main()

"""Draw the exact map of every simulated world, as one lap of its route sees it.

python benchmarks/draw_worlds.py --out docs/pictures
"""

import argparse
import sys
from pathlib import Path

from lidarslam.picture import Camera, draw, height_colours, save_picture
from lidarslam.simulation.mounts import mount_pose
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.reference_map import reference_map
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.worlds.registry import WORLDS, build_world


def draw_world(name: str, seed: int, motion: str, sensor: str, path: Path, most_scans: int | None = None) -> int:
    """Draw one world, or what the first scans of a lap see of it; how many points its map has."""
    world = build_world(name, seed)
    carried = motion_along_route(motion, world, seed)
    device = find_sensor(sensor)
    scans = min(int(carried.duration_s * device.rate_hz), most_scans or sys.maxsize)
    T_body_lidar = mount_pose("upright", carried.sensor_height_m)
    simulation = Simulation(world, device, carried, T_body_lidar, scans, seed)
    seen = reference_map(simulation, step=max(1, scans // 200))
    camera = Camera(azimuth_deg=-60.0, elevation_deg=38.0)
    save_picture(path, draw(seen.points, height_colours(seen.points), seen.normals, camera))
    return len(seen.points)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    parser.add_argument("--motion", default="car")
    parser.add_argument("--sensor", default="os0-64")
    parser.add_argument("--scans", type=int, help="draw what the first scans see; default: a lap")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.worlds:
        path = arguments.out / f"{name}.png"
        points = draw_world(name, arguments.seed, arguments.motion, arguments.sensor, path, arguments.scans)
        print(f"{path}: {points:,} points", flush=True)


if __name__ == "__main__":
    main()

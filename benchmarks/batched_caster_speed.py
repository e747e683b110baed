"""How fast the batched caster makes range images, beside the mesh caster on the same rays, and how far they agree.

    python benchmarks/batched_caster_speed.py --worlds street tunnel --columns 720
    python benchmarks/batched_caster_speed.py --device cuda --batch 64 --skip-mesh

What is wanted on two cores: 1 image a second or more in every world.
"""

import argparse
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.simulation.batched_caster import BatchedCaster
from lidarslam.simulation.batched_sweep import SweepGrid
from lidarslam.simulation.batched_world import BatchedWorld
from lidarslam.simulation.sensor_table import SENSORS
from lidarslam.simulation.sensors import find_sensor
from lidarslam.simulation.world import World
from lidarslam.simulation.worlds.registry import WORLDS, build_world

_HEIGHT_M = 1.7


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table with a row for each world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=WORLDS)
    parser.add_argument("--sensor", default="vlp-16", choices=[n for n in SENSORS if n != "livox"])
    parser.add_argument("--columns", type=int, default=720)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-range-m", type=float, default=100.0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--skip-mesh", action="store_true", help="for a machine without Open3D")
    options = parser.parse_args(arguments)
    grid = SweepGrid.of_sensor(find_sensor(options.sensor), columns=options.columns, device=options.device)
    rows, columns, _ = grid.directions.shape
    print(f"{options.batch} images of {rows} x {columns} at a time on {options.device}; images a second")
    print(f"{'world':10}{'primitives':>12}{'batched':>10}{'mesh':>10}{'within 5 mm':>14}")
    for name in options.worlds:
        world = build_world(name, options.seed)
        primitives = len(world.boxes) + len(world.cylinders)
        poses = _poses_on_route(world, options.batch)
        caster = BatchedCaster(BatchedWorld.from_world(world, options.device), options.max_range_m)
        images, rate = _timed(lambda c=caster, p=poses: _images(c, p, grid), options.repeats)  # type: ignore[misc]
        row = f"{name:10}{primitives:12,}{options.batch * rate:10.1f}"
        if not options.skip_mesh:
            expected, mesh_rate = _cast_mesh(world, poses, grid, options.max_range_m, options.repeats)
            near = np.abs(images[:, 3].reshape(len(images), -1) - expected) < 5e-3
            row += f"{options.batch * mesh_rate:10.1f}{near.mean():14.4f}"
        print(row, flush=True)


def _images(caster: BatchedCaster, T_world_lidar: FloatArray, grid: SweepGrid) -> FloatArray:
    # The copy to the host waits for the device.
    return caster.images(torch.tensor(T_world_lidar), grid).double().cpu().numpy()


def _cast_mesh(
    world: World, T_world_lidar: FloatArray, grid: SweepGrid, max_range_m: float, repeats: int
) -> tuple[FloatArray, float]:
    """Ranges (B, N) by the mesh caster, 0 where there is nothing, and batches a second."""
    from lidarslam.simulation.caster import Caster

    caster = Caster(world)
    rays = grid.directions.flatten(0, 1).double().cpu().numpy()

    def cast() -> FloatArray:
        ranges = []
        for T in T_world_lidar:
            origins = np.broadcast_to(T[:3, 3], rays.shape)
            ranges.append(caster.cast(origins, rays @ T[:3, :3].T, np.zeros(len(rays)), max_range_m).ranges)
        found = np.stack(ranges)
        return np.where(np.isfinite(found), found, 0.0)

    return _timed(cast, repeats)


def _timed(make: Callable[[], FloatArray], repeats: int) -> tuple[FloatArray, float]:
    """What is made, and how often a second at best: other load on the machine only slows."""
    made, seconds = make(), []
    for _ in range(repeats):
        start = time.perf_counter()
        made = make()
        seconds.append(time.perf_counter() - start)
    return made, 1.0 / min(seconds)


def _poses_on_route(world: World, count: int) -> FloatArray:
    """(count, 4, 4) above corners of the route."""
    corners = world.route.waypoints[np.linspace(0, len(world.route.waypoints) - 1, count).astype(int)]
    return make_transform(np.broadcast_to(np.eye(3), (count, 3, 3)), corners + np.array([0.0, 0.0, _HEIGHT_M]))


if __name__ == "__main__":
    main()

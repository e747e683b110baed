"""Casting whole batches of sweeps in torch, on a CPU or an accelerator, straight into range images for training.

What `Caster` does with triangles, to 2 mm: boxes and height fields are the same surfaces, cylinders are round where
its meshes have 24 sides, which lie within 0.6 % of the radius of the round form. There is no gradient.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from lidarslam.simulation.batched_culling import Cones, image_tiles
from lidarslam.simulation.batched_height_field import meet_fields
from lidarslam.simulation.batched_primitives import dot, meet_box, meet_cylinder, rotate
from lidarslam.simulation.batched_solids import TiledRays, meet_movers, meet_solids
from lidarslam.simulation.batched_sweep import SweepGrid, range_images
from lidarslam.simulation.batched_world import BatchedWorld

# Rays of an image that are culled together: a tile is about square for most sensors.
_TILE = (4, 8)
_TILE_OF_ROW = (1, 32)
# Comparisons of a tile with a sphere at a time: what fits a CPU's cache, and what fills an accelerator.
_COMPARISONS_CPU = 1 << 20
_COMPARISONS_ACCELERATOR = 1 << 26
_REFERENCE_DTYPE = torch.float64


@dataclass(frozen=True, eq=False)
class BatchedCaster:
    """Casts batches of sweeps into one world or several.

    Attributes:
        world: W worlds; image b of a batch sees world b, or all see the only one, unless `worlds` says otherwise.
        max_range_m: rays that meet nothing within it return nothing.
        comparisons: how many pairs of a tile of rays and a primitive are looked at together, which bounds the memory:
            some 50 bytes each. By default what suits the device.
    """

    world: BatchedWorld
    max_range_m: float
    comparisons: int | None = None

    @torch.no_grad()  # not inference mode: its tensors could not go into a network that is trained
    def images(
        self, T_world_lidar: Tensor, grid: SweepGrid, times: Tensor | None = None, worlds: Tensor | None = None
    ) -> Tensor:
        """Range images (B, 4, H, W) float32 of x, y, z and range, zero where nothing is met.

        Args:
            T_world_lidar: (B, 4, 4), or (B, W, 4, 4) for a pose to each column of a rolling sweep; best in float64.
                Points are in the LiDAR frame of their own column.
            grid: the rays.
            times: (B,) or (B, W) seconds, where movers are; 0 by default.
            worlds: (B,) int64 which world each image sees.
        """
        height, width = grid.directions.shape[:2]
        if T_world_lidar.ndim == 4:
            T_world_lidar = T_world_lidar[:, None].expand(-1, height, -1, -1, -1).flatten(1, 2)
        if times is not None and times.ndim == 2:
            times = times[:, None].expand(-1, height, -1).flatten(1)
        tiles = image_tiles(height, width, _TILE, self.world.device)
        ranges = self._ranges(T_world_lidar, grid.directions.flatten(0, 1), times, worlds, tiles)
        ranges = ranges.view(-1, height, width)  # (B, H * W) -> (B, H, W)
        return range_images(ranges, grid)

    @torch.no_grad()
    def ranges(
        self, T_world_lidar: Tensor, directions: Tensor, times: Tensor | None = None, worlds: Tensor | None = None
    ) -> Tensor:
        """Ranges (B, N) float32 along any rays, inf where nothing is met.

        Args:
            T_world_lidar: (B, 4, 4), or (B, N, 4, 4) for a pose to each ray.
            directions: (N, 3) unit, in the LiDAR frame; quickest if neighbours look in like directions.
            times: (B,) or (B, N) seconds, where movers are; 0 by default.
            worlds: (B,) int64 which world each image sees.
        """
        tiles = image_tiles(1, len(directions), _TILE_OF_ROW, self.world.device)
        return self._ranges(T_world_lidar, directions, times, worlds, tiles)

    def _ranges(
        self, T_world_lidar: Tensor, directions: Tensor, times: Tensor | None, worlds: Tensor | None, tiles: Tensor
    ) -> Tensor:
        images, count, device = len(T_world_lidar), len(directions), self.world.device
        poses = T_world_lidar.to(device, _REFERENCE_DTYPE)
        if poses.shape not in {(images, 4, 4), (images, count, 4, 4)}:
            raise ValueError(f"T_world_lidar must be (B, 4, 4) or one to each column or ray, got {tuple(poses.shape)}")
        if poses.ndim == 3:
            poses = poses[:, None]
        world = self._worlds_of(images) if worlds is None else worlds.to(device)
        if world.shape != (images,):
            raise ValueError(f"worlds must be ({images},), got {tuple(world.shape)}")
        when = torch.zeros(images, 1) if times is None else times.reshape(images, -1)
        when = when.to(device, torch.float64).expand(-1, count)
        # As many images at a time as keep the largest arrays within bounds.
        most = max(self.world.boxes.radii.shape[1], self.world.cylinders.radii.shape[1], 64)
        at_once = max(1, self._comparisons // (len(tiles) * most))
        parts = [slice(b, b + at_once) for b in range(0, images, at_once)]
        cast = [self._cast(poses[part], directions.to(device), when[part], world[part], tiles) for part in parts]
        return torch.cat(cast) if cast else torch.empty(0, count, device=device)

    def _cast(self, poses: Tensor, directions: Tensor, times: Tensor, world: Tensor, tiles: Tensor) -> Tensor:
        """Ranges (B, N) of directions (N, 3) from poses (B, N or 1, 4, 4), as many as fit the memory."""
        positions = poses[..., :3, 3]
        reference = positions.mean(dim=1)
        # Differences in float64, all else in float32: errors do not grow with the size of the world.
        o = (positions - reference[:, None]).float().movedim(-1, 0)
        R = poses[..., :3, :3].float().movedim((-2, -1), (0, 1))
        d = rotate(R, directions.float().T[:, None])  # (3, B, N)
        o = o.expand_as(d)
        reach = self.max_range_m + dot(o, o).sqrt().amax(dim=1)
        tiled = (o[..., tiles], d[..., tiles])
        rays = TiledRays(world, reference, reach, times[:, tiles], *tiled, tiles, Cones.around(*tiled))
        ranges = torch.full(d.shape[1:], torch.inf, device=d.device)
        meet_solids(rays, self.world.boxes, meet_box, ranges, self._comparisons)
        meet_solids(rays, self.world.cylinders, meet_cylinder, ranges, self._comparisons)
        meet_movers(rays, self.world.movers, ranges, self._comparisons)
        # The march along the ground ends where something stands in the way, else just beyond the limit, so that what
        # is met at the limit itself counts.
        ranges.clamp_(max=self.max_range_m * 1.000001)
        meet_fields(self.world.fields, world, reference, o, d, ranges)
        return torch.where(ranges <= self.max_range_m, ranges, torch.inf)

    @property
    def _comparisons(self) -> int:
        on_cpu = self.world.device.type == "cpu"
        return self.comparisons or (_COMPARISONS_CPU if on_cpu else _COMPARISONS_ACCELERATOR)

    def _worlds_of(self, images: int) -> Tensor:
        if len(self.world) not in {1, images}:
            raise ValueError(f"{images} images in {len(self.world)} worlds: say which image sees which with `worlds`")
        return torch.arange(images, device=self.world.device) % len(self.world)

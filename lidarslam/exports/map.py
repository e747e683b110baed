"""Maps for other programs: runs and clouds joined, cleaned, levelled and cropped; occupancy grids; meshes."""

import json
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from lidarslam.config.settings import load_config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.files import make_directory, replacing, written
from lidarslam.core.geometry import FloatArray, levelling, make_transform, rotation_angle, transform_points
from lidarslam.core.text import count
from lidarslam.core.trajectory import read_transform
from lidarslam.datasets.mounting import recorded_axes
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.map.alignment import GLOBAL, MapAlignment, align_map
from lidarslam.exports.source import read_map, read_run_scans, read_source
from lidarslam.mapping.global_map import edits
from lidarslam.mapping.global_map.edits import Mesh, reconstruct
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.global_map.moved_points import Views, seen_through
from lidarslam.mapping.global_map.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridOptions,
    OccupancyGrid,
    occupancy_grid,
)
from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud
from lidarslam.pipeline.map_building import MapBuilder
from lidarslam.storage.directory import CONFIG
from lidarslam.storage.finished_run import is_run, read_summary, read_trajectory

MAP_SUFFIXES = (".ply", ".pcd", ".laz", ".e57")
_FEWEST_SAMPLES = 10


@dataclass(frozen=True)
class MapEdits:
    """The edits, in this order."""

    # moved: range images that see through a moved point, 0: none is removed; None: maps as they are
    moved: int | None = None
    transforms: tuple[Path, ...] = ()  # files of `T_first_other` (4, 4) of the sources after the first
    register: bool = False  # whether these are registered to the first
    # statistical, radius: see `without_outliers`
    statistical: tuple[int, float] | None = None
    radius: tuple[int, float] | None = None
    level: Literal["ground", "gravity"] | None = None
    ground_at_zero: bool = False  # whether the ground below the origin gets z = 0
    box: tuple[float, ...] | None = None  # low and high x, y, z
    within_m: float | None = None  # farther points from the path are left out


@dataclass(frozen=True, eq=False)
class _Map:
    cloud: PointCloud
    positions: FloatArray  # (K, 3) of the sensor, none of a cloud

    def moved(self, T: FloatArray) -> "_Map":
        return _Map(edits.moved(self.cloud, T), transform_points(T, self.positions))


def edit_map(sources: Sequence[Path], out: Path, asked: MapEdits) -> Iterator[str]:
    """Write the edited map of run directories and clouds, in the frame of the first; lines about it."""
    maps = []
    for source in sources:
        maps.append((yield from _read(source, asked.moved)))
    for number, source in enumerate(sources[1:], 1):
        file = asked.transforms[number - 1] if asked.transforms else None
        T = np.eye(4) if file is None else read_transform(file)
        if asked.register:
            fit = _registered(maps[number].cloud, maps[0].cloud, T, source)
            T = fit.T_reference_map
            moved = f"moved by {fit.moved_m:.2f} m, {fit.moved_deg:.2f} deg"
            how = "from everywhere" if fit.method == GLOBAL else moved
            yield f"{source}: registered, {how}; {100.0 * fit.fitness:.0f} % of it within {fit.inlier_m:.2f} m"
        maps[number] = maps[number].moved(T)
    cloud = edits.joined([one.cloud for one in maps])
    whole = _Map(cloud, np.concatenate([one.positions for one in maps]))
    if asked.statistical is not None or asked.radius is not None:
        whole = _Map(edits.without_outliers(cloud, asked.statistical, asked.radius), whole.positions)
        yield f"outliers: {count(len(cloud) - len(whole.cloud), 'point')} of {len(cloud):,} removed"
    whole = yield from _levelled(whole, sources[0], asked)
    cloud = yield from _cropped(whole, asked)
    make_directory(out.parent)
    with replacing(out) as partial:
        write_cloud(partial, cloud)
    yield f"{count(len(cloud), 'point')} written to {out}"


def _read(source: Path, moved: int | None) -> Generator[str, None, _Map]:
    positions = read_trajectory(source).positions if is_run(source) else np.empty((0, 3))
    if moved is not None:
        if not is_run(source):
            raise InputError(f"{source}: is a cloud; moved points are found in the scans of a run")
        cloud, removed = redrawn(source, moved)
        yield f"{source}: drawn again from the recording, {count(removed, 'point')} of moving objects removed"
        return _Map(cloud, positions)
    cloud, _ = read_map(source)
    if not cloud.normals[:, :2].any():  # it has none
        cloud = replace(cloud, normals=np.zeros_like(cloud.normals))
    tiles = read_summary(source).get("map_tiles")
    if tiles is not None:
        yield f"{source}: the overview of a map in tiles, {len(cloud):,} of {tiles['points']:,} points"
    return _Map(cloud, positions)


def _registered(cloud: PointCloud, first: PointCloud, T_guess: FloatArray, source: Path) -> MapAlignment:
    try:
        return align_map(cloud.points, first.points, {"given": T_guess}, search=True)
    except InputError as error:
        reason = "half of its points must lie where the first source has some, at one pose only"
        raise InputError(f"{source}: could not be registered: {reason}; give its pose with --transform") from error


def _levelled(whole: _Map, first: Path, asked: MapEdits) -> Generator[str, None, _Map]:
    if asked.level is not None:
        if asked.level == "gravity":
            if not is_run(first):
                raise InputError(f"{first}: is a cloud, which knows no gravity; use --level ground")
            up, by = upwards(first), "gravity"
        else:
            ground = _ground(whole, first)
            up, by = ground.up, f"the ground, {100.0 * ground.share:.0f} % of what faces upwards"
        T = make_transform(levelling(up), np.zeros(3))
        whole = whole.moved(T)
        yield f"levelled by {np.rad2deg(rotation_angle(T)):.2f} degrees, to {by}"
    if asked.ground_at_zero:
        ground = _ground(whole, first)
        z = ground.height_m / float(ground.up[2])
        whole = whole.moved(make_transform(np.eye(3), [0.0, 0.0, -z]))
        yield f"ground below the origin: from z = {z:.2f} m to 0"
    return whole


def _ground(whole: _Map, first: Path) -> edits.GroundPlane:
    ground = edits.ground_plane(whole.cloud)
    if ground is None:
        raise InputError(f"{first}: no ground within 45 degrees of level; is z of the map upwards?")
    return ground


def _cropped(whole: _Map, asked: MapEdits) -> Generator[str, None, PointCloud]:
    cloud, kept = whole.cloud, np.ones(len(whole.cloud), dtype=np.bool_)
    if asked.box is not None:
        low, high = np.array(asked.box).reshape(3, 2).T
        kept &= ((cloud.points >= low) & (cloud.points <= high)).all(axis=1)
    if asked.within_m is not None:
        if not len(whole.positions):
            raise InputError("--within needs the path of a run; name a run directory, or use --box")
        kept &= np.isfinite(cKDTree(whole.positions).query(cloud.points, distance_upper_bound=asked.within_m)[0])
    if not kept.any():
        raise InputError("no point is left of the map; take a larger --box or --within")
    if not kept.all():
        yield f"cropped: {kept.sum():,} of {count(len(cloud), 'point')} kept"
    return cloud.select(kept)


def upwards(run: Path) -> FloatArray:
    """Unit vector (3,) upwards: the mean specific force in the world, without the change of the velocity."""
    of = read_source(run, "is needed for the direction of gravity; level by the ground instead")
    recording, trajectory = open_recording(of.source, of.reader), read_trajectory(run)
    samples, instead = recording.imu, "level by the ground instead, with --level ground"
    if samples is None:
        raise InputError(f"{of.source}: has no IMU; {instead}")
    T_lidar_imu, T_recorded_imu = samples.T_lidar_imu, load_config(run / CONFIG).odometry.T_recorded_imu
    if T_recorded_imu is not None:
        T_lidar_imu = recorded_axes(recording)[1] @ T_recorded_imu
    if T_lidar_imu is None:
        raise InputError(f"{of.source}: the rotation of its IMU is not known; {instead}")
    stamps = trajectory.stamps
    during = (samples.stamps >= stamps[0]) & (samples.stamps <= stamps[-1])
    if during.sum() < _FEWEST_SAMPLES or len(trajectory) < 3:
        raise InputError(f"{of.source}: its IMU has too few samples during the run; {instead}")
    R_world_imu = trajectory.at(samples.stamps[during])[:, :3, :3] @ T_lidar_imu[:3, :3]
    force = np.einsum("nij,nj->ni", R_world_imu, samples.accelerations[during]).mean(axis=0)
    velocities = np.diff(trajectory.positions, axis=0) / np.diff(stamps)[:, None]
    force = force - (velocities[-1] - velocities[0]) / trajectory.duration_s
    return np.asarray(force / np.linalg.norm(force))


def redrawn(run: Path, least_through: int) -> tuple[PointCloud, int]:
    """The map in one piece, and the number of points left out: those that `least_through` images see through, 0: none.

    Scans are deskewed along the final trajectory; those on which tracking was lost are left out.
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
    points = drawn.points()
    moved = np.zeros(len(points), dtype=np.bool_)
    if least_through:
        moved = seen_through(points, views.placed(poses), drawn.voxel_size_m, least_through)
    cloud = drawn.cloud(moved)
    return PointCloud(cloud.points, cloud.normals, cloud.attributes.only(config.fields)), int(moved.sum())


GRID_SUFFIXES = (".yaml", ".yml")
_FINEST_M = 0.05
_GREY = {OCCUPIED: 0, UNKNOWN: 205, FREE: 254}
# The shade of the unknown, (255 - 205) / 255 = 0.1961, lies between them.
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}


def export_grid(run: Path, out: Path, resolution_m: float | None, options: dict[str, float]) -> Iterator[str]:
    """Write the grid of a run to a .yaml file and an image; lines about it.

    Without a resolution, the edge of a cell is that of the map's voxels, at least 5 cm; the options are those of
    `GridOptions`.
    """
    trajectory, (cloud, voxel_m) = read_trajectory(run), read_map(run)
    chosen = resolution_m or max(_FINEST_M, round(voxel_m or 0.0, 2))
    asked = GridOptions(resolution_m=chosen, **options)
    try:
        grid = occupancy_grid(cloud.points, cloud.normals, trajectory.positions, asked)
    except ValueError as error:
        raise ConfigError(f"the grid would have {error}; take a larger --resolution or a smaller --max-range") from None
    if grid is None:
        raise InputError(f"{run}: no ground was found below the sensor; is z of the map upwards?")
    rows, columns = grid.cells.shape
    yield f"{columns:,} x {rows:,} cells of {chosen:g} m, {columns * chosen:.1f} x {rows * chosen:.1f} m"
    free, occupied = (float(np.mean(grid.cells == value)) for value in (FREE, OCCUPIED))
    yield f"free {100 * free:.1f} %, occupied {100 * occupied:.1f} %, unknown {100 * (1 - free - occupied):.1f} %"
    yield f"written to {', '.join(map(str, write_grid(out, grid)))}"


def write_grid(path: Path, grid: OccupancyGrid) -> list[Path]:
    """Write `path`, a .yaml file, and the image next to it; the files."""
    image = path.with_suffix(".pgm")
    pixels = np.full(grid.cells.shape, _GREY[UNKNOWN], dtype=np.uint8)
    for value, grey in _GREY.items():
        pixels[grid.cells == value] = grey
    origin = [round(float(grid.origin[0]), 6), round(float(grid.origin[1]), 6), 0.0]
    about = {"image": image.name, "mode": "trinary", "resolution": grid.resolution_m, "origin": origin, "negate": 0}
    make_directory(path.parent)
    with written(image) as partial:
        Image.fromarray(pixels[::-1]).save(partial, format="PPM")  # the first row of an image is its top
    with written(path) as partial:
        text = yaml.safe_dump({**about, **_THRESHOLDS}, sort_keys=False, default_flow_style=None)
        partial.write_text(text, encoding="utf-8")
    return [path, image]


MESH_SUFFIXES = (".ply", ".obj", ".glb", ".stl")
_DEFAULT_CELL_M = 0.1
_FLOAT, _UINT32, _UINT8 = 5126, 5125, 5121
_VERTICES, _INDICES = 34962, 34963
# glTF has y up: a turn by -90 degrees about x takes z there.
_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
_ALIGNMENT = 4


def export_mesh(run: Path, out: Path, cell_m: float | None) -> Iterator[str]:
    """Write the mesh of a run to a file with one of `MESH_SUFFIXES`; lines about it.

    Without an edge of the smallest cells, it is twice that of the map's voxels.
    """
    cloud, voxel_m = read_map(run)
    mesh = reconstruct(cloud, cell_m or (2.0 * voxel_m if voxel_m else _DEFAULT_CELL_M))
    if not len(mesh.triangles):
        raise InputError(f"{run}: no surface comes of the {len(cloud):,} points of its map")
    _write(out, mesh)
    yield f"{len(mesh.vertices):,} vertices, {len(mesh.triangles):,} triangles"
    yield f"written to {out}"


def _write(out: Path, mesh: Mesh) -> None:
    import open3d as o3d

    triangles = o3d.utility.Vector3iVector(mesh.triangles)
    surface = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(mesh.vertices), triangles)
    surface.compute_vertex_normals()
    if mesh.colours is not None:
        surface.vertex_colors = o3d.utility.Vector3dVector(mesh.colours.astype(np.float64) / 255.0)
    make_directory(out.parent)
    with written(out) as partial, o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        if out.suffix == ".glb":
            write_glb(partial, mesh, np.asarray(surface.vertex_normals))
        elif not o3d.io.write_triangle_mesh(partial, surface):
            raise OutputError(f"{out}: cannot be written; is the disk full?")


def write_glb(path: Path, mesh: Mesh, normals: FloatArray) -> None:
    """Write a mesh with normals (N, 3) of its vertices."""
    vertices, vectors = mesh.vertices.astype("<f4"), {"componentType": _FLOAT, "type": "VEC3"}
    box = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    arrays: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
        ("", mesh.triangles.astype("<u4").reshape(-1), {"componentType": _UINT32, "type": "SCALAR"}),
        ("POSITION", vertices, {**vectors, **box}),
        ("NORMAL", normals.astype("<f4"), vectors),
    ]
    if mesh.colours is not None:
        opaque = np.column_stack([mesh.colours, np.full(len(vertices), 255, np.uint8)])
        arrays.append(("COLOR_0", opaque, {"componentType": _UINT8, "type": "VEC4", "normalized": True}))
    views, accessors, offset = [], [], 0
    for number, (name, values, about) in enumerate(arrays):
        target = _VERTICES if name else _INDICES
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": target})
        accessors.append({"bufferView": number, "count": len(values), **about})
        offset += values.nbytes  # each a multiple of four bytes
    attributes = {name: number for number, (name, *_) in enumerate(arrays) if name}
    scene = {
        "asset": {"version": "2.0", "generator": "lidarslam"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _Y_UP}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0, "material": 0}]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    with path.open("wb") as file:
        file.write(b"glTF" + np.array([2, 12 + 8 + len(text) + 8 + offset], "<u4").tobytes())
        file.write(np.array([len(text)], "<u4").tobytes() + b"JSON" + text)
        file.write(np.array([offset], "<u4").tobytes() + b"BIN\0")
        for _, values, _ in arrays:
            file.write(np.ascontiguousarray(values).tobytes())

"""The mesh of a run's map in a file."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import cannot_write, make_directory, replacing
from lidarslam.exports.glb import write_glb
from lidarslam.mapping.global_map.products.mesh import Mesh, reconstruct
from lidarslam.storage.finished_run import load_map, read_summary

SUFFIXES = (".ply", ".obj", ".glb", ".stl")
_DEFAULT_CELL_M = 0.1


def export_mesh(run: Path, out: Path, cell_m: float | None) -> Iterator[str]:
    """Write the mesh; lines about it.

    Args:
        run: its directory.
        out: the file, with one of `SUFFIXES`.
        cell_m: edge of the smallest cells; None for twice that of the map's voxels.

    Raises:
        InputError: there is no run or no map, or no surface comes of it.
        OutputError: the file cannot be written.
    """
    cloud = load_map(run)
    if not len(cloud):
        raise InputError(f"{run}: has no map")
    voxel = read_summary(run).get("map_voxel_size_m")
    mesh = reconstruct(cloud, cell_m or (2.0 * voxel if voxel else _DEFAULT_CELL_M))
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
    try:
        with replacing(out) as partial, o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            if out.suffix == ".glb":
                write_glb(partial, mesh, np.asarray(surface.vertex_normals))
            elif not o3d.io.write_triangle_mesh(partial, surface):
                raise OutputError(f"{out}: cannot be written; is the disk full?")
    except OSError as error:
        raise cannot_write(out, error) from error

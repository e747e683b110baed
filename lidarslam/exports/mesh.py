"""The mesh of a run's map in a file."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError, OutputError
from lidarslam.core.files import make_directory, written
from lidarslam.core.geometry import FloatArray
from lidarslam.exports.source import read_map
from lidarslam.mapping.global_map.edits import Mesh, reconstruct

SUFFIXES = (".ply", ".obj", ".glb", ".stl")
_DEFAULT_CELL_M = 0.1
_FLOAT, _UINT32, _UINT8 = 5126, 5125, 5121
_VERTICES, _INDICES = 34962, 34963
# glTF has y up: a turn by -90 degrees about x takes z there.
_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
_ALIGNMENT = 4


def export_mesh(run: Path, out: Path, cell_m: float | None) -> Iterator[str]:
    """Write the mesh of a run to a file with one of `SUFFIXES`; lines about it.

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

"""Meshes as binary glTF 2.0; what Open3D 0.20 writes by that name, Open3D itself and others built on Assimp refuse."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.global_map.products.mesh import Mesh

_FLOAT, _UINT32, _UINT8 = 5126, 5125, 5121
_VERTICES, _INDICES = 34962, 34963
# glTF has y up: a turn by -90 degrees about x takes z there.
_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
_ALIGNMENT = 4


def write_glb(path: Path, mesh: Mesh, normals: FloatArray) -> None:
    """Write a mesh with normals (N, 3) of its vertices."""
    vertices = mesh.vertices.astype("<f4")
    arrays: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
        ("", mesh.triangles.astype("<u4").reshape(-1), {"componentType": _UINT32, "type": "SCALAR"}),
        (
            "POSITION",
            vertices,
            {
                "componentType": _FLOAT,
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
        ),
        ("NORMAL", normals.astype("<f4"), {"componentType": _FLOAT, "type": "VEC3"}),
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

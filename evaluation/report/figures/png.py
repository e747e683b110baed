"""A picture with a palette as PNG, for pictures of more points than SVG can carry."""

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray


def indexed_png(indices: NDArray[np.uint8], palette: NDArray[np.uint8]) -> bytes:
    """PNG of rows and columns of palette entries (H, W); the palette holds (K, 3) colours, the first is transparent.

    Raises:
        ValueError: the palette has no or more than 256 colours, or an index lies outside it.
    """
    if palette.ndim != 2 or palette.shape[1] != 3 or not 0 < len(palette) <= 256:
        raise ValueError(f"palette must be (1 to 256, 3), got {palette.shape}")
    if indices.ndim != 2 or indices.size == 0 or int(indices.max()) >= len(palette):
        raise ValueError(f"indices must be (H, W) below {len(palette)}, got {indices.shape}")
    height, width = indices.shape
    rows = np.column_stack([np.zeros(height, dtype=np.uint8), indices])  # every row begins with "no filter"
    return b"".join(
        [
            b"\x89PNG\r\n\x1a\n",
            _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
            _chunk(b"PLTE", palette.astype(np.uint8).tobytes()),
            _chunk(b"tRNS", b"\x00"),
            _chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)),
            _chunk(b"IEND", b""),
        ]
    )


def data_uri(png: bytes) -> str:
    """The picture as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

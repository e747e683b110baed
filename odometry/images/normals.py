"""Surface normals of range images: planes fitted to each pixel's neighbourhood."""

import numpy as np

from odometry.images import normal_kernels as kernels
from odometry.images.normal_config import NormalConfig
from odometry.images.normal_kernels import Floats


def surface_normals(image: Floats, config: NormalConfig) -> Floats:
    """Unit normals (3, H, W) float32 that face the sensor, zero where the neighbourhood is no plane.

    A principal component analysis of the points around each pixel whose ranges are close to its own, as in DeLORA
    (Nubert et al. 2021). Neighbourhoods go on across the seam of azimuth; above and below the image nothing is.

    Args:
        image: (C, H, W) float32, C at least 4: x, y, z and range in metres in the sensor's frame, zero where empty.
        config: which neighbours count, and which neighbourhoods are planes.

    Raises:
        ValueError: the image has another shape, or is narrower than the neighbourhood.
    """
    if image.ndim != 3 or image.shape[0] < 4:
        raise ValueError(f"an image must be (at least 4, H, W), got {image.shape}")
    widest = max(config.columns, config.wide_columns)
    if image.shape[2] < 2 * widest + 1:
        raise ValueError(f"an image of {image.shape[2]} columns is narrower than the neighbourhood")
    _, height, width = image.shape
    padded = np.empty((4, height + 2 * config.rows, width + 2 * widest), dtype=np.float32)
    kernels.pad(np.ascontiguousarray(image[:4], dtype=np.float32), config.rows, widest, padded)
    normals = np.zeros((3, height, width), dtype=np.float32)
    kernels.planes(padded, widest, _neighbourhood(config, config.gate_m, config.columns), normals)
    if config.wide_gate_m is not None:
        kernels.planes(padded, widest, _neighbourhood(config, config.wide_gate_m, config.wide_columns), normals)
    return normals


def _neighbourhood(config: NormalConfig, gate_m: float, columns: int) -> kernels.Neighbourhood:
    return kernels.Neighbourhood(
        rows=config.rows, columns=columns, gate_m=gate_m, most_apart_m=2.0 * config.gate_m,
        min_neighbours=config.min_neighbours, max_flatness=config.max_flatness, min_spread=config.min_spread,
    )  # fmt: skip

"""Occupancy grids as the map server of ROS and Nav2 reads them: map.yaml and map.pgm."""

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from lidarslam.core.errors import OutputError
from lidarslam.core.files import cannot_write, make_directory, replacing
from lidarslam.mapping.global_map.products.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_GREY = {OCCUPIED: 0, UNKNOWN: 205, FREE: 254}
# The shade of the unknown, (255 - 205) / 255 = 0.1961, lies between them.
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}


def write_grid(path: Path, grid: OccupancyGrid) -> list[Path]:
    """Write `path`, a .yaml file, and the image beside it; the files.

    Raises:
        OutputError: they cannot be written.
    """
    image = path.with_suffix(".pgm")
    pixels = np.full(grid.cells.shape, _GREY[UNKNOWN], dtype=np.uint8)
    for value, grey in _GREY.items():
        pixels[grid.cells == value] = grey
    about = {
        "image": image.name,
        "mode": "trinary",
        "resolution": grid.resolution_m,
        "origin": [round(float(grid.origin[0]), 6), round(float(grid.origin[1]), 6), 0.0],
        "negate": 0,
        **_THRESHOLDS,
    }
    make_directory(path.parent)
    try:
        with replacing(image) as partial:
            Image.fromarray(pixels[::-1]).save(partial, format="PPM")  # the first row of an image is its top
        with replacing(path) as partial:
            partial.write_text(yaml.safe_dump(about, sort_keys=False, default_flow_style=None), encoding="utf-8")
    except OSError as error:
        raise cannot_write(path, error) from error
    return [path, image]


def require_yaml(path: Path) -> None:
    """Check the suffix of a grid.

    Raises:
        OutputError: it is not .yaml.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise OutputError(f"{path}: expected a .yaml file, such as map.yaml; the image map.pgm is written beside it")

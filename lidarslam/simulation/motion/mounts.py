"""How the LiDAR sits on what carries it."""

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform

# Rotations of the LiDAR on the body: rotation vectors, degrees. Tilted: looking down to the front and a little aside.
MOUNTS: dict[str, tuple[float, float, float]] = {
    "upright": (0.0, 0.0, 0.0),
    "upside-down": (180.0, 0.0, 0.0),
    "tilted": (6.0, 25.0, 0.0),
}


def mount_pose(name: str, height_m: float) -> FloatArray:
    """T_body_lidar (4, 4) of a LiDAR that far above the body's origin.

    Raises:
        InputError: there is no such mount.
    """
    if name not in MOUNTS:
        raise InputError(f"no mount is called {name!r}; there are: {', '.join(MOUNTS)}")
    R = Rotation.from_rotvec(np.deg2rad(MOUNTS[name])).as_matrix()
    return make_transform(R, [0.0, 0.0, height_m])

"""Shared fixtures."""

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng() -> np.random.Generator:
    """A seeded source of random numbers."""
    return np.random.default_rng(2021)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder with unpacked real recordings, named by LIDARSLAM_TEST_DATA."""
    folder = os.environ.get("LIDARSLAM_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("set LIDARSLAM_TEST_DATA to the folder with kitti_odometry_04 and kitti_raw_0005")
    return Path(folder)

"""Arrays are read on several threads at a time."""

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO

import numpy as np
import pytest

from lidarslam.core.files import read_array

READERS, TIMES = 4, 12_000


class Garbage:
    """It is collected, and its finaliser lets another thread run, in the midst of anything."""

    def __init__(self) -> None:
        self.itself = self

    def __del__(self) -> None:
        sum(range(200))


@pytest.fixture
def eager_threads() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("eager_threads")
def test_readers_do_not_disturb_one_another() -> None:
    points = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2"), ("time", "f8")])
    file = BytesIO()
    np.save(file, points)

    def read(_: int) -> None:
        for _ in range(TIMES):
            Garbage()
            assert read_array(BytesIO(file.getvalue())).dtype == points.dtype

    with ThreadPoolExecutor(READERS) as readers:
        list(readers.map(read, range(READERS)))

"""Attributes of points stay in step with one another."""

import numpy as np
import pytest

from lidarslam.core.point_attributes import PointAttributes

SOME = PointAttributes(
    intensity=np.array([1.0, np.nan, 3.0], dtype=np.float32), rgb=np.arange(9, dtype=np.uint8).reshape(3, 3)
)


@pytest.mark.parametrize("chosen", [np.array([True, False, True]), np.array([0, 2])], ids=["mask", "indices"])
def test_selected_together(chosen):
    part = SOME.select(chosen)
    assert part.intensity.tolist() == [1.0, 3.0]
    assert part.rgb.tolist() == [[0, 1, 2], [6, 7, 8]]
    assert part.ring is part.time is None


def test_chosen_by_name():
    assert [name for name, _ in SOME.present()] == ["intensity", "rgb"]
    assert [name for name, _ in SOME.only(["rgb", "time"]).present()] == ["rgb"]


def test_construction_is_checked():
    with pytest.raises(ValueError, match=r"differ in length: \{'intensity': 2, 'time': 3\}"):
        PointAttributes(intensity=np.zeros(2, dtype=np.float32), time=np.zeros(3))
    with pytest.raises(ValueError, match=r"rgb must be \(N, 3\), got \(3, 4\)"):
        PointAttributes(rgb=np.zeros((3, 4), dtype=np.uint8))

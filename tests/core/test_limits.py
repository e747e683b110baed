import pytest

from lidarslam.core.limits import require_lost_worse, require_range_left


def test_a_range_must_be_left():
    require_range_left(0.5, 0.6)
    with pytest.raises(ValueError, match=r"^min_range_m=80 must be less than max_range_m=80, or no point is left$"):
        require_range_left(80.0, 80.0)


def test_lost_must_be_worse_than_degraded():
    require_lost_worse(0.5, 0.5)
    with pytest.raises(ValueError, match=r"^lost_below=0\.8 must not exceed degraded_below=0\.7, as a lost scan"):
        require_lost_worse(0.8, 0.7)

"""The spread of a field's values, damaged ones among them."""

import numpy as np
import pytest

from lidarslam.datasets.value_spread import value_spread


def test_a_few_strays_do_not_count() -> None:
    values = np.linspace(2.0, 3.0, 1001)
    values[17] = 1e9
    spread = value_spread(values)
    assert spread is not None
    assert (spread.first, spread.middle, spread.last) == pytest.approx((2.006, 2.501, 2.996), abs=1e-3)
    assert value_spread(np.full(9, 4.0)) is None


@pytest.mark.filterwarnings("error")
def test_nan_of_any_kind_is_left_out() -> None:
    """A signalling one, as changed bytes may be, does not signal."""
    values = np.arange(8, dtype=np.float32)
    values[5] = np.nan
    values.view(np.uint32)[3] = 0x7FA00000
    spread = value_spread(values)
    assert spread is not None
    assert spread.middle == pytest.approx(3.0, abs=0.6)
    assert spread.span == pytest.approx(7.0, abs=0.1)

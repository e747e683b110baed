"""Scans whose stamps go back in time have no place in a trajectory."""

from collections.abc import Iterable, Iterator

from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.stamp_order import in_stamp_order


def in_order(scans: Iterable[Scan]) -> Iterator[Scan]:
    """The scans whose stamps increase; no trajectory could hold the others, and nobody counts them."""
    return in_stamp_order(scans, lambda scan: scan.stamp, Faults(), may_be_set_back=True)

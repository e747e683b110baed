"""Scans whose stamps go back in time have no place in a trajectory."""

from collections.abc import Iterable, Iterator

import numpy as np

from lidarslam.core.scan import Scan


def in_order(scans: Iterable[Scan], latest: float = -np.inf) -> Iterator[Scan]:
    """The scans whose stamps increase, from after the latest; no trajectory could hold the others."""
    for scan in scans:
        if scan.stamp > latest:
            latest = scan.stamp
            yield scan

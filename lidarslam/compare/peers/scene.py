"""The maximum range by the size of a scene: `@scene` behind a method's name.

KISS-ICP's voxels are a hundredth of its maximum range, 100 m by default, which suits streets; its authors advise a
shorter range indoors. One rule for KISS-ICP and for every peer with voxels: the range is twice that of 99 % of the
points of the first scans, as the default is on streets, and voxels are in proportion to it.
"""

from contextlib import suppress

import numpy as np

from lidarslam.compare.peers.interface import MAX_RANGE_M
from lidarslam.core.errors import InputError
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.recording import Recording

BY_SCENE = "scene"
_SCANS, _PERCENT, _TIMES = 10, 99.0, 2.0
# As KISS-ICP's authors advise for indoor data; finer voxels than a tenth of the default would hold single points.
_SHORTEST_M = 10.0


def scene_range_m(recording: Recording, chosen: range) -> float:
    """Twice the range of 99 % of the points of the first ten chosen scans, within 10 and 100 m; no truth is used."""
    ranges = [np.empty(0)]
    with suppress(InputError):  # raised again when the methods read the scans
        for scan in recording.scans(chosen.start, chosen[:_SCANS].stop, chosen.step, Faults()):
            ranges.append(np.linalg.norm(scan.points, axis=1))
    found = np.concatenate(ranges)
    if not len(found):
        return MAX_RANGE_M
    return round(float(np.clip(_TIMES * np.percentile(found, _PERCENT), _SHORTEST_M, MAX_RANGE_M)), 1)


def scene_note(range_m: float) -> str:
    """A sentence on the meaning of the name on this recording."""
    return (
        f"@{BY_SCENE}: maximum range {range_m:g} m instead of {MAX_RANGE_M:g} m, and voxels in proportion, by the"
        " ranges of the first scans"
    )

"""The scan of a decoded message."""

from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.ros.point_cloud2 import DecodedCloud
from lidarslam.datasets.times.point_time import PointTimeModel


def timed_scan(cloud: DecodedCloud, model: PointTimeModel | None, stamp: float, faults: Faults) -> Scan:
    """The valid points of a message; one without usable point times, where others have them, is counted."""
    offsets = None
    if model is not None and cloud.times is not None and cloud.time_field == model.field:
        offsets = model.offsets(cloud.times, stamp)
    scan = Scan.from_raw(cloud.points, stamp, offsets, cloud.rings, cloud.intensities, cloud.colours)
    if model is not None and scan.time_offsets is None and len(scan):
        faults.note(NO_POINT_TIME, f"{stamp:.9f}")
    return scan

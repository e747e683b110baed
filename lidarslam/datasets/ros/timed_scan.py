"""The scan of a decoded message."""

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.ros.point_cloud2 import DecodedCloud
from lidarslam.datasets.times.point_time import PointTimeModel


def field_offsets(cloud: DecodedCloud, model: PointTimeModel, stamp: float) -> FloatArray | None:
    """Seconds (N,) from the stamp by the time field of the model; None where this cloud lacks it."""
    if cloud.times is None or cloud.time_field != model.field:
        return None
    return model.offsets(cloud.times, stamp)


def timed_scan(
    cloud: DecodedCloud, offsets: FloatArray | None, stamp: float, expects_times: bool, faults: Faults
) -> Scan:
    """The valid points of a message; one without usable point times, where others have them, is counted."""
    scan = Scan.from_raw(cloud.points, stamp, offsets, cloud.rings, cloud.intensities, cloud.colours)
    if expects_times and scan.time_offsets is None and len(scan):
        faults.note(NO_POINT_TIME, f"{stamp:.9f}")
    return scan

"""KISS-ICP (Vizzo et al., RA-L 2023) behind the odometry protocol.

Two things differ from calling the library: it runs in a child process, because it aborts on some inputs (an assertion
in its C++ part, not an exception); and its pose, which belongs to the end of the sweep, is expressed at the scan's
stamp. Run as a module, this file is the child process; its argument is the file descriptor of its end of a pipe.
"""

import logging
import signal
import subprocess
import sys
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.core.errors import InputError, LidarSlamError
from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.core.scan import Scan
from lidarslam.core.state import State
from lidarslam.odometry.config import KissConfig
from lidarslam.odometry.interface import Motion

_log = logging.getLogger(__name__)

# Fewer points do not fix six degrees of freedom, and one alone makes the library abort.
_MIN_POINTS = 10


class OdometryError(LidarSlamError):
    """A method cannot work on this machine."""


class _Worker:
    """The child process; OdometryError where it does not start."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._pipe, end = Pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lidarslam.odometry.methods.kiss", str(end.fileno())],
            stdin=subprocess.DEVNULL,
            stdout=2,  # the library's output
            pass_fds=[end.fileno()],
            cwd=Path(__file__).resolve().parents[2],  # a folder called odometry in the working directory must not win
        )
        end.close()
        try:
            self.ask(settings)
        except (EOFError, OSError) as error:
            raise OdometryError(f"KISS-ICP did not start (status {self.close()}); is kiss-icp installed?") from error

    def ask(self, message: Any) -> Any:
        """The answer to a message, see `main`; EOFError or OSError if the child died."""
        self._pipe.send(message)
        return self._pipe.recv()

    def close(self) -> int:
        """End the child; its exit status, negative for the signal that ended it."""
        self._pipe.close()
        try:
            return self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


@dataclass(frozen=True, eq=False)
class _TimedPose:
    time: float
    T_map_lidar: FloatArray


class KissOdometry:
    """KISS-ICP, untouched, with motions between the stamps of consecutive scans."""

    def __init__(self, config: KissConfig) -> None:
        self._config = config
        self._worker: _Worker | None = _Worker(_library_settings(config))
        self._registered = 0  # scans in the child's map
        self._last: _TimedPose | None = None  # the child's last pose, at the time it belongs to
        self._previous: _TimedPose | None = None  # the previous scan, at its stamp
        self._velocity = np.zeros(6)

    def estimate(self, scan: Scan) -> Motion:
        """Register one scan; one that KISS-ICP cannot take gives a prediction by the last velocity, and the reason."""
        ranges = np.linalg.norm(scan.points, axis=1)
        count = int(((ranges > self._config.min_range_m) & (ranges < self._config.max_range_m)).sum())
        if count < _MIN_POINTS:
            return self._predict(scan.stamp, f"{count} points from min_range_m to max_range_m are too few to register")
        offsets = self._usable_offsets(scan)
        try:
            if self._worker is None:
                self._worker = _Worker(_library_settings(self._config))
            T_map_lidar, points_used = self._worker.ask((scan.points, offsets))
        except (EOFError, OSError):
            return self._predict(scan.stamp, self._bury_worker())
        last, self._last = self._last, _TimedPose(self._pose_time(scan, offsets), T_map_lidar)
        self._registered += 1
        if last is None:
            return self._begin(_TimedPose(scan.stamp, T_map_lidar))
        return Motion(self._motion(last, self._last, scan.stamp), points_used)

    def state(self) -> State | None:
        """None: the library does not expose its state."""
        return None

    def restore(self, saved: State) -> None:  # noqa: ARG002
        """There is no state to resume from; always an InputError."""
        raise InputError("KISS-ICP has no state to resume from; begin again with --overwrite")

    def close(self) -> None:
        """End the child process."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def _usable_offsets(self, scan: Scan) -> FloatArray:
        """The scan's times if the library can divide by their span, else none (it then does not deskew)."""
        if not self._config.deskew or scan.time_offsets is None or np.ptp(scan.time_offsets) <= 0.0:
            return np.empty(0)
        return scan.time_offsets

    def _pose_time(self, scan: Scan, offsets: FloatArray) -> float:
        """The instant of KISS-ICP's next pose.

        It moves every point to the end of the sweep with the motion before. The first two scans come before any
        motion is known and stay smeared over the sweep, as all do without deskewing: the registered pose is
        that of the sweep's middle.
        """
        if self._registered < 2 or not len(offsets):
            return scan.stamp + scan.middle_offset_s
        return scan.stamp + float(offsets.max())

    def _motion(self, last: _TimedPose, pose: _TimedPose, stamp: float) -> FloatArray:
        """T_prev_curr between the last two stamps, at constant velocity between the child's last two poses."""
        assert self._previous is not None
        previous = self._previous
        interval = pose.time - last.time
        if interval > 0.0:
            self._velocity = log(inverse(last.T_map_lidar) @ pose.T_map_lidar) / interval
        if self._registered == 2:  # the first velocity, and with it the pose at the first stamp
            previous = self._at(previous.time, last)
        self._previous = self._at(stamp, pose)
        return inverse(previous.T_map_lidar) @ self._previous.T_map_lidar

    def _at(self, time: float, pose: _TimedPose) -> _TimedPose:
        return _TimedPose(time, pose.T_map_lidar @ exp(self._velocity * (time - pose.time)))

    def _begin(self, first: _TimedPose) -> Motion:
        """The first scan of a map, which has no relation to the scans before, if there were any."""
        previous, self._previous = self._previous, first
        if previous is None:
            return Motion(np.eye(4), 0)
        T_prev_curr = exp(self._velocity * (first.time - previous.time))
        return Motion(T_prev_curr, 0, "first scan in KISS-ICP's new map: the motion is a prediction")

    def _predict(self, stamp: float, failure: str) -> Motion:
        """The motion at the last velocity, from which the next scan registered is measured."""
        if self._previous is None:
            return Motion(np.eye(4), 0, failure)
        previous, self._previous = self._previous, self._at(stamp, self._previous)
        return Motion(inverse(previous.T_map_lidar) @ self._previous.T_map_lidar, 0, failure)

    def _bury_worker(self) -> str:
        """Clean up after the child died; the next scan begins an empty map. Returns the message."""
        status = self._worker.close() if self._worker is not None else 0
        self._worker, self._last, self._registered = None, None, 0
        message = f"KISS-ICP's process ended (status {status}); it starts again with an empty map"
        _log.warning(message)
        return message


def _library_settings(config: KissConfig) -> dict[str, Any]:
    voxel_size = config.voxel_size_m or config.max_range_m / 100.0
    return {
        "data": {"max_range": config.max_range_m, "min_range": config.min_range_m, "deskew": config.deskew},
        "mapping": {"voxel_size": voxel_size, "max_points_per_voxel": config.max_points_per_voxel},
        "registration": {"max_num_threads": config.threads},
        "adaptive_threshold": {"initial_threshold": config.initial_threshold_m},
    }


def main() -> None:
    """Until the parent closes the pipe: take the settings, answered by None, and then points (N, 3) and stamps (M,).

    These are answered by the pose (4, 4) and the number of points registered.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends this process
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    pipe: Connection = Connection(int(sys.argv[1]))
    odometry = KissICP(KISSConfig.model_validate(pipe.recv()))
    pipe.send(None)
    while True:
        try:
            points, stamps = pipe.recv()
        except EOFError:
            return
        _, source = odometry.register_frame(points, stamps)
        pipe.send((np.asarray(odometry.last_pose), len(source)))


if __name__ == "__main__":
    main()

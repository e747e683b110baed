"""The IMU of a robot that is running: its topic, and its samples as they come."""

import threading
import time
from collections.abc import Callable, Iterable
from typing import Self, TypeVar

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.datasets.ros.bag_imu import ACCELERATION, ANGULAR_VELOCITY, IMU_TYPE, imu_numbers
from lidarslam.datasets.ros.bag_message import read_header
from lidarslam.pipeline.imu_stream import ImuStream
from lidarslam.run.modes.live.discovery import Published
from lidarslam.run.modes.live.incoming import Received

# Samples that may wait in a reader: a second of a fast IMU.
DEPTH = 1000
_DISCOVERY_S, _POLL_S = 5.0, 0.1
# A scan waits so long at most for the samples of its sweep, seconds.
_PATIENCE_S, _STEP_S = 0.05, 0.002
# A stamp so far ahead, seconds, is taken when so many in a row are.
_FAR_S, _STRAYS = 5.0, 10

P = TypeVar("P", bound=Published)


def find_imu(published: Callable[[], Iterable[P]], wanted: str | None) -> P:
    """Wait a moment for the publisher of an IMU; without a name, for the only one.

    Raises:
        InputError: there is none, or there are several and none is named.
    """
    end = time.monotonic() + _DISCOVERY_S
    while True:
        imus = [topic for topic in published() if topic.message_type == IMU_TYPE]
        found = imus if wanted is None else [topic for topic in imus if topic.name.lstrip("/") == wanted.lstrip("/")]
        if len(found) == 1:
            return found[0]
        names = ", ".join(topic.name for topic in imus)
        if len(found) > 1:
            raise InputError(f"IMUs are published on {names}; choose one with --set reader.imu_topic=NAME")
        if time.monotonic() > end:
            what = f"no {IMU_TYPE} is published{'' if wanted is None else f' on {wanted}'}"
            raise InputError(f"{what}; published: {names or 'none'}. Choose --odometry learned, which needs none")
        time.sleep(_POLL_S)


class ImuReceiver:
    """Gives the messages of an IMU to a stream, on a thread of its own; a context manager.

    Args:
        receive: the next messages, waiting for so many seconds at most.
        stream: takes the samples.
    """

    def __init__(self, receive: Callable[[float], Iterable[Received]], stream: ImuStream) -> None:
        self._receive, self._stream = receive, stream
        self._is_ended, self._strays = False, 0
        self._thread = threading.Thread(target=self._run, name="imu", daemon=True)
        self.frame_id: str | None = None  # of the first message

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_ended = True
        self._thread.join()

    def wait_for(self, stamp: float) -> None:
        """Wait for the sample at a stamp of the scans' clock, for 50 ms and the delay of the IMU's clock at most."""
        late_s = self._stream.offset_s
        end = time.monotonic() + _PATIENCE_S + max(0.0, late_s)
        while self._stream.last_s - late_s < stamp and time.monotonic() < end:
            time.sleep(_STEP_S)

    def _run(self) -> None:
        while not self._is_ended:
            for message in self._receive(_POLL_S):
                self._take(message)

    def _take(self, message: Received) -> None:
        """Give a message to the stream; one that is damaged or late is left out, as a gap between samples."""
        try:
            stamp_ns, frame_id = read_header(message.raw, ros2=True)
            numbers = imu_numbers(message.raw, ros2=True)
        except ValueError:
            return
        stamp = (stamp_ns or message.published_ns) / 10**9
        if numbers is None or stamp <= self._stream.last_s or self._is_stray(stamp):
            return
        rates, forces = numbers[ANGULAR_VELOCITY], numbers[ACCELERATION]
        if np.isfinite(rates).all() and np.isfinite(forces).all():
            self._stream.add(stamp, rates, forces)
            self.frame_id = self.frame_id or frame_id

    def _is_stray(self, stamp: float) -> bool:
        """Whether a stamp is an outlier, far ahead of the last one; several in a row are a new time."""
        self._strays = self._strays + 1 if stamp > self._stream.last_s + _FAR_S else 0
        return np.isfinite(self._stream.last_s) and 0 < self._strays < _STRAYS

"""KISS-ICP in a process of its own; the only file that imports kiss_icp.

The library aborts the process on some inputs (an assertion in its C++ part, not an exception). Run as a module, this
file is the child process. Messages are arrays: the settings as JSON, answered by an empty array; then points (N, 3) and
time stamps (M,), answered by the pose (4, 4) and the number of points registered, until the input ends.
"""

import json
import os
import signal
import struct
import sys
from io import BytesIO
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.files import read_array

_LENGTH = struct.Struct("<q")


def build(settings: dict[str, Any]) -> Any:
    """KISS-ICP's odometry with the settings of its own configuration sections."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    return KissICP(KISSConfig.model_validate(settings))


def send(stream: IO[bytes], *arrays: NDArray[Any]) -> None:
    """Write arrays in NumPy's format, each after its length."""
    for array in arrays:
        content = BytesIO()
        np.save(content, array, allow_pickle=False)
        stream.write(_LENGTH.pack(content.tell()))
        stream.write(content.getbuffer())
    stream.flush()


def receive(stream: IO[bytes]) -> NDArray[Any]:
    """Read one array.

    Raises:
        EOFError: the stream ended.
    """
    header = stream.read(_LENGTH.size)
    (length,) = _LENGTH.unpack(header) if len(header) == _LENGTH.size else (1,)
    content = stream.read(length)
    if len(content) < length:
        raise EOFError
    return read_array(BytesIO(content))


def main() -> None:
    """Serve on the standard streams; the library's output goes to standard error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends this process
    requests, replies = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    odometry = build(json.loads(str(receive(requests))))
    send(replies, np.empty(0))
    while True:
        try:
            points, stamps = receive(requests), receive(requests)
        except EOFError:
            return
        _, source = odometry.register_frame(points, stamps)
        send(replies, np.asarray(odometry.last_pose), np.array(len(source)))


if __name__ == "__main__":
    main()

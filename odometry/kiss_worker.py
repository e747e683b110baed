"""KISS-ICP in a process of its own; the only file that imports kiss_icp.

The library aborts the process on some inputs (an assertion in its C++ part, not an exception). Run as a module, this
file is the child process: it reads requests from its standard input and writes replies to its standard output.

Request: header `<qq` (points, time stamps), points (N, 3) float64, time stamps (N,) float64. Reply: pose (16,) float64,
row by row, and the number of points registered, as a seventeenth float64.
"""

import json
import os
import struct
import sys
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

REQUEST_HEADER = struct.Struct("<qq")
REPLY_FLOATS = 17


def build(settings: dict[str, Any]) -> Any:
    """KISS-ICP's odometry with the settings of its own configuration sections."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    return KissICP(KISSConfig.model_validate(settings))


def read_array(stream: BinaryIO, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Read exactly one float64 array.

    Raises:
        EOFError: the stream ended before.
    """
    array = np.empty(shape, dtype=np.float64)
    view = memoryview(array).cast("B") if array.size else memoryview(b"")
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            raise EOFError
        done += count
    return array


def serve(odometry: Any, requests: BinaryIO, replies: BinaryIO) -> None:
    """Register scan after scan until the requests end."""
    while len(header := requests.read(REQUEST_HEADER.size)) == REQUEST_HEADER.size:
        points, times = REQUEST_HEADER.unpack(header)
        frame = read_array(requests, (points, 3))
        stamps = read_array(requests, (times,))
        _, source = odometry.register_frame(frame, stamps)
        reply = np.append(np.asarray(odometry.last_pose, dtype=np.float64).reshape(-1), float(len(source)))
        replies.write(reply.tobytes())
        replies.flush()


def main() -> None:
    """Serve on the standard streams; whatever the library prints goes to standard error."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    odometry = build(json.loads(sys.argv[1]))
    serve(odometry, sys.stdin.buffer, replies)


if __name__ == "__main__":
    main()

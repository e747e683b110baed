"""KISS-ICP in a process of its own; the only file that imports kiss_icp.

The library aborts the process on some inputs (an assertion in its C++ part, not an exception). Run as a module, this
file is the child process: it reads requests from its standard input and writes replies to its standard output.

Once the library is loaded it says READY. Request: header `<qq` (points, time stamps), points (N, 3) float64, time
stamps (N,) float64. Reply: pose (16,) float64, row by row, and the number of points registered, as a seventeenth.
"""

import json
import os
import signal
import struct
import sys
from io import BufferedReader
from typing import Any, BinaryIO, Protocol, cast

import numpy as np
from numpy.typing import NDArray


class Readable(Protocol):
    """A binary stream that can fill a buffer."""

    def readinto(self, buffer: memoryview, /) -> int | None:
        """Read up to the buffer's length; how much was read."""


REQUEST_HEADER = struct.Struct("<qq")
REPLY_FLOATS = 17
READY = b"R"


def build(settings: dict[str, Any]) -> Any:
    """KISS-ICP's odometry with the settings of its own configuration sections."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    return KissICP(KISSConfig.model_validate(settings))


def read_array(stream: Readable, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Read exactly one float64 array.

    Raises:
        EOFError: the stream ended before.
    """
    buffer = bytearray(8 * int(np.prod(shape)))
    view = memoryview(buffer)
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])
        if not count:
            raise EOFError
        done += count
    return np.frombuffer(buffer, dtype=np.float64).reshape(shape)


def serve(odometry: Any, requests: BufferedReader, replies: BinaryIO) -> None:
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever is interrupted is the parent, and ends this one
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    odometry = build(json.loads(sys.argv[1]))
    replies.write(READY)
    replies.flush()
    serve(odometry, cast(BufferedReader, sys.stdin.buffer), replies)


if __name__ == "__main__":
    main()

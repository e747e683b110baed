"""KISS-ICP in a process of its own; the only file that imports kiss_icp.

The library aborts the process on some inputs (an assertion in its C++ part, not an exception). Run as a module, this
file is the child process. Messages are pickles: settings; then points (N, 3) and time stamps (M,), answered by the pose
(4, 4) and the number of points registered, until the input ends.
"""

import os
import pickle
import signal
import sys
from typing import Any, BinaryIO


def build(settings: dict[str, Any]) -> Any:
    """KISS-ICP's odometry with the settings of its own configuration sections."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    return KissICP(KISSConfig.model_validate(settings))


def send(stream: BinaryIO, message: object) -> None:
    """Write one message."""
    pickle.dump(message, stream, protocol=pickle.HIGHEST_PROTOCOL)
    stream.flush()


def main() -> None:
    """Serve on the standard streams; whatever the library prints goes to standard error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever is interrupted is the parent, and ends this one
    requests, replies = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    odometry = build(pickle.load(requests))
    send(replies, "ready")
    while True:
        try:
            points, stamps = pickle.load(requests)
        except EOFError:
            return
        _, source = odometry.register_frame(points, stamps)
        send(replies, (odometry.last_pose, len(source)))


if __name__ == "__main__":
    main()

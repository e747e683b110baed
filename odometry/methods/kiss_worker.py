"""KISS-ICP in a process of its own; the only file that imports kiss_icp.

The library aborts the process on some inputs (an assertion in its C++ part, not an exception). Run as a module, this
file is the child process, whose argument is the file descriptor of its end of a pipe. It receives the settings, which
it answers with None; then points (N, 3) and time stamps (M,), answered by the pose (4, 4) and the number of points
registered, until the pipe is closed.
"""

import signal
import sys
from multiprocessing.connection import Connection

import numpy as np


def main() -> None:
    """Serve until the parent closes the pipe."""
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

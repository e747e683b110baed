"""KISS-ICP's `register_frame` over scans from a file: seconds of wall and processor time, after the first few scans.

    python benchmarks/kiss_loop.py SCANS.npz 5

Nothing else is imported: beside other libraries' thread pools KISS-ICP does not get all the cores.
"""

import sys
import time

import numpy as np
from kiss_icp.config.parser import load_config
from kiss_icp.kiss_icp import KissICP


def main() -> None:
    """Print the two times."""
    file, warm_up = np.load(sys.argv[1]), int(sys.argv[2])
    scans = [(file[f"points_{i}"], file[f"times_{i}"]) for i in range(len(file.files) // 2)]
    kiss = KissICP(load_config(None))
    wall, cpu = time.perf_counter(), time.process_time()
    for number, (points, times) in enumerate(scans):
        if number == warm_up:
            wall, cpu = time.perf_counter(), time.process_time()
        kiss.register_frame(points, times)
    print(time.perf_counter() - wall, time.process_time() - cpu)


if __name__ == "__main__":
    main()

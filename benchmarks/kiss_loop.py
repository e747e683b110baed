"""Time of KISS-ICP's `register_frame` over scans from a file, without the first few, as JSON.

    python benchmarks/kiss_loop.py SCANS.npz 5

No other libraries are imported: with their thread pools, KISS-ICP does not get all cores.
"""

import json
import sys
import time

import numpy as np
from kiss_icp.config.parser import load_config
from kiss_icp.kiss_icp import KissICP


def main() -> None:
    """Print wall and CPU seconds, and milliseconds of single scans."""
    file, warm_up = np.load(sys.argv[1]), int(sys.argv[2])
    scans = [(file[f"points_{i}"], file[f"times_{i}"]) for i in range(len(file["stamps"]))]
    kiss = KissICP(load_config(None))
    scan_ms: list[float] = []
    wall, cpu = time.perf_counter(), time.process_time()
    for number, (points, times) in enumerate(scans):
        if number == warm_up:
            wall, cpu, scan_ms = time.perf_counter(), time.process_time(), []
        started = time.perf_counter()
        kiss.register_frame(points, times)
        scan_ms.append(1e3 * (time.perf_counter() - started))
    taken = {"wall": time.perf_counter() - wall, "processor": time.process_time() - cpu}
    print(json.dumps(taken | {"scan_ms": scan_ms}))


if __name__ == "__main__":
    main()

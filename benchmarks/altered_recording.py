"""A copy of a recording as another sensor or driver would have made it, as a folder of scans.

    python benchmarks/altered_recording.py vlp16_loop vlp8_loop --ring-step 2
    python benchmarks/altered_recording.py sim_office_mid360 mid_50_hz --parts 5
    python benchmarks/altered_recording.py kitti/sequences/04 on_a_truck --carrier cab
    lidarslam run mid_50_hz

`--ring-step` keeps every so many-th ring; the ring numbers have to be recorded. `--parts` divides each sweep by the
times of its points into messages of equal duration, as packets, segments, or a Livox at a higher rate. `--carrier`
puts surfaces in front of the sensor that move along with it: a cab behind and on both sides, a vehicle's side or rear.
"""

import argparse
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from mapping_accuracy import make_parser

from lidarslam.core.scan import Scan
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.registry import open_recording


def with_fewer_rings(scan: Scan, step: int) -> Scan:
    """The points of every `step`-th ring."""
    if step == 1:
        return scan
    if scan.rings is None:
        raise SystemExit("the recording has no ring numbers")
    return scan.select(scan.rings % step == 0)


def parts_of(scan: Scan, count: int, sweep_s: float) -> Iterator[Scan]:
    """A sweep as messages of equal duration, stamped at their beginning."""
    if count == 1:
        yield scan
        return
    if scan.time_offsets is None:
        raise SystemExit("the recording has no times of points")
    offsets = scan.time_offsets
    begin = float(offsets.min())
    numbers = np.minimum((offsets - begin) / sweep_s * count, count - 1).astype(np.intp)
    for number in np.unique(numbers):
        chosen, at = numbers == number, begin + sweep_s * float(number) / count
        yield replace(scan.select(chosen), stamp=scan.stamp + at, time_offsets=offsets[chosen] - at)


# The planes of carriers: the axis that they are perpendicular to, their place along it, and the lowest and highest
# coordinates along the other horizontal axis, metres, from 2 m below the sensor to 1.5 m above it.
CARRIERS = {
    "cab": [(1, -0.8, -6.0, 0.5), (1, 0.8, -6.0, 0.5), (0, -1.0, -0.8, 0.8)],
    "corner": [(1, -0.4, -5.0, 0.2), (0, -0.4, -0.2, 3.0)],
    "side": [(1, -0.8, -6.0, 6.0)],
    "rear": [(0, -0.5, -3.0, 3.0)],
}
_BELOW_M, _ABOVE_M, _NOISE_M = -2.0, 1.5, 0.01


def behind_carrier(scan: Scan, name: str | None) -> Scan:
    """The scan with the points that a carrier hides on its surfaces."""
    rng, points = np.random.default_rng(0), scan.points
    for axis, place, low, high in CARRIERS.get(name or "", []):
        with np.errstate(divide="ignore", invalid="ignore"):
            nearer = place / points[:, axis]
            there = nearer[:, None] * points
        is_hidden = (nearer > 0.0) & (nearer < 1.0) & (there[:, 1 - axis] > low) & (there[:, 1 - axis] < high)
        is_hidden &= (there[:, 2] > _BELOW_M) & (there[:, 2] < _ABOVE_M)
        noise = 1.0 + rng.normal(0.0, _NOISE_M, (len(points), 1)) / np.linalg.norm(there, axis=1, keepdims=True)
        points = np.where(is_hidden[:, None], there * noise, points)
    return replace(scan, points=points)


def write_scan(path: Path, scan: Scan) -> None:
    """One .npy file with the coordinates, and times and rings where there are any."""
    columns = dict(zip("xyz", scan.points.T.astype(np.float32), strict=True))
    columns |= {} if scan.time_offsets is None else {"time": scan.time_offsets.astype(np.float32)}
    columns |= {} if scan.rings is None else {"ring": scan.rings.astype(np.uint16)}
    table = np.empty(len(scan), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    np.save(path, table)


def main(arguments: argparse.Namespace) -> None:
    """Write the folder."""
    source, out = arguments.recording, arguments.out
    recording = open_recording(source, ReaderConfig(mounting="upright", carrier="keep", sweep_s=0.0))
    out.mkdir()
    stamps: list[float] = []
    sweep_s = recording.describe().duration_s / (len(recording) - 1)
    for scan in recording.scans():
        altered = behind_carrier(with_fewer_rings(scan, arguments.ring_step), arguments.carrier)
        for part in parts_of(altered, arguments.parts, sweep_s):
            write_scan(out / f"{len(stamps):06d}.npy", part)
            stamps.append(part.stamp)
    np.savetxt(out / "timestamps.txt", stamps, fmt="%.9f")
    if recording.ground_truth is not None:
        recording.ground_truth.save(out / "ground_truth.tum")
    if (source / "imu.csv").is_file():
        shutil.copy(source / "imu.csv", out)
    print(f"{out}: {len(stamps)} scans")


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path, help="folder to be made")
    parser.add_argument("--ring-step", type=int, default=1, help="of the rings that are kept")
    parser.add_argument("--parts", type=int, default=1, help="messages of a sweep")
    parser.add_argument("--carrier", choices=CARRIERS, help="that hides a part of the view")
    main(parser.parse_args())

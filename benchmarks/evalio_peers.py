"""Peers that evalio runs (CT-ICP, GenZ-ICP, MAD-ICP) on the same scans as ours: poses at the scans' stamps.

    pip install 'lidarslam[benchmarks]'
    python benchmarks/evalio_peers.py RECORDING
    python benchmarks/evalio_peers.py RECORDING --peers CT-ICP GenZ-ICP --step 2 --scans 100

Prints a Markdown table, a row for each peer: path length, ATE where the recording has ground truth, and ms a scan.

Every peer runs with evalio's defaults, with three exceptions: the number of threads; CT-ICP's rigid model for scans
that are motion compensated already; and MAD-ICP's real-time mode, which drops work on a busy machine, is off. Native
code may abort, so each run is a child process.

CT-ICP's instants were found by comparison with exact truth:

- sweeps with times: a saved pose belongs to the start of the sweep. The first scan is taken rigidly, so that its pose
  belongs to the middle of its sweep; the pose saved with the second scan is the first one's again and is left out;
- compensated scans: it belongs to the stamp of the scan before. The last scan is therefore registered a second time.

The poses at the stamps are interpolated between these at constant velocity. GenZ-ICP and MAD-ICP compensate no motion
by default, so that the sweep has no one instant; their poses are taken for those of its middle. On a simulated street
at 12 m/s GenZ-ICP's ATE is 0.037, 0.043 or 0.053 m with the start, the middle or the end.
"""

import argparse
import importlib.util
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from lidarslam.core.errors import LidarSlamError
from lidarslam.core.geometry import FloatArray, orthonormalize
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory

# The default of CT-ICP and of KISS-ICP.
_MAX_RANGE_M = 100.0

_Parameters = dict[str, bool | int | float | str]


class PeerError(LidarSlamError):
    """A peer is not installed, ended before the last scan, or gave poses that are none."""


@dataclass(frozen=True)
class Peer:
    """One of evalio's pipelines.

    Attributes:
        pipeline: name of the class in `evalio.pipelines`.
        parameters: changes to its defaults.
        compensated: further changes for scans that are motion compensated.
        is_elastic: whether it estimates the motion during the sweep, as CT-ICP does; its docstring above says when.
    """

    pipeline: str
    parameters: _Parameters = field(default_factory=dict)
    compensated: _Parameters = field(default_factory=dict)
    is_elastic: bool = False


_RIGID: _Parameters = {
    "motion_compensation": "NONE",
    "distance": "POINT_TO_PLANE",
    "point_to_plane_with_distortion": False,
}
PEERS = {
    "CT-ICP": Peer("CTICP", {"ls_num_threads": os.cpu_count() or 1}, _RIGID, is_elastic=True),
    "GenZ-ICP": Peer("GenZICP"),
    "MAD-ICP": Peer("MadICP", {"realtime": False}),
}


def run_peer(name: str, scans: Iterable[Scan]) -> Trajectory:
    """The trajectory of a peer at the scans' stamps.

    Args:
        name: one of `PEERS`.
        scans: in the order of time; those without times are taken for motion compensated, and then all have to be.

    Raises:
        PeerError: evalio is not installed, the peer's process ended early, or its poses are not rigid motions.
    """
    if importlib.util.find_spec("evalio") is None:
        raise PeerError(f"{name} runs through evalio, which is not installed: pip install 'lidarslam[benchmarks]'")
    spans: list[tuple[float, float, float]] = []
    with _Child(name) as child:
        poses = child.register(_noting(scans, spans))
    if not np.isfinite(poses).all():
        raise PeerError(f"{name}: some of its {len(poses)} poses are not finite")
    stamps, starts, ends = np.array(spans).T
    rows, instants = pose_instants(PEERS[name].is_elastic, stamps, starts, ends)
    if len(rows) < 2:
        raise PeerError(f"{name}: {len(stamps)} scans are too few")
    return Trajectory(stamps, Trajectory(instants, orthonormalize(poses)[rows]).at(stamps, extrapolation_s=np.inf))


def pose_instants(
    is_elastic: bool, stamps: FloatArray, starts: FloatArray, ends: FloatArray
) -> tuple[list[int], FloatArray]:
    """Which of the saved poses count, and the instants (M,) that they belong to.

    Args:
        is_elastic: as `Peer.is_elastic`.
        stamps: (N,) of the scans.
        starts, ends: (N,) instants of the first and the last point of each; the stamps where they are compensated.
    """
    rows = list(range(len(stamps)))
    if not is_elastic:
        return rows, 0.5 * (starts + ends)
    if _are_compensated(starts, ends):
        return [row + 1 for row in rows], stamps
    return [0, *rows[2:]], np.append(0.5 * (starts[:1] + ends[:1]), starts[2:])


def _are_compensated(starts: FloatArray, ends: FloatArray) -> bool:
    return bool((ends <= starts).all())


def _noting(scans: Iterable[Scan], spans: list[tuple[float, float, float]]) -> Iterable[Scan]:
    """The scans; the stamp, start and end of each is appended to `spans` on the way."""
    for scan in scans:
        offsets = np.zeros(1) if scan.time_offsets is None else scan.time_offsets
        spans.append((scan.stamp, scan.stamp + float(offsets.min()), scan.stamp + float(offsets.max())))
        yield scan


class _Child:
    """The process that the peer runs in."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=os.environ | {"OMP_WAIT_POLICY": "passive"},  # threads that wait leave the cores to others
        )

    def __enter__(self) -> "_Child":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._log):
            if stream is not None:
                stream.close()

    def register(self, scans: Iterable[Scan]) -> FloatArray:
        """The poses (M, 4, 4) that it saves.

        Raises:
            PeerError: the process ended early.
        """
        requests, replies = cast(IO[bytes], self._process.stdin), cast(IO[bytes], self._process.stdout)
        poses: list[FloatArray] = []
        try:
            for scan in scans:
                pickle.dump((scan.points, scan.time_offsets, scan.stamp), requests, pickle.HIGHEST_PROTOCOL)
                requests.flush()
                poses.append(pickle.load(replies))
            pickle.dump(None, requests)
            requests.flush()
            last: FloatArray | None = pickle.load(replies)
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            raise PeerError(f"{self._name}: ended at scan {len(poses)} ({self._reason()})") from error
        return np.array(poses if last is None else [*poses, last])

    def _reason(self) -> str:
        status = self._process.wait()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return f"status {status}" + (f": {lines[-1]}" if lines else "")


def _serve(name: str) -> None:
    """Be the child: scans from standard input, poses to standard output; what the library prints goes to the log."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    pipeline: Any = None
    scan: Any = None
    while (request := pickle.load(sys.stdin.buffer)) is not None:
        scan = request
        if pipeline is None:
            pipeline = _build(PEERS[name], is_compensated=scan[1] is None)
        _reply(replies, _add(pipeline, *scan))
    is_behind = scan is not None and scan[1] is None and PEERS[name].is_elastic
    _reply(replies, _add(pipeline, *scan) if is_behind else None)


def _reply(replies: IO[bytes], pose: FloatArray | None) -> None:
    pickle.dump(pose, replies, pickle.HIGHEST_PROTOCOL)
    replies.flush()


def _build(peer: Peer, is_compensated: bool) -> Any:
    """The pipeline; `set_params` sets only what it is given, so the defaults are given too."""
    from evalio import pipelines
    from evalio.types import SE3, LidarParams

    pipeline: Any = getattr(pipelines, peer.pipeline)()
    changes = {**peer.parameters, **(peer.compensated if is_compensated else {})}
    pipeline.set_params({**pipeline.default_params(), **changes})
    # The shape of the image is asked for by none of the peers here.
    pipeline.set_lidar_params(LidarParams(num_rows=64, num_columns=1024, min_range=0.0, max_range=_MAX_RANGE_M))
    pipeline.set_imu_T_lidar(SE3.identity())
    pipeline.initialize()
    return pipeline


def _add(pipeline: Any, points: FloatArray, offsets: FloatArray | None, stamp: float) -> FloatArray:
    """Register one scan; the pose (4, 4) that is saved with it."""
    from evalio.types import Duration, LidarMeasurement, Point, Stamp

    since_start = np.zeros(len(points)) if offsets is None else offsets - offsets.min()
    measured = [
        Point(x=x, y=y, z=z, t=Duration.from_sec(seconds))
        for (x, y, z), seconds in zip(points.tolist(), since_start.tolist(), strict=True)
    ]
    pipeline.add_lidar(LidarMeasurement(Stamp.from_sec(stamp), measured))
    pipeline.saved_features()  # they pile up otherwise
    return np.array(pipeline.saved_estimates()[-1][1].to_mat(), dtype=np.float64)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, or be the child process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", type=Path, help="recordings")
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS))
    parser.add_argument("--scans", type=int, help="at most so many")
    parser.add_argument("--step", type=int, default=1, help="take every n-th scan")
    parser.add_argument("--serve", choices=list(PEERS), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.serve is not None:
        _serve(options.serve)
        return
    print("| recording | peer | scans | path, m | ATE, m | ms a scan |\n| --- | --- | ---: | ---: | ---: | ---: |")
    for source in options.sources:
        for peer in options.peers:
            _print(source, peer, options.scans, options.step)


def _print(source: Path, peer: str, count: int | None, step: int) -> None:
    """One row of the table."""
    from lidarslam.datasets.registry import open_recording
    from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
    from lidarslam.pipeline.scan_stream import in_order

    recording = open_recording(source)
    stop = None if count is None else count * step
    started = time.perf_counter()
    trajectory = run_peer(peer, in_order(recording.scans(0, stop, step)))
    ms = 1e3 * (time.perf_counter() - started) / len(trajectory)
    truth = recording.ground_truth
    ate = "" if truth is None else f"{evaluate_trajectory(trajectory, truth).errors.ate_rmse_m:.3f}"
    cells = (recording.name, peer, len(trajectory), f"{trajectory.length_m:.1f}", ate, f"{ms:.0f}")
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()

"""The peers by name, their libraries loaded on use; a recording through a peer: poses, map and times."""

import importlib.util
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from lidarslam.compare.peers.evalio_pipelines import PIPELINES, EvalioEstimator
from lidarslam.compare.peers.interface import Estimator, PeerError, Poses, Sweep
from lidarslam.compare.peers.libraries import KissSlamEstimator, RkoLioEstimator, SmallGicpEstimator
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.core.plugins import PlugPoint
from lidarslam.core.scan import Scan
from lidarslam.core.text import count
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.odometry.methods.external import ExternalOdometry, longest_bridged_s
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.interruption import Interruptions
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.run.results import RunOutcome, Tracked, TrackedScans, unless_damaged, write_results
from lidarslam.run.summary import ScanLog
from lidarslam.storage.directory import RunDirectory

EXTRA = "pip install 'lidarslam[peers]'"

Make = Callable[[Sweep, ImuSamples | None, float | None], Estimator]
"""From the first sweep with points, the IMU, and the maximum range by the size of the scene; None: its defaults."""


@dataclass(frozen=True)
class Peer:
    """Another program on the same scans."""

    name: str  # in `--methods`
    library: str  # the module that it needs
    package: str  # that holds it
    make: Make
    needs_imu: bool = False
    has_voxels: bool = True  # whether it has settings that follow the size of the scene

    def require(self, has_imu: Callable[[], bool]) -> None:
        """Refuse where it cannot run."""
        if importlib.util.find_spec(self.library) is None:
            extra = EXTRA if self.name in PEERS else f"pip install {self.package}"
            raise PeerError(f"runs with {self.package}, which is not installed: {extra}")
        if self.needs_imu and not has_imu():
            raise PeerError("needs an IMU, and the recording has none")


_ALL = (
    *(
        Peer(name, "evalio", "evalio", partial(EvalioEstimator, one), one.needs_imu, bool(one.voxels_m))
        for name, one in PIPELINES.items()
    ),
    Peer("kiss-slam", "kiss_slam", "kiss-slam", KissSlamEstimator),
    Peer("small-gicp", "small_gicp", "small_gicp", SmallGicpEstimator),
    Peer("rko-lio", "rko_lio", "rko_lio", RkoLioEstimator, needs_imu=True),
)
PEERS = {peer.name: peer for peer in _ALL}
ALL_PEERS = PlugPoint("peer", tuple(PEERS))


def peer_named(name: str) -> Peer:
    """The peer of a name in `ALL_PEERS`."""
    return PEERS.get(name) or cast(Peer, ALL_PEERS.load(name, Peer))


# Fewer points do not fix six degrees of freedom, and some libraries abort on a handful.
_MIN_POINTS = 10
# Poses are extrapolated to stamps up to this far outside their instants: the longest sweep.
_EXTRAPOLATION_S = 0.25


class Estimate(NamedTuple):
    """The poses and times of a peer on a recording."""

    trajectory: Trajectory  # at the stamps of the scans that its poses cover
    register_ms: dict[float, float]  # stamp -> wall time of the registration of that scan


def describe_peer(request: RunRequest, peer: Peer, range_m: float | None) -> dict[str, object]:
    """The section of config.yaml that describes the run."""
    by_scene = {} if range_m is None else {"max_range_m": range_m}
    return {**describe_run(request), "peer": f"{peer.package} {version(peer.package)}", **by_scene}


def execute_peer(
    request: RunRequest, peer: Peer, progress: Callable[[int, int], None], range_m: float | None = None
) -> RunOutcome:
    """Run a peer, and write the run directory.

    First the peer takes all scans; then they are read again, chained with its poses, checked and added to the map as
    with an odometry of ours. A damaged recording ends both at the same scan. `progress` is called after every scan that
    the peer has registered, with its number from 1 and the total; `range_m` is as of `estimate`.
    """
    recording, chosen = request.open()
    errors: list[InputError] = []
    scans = _until_damaged(take_in(recording, chosen, Faults()), errors)
    samples = recording.imu if peer.needs_imu else None
    estimated = estimate(peer, prefetch(scans), samples, lambda number: progress(number, len(chosen)), range_m)
    with Interruptions() as interruptions, RunDirectory.create(request.out, request.overwrite) as directory:
        interruptions.protect_results()
        tracked = _track(request, recording, chosen, estimated, errors[0] if errors else None)
        return write_results(directory, request.config, describe_peer(request, peer, range_m), tracked)


def _until_damaged(scans: Iterator[Scan], errors: list[InputError]) -> Iterator[Scan]:
    try:
        yield from scans
    except InputError as error:
        errors.append(error)


def _track(
    request: RunRequest, recording: Recording, chosen: range, estimated: Estimate, error: InputError | None
) -> Tracked:
    """The scans that have a pose through the pipeline."""
    config, faults, log = request.config, Faults(), ScanLog()
    covered = set(estimated.trajectory.stamps.tolist())
    unplaced = 0

    def placed() -> Iterator[Scan]:
        nonlocal unplaced
        for scan in _until_damaged(take_in(recording, chosen, faults), []):
            if scan.stamp in covered:
                yield scan
            else:
                unplaced += 1

    odometry, store = ExternalOdometry(estimated.trajectory), TileStore(request.out)
    pipeline = Pipeline(odometry, make_localiser(config), config.global_map, store=store)
    with closing(pipeline.run(prefetch(placed()))) as results:
        for result in results:
            ms = estimated.register_ms.get(result.stamp, 0.0)
            log.add(replace(result, stage_ms={"odometry": ms}), ms)
    if unplaced:
        log.warn(f"{count(unplaced, 'scan')} without a pose")
    truth = unless_damaged(lambda: recording.ground_truth, log, "no metrics")
    scans = TrackedScans.of(log, faults, pipeline.map, len(chosen) - unplaced, error)
    return Tracked(scans, pipeline.map.global_map, recording, truth)


def estimate(
    peer: Peer,
    scans: Iterable[Scan],
    imu: ImuSamples | None = None,
    progress: Callable[[int], None] = lambda _: None,
    range_m: float | None = None,
) -> Estimate:
    """Register all scans, in the order of time; those without times are taken for motion compensated.

    `progress` is called after every scan with its number from 1; `range_m` is the maximum range by the size of the
    scene, for the peers with voxels.
    """
    peer.require(lambda: imu is not None)
    samples = imu if peer.needs_imu else None
    estimator: Estimator | None = None
    stamps: list[float] = []
    register_ms: dict[float, float] = {}
    taken = 0
    for scan in scans:
        stamps.append(scan.stamp)
        if len(scan) >= _MIN_POINTS:
            sweep = Sweep.of(scan)
            estimator = estimator or peer.make(sweep, samples, range_m)
            register = estimator.load(sweep)
            started = time.perf_counter()
            taken = _take_imu(estimator, samples, taken, sweep.end)
            register()
            register_ms[scan.stamp] = 1e3 * (time.perf_counter() - started)
        progress(len(stamps))
    if estimator is None:
        raise PeerError(f"none of the {len(stamps)} scans has {_MIN_POINTS} points")
    return Estimate(_at_stamps(estimator.finish(), np.array(stamps)), register_ms)


def _take_imu(estimator: Estimator, samples: ImuSamples | None, taken: int, until: float) -> int:
    """Hand on the samples up to an instant, from number `taken` on; the number of the next one."""
    if samples is None:
        return 0
    end = int(np.searchsorted(samples.stamps, until, side="right"))
    for number in range(taken, end):
        estimator.add_imu(samples, number)
    return max(taken, end)


def _at_stamps(poses: Poses, stamps: FloatArray) -> Trajectory:
    instants, T_world_lidar = poses.instants, poses.T_world_lidar
    if not np.isfinite(T_world_lidar).all():
        raise PeerError(f"some of its {len(instants)} poses are not finite")
    if len(instants) < 2:
        raise PeerError(f"has {len(instants)} poses for {len(stamps)} scans, and two or more are needed")
    covered = stamps[is_covered(instants, stamps)]
    return Trajectory(covered, Trajectory(instants, orthonormalize(T_world_lidar)).at(covered, _EXTRAPOLATION_S))


def is_covered(instants: FloatArray, stamps: FloatArray) -> NDArray[np.bool_]:
    """Which stamps (N,) have a pose: none within a gap between instants (M,), or far outside them."""
    steps = np.diff(instants)
    left = np.clip(np.searchsorted(instants, stamps, side="right") - 1, 0, len(steps) - 1)
    outside_s = np.maximum(instants[0] - stamps, stamps - instants[-1])
    return np.asarray((steps[left] <= longest_bridged_s(instants)) & (outside_s <= _EXTRAPOLATION_S))

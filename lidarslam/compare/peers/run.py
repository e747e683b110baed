"""A run of a peer on disk: its poses, a map of them, and its times, as of any other method."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace

from lidarslam.compare.peers.estimation import Estimate, estimate
from lidarslam.compare.peers.registry import Peer
from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.core.text import count
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import choose_scans, take_in
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.interruption import Interruptions
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.run.results import RunOutcome, final_map, write_results
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.tracking import Tracked, unless_damaged
from lidarslam.storage.directory import RunDirectory

PEER_KEY = "peer"


def describe_peer(request: RunRequest, peer: Peer, range_m: float | None) -> dict[str, object]:
    """The section of config.yaml about what was run."""
    by_scene = {} if range_m is None else {"max_range_m": range_m}
    return {**describe_run(request), PEER_KEY: peer.version, **by_scene}


def execute_peer(
    request: RunRequest, peer: Peer, progress: Callable[[int, int], None], range_m: float | None = None
) -> RunOutcome:
    """Run a peer, and write the run directory.

    First the peer takes all scans; then they are read again, chained with its poses, checked and drawn into the map as
    with an odometry of ours. A damaged recording ends both at the same scan.

    Args:
        request: what is run, with the poses of an external odometry.
        peer: which one.
        progress: called after every scan that the peer has registered, with its number from 1 and how many there are.
        range_m: as of `estimate`.

    Raises:
        LidarSlamError: the source, the peer or the output directory is not usable.
    """
    recording = open_recording(request.source, request.config.reader)
    chosen = choose_scans(recording, request.source, request.start, request.stop, request.step)
    errors: list[InputError] = []
    scans = _until_damaged(take_in(recording, chosen, Faults()), errors)
    samples = recording.imu if peer.needs_imu else None
    estimated = estimate(peer, prefetch(scans), samples, lambda number: progress(number, len(chosen)), range_m)
    with Interruptions() as interruptions, RunDirectory.create(request.out, request.overwrite) as directory:
        interruptions.protect_results()
        tracked = _track(request, recording, chosen, estimated)
        if errors:
            tracked = replace(tracked, error=errors[0])
        drawn = final_map(tracked, None, request.config.global_map, directory)
        return write_results(directory, request.config, describe_peer(request, peer, range_m), tracked, None, drawn)


def _until_damaged(scans: Iterator[Scan], errors: list[InputError]) -> Iterator[Scan]:
    try:
        yield from scans
    except InputError as error:
        errors.append(error)


def _track(request: RunRequest, recording: Recording, chosen: range, estimated: Estimate) -> Tracked:
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
    built = pipeline.map
    asked = len(chosen) - unplaced
    return Tracked(recording, truth, log, asked, faults, built.global_map, built.views, built.slides.tests, None)

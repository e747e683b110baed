"""A recording through the pipeline: every scan is logged and shown, the state saved."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from typing import TYPE_CHECKING

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import inverse
from lidarslam.core.scan import Scan
from lidarslam.core.text import count
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.elevation import ElevationEstimator
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.mapping.smoothed_start import SHOWING, SmoothedMotion, smoothed_start
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import Localiser, ScanMapper, ScanToMap, make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.checkpoints import Checkpoints
from lidarslam.run.elevation import Elevation
from lidarslam.run.inertial import open_inertial
from lidarslam.run.request import RunRequest
from lidarslam.run.results import Tracked, TrackedScans, reason_of, unless_damaged
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.session import RunSession
from lidarslam.viewer.viewer import Viewer

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.inertial.inertial import Inertial

logger = logging.getLogger(__name__)

Progress = Callable[[int, int, ScanEstimate], None]
"""Called after every scan with its number from 1, how many there are, and its result."""


class NoScanError(InputError):
    """No scan of a recording could be used, because of an interruption or of the recording."""

    def __init__(self, message: str, interrupted: bool) -> None:
        super().__init__(message)
        self.interrupted = interrupted


def track(
    session: RunSession,
    request: RunRequest,
    recording: Recording,
    chosen: range,
    progress: Progress,
    graph: KeyframeGraph | None = None,
    mapper: ScanMapper | None = None,
) -> Tracked:
    """Take the chosen scans of a recording through the pipeline.

    Args:
        session: logs, shows and saves them.
        request: of the run.
        recording, chosen: the source, and the indices of the scans.
        progress: called for every scan.
        graph: new, or resumed.
        mapper: registers the scans; None: as configured.

    Raises:
        NoScanError: no scan could be used.
        InputError: the recording is not the one that the run began with.
    """
    config, faults, log, odometry = request.config, Faults(), session.log, session.odometry
    scans = take_in(recording, chosen, faults)
    inertial = open_inertial(config, recording, chosen, log.warn)
    if inertial is not None:
        scans = map(inertial.gyroscope.evened, scans)
    unfinished = session.unfinished
    checkpoints = None if unfinished is None else Checkpoints(unfinished, config.checkpoints, odometry, log, graph)
    estimator = ElevationEstimator()
    localiser: Localiser
    if mapper is not None:
        localiser = ScanToMap(mapper, inertial)
    else:
        localiser = make_localiser(config, inertial, estimator, _start(config, recording, chosen, inertial))
    store = TileStore(request.out, None if unfinished is None else unfinished.files.tiles)
    pipeline = Pipeline(odometry, localiser, config.global_map, graph, checkpoints, store)
    if checkpoints is not None:
        scans = checkpoints.begin(pipeline, scans, is_recorded=request.rerun != "off")
    truth = unless_damaged(lambda: recording.ground_truth, log, "no metrics")
    with suppress(InputError):  # raised again when the scans are read
        for warning in recording.warnings:
            log.warn(warning)
    error = _process(pipeline, scans, session, truth, lambda number, result: progress(number, len(chosen), result))
    for warning in inertial.warnings if inertial is not None else ():
        log.warn(warning)
    if isinstance(odometry, ExternalOdometry) and odometry.warning is not None:
        log.warn(odometry.warning)
    if not log.points_read:
        if isinstance(error, KeyboardInterrupt):
            raise NoScanError(f"{request.source}: interrupted before a scan was done; nothing was kept", True)
        why = "; ".join(_why_none(log, faults, error))
        raise NoScanError(f"{request.source}: no scan could be used: {why}", False)
    elevation = Elevation.found(recording, estimator)
    if elevation is not None and elevation.warning is not None:
        log.warn(elevation.warning)
    tracked = TrackedScans.of(log, faults, pipeline.map, len(chosen), error)
    return Tracked(tracked, pipeline.map.global_map, recording, truth, elevation)


def _start(
    config: Config, recording: Recording, chosen: range, inertial: "Inertial | None"
) -> dict[float, SmoothedMotion]:
    """The motions of the first scans, where they have to be smoothed."""
    if config.mapping.method != "surfels" or len(chosen) < SHOWING:
        return {}
    logger.info("the first scans are registered beforehand")
    with suppress(InputError):  # raised again when the scans are read
        scans = take_in(recording, chosen, Faults())
        if inertial is None:
            return smoothed_start(scans, config.mapping)
        return smoothed_start(map(inertial.gyroscope.evened, scans), config.mapping, inertial.anew())
    return {}


def _process(
    pipeline: Pipeline,
    scans: Iterable[Scan],
    session: RunSession,
    truth: Trajectory | None,
    progress: Callable[[int, ScanEstimate], None],
) -> InputError | KeyboardInterrupt | None:
    """Take every scan through the pipeline; the error that ended it early, or None."""
    log, finished = session.log, time.perf_counter()
    try:
        with closing(pipeline.run(prefetch(scans))) as estimates:
            for estimate in estimates:
                before, finished = finished, time.perf_counter()
                if truth is not None:
                    _show_reference(session.viewer, truth, log.stamps[0] if len(log) else estimate.stamp)
                    truth = None
                session.take(estimate, 1e3 * (finished - before), pipeline.map)
                progress(len(log), estimate)
    except (InputError, KeyboardInterrupt) as error:
        log.warn(f"stopped after {count(len(log), 'scan')}: {reason_of(error)}")
        return error.with_traceback(None)  # whose frames hold maps and scans
    return None


def _show_reference(viewer: Viewer, truth: Trajectory, first_stamp: float) -> None:
    """Show the ground truth in the run's world: they coincide at the first scan."""
    if len(truth) >= 2:
        nearest = np.clip(first_stamp, truth.stamps[0], truth.stamps[-1])
        viewer.show_reference(truth.transformed(inverse(truth.at(np.array([nearest]))[0])))


def _why_none(log: ScanLog, faults: Faults, error: InputError | None) -> Iterator[str]:
    if error is not None:
        yield str(error)
    yield from faults.warnings()
    if len(log):
        invalid = count(log.points_dropped, "invalid point")
        yield f"{count(len(log), 'scan')} without a valid point, {invalid} (NaN, at the origin, too far)"

"""A recording through the pipeline: every scan is logged and shown, the state saved."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

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
from lidarslam.mapping.consistency import PairTest
from lidarslam.mapping.elevation import ElevationEstimator
from lidarslam.mapping.global_map.global_map import GlobalMap
from lidarslam.mapping.global_map.moved_points import Views
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.mapping.pose_graph.keyframe_graph import KeyframeGraph
from lidarslam.mapping.smoothed_start import SHOWING, SmoothedMotion, smoothed_start
from lidarslam.odometry.interface import Odometry
from lidarslam.odometry.methods.external import ExternalOdometry
from lidarslam.pipeline.estimates import ScanResult
from lidarslam.pipeline.localisation import Localiser, ScanMapper, ScanToMap, make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.pipeline.threads import prefetch
from lidarslam.run.checkpoints import Checkpoints
from lidarslam.run.elevation import Elevation
from lidarslam.run.inertial import open_inertial
from lidarslam.run.request import RunRequest
from lidarslam.run.scan_log import ScanLog
from lidarslam.storage.unfinished import Unfinished
from lidarslam.viewer.viewer import Viewer

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.inertial.inertial import Inertial

logger = logging.getLogger(__name__)

T = TypeVar("T")
Progress = Callable[[int, int, ScanResult], None]
"""Called after every scan with its number from 1, how many there are, and its result."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A recording after the pipeline."""

    # recording, truth, log: the recording, its ground truth, its scans; scans may come from elsewhere
    recording: Recording | None
    truth: Trajectory | None
    log: ScanLog
    asked: int  # number of scans that were asked for
    faults: Faults  # what was left out of them, and what is wrong with them
    global_map: GlobalMap | None  # of the poses before loop closure; None when no scan was added
    views: Views  # range images of some scans, for the removal of moving objects
    slides: list[PairTest]  # pairs of scans, for the detection of slips
    error: InputError | KeyboardInterrupt | None  # what ended it before its last scan, None when nothing did
    elevation: Elevation | None = None  # the error of the sensor's elevations; None where nothing shows it

    @property
    def stopped(self) -> str | None:
        """Why it ended before its last scan."""
        return None if self.error is None else _reason(self.error)


class NoScanError(InputError):
    """No scan of a recording could be used, because of an interruption or of the recording."""

    def __init__(self, message: str, interrupted: bool) -> None:
        super().__init__(message)
        self.interrupted = interrupted


def track(
    request: RunRequest,
    recording: Recording,
    chosen: range,
    odometry: Odometry,
    log: ScanLog,
    graph: KeyframeGraph | None,
    viewer: Viewer,
    progress: Progress,
    unfinished: Unfinished | None = None,
    mapper: ScanMapper | None = None,
) -> Tracked:
    """Take the chosen scans of a recording through the pipeline.

    Args:
        request: of the run.
        recording, chosen: the source, and the indices of the scans.
        odometry, log, graph: new, but for a graph that is resumed.
        viewer, progress: called for every scan.
        unfinished: where checkpoints are saved; None: nowhere.
        mapper: registers the scans; None: as configured.

    Raises:
        NoScanError: no scan could be used.
        InputError: the recording is not the one that the run was begun with.
    """
    config, faults = request.config, Faults()
    scans = take_in(recording, chosen, faults)
    inertial = open_inertial(config, recording, chosen, log.warn)
    if inertial is not None:
        scans = map(inertial.gyroscope.evened, scans)
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
    error = _process(pipeline, scans, log, viewer, truth, lambda number, result: progress(number, len(chosen), result))
    for warning in inertial.warnings if inertial is not None else ():
        log.warn(warning)
    if isinstance(odometry, ExternalOdometry) and odometry.warning is not None:
        log.warn(odometry.warning)
    if not log.points_read:
        if isinstance(error, KeyboardInterrupt):
            raise NoScanError(f"{request.source}: interrupted before a scan was done; nothing was kept", True)
        why = "; ".join(_why_none(log, faults, error))
        raise NoScanError(f"{request.source}: no scan could be used: {why}", False)
    built, elevation = pipeline.map, Elevation.found(recording, estimator)
    if elevation is not None and elevation.warning is not None:
        log.warn(elevation.warning)
    return Tracked(
        recording, truth, log, len(chosen), faults, built.global_map, built.views, built.slides.tests, error, elevation
    )


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
    log: ScanLog,
    viewer: Viewer,
    truth: Trajectory | None,
    progress: Callable[[int, ScanResult], None],
) -> InputError | KeyboardInterrupt | None:
    """Take every scan through the pipeline; what ended it early, None when nothing did."""
    finished = time.perf_counter()
    try:
        with closing(pipeline.run(prefetch(scans))) as results:
            for result in results:
                before, finished = finished, time.perf_counter()
                log.add(result, 1e3 * (finished - before))
                if truth is not None:
                    _show_reference(viewer, truth, log.stamps[0])
                    truth = None
                viewer.show_scan(len(log) - 1, result)
                if pipeline.map.global_map is not None and viewer.wants_map(len(log) - 1):
                    viewer.show_map(pipeline.map.global_map.points())
                progress(len(log), result)
    except (InputError, KeyboardInterrupt) as error:
        log.warn(f"stopped after {count(len(log), 'scan')}: {_reason(error)}")
        return error.with_traceback(None)  # whose frames hold maps and scans
    return None


def _show_reference(viewer: Viewer, truth: Trajectory, first_stamp: float) -> None:
    """Show the ground truth in the run's world: they coincide at the first scan."""
    if len(truth) >= 2:
        nearest = np.clip(first_stamp, truth.stamps[0], truth.stamps[-1])
        viewer.show_reference(truth.transformed(inverse(truth.at(np.array([nearest]))[0])))


def unless_damaged(read: Callable[[], T], log: ScanLog, consequence: str) -> T | None:
    """Something that came with the recording; None and a warning where it is damaged."""
    try:
        return read()
    except InputError as error:
        log.warn(f"{consequence}: {error}")
        return None


def _reason(error: InputError | KeyboardInterrupt) -> str:
    return str(error) or "interrupted"


def _why_none(log: ScanLog, faults: Faults, error: InputError | None) -> Iterator[str]:
    if error is not None:
        yield _reason(error)
    yield from faults.warnings()
    if len(log):
        invalid = count(log.points_dropped, "invalid point")
        yield f"{count(len(log), 'scan')} without a valid point, {invalid} (NaN, at the origin, too far)"

"""Localisation of a recording in a finished map: from a source and a map to a run directory in the map's frame."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.config.settings import dump_yaml
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.text import as_typed, command_line, count, joined
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import format_tum
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.mapping.localization.map_localiser import MapLocaliser
from lidarslam.mapping.localization.place_search import FixedMap
from lidarslam.mapping.tracking.mapped_scan import NOT_CONFIRMED
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.run.request import RunRequest, describe_run, log_choices, require_possible
from lidarslam.run.results import RunOutcome, Tracked, format_end, format_times
from lidarslam.run.run import Progress, RunSession, open_session, track
from lidarslam.run.summary import ScanLog, WrittenMap, summarise
from lidarslam.storage import directory as files
from lidarslam.storage.directory import SUMMARY
from lidarslam.storage.finished_run import load_map
from lidarslam.viewer.rerun_program import WebPage
from lidarslam.viewer.viewer import Viewer

# A map of fewer points is too small for a search.
_FEWEST_POINTS = 1000


@dataclass(frozen=True)
class LocaliseRequest:
    """A recording, and the map that it is to be found in."""

    run: RunRequest  # the recording, and where the results go; no checkpoints
    map: Path  # a run directory, a .ply or a .pcd file with normals
    guess: tuple[float, float, float] | None = None  # rough x, y (m) and heading (degrees) of the first scan in the map

    def describe(self) -> dict[str, Any]:
        """For config.yaml."""
        return describe_run(self.run) | {"map": str(self.map.resolve()), "guess": self.guess and list(self.guess)}


def read_map(request: LocaliseRequest) -> tuple[PointCloud, FixedMap]:
    """The points of the map, and the map to register to; InputError where it is too small, or without normals."""
    if request.run.config.mapping.method != "surfels":
        raise ConfigError("mapping.method: scans are localised by registration to surfels; leave the setting out")
    cloud = load_map(request.map)
    if len(cloud) < _FEWEST_POINTS:
        raise InputError(f"{request.map}: holds no map to localise in ({len(cloud):,} points)")
    if not cloud.normals[:, :2].any():
        raise InputError(f"{request.map}: has points without normals, which say from which side walls were seen")
    return cloud, FixedMap(cloud.points, cloud.normals)


class PlacedViewer(Viewer):
    """Forwards scans once one is localised in the map: before, poses are in a frame of their own."""

    def __init__(self, shown: Viewer) -> None:
        self._shown = shown
        self._is_placed = False

    def show_scan(self, index: int, result: ScanEstimate) -> None:
        """Show a scan, if its pose in the map is known."""
        self._is_placed = self._is_placed or result.status is not Status.LOST
        if self._is_placed:
            self._shown.show_scan(index, result)


_AFTERWARDS = "placed afterwards: the recording's own map leads from here to the place that was found"
_REVOKED = "a place was found here, but later scans did not confirm it"


@dataclass(frozen=True)
class Localisation:
    """When and how a recording was found; scans are numbered from 0."""

    searches_refused: tuple[tuple[int, str], ...]  # scan and reason of every search without a place
    found_scan: int | None = None  # the scan that was found first; None: never
    confirmed_scan: int | None = None  # the scan that confirmed it
    confirmed_after_s: float | None = None  # time from the first scan to that
    found_inlier_ratio: float | None = None  # mean of the scans that it was found with
    times_found: int = 0  # more than once where it was lost in between
    tracked_scans: int = 0  # scans that were registered to the map
    placed_afterwards: int = 0  # scans before the first place that follow from it

    def to_json(self) -> dict[str, Any]:
        """The section of summary.json, without the map."""
        refused = [{"scan": scan, "reason": reason} for scan, reason in self.searches_refused]
        return {"found": self.found_scan is not None, **vars(self), "searches_refused": refused}


@dataclass(frozen=True)
class LocaliseOutcome:
    """A localisation that was written."""

    run: RunOutcome  # summary, and metrics where there is ground truth
    localisation: Localisation


def execute(
    request: LocaliseRequest,
    progress: Progress,
    phase: Callable[[str], None] = lambda _: None,
    page: WebPage | None = None,
) -> LocaliseOutcome:
    """Localise, and write the run directory; the map is only read. Arguments as of `lidarslam.run.run.execute`."""
    run = request.run
    require_possible(run, run.source, request.map)
    phase("reading the map")
    cloud, fixed_map = read_map(request)
    recording, chosen = run.open()
    log_choices(run, chosen, len(recording))
    guess = None if request.guess is None else (*request.guess[:2], float(np.deg2rad(request.guess[2])))
    localiser = MapLocaliser(run.config.mapping, fixed_map, guess)
    with open_session(run, phase, recording) as session:
        session.show(recording.name, page)
        shown = session.viewer
        shown.show_final_map(cloud.points)
        session.viewer = PlacedViewer(shown)
        session.wait_for_loops()
        phase("searching for the place")
        tracked = track(session, recording, chosen, progress, mapper=localiser)
        session.end_scans()
        session.shown.close()
        return _write(request, session, tracked, localiser)


def _write(
    request: LocaliseRequest, session: RunSession[RunRequest], tracked: Tracked, localiser: MapLocaliser
) -> LocaliseOutcome:
    """Write the results so far; a recording that was never found has no trajectory in the map."""
    log, directory, config, described = session.log, session.directory, request.run.config, request.describe()
    _correct(log, localiser)
    found = _localisation(log, localiser)
    section = {"localisation": {"map": described["map"], **found.to_json()}}
    if found.found_scan is not None:
        run = session.finish(replace(tracked, global_map=None), described)
        directory.write_json(files.SUMMARY, run.summary.to_json() | section)
        return LocaliseOutcome(run, found)
    directory.write_text(files.CONFIG, dump_yaml(config, described))
    directory.write_text(files.SCANS_CSV, log.format_csv())
    directory.write_text(files.ODOMETRY_TUM, format_tum(log.odometry))
    log.warnings.extend(tracked.scans.faults.warnings())
    summary = summarise(log, WrittenMap(0, None, 0), tracked.scans.faults.unreadable_scans)
    directory.write_json(files.SUMMARY, summary.to_json() | section)
    return LocaliseOutcome(RunOutcome(summary, None, tracked.scans.stopped), found)


def _correct(log: ScanLog, localiser: MapLocaliser) -> None:
    scans = range(len(log))
    poses = log.trajectory.T_world_lidar.copy()
    for number, T_map_lidar in localiser.corrections.items():
        if number in scans:
            poses[number] = T_map_lidar
    log.correct(poses)
    log.mark([number for number in localiser.placed_afterwards if number in scans], Status.DEGRADED, _AFTERWARDS)
    for found in localiser.found:
        waited = range(found.scan, min(found.confirmed, len(log)))  # an interrupted run lacks the last scans
        log.mark([number for number in waited if log.messages[number].endswith(NOT_CONFIRMED)], Status.OK, "")
    log.mark([number for number in localiser.unconfirmed() if number in scans], Status.LOST, _REVOKED)


def _localisation(log: ScanLog, localiser: MapLocaliser) -> Localisation:
    refused = tuple(localiser.refusals)
    if not localiser.found or not len(log):
        return Localisation(refused)
    first = localiser.found[0]
    lost, afterwards = log.statuses.count(Status.LOST), len(localiser.placed_afterwards)
    return Localisation(
        refused,
        found_scan=first.scan,
        confirmed_scan=first.confirmed,
        confirmed_after_s=float(log.stamps[min(first.confirmed, len(log) - 1)] - log.stamps[0]),
        found_inlier_ratio=float(np.mean([fit.inlier_ratio or 0.0 for fit in first.fits])),
        times_found=len(localiser.found),
        tracked_scans=len(log) - lost - afterwards,
        placed_afterwards=afterwards,
    )


def format_localisation(request: LocaliseRequest, outcome: LocaliseOutcome) -> str:
    """A localisation in a few lines: where it was found, tracked and lost scans, and where the files are."""
    summary, found, out = outcome.run.summary, outcome.localisation, request.run.out
    confirmed = f"confirmed at scan {found.confirmed_scan}, after {found.confirmed_after_s:.1f} s"
    before = f", {found.placed_afterwards:,} before that placed afterwards" if found.placed_afterwards else ""
    lines = [
        f"{count(summary.scans, 'scan')}, {summary.length_m:.1f} m in {summary.duration_s:.1f} s",
        f"found at scan {found.found_scan}, {confirmed}",
        f"{found.tracked_scans:,} scans tracked in the map{before}, {summary.lost_scans:,} lost",
        *format_times(summary),
        *format_end(out, summary),
        f"next: {command_line(as_typed('lidarslam'), 'view', str(request.map), str(out))}",
    ]
    return joined(lines)


def format_not_found(request: LocaliseRequest, outcome: LocaliseOutcome) -> str:
    """A line about a recording that was not found."""
    refused, scans = outcome.localisation.searches_refused, count(outcome.run.summary.scans, "scan")
    last = f"; the last search: {refused[-1][1]}" if refused else ""
    return f"{request.run.source}: not found in {request.map} with {scans}{last}; {SUMMARY} has all reasons"

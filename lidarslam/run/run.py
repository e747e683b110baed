"""One run on disk: from a recording to a run directory."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from lidarslam.core.errors import InputError
from lidarslam.datasets.intake import choose_scans
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.run.checkpoints import describe_computed
from lidarslam.run.elevation import with_elevations
from lidarslam.run.inertial import imu_samples
from lidarslam.run.request import RunRequest, describe_run, log_choices
from lidarslam.run.results import RunOutcome
from lidarslam.run.session import open_session, require_apart
from lidarslam.run.tracking import Progress, track
from lidarslam.viewer.web_page import WebPage

if TYPE_CHECKING:  # loads SciPy and the pose graph
    from lidarslam.mapping.pose_graph.edges import ProjectedTrack


def execute(
    request: RunRequest,
    progress: Progress,
    phase: Callable[[str], None] = lambda _: None,
    page: WebPage | None = None,
) -> RunOutcome:
    """Run, and write the run directory.

    A damaged recording or an interruption ends the run early, with the results so far. A run that is killed can be
    resumed, to the same results.

    Args:
        request: the run to execute.
        progress: called after every scan.
        phase: called with a short text on the progress before the first scan and after the last.
        page: shows the run in browsers, with `rerun="web"`.

    Raises:
        LidarSlamError: the source, the configuration or the output directory is not usable, or there is nothing to
            resume.
    """
    require_apart(request.out, request.source)
    phase("opening the recording")
    recording = open_recording(request.source, request.config.reader)
    chosen = _choose(request, recording)
    log_choices(request, chosen, len(recording))
    imu_samples(request.config, recording)
    gnss = gnss_track(request)
    with open_session(request, phase, recording, is_placed=gnss is not None) as session:
        if request.resumable:
            session.claim(describe_computed(request, recording), request.resume)
        session.begin_graph(request.given, takes_gnss=True)
        if request.config.mapping.budget_ms is not None:
            session.log.warn("with mapping.budget_ms the results depend on the clock; another run may differ")
        session.show(recording.name, page)
        session.wait_for_loops(for_first_scan=True)
        request, recording = with_elevations(request, recording, chosen, phase)
        session.request = request
        phase("reading the first scans")
        tracked = track(session, request, recording, chosen, progress, session.graph)
        session.end_scans()
        return session.finish(tracked, describe_run(request), gnss)


def gnss_track(request: RunRequest) -> "ProjectedTrack | None":
    """The GNSS track of a recording, in UTM; None where the pose graph uses none.

    Raises:
        InputError: the recording has no GNSS positions.
        ConfigError: pyproj is not installed.
    """
    if not (request.config.pose_graph.enabled and request.config.pose_graph.gnss):
        return None
    from lidarslam.exports.geo import read_gnss, utm_around
    from lidarslam.mapping.pose_graph.edges import ProjectedTrack

    track = read_gnss(request.source, request.config.reader)
    utm = utm_around(track.geodetic)
    return ProjectedTrack(track, utm.project(track.geodetic), utm.scale)


def _choose(request: RunRequest, recording: Recording) -> range:
    """The scans of a run.

    Raises:
        InputError: there are none, or not those of a loop closure that is given or forbidden.
    """
    chosen = choose_scans(recording, request.source, request.start, request.stop, request.step)
    scans = len(chosen)
    for option, pairs in (("--loop", request.given.closed), ("--no-loop", request.given.forbidden)):
        for first, second in pairs:
            if second >= scans:
                raise InputError(f"{option} {first} {second}: the run has {scans} scans, from 0 to {scans - 1}")
    return chosen

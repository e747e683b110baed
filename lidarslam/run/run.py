"""One run on disk: from a source to a run directory."""

from contextlib import ExitStack
from pathlib import Path

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.trajectory_io import read_tum
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.pipeline.loop_closing import close_loops
from lidarslam.resume.resuming import astray_before, describe_computed
from lidarslam.resume.run_state import log_and_graph
from lidarslam.resume.unfinished import Unfinished
from lidarslam.run.directory import RunDirectory
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.run.results import RunOutcome, final_map, write_results
from lidarslam.run.tracking import track
from lidarslam.run.watch import Progress
from lidarslam.viewer.viewer import viewing
from odometry.interface import Odometry
from odometry.registry import make_odometry


def execute(request: RunRequest, progress: Progress) -> RunOutcome:
    """Run, and write the run directory.

    A recording that turns out damaged on the way, or an interruption, ends the run with what there is. A run that is
    killed leaves a folder from which it can be resumed to the results it would have had.

    Raises:
        LidarSlamError: the source, the configuration or the output directory is not usable, or there is nothing to
            resume.
    """
    require_apart(request.out, request.source)
    config = request.config
    recording = open_recording(request.source, config.reader)
    chosen = range(len(recording))[request.start : request.stop : request.step]
    if not chosen:
        raise InputError(
            f"{request.source}: none of its {len(recording)} scans is left after --start, --stop and --step"
        )
    with ExitStack() as stack:
        odometry = open_odometry(config, request.prior)
        stack.callback(odometry.close)
        directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite, request.resume))
        unfinished = _claim(request, recording, directory, stack)
        log, graph = log_and_graph(config, directory, unfinished, stack)
        with viewing(request.rerun, recording.name, config.viewer, directory, log) as viewer:
            tracked = track(request, recording, chosen, odometry, log, graph, viewer, progress, unfinished)
            closed = close_loops(graph, tracked.global_map, log, viewer)
            drawn = final_map(tracked, closed, config.global_map)
            if drawn.cloud is not None:
                viewer.show_final_map(drawn.cloud.points)
        outcome = write_results(directory, request, tracked, closed, drawn)
    if unfinished is not None:
        unfinished.end(outcome.stopped is not None)
    return outcome


def astray_when_finished(request: RunRequest) -> bool | None:
    """Whether tracking was lost, if `out` holds this very run with nothing left to resume; None if it does not.

    Raises:
        InputError: it holds another one.
    """
    return astray_before(request.out, request.config, describe_run(request))


def _claim(request: RunRequest, recording: Recording, directory: RunDirectory, stack: ExitStack) -> Unfinished | None:
    """What makes a run resumable."""
    if not request.resumable:
        return None
    description = describe_computed(request.config, recording, describe_run(request), request.prior)
    return stack.enter_context(Unfinished.claim(request.out, description, request.resume, lambda: directory.is_mixed))


def require_apart(out: Path, source: Path) -> None:
    """See that nothing is written into a recording.

    Raises:
        OutputError: it would be.
    """
    if out.resolve() == source.resolve():
        raise OutputError(f"{out}: is the recording itself; name another directory for the run")


def open_odometry(config: Config, prior: Path | None) -> Odometry:
    """The odometry that is configured; whoever asks for it closes it.

    Raises:
        LidarSlamError: the configuration contradicts itself, or a file is not what it should be.
    """
    method = config.odometry.method
    if method == "constant-velocity" and not config.mapping.enabled:
        raise ConfigError(
            "constant-velocity only predicts; without scan-to-map refinement it would stand still."
            " Choose --odometry learned, give a trajectory with --prior, or leave --no-mapping out"
        )
    if method == "external" and prior is None:
        raise ConfigError("odometry.method is external: give its trajectory with --prior FILE")
    return make_odometry(config.odometry, None if prior is None else read_tum(prior))

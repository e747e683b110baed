"""A live run on disk: from the clouds of a robot to a run directory."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.datasets.faults import Faults
from lidarslam.live.clouds import CloudDecoder
from lidarslam.live.receiving import IMU_DEPTH, ImuReceiver, IncomingQueue, find_imu, find_topic
from lidarslam.live.session import LiveRequest, LiveSession, warm_up
from lidarslam.live.statistics import LiveCounts
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.pipeline.compile_ahead import CompileAhead, parts_of
from lidarslam.run.inertial import make_imu_stream
from lidarslam.run.interruption import Interruptions
from lidarslam.run.loop_closing import begin_graph, close_loops
from lidarslam.run.results import RunOutcome, final_map, write_results
from lidarslam.run.run import open_odometry, require_no_trajectory, viewing
from lidarslam.run.scan_log import ScanLog
from lidarslam.storage.directory import RunDirectory
from lidarslam.viewer.rerun_program import require_window
from lidarslam.viewer.web_page import WebPage

if TYPE_CHECKING:
    from lidarslam.live.dds import DdsNode
    from lidarslam.live.following import Follower
    from lidarslam.pipeline.imu_stream import ImuStream


@dataclass(frozen=True)
class LiveOutcome:
    """The outcome of a live run."""

    run: RunOutcome  # as of a recording
    topic: str
    counts: LiveCounts  # what became of the scans
    is_interrupted: bool  # whether Ctrl-C ended it


def execute(request: LiveRequest, show: Callable[[str], None], page: WebPage | None = None) -> LiveOutcome:
    """Follow a robot, publish its poses, and write the run directory.

    Args:
        request: what is followed, and until when; Ctrl-C ends it at any time, with all results.
        show: called with a few words on what goes on, every second while scans come.
        page: shows the run in browsers, with `rerun="web"`.

    Raises:
        LidarSlamError: the extra `live` is not installed, no scan came, or topic, configuration or output directory are
            not usable.
    """
    node = _open_node(request.domain)
    if request.rerun == "spawn":
        require_window("serve a browser with --rerun web, or write a file with --rerun save")
    config, log, faults = bounded(request.config), ScanLog(), Faults()
    require_no_trajectory(config)
    with Interruptions() as interruptions:
        with ExitStack() as stack:
            compiling = stack.enter_context(CompileAhead(parts_of(config)))
            show("loading the odometry")
            odometry = open_odometry(config, None)
            stack.callback(odometry.close)
            directory = stack.enter_context(RunDirectory.create(request.out, request.overwrite))
            graph = begin_graph(config, directory.path)
            if graph is not None:
                stack.callback(graph.close)
            compiling.wait_for_all(show)
            show("warming up")
            with closing(open_odometry(config, None)) as rehearsing:
                warm_up(config, rehearsing)
            show("waiting for clouds")
            topic = find_topic(node.published, request.topic, request.domain, request.duration_s)
            imu = _receive_imu(config, node, log)
            show(f"{topic.name}: waiting for the first scan")
            with viewing(request.rerun, config.viewer, topic.name, directory, log, page) as viewer:
                with (
                    threadpool_limits(1, "blas"),
                    LiveSession(
                        config, odometry, graph, log, faults, viewer, TileStore(request.out), imu and imu[1]
                    ) as session,
                ):
                    if imu is not None:
                        stack.enter_context(imu[0])
                    decoder = CloudDecoder(config.reader, topic.message_type, faults)
                    follower = _follower(request, node, session, decoder, imu)
                    incoming = IncomingQueue(node.subscribe(topic).take, request.queue, follower.on_arrival)
                    counts, is_interrupted = follower.follow(incoming, show)
                    interruptions.protect_results()
                    show("writing the results")
                    tracked = session.finish()
                _require_scans(topic.name, log, faults)
                for warning in [*counts.warnings(), *(imu[1].warnings if imu is not None else ())]:
                    log.warn(warning)
                closed = close_loops(graph, tracked.global_map, log, viewer)
                drawn = final_map(tracked, closed, config.global_map, directory)
                if drawn.cloud is not None:
                    viewer.show_final_map(drawn.cloud.points)
            described = _describe(request, topic.name)
            outcome = write_results(directory, config, described, tracked, closed, drawn, request.map_formats)
        if request.report:
            from lidarslam.viewer.run_report import Accuracy, leave_report

            show("drawing the report")
            leave_report(request.out, Accuracy(outcome.metrics))
    return LiveOutcome(outcome, topic.name, counts, is_interrupted)


def bounded(config: Config) -> Config:
    """The configuration in which scans wait for nothing.

    A scan's mapping has a budget, which follows the rate of the sensor unless one is given. The local map is not
    corrected: tracking would wait for the pose graph to draw it.
    """
    mapping = config.mapping.model_copy(update={"budget_ms": config.mapping.budget_ms or "auto"})
    graph = config.pose_graph.model_copy(update={"corrects_local_map": False})
    return config.model_copy(update={"mapping": mapping, "pose_graph": graph})


def _follower(
    request: LiveRequest,
    node: "DdsNode",
    session: LiveSession,
    decoder: CloudDecoder,
    imu: "tuple[ImuReceiver, ImuStream] | None",
) -> "Follower":
    from lidarslam.live.following import Follower  # loads cyclonedds

    return Follower(request, node, session, decoder, imu)


def _receive_imu(config: Config, node: "DdsNode", log: ScanLog) -> "tuple[ImuReceiver, ImuStream] | None":
    """The receiver of the IMU's samples and the stream they go to; None where the odometry uses none.

    Raises:
        InputError: no IMU is published, or several.
    """
    stream = make_imu_stream(config, log.warn)
    if stream is None:
        return None
    topic = find_imu(node.published, config.reader.imu_topic)
    return ImuReceiver(node.subscribe(topic, depth=IMU_DEPTH).take, stream), stream


def _open_node(domain: int) -> "DdsNode":
    """The participant in the domain.

    Raises:
        ConfigError: the extra is not installed.
        InputError: the library cannot join the domain.
    """
    try:
        from lidarslam.live.dds import open_node
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error.name} is not installed, which live needs; pip install 'lidarslam[live]'") from error
    return open_node(domain)


def _require_scans(topic: str, log: ScanLog, faults: Faults) -> None:
    """Check that there is something to write.

    Raises:
        InputError: no scan came that could be used.
    """
    if not log.points_read:
        why = "; ".join(faults.warnings()) or ("its scans had no valid point" if len(log) else "none came")
        raise InputError(f"{topic}: no scan could be used: {why}")


def _describe(request: LiveRequest, topic: str) -> dict[str, Any]:
    """The section of config.yaml about what was run."""
    return {
        "version": version("lidarslam"),
        "source": None,
        "topic": topic,
        "domain": request.domain,
        "base_frame": request.base_frame,
    }

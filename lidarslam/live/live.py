"""A live run on disk: from the clouds of a robot to a run directory."""

import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at
from lidarslam.datasets.ros.bag_imu import IMU_TYPE
from lidarslam.datasets.ros.bag_message import CLOUD_TYPES
from lidarslam.live.clouds import CloudDecoder
from lidarslam.live.following import Follower
from lidarslam.live.receiving import IMU_DEPTH, IMU_WITHIN_S, ImuReceiver, IncomingQueue, find_topic
from lidarslam.live.statistics import LiveCounts
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.pipeline.compile_ahead import made_up_scans
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run.inertial import make_imu_stream
from lidarslam.run.request import LiveRequest, require_possible
from lidarslam.run.results import RunOutcome, Tracked, TrackedScans
from lidarslam.run.run import open_odometry, open_session
from lidarslam.run.scan_log import ScanLog
from lidarslam.viewer.web_page import WebPage

if TYPE_CHECKING:  # needs the extra
    from lidarslam.live.dds import DdsNode


@dataclass(frozen=True)
class LiveOutcome:
    """The outcome of a live run."""

    run: RunOutcome  # as of a recording
    counts: LiveCounts  # of the scans
    is_interrupted: bool  # whether Ctrl-C ended it


def execute(request: LiveRequest, show: Callable[[str], None], page: WebPage | None = None) -> LiveOutcome:
    """Follow a robot, publish its poses, and write the run directory.

    Args:
        request: the topic to follow, and the end of the run; Ctrl-C ends it at any time, with all results.
        show: called with a short text on the progress, every second while scans arrive.
        page: shows the run in browsers, with `rerun="web"`.
    """
    require_possible(request)
    node = _open_node(request.domain)
    request = replace(request, config=bounded(request.config))
    config, faults = request.config, Faults()
    with open_session(request, show) as session:
        log = session.log
        session.begin_graph()
        session.wait_for_loops()
        show("warming up")
        _warm_up(config)
        show("waiting for clouds")
        topic = find_topic(node.published, request.topic, CLOUD_TYPES, "--topic", request.duration_s)
        imu = _receive_imu(config, node, log)
        show(f"{topic.name}: waiting for the first scan")
        session.show(topic.name, page)
        localiser = make_localiser(config, None if imu is None else imu.stream)
        store = TileStore(request.out)
        pipeline = Pipeline(session.odometry, localiser, config.global_map, session.graph, store=store)

        def register(scan: Scan, started: float) -> ScanEstimate:
            scan = look_at(scan, faults)
            if imu is not None:
                scan = imu.stream.take_up(scan)
            return pipeline.register(scan, started, lambda estimate, ms: session.take(estimate, ms, pipeline.map))

        with threadpool_limits(1, "blas"), closing(pipeline), imu or nullcontext():
            decoder = CloudDecoder(config.reader, topic.message_type, faults)
            follower = Follower(request, node, register, decoder, imu)
            incoming = IncomingQueue(node.subscribe(topic).take, request.queue, follower.on_arrival)
            counts, is_interrupted = follower.follow(incoming, show)
            session.end_scans()
            pipeline.finish()
        if not log.table["points"].any():
            why = "; ".join(faults.warnings()) or ("its scans had no valid point" if len(log) else "none came")
            raise InputError(f"{topic.name}: no scan could be used: {why}")
        for warning in [*counts.warnings(), *(imu.stream.warnings if imu is not None else ())]:
            log.warn(warning)
        tracked = Tracked(TrackedScans.of(log, faults, pipeline.map), pipeline.map.global_map)
        described: dict[str, Any] = {"version": version("lidarslam"), "source": None, "topic": topic.name}
        described |= {"domain": request.domain, "base_frame": request.base_frame}
        outcome = session.finish(tracked, described)
    return LiveOutcome(outcome, counts, is_interrupted)


def _warm_up(config: Config) -> None:
    """Register made-up scans: the first calls load compiled loops, which takes seconds on a busy machine."""
    with (
        closing(open_odometry(config, None)) as odometry,
        closing(Pipeline(odometry, make_localiser(config), config.global_map)) as pipeline,
    ):
        for scan in made_up_scans():
            pipeline.register(scan, time.perf_counter(), lambda *_: None)


def bounded(config: Config) -> Config:
    """The configuration without waiting for results.

    A scan's mapping has a budget, which follows the rate of the sensor unless one is given. The local map is not
    corrected: tracking would wait for the pose graph to rebuild it.
    """
    mapping = config.mapping.model_copy(update={"budget_ms": config.mapping.budget_ms or "auto"})
    graph = config.pose_graph.model_copy(update={"corrects_local_map": False})
    return config.model_copy(update={"mapping": mapping, "pose_graph": graph})


def _receive_imu(config: Config, node: "DdsNode", log: ScanLog) -> ImuReceiver | None:
    """The receiver of the IMU's samples; None where the odometry uses none.

    InputError where no IMU is published, or several.
    """
    stream = make_imu_stream(config, log.warn)
    if stream is None:
        return None
    option = "--set reader.imu_topic=NAME"
    topic = find_topic(node.published, config.reader.imu_topic, (IMU_TYPE,), option, IMU_WITHIN_S)
    return ImuReceiver(node.subscribe(topic, depth=IMU_DEPTH).take, stream)


def _open_node(domain: int) -> "DdsNode":
    try:
        from lidarslam.live.dds import open_node
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error.name} is not installed, which live needs; pip install 'lidarslam[live]'") from error
    return open_node(domain)

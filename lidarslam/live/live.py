"""A live run: each cloud of a robot becomes a scan, a pose and a message to the robot; at the end, a run directory."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from lidarslam.config.settings import Config
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.plugins import require_library
from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at
from lidarslam.datasets.ros.bag_imu import IMU_TYPE, Edges, add_edges, chain
from lidarslam.datasets.ros.bag_message import CLOUD_TYPES, TRANSFORMS_TYPE, read_header
from lidarslam.datasets.ros.made_messages import ODOMETRY_TYPE
from lidarslam.live.messages import CloudDecoder, LiveScan, PosePublisher
from lidarslam.live.receiving import (
    IMU_DEPTH,
    IMU_WITHIN_S,
    ImuReceiver,
    IncomingQueue,
    LiveCounts,
    LiveStatistics,
    PublishedTopic,
    Received,
    find_topic,
)
from lidarslam.mapping.global_map.voxels import TileStore
from lidarslam.pipeline.compile_ahead import made_up_scans
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.run.calibration import make_imu_stream
from lidarslam.run.request import LiveRequest, require_possible
from lidarslam.run.results import RunOutcome, Tracked, TrackedScans
from lidarslam.run.run import open_odometry, open_session
from lidarslam.run.summary import ScanLog
from lidarslam.viewer.rerun_program import WebPage

if TYPE_CHECKING:  # needs the extra
    from lidarslam.live.dds import DdsNode

logger = logging.getLogger(__name__)

Register = Callable[[Scan, float], ScanEstimate]
"""Gives the pose of the next scan, whose message was taken up at a reading of `time.perf_counter`."""

ODOMETRY_TOPIC, TF_TOPIC, TF_STATIC_TOPIC = "/lidarslam/odometry", "/tf", "/tf_static"
_POLL_S, _SHOWN_EVERY_S = 0.2, 1.0
# Number of reports without a message after which the silence is reported.
_SILENT = 5
_SILENCE = (
    "no scan came for some seconds; Ctrl-C ends the run; the publisher is idle, or cannot reach this program"
    " (firewall, container, network interface)"
)
# A static transform is sent again to later subscribers; discovery of its publisher takes a while.
_STATIC_WITHIN_S = 5.0


class Follower:
    """Registers the clouds of a topic, and publishes their poses."""

    def __init__(
        self,
        request: LiveRequest,
        node: "DdsNode",
        register: Register,
        decoder: CloudDecoder,
        imu: ImuReceiver | None = None,
    ) -> None:
        self._request, self._register_scan, self._decoder, self._imu = request, register, decoder, imu
        self._statistics = LiveStatistics()
        self._publish_odometry = node.publisher(ODOMETRY_TOPIC, ODOMETRY_TYPE)
        self._publish_tf = node.publisher(TF_TOPIC, TRANSFORMS_TYPE) if request.publish_tf else None
        self._static = None
        if request.base_frame is not None or imu is not None:
            self._static = node.subscribe(PublishedTopic(TF_STATIC_TOPIC, TRANSFORMS_TYPE), is_kept=True)
        self._edges: Edges = {}
        self._poses: PosePublisher | None = None
        self._received = self._silent = 0  # messages until the last report, and reports since without any

    def follow(self, incoming: IncomingQueue, show: Callable[[str], None]) -> tuple[LiveCounts, bool]:
        """Register arriving clouds; the counts of the scans, and whether Ctrl-C ended it.

        Queued ones are still registered at the end. Registration has a thread of its own, so that Ctrl-C falls between
        two scans.
        """
        is_interrupted = False
        with incoming, ThreadPoolExecutor(1, thread_name_prefix="register") as worker:
            registering = worker.submit(self._register_all, incoming)
            try:
                while not wait([registering], timeout=_SHOWN_EVERY_S).done:
                    self._report(self._statistics.counts(incoming.dropped), show)
            except KeyboardInterrupt:
                is_interrupted = True
            incoming.end()
            registering.result()
        return self._statistics.counts(incoming.dropped), is_interrupted

    def _report(self, counts: LiveCounts, show: Callable[[str], None]) -> None:
        """Show the counts; the absence of messages, or of further ones, is logged, once each time."""
        show(counts.line())
        self._silent = self._silent + 1 if counts.received == self._received else 0
        self._received = counts.received
        if self._silent == _SILENT:
            logger.warning(_SILENCE)

    def on_arrival(self, message: Received) -> None:
        with suppress(ValueError):  # damaged, which is counted when it is decoded
            stamp_ns, _ = read_header(message.raw, ros2=True)
            self._statistics.arrived((stamp_ns or message.published_ns) / 10**9, message.arrived_s)

    def _register_all(self, incoming: IncomingQueue) -> None:
        started, begin, registered = time.monotonic(), None, 0
        while True:
            message = incoming.take(_POLL_S)
            if message is None:
                if incoming.is_ended or _is_over(self._request.duration_s, time.monotonic() - (begin or started)):
                    return
                continue
            begin = begin or message.arrived_s
            registered += self._register(message)
            if self._decoder.is_set_back:
                logger.warning("the clock of the stamps was set back: the run ends here, with its results")
                return
            if registered == self._request.scans or _is_over(self._request.duration_s, message.arrived_s - begin):
                return

    def _register(self, message: Received) -> bool:
        """The pose of a message's scan; whether there is one."""
        started = time.perf_counter()
        live = self._decoder.scan(message.raw, message.published_ns)
        if live is None:
            return False
        if self._poses is None:
            self._poses = self._pose_publisher(live.frame_id)
        if self._imu is not None:
            self._wait_for_imu(self._imu, live)
        self._poses.publish(live.stamp_ns, self._register_scan(live.scan, started))
        self._statistics.registered(live.scan.stamp, message.arrived_s)
        return True

    def _wait_for_imu(self, imu: ImuReceiver, live: LiveScan) -> None:
        """Wait for the samples of the sweep; before the first one, for the place of the IMU."""
        offsets = live.scan.time_offsets
        imu.wait_for(live.scan.stamp + (0.0 if offsets is None or not len(offsets) else float(offsets.max())))
        if not imu.stream.is_placed and imu.frame_id is not None:
            T_recorded_imu: FloatArray | None = np.eye(4)
            if imu.frame_id.lstrip("/") != live.frame_id.lstrip("/"):
                T_recorded_imu = self._static_transform(live.frame_id, imu.frame_id)
                if T_recorded_imu is None:
                    logger.info("%s does not hold the place of the IMU; its turns have to show it", TF_STATIC_TOPIC)
            imu.stream.place(None if T_recorded_imu is None else self._decoder.T_upright_recorded @ T_recorded_imu)

    def _pose_publisher(self, lidar_frame: str) -> PosePublisher:
        """Once the frame of the LiDAR is known; InputError: no static transforms connect it with the base frame."""
        body = self._request.base_frame or lidar_frame
        T_body_lidar = np.eye(4) if self._request.base_frame is None else self._static_transform(body, lidar_frame)
        if T_body_lidar is None:
            raise InputError(
                f"{TF_STATIC_TOPIC} does not connect --base-frame {body} with {lidar_frame}, the frame of the clouds;"
                f" its frames: {', '.join(sorted(self._edges)) or 'none'}"
            )
        T_body_lidar = T_body_lidar @ inverse(self._decoder.T_upright_recorded)
        return PosePublisher(self._publish_odometry, self._publish_tf, self._request.odom_frame, body, T_body_lidar)

    def _static_transform(self, target: str, source: str) -> FloatArray | None:
        """T_target_source (4, 4), once static transforms connect both; None if they do not."""
        begin = time.monotonic()
        while self._static is not None and time.monotonic() - begin < _STATIC_WITHIN_S:
            if (T_target_source := chain(self._edges, target, source)) is not None:
                return T_target_source
            for message in self._static.take(_POLL_S):
                add_edges(self._edges, message.raw, ros2=True)
        return chain(self._edges, target, source)


def _is_over(limit_s: float | None, passed_s: float) -> bool:
    return limit_s is not None and passed_s >= limit_s


@dataclass(frozen=True)
class LiveOutcome:
    """The outcome of a live run."""

    run: RunOutcome  # as of a recording
    counts: LiveCounts  # of the scans
    is_interrupted: bool  # whether Ctrl-C ended it


def execute(request: LiveRequest, show: Callable[[str], None], page: WebPage | None = None) -> LiveOutcome:
    """Follow a robot, publish its poses, and write the run directory; Ctrl-C ends it at any time, with all results.

    `show` is called with a short text on the progress, every second while scans arrive; the page is of `rerun="web"`.
    """
    require_possible(request)
    require_library("cyclonedds", "live needs", "pip install 'lidarslam[live]'")
    from lidarslam.live.dds import open_node

    node = open_node(request.domain)
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
        log.warn(*counts.warnings(), *(imu.stream.warnings if imu is not None else ()))
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
    config = config.having("mapping", budget_ms=config.mapping.budget_ms or "auto")
    return config.having("pose_graph", corrects_local_map=False)


def _receive_imu(config: Config, node: "DdsNode", log: ScanLog) -> ImuReceiver | None:
    """The receiver of the IMU's samples, None without; InputError where no IMU is published, or several."""
    stream = make_imu_stream(config, log.warn)
    if stream is None:
        return None
    option = "--set reader.imu_topic=NAME"
    topic = find_topic(node.published, config.reader.imu_topic, (IMU_TYPE,), option, IMU_WITHIN_S)
    return ImuReceiver(node.subscribe(topic, depth=IMU_DEPTH).take, stream)

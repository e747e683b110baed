"""What the state of a run is made of: how it is kept, and how a run goes on from it."""

import logging
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.pipeline.loop_closing import begin_graph, restore_graph
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.resume.checkpoints import Checkpoints
from lidarslam.resume.resuming import scans_left
from lidarslam.resume.unfinished import Unfinished
from lidarslam.run import directory as files
from lidarslam.run.directory import RunDirectory
from lidarslam.run.scan_log import ScanLog
from lidarslam.run.watch import Watch
from odometry.interface import Odometry

if TYPE_CHECKING:
    from mapping.pose_graph.slam_graph import SlamGraph

logger = logging.getLogger(__name__)

# How the sentence in the summary begins.
_RESUMED = "the run was resumed "


def log_and_graph(
    config: Config, directory: RunDirectory, unfinished: Unfinished | None, stack: ExitStack
) -> tuple[ScanLog, "SlamGraph | None"]:
    """New, or as they were saved; the stack closes them.

    Raises:
        InputError: what was saved is damaged.
    """
    if unfinished is None:
        log, graph = stack.enter_context(ScanLog.open(directory)), begin_graph(config, directory.path)
    elif unfinished.saved is None:
        log = stack.enter_context(ScanLog.open(directory, unfinished.rows))
        graph = begin_graph(config, file=unfinished.submaps)
    else:
        saved = unfinished.saved
        log = stack.enter_context(ScanLog.open(directory, unfinished.rows, saved.part("log")))
        graph = saved.optional("graph", lambda part: restore_graph(config, part, unfinished.submaps))
    if graph is not None:
        stack.callback(graph.close)
    return log, graph


def keeper_of(config: Config, unfinished: Unfinished, watch: Watch, graph: "SlamGraph | None") -> Checkpoints:
    """Saves everything that a run is made of."""

    def rest() -> State:
        saved = None if graph is None else graph.state()
        return {"graph": saved, "log": watch.log.state(), "total_ms": np.array(watch.total_ms)}

    return Checkpoints(unfinished, config.checkpoints, rest, watch.log.warn)


def restore(
    saved: Saved, pipeline: Pipeline, watch: Watch, scans: Iterator[Scan], odometry: Odometry
) -> Iterator[Scan]:
    """Go on from a state; of all the scans, those that are left.

    Raises:
        InputError: it is damaged, or the recording is another one.
    """
    part = saved.part("pipeline")
    pipeline.restore(part)
    if pipeline.held is None:
        raise saved.refuse("no scan is held")
    watch.total_ms = saved.array("total_ms", (len(watch.log),)).tolist()
    return scans_left(scans, pipeline.held, odometry, part)


def begin(unfinished: Unfinished, log: ScanLog, out: Path, resume: bool, is_recorded: bool) -> None:
    """From here on the run is at work; of one that was resumed the summary says so.

    Args:
        unfinished, log: of the run, restored by now.
        out: its directory.
        resume: whether it is gone on with.
        is_recorded: whether a Rerun recording is written.
    """
    unfinished.begin(len(log) if resume else None)
    was_saved, unfinished.saved = unfinished.saved is not None, None  # what is in use by now need not be held twice
    resumed = unfinished.about.resumed_after
    if not resumed:
        return
    if not was_saved:
        logger.warning("%s: nothing was saved yet; the run begins from the start", out)
    elif is_recorded:
        log.warn(f"{files.RERUN} holds the scans from {len(log)} on; lidarslam view shows the whole run")
    times = "once" if len(resumed) == 1 else f"{len(resumed)} times"
    log.warnings = [warning for warning in log.warnings if not warning.startswith(_RESUMED)]
    log.warn(f"{_RESUMED}{times}, after {', '.join(map(str, resumed))} scans; the peak memory is that of the last part")

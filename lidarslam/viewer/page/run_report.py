"""report.html, map.png and trajectory.png of a run, drawn from the files of its directory."""

import io
import logging
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lidarslam.config.yaml_text import read_yaml
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.comparison.comparison import MapErrors, MethodResult, SequenceComparison
from lidarslam.evaluation.report.run_page import RunPage, render_run
from lidarslam.evaluation.trajectory.metrics import TrajectoryMetrics
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.storage import directory as files
from lidarslam.storage.directory import RunDirectory
from lidarslam.storage.finished_run import read_summary
from lidarslam.viewer.drawn_runs import load_drawn_runs
from lidarslam.viewer.page.run_result import read_series, with_run
from lidarslam.viewer.page.run_text import changed_settings, describe_results, describe_source, describe_warnings
from lidarslam.viewer.picture import draw_runs, fit_frame

logger = logging.getLogger(__name__)

_NO_CLOUD = PointCloud(np.empty((0, 3)), np.empty((0, 3)))
_CAPTION = (
    "From above, to scale; the colour is the height. The path is orange where tracking was degraded, red where it was"
    " lost."
)


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Errors of a run, as far as there are references."""

    metrics: TrajectoryMetrics | None = None
    reference: str = "ground truth"  # name of the reference trajectory
    trajectory: Trajectory | None = None  # the poses that were compared; None: the run's own
    map_metrics: Mapping[str, object] | None = None  # the content of metrics.json's "map"
    map_errors: MapErrors | None = None
    notes: tuple[str, ...] = ()  # remarks for the reader


def leave_report(run: Path, accuracy: Accuracy) -> bool:
    """Draw the page and the pictures of a finished run; whether it could be done. A failure is a warning."""
    try:
        _draw(run, accuracy)
    except KeyboardInterrupt:
        logger.warning("%s: no %s was drawn: interrupted", run, files.REPORT)
    except Exception as error:
        logger.warning("%s: no %s was drawn: %s", run, files.REPORT, error or type(error).__name__)
        logger.info("raised here:", exc_info=True)
    else:
        return True
    return False


def _draw(run: Path, accuracy: Accuracy) -> None:
    directory, (drawn,) = RunDirectory(run), load_drawn_runs([run])
    path, truth = replace(drawn, cloud=_NO_CLOUD), _true_path(accuracy)
    frame = fit_frame([drawn])
    alone = fit_frame([path], reference=truth, turn_deg=frame.view.turn_deg)
    _write_picture(directory, files.TRAJECTORY_PNG, draw_runs([path], reference=truth, frame=alone).pixels)
    picture = None
    if len(drawn.cloud):
        picture = _write_picture(directory, files.MAP_PNG, draw_runs([drawn], frame=frame).pixels)
    directory.write_text(files.REPORT, render_run(_page(run, accuracy, picture)))


def _true_path(accuracy: Accuracy) -> FloatArray | None:
    """Positions of the reference in the run's world; None without one, or in the frame of a camera."""
    if accuracy.metrics is None or accuracy.trajectory is not None:
        return None
    reference = accuracy.metrics.association.reference
    return reference.transformed(inverse(accuracy.metrics.T_reference_estimate)).positions


def _write_picture(directory: RunDirectory, name: str, pixels: NDArray[np.uint8]) -> str:
    """Write a PNG file; its content in base64."""
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, format="PNG")
    with directory.replacing(name) as partial:
        partial.write_bytes(content.getvalue())
    return b64encode(content.getvalue()).decode()


def _page(run: Path, accuracy: Accuracy, picture: str | None) -> RunPage:
    summary, settings = read_summary(run), (run / files.CONFIG).read_text(encoding="utf-8")
    tree = read_yaml(run / files.CONFIG)
    described = tree.get(files.RUN_SECTION) or {}
    result = with_run(MethodResult(run.resolve().name, "lost" if summary["lost_scans"] else "ok"), run)
    result = replace(
        result,
        trajectory=accuracy.trajectory or result.trajectory,
        metrics=accuracy.metrics,
        map_metrics=accuracy.map_metrics,
        map_errors=accuracy.map_errors,
        peak_rss_mb=summary["peak_rss_mb"],
        series=read_series(run),
    )
    reference = None if accuracy.metrics is None else accuracy.metrics.association.reference
    return RunPage(
        title=result.name,
        about=describe_source(described),
        sequence=SequenceComparison(
            result.name, str(described.get("source", "")), reference, accuracy.reference, [result]
        ),
        picture=picture,
        caption=_CAPTION,
        warnings=[*describe_warnings(summary), *accuracy.notes],
        summary=describe_results(summary),
        changed=changed_settings(tree),
        settings=settings,
    )

"""report.html, map.png and trajectory.png of a run, drawn from the files of its directory."""

import io
import logging
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from lidarslam.config.settings import Config, load_config, read_yaml
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.text import count, scan_span, small_length, up_to
from lidarslam.evaluation.comparison.comparison import GROUND_TRUTH, MethodResult, ScanSeries, SequenceComparison
from lidarslam.evaluation.report.report import render_run
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.storage import directory as files
from lidarslam.storage.directory import MAP_TILES, SCANS_CSV, RunDirectory, flat
from lidarslam.storage.finished_run import read_scans, read_summary, read_trajectory, where_astray
from lidarslam.viewer.picture import draw_runs, fit_frame, load_drawn_runs

logger = logging.getLogger(__name__)

_NO_CLOUD = PointCloud(np.empty((0, 3)), np.empty((0, 3)))
_CAPTION = (
    "From above, to scale; the colour is the height. The path is orange where tracking was degraded, red where it was"
    " lost."
)
# Stretches of lost scans that are listed; scans.csv has them all.
_LISTED = 3


def leave_report(run: Path, errors: MethodResult, reference: str = GROUND_TRUTH, notes: Sequence[str] = ()) -> bool:
    """Draw the page and the pictures of a run's directory; whether it could be done. A failure is a warning.

    A trajectory in the errors is the one that was compared with the reference, if that is not the run's own.
    """
    try:
        directory, (drawn,) = RunDirectory(run), load_drawn_runs([run])
        path, truth, frame = replace(drawn, cloud=_NO_CLOUD), _true_path(errors), fit_frame([drawn])
        alone = fit_frame([path], reference=truth, turn_deg=frame.view.turn_deg)
        _write_picture(directory, files.TRAJECTORY_PNG, draw_runs([path], alone, truth))
        picture = None
        if len(drawn.cloud):
            picture = _write_picture(directory, files.MAP_PNG, draw_runs([drawn], frame))
        directory.write_text(files.REPORT, _page(run, errors, reference, notes, picture))
    except KeyboardInterrupt:
        logger.warning("%s: no %s was drawn: interrupted", run, files.REPORT)
    except Exception as error:
        logger.warning("%s: no %s was drawn: %s", run, files.REPORT, error or type(error).__name__)
        logger.info("raised here:", exc_info=True)
    else:
        return True
    return False


def _true_path(errors: MethodResult) -> FloatArray | None:
    """Positions of the reference in the run's world; None without one, or in the frame of a camera."""
    if errors.metrics is None or errors.trajectory is not None:
        return None
    reference = errors.metrics.association.reference
    return reference.transformed(inverse(errors.metrics.T_reference_estimate)).positions


def _write_picture(directory: RunDirectory, name: str, pixels: NDArray[np.uint8]) -> str:
    """Write a PNG file; its content in base64."""
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, format="PNG")
    with directory.replacing(name) as partial:
        partial.write_bytes(content.getvalue())
    return b64encode(content.getvalue()).decode()


def _page(run: Path, errors: MethodResult, reference_name: str, notes: Sequence[str], picture: str | None) -> str:
    summary, settings = read_summary(run), (run / files.CONFIG).read_text(encoding="utf-8")
    described = read_yaml(run / files.CONFIG).get(files.RUN_SECTION) or {}
    name, where = run.resolve().name, where_astray(summary)
    result = replace(errors, name=name, status="ok" if where is None else "lost", message=where or "")
    result = with_run(replace(result, peak_rss_mb=summary["peak_rss_mb"]), run)
    result = replace(result, trajectory=errors.trajectory or result.trajectory, series=_series(run, result.scans))
    reference = None if errors.metrics is None else errors.metrics.association.reference
    return render_run(
        name,
        SequenceComparison(name, str(described.get("source", "")), reference, reference_name, [result]),
        about=describe_source(described),
        picture=picture,
        caption=_CAPTION,
        warnings=[*describe_warnings(summary), *notes],
        summary=describe_results(summary),
        changed=changed_settings(load_config(run / files.CONFIG)),
        settings=settings,
    )


def with_run(result: MethodResult, run: Path) -> MethodResult:
    """The result with the content of a run directory."""
    trajectory, summary = read_trajectory(run), read_summary(run)
    lost = read_scans(run, len(trajectory)).lost
    try:
        ms = {stage: values["median"] for stage, values in summary["ms_per_scan"].items()}
        return replace(
            result,
            scans=len(trajectory),
            trajectory=trajectory,
            lost=lost,
            lost_reasons=tuple(stretch["reason"] for stretch in summary["lost"]),
            map_entropy=summary["map_entropy"],
            elapsed_ms_per_scan=summary["elapsed_ms_per_scan"],
            latency_ms_median=summary["latency_ms"]["median"],
            latency_ms_p99=summary["latency_ms"]["p99"],
            ms_per_scan_median=ms.pop("total"),
            ms_per_scan_p95=summary["ms_per_scan"]["total"]["p95"],
            ms_per_scan_p99=summary["ms_per_scan"]["total"]["p99"],
            stage_ms=ms,
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{run / files.SUMMARY}: not a run's summary ({error!r}); make the run again") from error


def _series(run: Path, scans: int) -> ScanSeries | None:
    """The registration of each scan; None where no table has been kept."""
    table = read_scans(run, scans)
    if not table.rows:
        return None
    stamps = table.numbers("stamp")
    columns = (table.numbers(name) for name in ("residual_m", "inlier_ratio", "points_used"))
    return ScanSeries(stamps - stamps[:1], table.statuses, *columns)


def describe_source(described: Mapping[str, Any]) -> list[str]:
    """Lines that describe the run, from config.yaml's section about it."""
    chosen = {name: described.get(name) for name in ("start", "stop", "step")}
    lines = [f"Source: {described.get('source', 'unknown')}"]
    if chosen != {"start": 0, "stop": None, "step": 1}:
        lines.append(f"Scans: {', '.join(f'{name} {value}' for name, value in chosen.items())}")
    if described.get("prior"):
        lines.append(f"Prior: {described['prior']}")
    return [*lines, f"lidarslam {described.get('version', '')}"]


def describe_results(summary: Mapping[str, Any]) -> dict[str, str]:
    """Quantities of summary.json in words, except those in the report's tables."""
    lost, degraded, scans = summary["lost_scans"], summary["degraded_scans"], summary["scans"]
    shown = {
        "path": f"{summary['length_m']:.1f} m in {summary['duration_s']:.1f} s, {count(scans, 'scan')}",
        "tracking": f"{scans - lost - degraded:,} ok, {degraded:,} degraded, {lost:,} lost",
    }
    if summary["map_points"]:
        moved = summary["map_points_moved"]
        removed = f"; {count(moved, 'point')} of moving objects removed" if moved else ""
        voxel = small_length(summary["map_voxel_size_m"])
        tiles = summary.get("map_tiles")
        whole = f", of {tiles['points']:,} in {MAP_TILES}/" if tiles else ""
        shown["map"] = f"{count(summary['map_points'], 'point')}{whole}, voxels of {voxel}{removed}"
    if summary["pose_graph"] is not None:
        graph = summary["pose_graph"]
        closed = count(summary["loop_closures"], "loop")
        shown["pose graph"] = (
            f"{count(graph['keyframes'], 'keyframe')}, {closed} closed, poses corrected by"
            f" {up_to(graph['largest_correction_m'])}"
        )
    return shown


def describe_warnings(summary: Mapping[str, Any]) -> Iterator[str]:
    """Lost stretches, and the warnings of summary.json."""
    for stretch in summary["lost"][:_LISTED]:
        yield f"tracking was lost on {scan_span(stretch['first'], stretch['last'])}: {stretch['reason']}"
    if (more := len(summary["lost"]) - _LISTED) > 0:
        yield f"tracking was lost on {more} more {'stretch' if more == 1 else 'stretches'}; {SCANS_CSV} lists them"
    yield from summary["warnings"]


def changed_settings(config: Config) -> dict[str, str]:
    """Settings that differ from the defaults, with these."""
    usual, ours = (flat(one.model_dump(mode="json")) for one in (Config(), config))
    changed = {name: value for name, value in ours.items() if value != usual.get(name)}
    return {name: f"{_as_yaml(value)} (default {_as_yaml(usual.get(name))})" for name, value in changed.items()}


def _as_yaml(value: Any) -> str:
    if isinstance(value, str):
        return value
    return str(yaml.safe_dump(value, default_flow_style=True)).removesuffix("\n").removesuffix("\n...")

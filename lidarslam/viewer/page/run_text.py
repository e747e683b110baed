"""What the page of a run says in words: its source, a summary, warnings, settings that differ from the defaults."""

from collections.abc import Iterator, Mapping
from typing import Any

import yaml
from pydantic import ValidationError

from lidarslam.config.settings import Config
from lidarslam.core.text import count, scan_span, small_length
from lidarslam.storage.directory import MAP_TILES, RUN_SECTION, SCANS_CSV

# Stretches of lost scans that are listed; scans.csv has them all.
_LISTED = 3


def describe_source(described: Mapping[str, Any]) -> list[str]:
    """Lines about what was run, from config.yaml's section about it."""
    chosen = {name: described.get(name) for name in ("start", "stop", "step")}
    part = chosen != {"start": 0, "stop": None, "step": 1}
    lines = [f"Source: {described.get('source', 'unknown')}"]
    lines += [f"Scans: {', '.join(f'{name} {value}' for name, value in chosen.items())}"] if part else []
    lines += [f"Prior: {described['prior']}"] if described.get("prior") else []
    return [*lines, f"lidarslam {described.get('version', '')}"]


def describe_results(summary: Mapping[str, Any]) -> dict[str, str]:
    """Quantities of summary.json in words, but for those in the report's tables."""
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
            f"{count(graph['keyframes'], 'keyframe')}, {closed} closed, poses corrected by up to"
            f" {small_length(graph['largest_correction_m'])}"
        )
    return shown


def describe_warnings(summary: Mapping[str, Any]) -> Iterator[str]:
    """Lost stretches, and the warnings of summary.json."""
    for stretch in summary["lost"][:_LISTED]:
        yield f"tracking was lost on {scan_span(stretch['first'], stretch['last'])}: {stretch['reason']}"
    if (more := len(summary["lost"]) - _LISTED) > 0:
        yield f"tracking was lost on {more} more {'stretch' if more == 1 else 'stretches'}; {SCANS_CSV} lists them"
    yield from summary["warnings"]


def changed_settings(tree: Mapping[str, Any]) -> dict[str, str] | None:
    """Settings of config.yaml that differ from the defaults, with these; None where the file is of another version."""
    try:
        used = Config.model_validate({name: value for name, value in tree.items() if name != RUN_SECTION})
    except ValidationError:
        return None
    usual = dict(_flat(Config().model_dump(mode="json")))
    ours = _flat(used.model_dump(mode="json"))
    return {
        name: f"{_text(value)} (default {_text(usual.get(name))})" for name, value in ours if value != usual.get(name)
    }


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Values by their dotted names."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _text(value: Any) -> str:
    """A value as in YAML."""
    if isinstance(value, str):
        return value
    return str(yaml.safe_dump(value, default_flow_style=True)).removesuffix("\n").removesuffix("\n...")

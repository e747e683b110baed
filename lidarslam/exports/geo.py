"""A run in UTM: trajectory and map, placed by the GNSS track of its recording."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.files import cannot_write, make_directory, replacing
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory, write_tum
from lidarslam.exports.gnss import read_gnss
from lidarslam.exports.new_file import require_new
from lidarslam.exports.projection import Utm, utm_around
from lidarslam.exports.source import read_source
from lidarslam.mapping.global_map.point_cloud import write_laz
from lidarslam.mapping.global_map.products.georeference import (
    Georeference,
    GnssTrack,
    TooFewPositionsError,
    align_to_track,
)
from lidarslam.storage.finished_run import load_map, read_trajectory

MAP, TRAJECTORY, GEOJSON, KML = "map.laz", "trajectory_utm.tum", "trajectory.geojson", "trajectory.kml"
ABOUT = "georeference.json"
_FILES = (MAP, TRAJECTORY, GEOJSON, KML, ABOUT)
# A heading that is off by more displaces the end of 100 m by 5 m.
_LARGEST_HEADING_SIGMA_DEG = 3.0


@dataclass(frozen=True, eq=False)
class GeoRun:
    """A run, and where it lies."""

    run: Path
    trajectory: Trajectory
    track: GnssTrack
    utm: Utm
    placed: Georeference


def georeference(run: Path) -> GeoRun:
    """Align a run with the GNSS track of its recording.

    Raises:
        InputError: there is no run, its recording has no GNSS, or the track is too short to determine the heading.
        ConfigError: pyproj is not installed.
    """
    trajectory, source = read_trajectory(run), read_source(run, "has the GNSS positions")
    track = read_gnss(source.path, source.reader)
    utm = utm_around(track.geodetic)
    try:
        placed = align_to_track(trajectory, track, utm.project(track.geodetic), utm.scale)
    except TooFewPositionsError as error:
        raise InputError(f"{source.path}: {error}") from error
    if placed.heading_sigma_deg > _LARGEST_HEADING_SIGMA_DEG:
        raise InputError(
            f"{run}: too short to determine the heading from its GNSS positions: they leave"
            f" {placed.heading_sigma_deg:.1f} deg open, more than {_LARGEST_HEADING_SIGMA_DEG:g}"
        )
    return GeoRun(run, trajectory, track, utm, placed)


def export_geo(geo: GeoRun, out: Path, overwrite: bool) -> Iterator[str]:
    """Write map, trajectory and the pose of the world; lines about them.

    Raises:
        OutputError: a file cannot be written, or is there already.
    """
    make_directory(out)
    for name in _FILES:
        require_new(out / name, overwrite)
    placed, utm = geo.placed, geo.utm
    T = placed.T_map_world @ geo.trajectory.T_world_lidar
    T[:, :3, 3] = placed.positions(geo.trajectory.positions)
    trajectory = Trajectory(geo.trajectory.stamps, T)
    lines = utm.geodetic(trajectory.positions)
    cloud = load_map(geo.run)
    written = [name for name in _FILES if name != MAP or len(cloud)]
    try:
        if len(cloud):
            normals = cloud.normals @ placed.T_map_world[:3, :3].T
            with replacing(out / MAP) as partial:
                write_laz(partial, replace(cloud, points=placed.positions(cloud.points), normals=normals), utm.wkt)
        with replacing(out / TRAJECTORY) as partial:
            write_tum(partial, trajectory)
        texts = {
            GEOJSON: json.dumps(_geojson(geo, lines)),
            KML: _kml(geo.run.resolve().name, lines),
            ABOUT: json.dumps(_about(geo), indent=2),
        }
        for name, text in texts.items():
            with replacing(out / name) as partial:
                partial.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise cannot_write(out, error) from error
    yield f"{utm.name}, EPSG:{utm.epsg}, scale {utm.scale:.6f}"
    yield f"{placed.matched:,} GNSS positions; residual {placed.rms_m:.2f} m RMS, {placed.median_m:.2f} m median"
    yield f"heading known to {placed.heading_sigma_deg:.2f} deg"
    yield from (f"note: {note}" for note in geo.track.notes)
    yield f"written to {', '.join(str(out / name) for name in written)}"


def _about(geo: GeoRun) -> dict[str, Any]:
    placed, utm = geo.placed, geo.utm
    return {
        "epsg": utm.epsg,
        "crs": utm.name,
        "T_utm_world": placed.T_map_world.tolist(),
        "scale": placed.scale,
        "meridian_convergence_deg": utm.convergence_deg,
        "gnss_positions": placed.matched,
        "residual_rms_m": placed.rms_m,
        "residual_median_m": placed.median_m,
        "heading_sigma_deg": placed.heading_sigma_deg,
        "lidar_antenna_m": geo.track.lidar_antenna.tolist(),
        "notes": list(geo.track.notes),
    }


def _geojson(geo: GeoRun, geodetic: FloatArray) -> dict[str, Any]:
    """RFC 7946: longitude, latitude, height."""
    line = {"type": "LineString", "coordinates": np.round(geodetic[:, [1, 0, 2]], 9).tolist()}
    about = {"name": geo.run.resolve().name, "times": geo.trajectory.stamps.tolist()}
    return {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": about, "geometry": line}]}


def _kml(name: str, geodetic: FloatArray) -> str:
    """OGC KML 2.2, a line on the ground: heights of GNSS are above the ellipsoid, those of KML above the sea."""
    points = " ".join(f"{longitude:.9f},{latitude:.9f}" for latitude, longitude in geodetic[:, :2])
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark>'
        f"<name>{escape(name)}</name><LineString><tessellate>1</tessellate><coordinates>{points}</coordinates>"
        "</LineString></Placemark></kml>"
    )

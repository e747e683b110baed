"""A run in UTM: trajectory and map, placed by the GNSS track of its recording."""

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.files import make_directory, written
from lidarslam.core.geometry import FloatArray
from lidarslam.core.plugins import require_library
from lidarslam.core.trajectory import Trajectory, format_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.mounting import recorded_axes
from lidarslam.datasets.published.kitti import KittiRawRecording
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_imu import static_transform
from lidarslam.datasets.ros.bag_message import deserialize
from lidarslam.datasets.ros.rosbag import BagRecording
from lidarslam.exports.source import read_source, require_new
from lidarslam.mapping.global_map.georeference import Georeference, GnssTrack, TooFewPositionsError, align_to_track
from lidarslam.mapping.global_map.point_cloud import write_laz
from lidarslam.storage.finished_run import load_map, read_trajectory

MAP, TRAJECTORY, GEOJSON, KML = "map.laz", "trajectory_utm.tum", "trajectory.geojson", "trajectory.kml"
ABOUT = "georeference.json"
_FILES = (MAP, TRAJECTORY, GEOJSON, KML, ABOUT)
# A heading that is off by more displaces the end of 100 m by 5 m.
_LARGEST_HEADING_SIGMA_DEG = 3.0
_FIX_TYPE = "sensor_msgs/msg/NavSatFix"
_NO_FIX = -1
_SAME_PLACE = "where the antenna is on the sensor is unknown, so it is taken to be at the LiDAR"
_NORTH, _SOUTH = 32600, 32700  # EPSG codes of the zones of WGS 84


@dataclass(frozen=True, eq=False)
class Utm:
    """The UTM zone of a place."""

    epsg: int  # code of the coordinate system
    name: str  # such as WGS 84 / UTM zone 32N
    wkt: str  # its definition, in the first version of the language, which LAS has
    scale: float  # of the projection at the place
    convergence_deg: float  # of the meridians there: grid north is this far east of true north
    _forward: Any  # pyproj's transformer

    def project(self, geodetic: FloatArray) -> FloatArray:
        """East, north and height (N, 3) of latitude, longitude and height."""
        east, north = self._forward.transform(geodetic[:, 1], geodetic[:, 0])
        return np.column_stack([east, north, geodetic[:, 2]])

    def geodetic(self, projected: FloatArray) -> FloatArray:
        """Latitude, longitude and height (N, 3) of east, north and height."""
        longitude, latitude = self._forward.transform(projected[:, 0], projected[:, 1], direction="INVERSE")
        return np.column_stack([latitude, longitude, projected[:, 2]])


def utm_around(geodetic: FloatArray) -> Utm:
    """The zone of most positions (N, 3): latitude and longitude in degrees, height."""
    pyproj = require_library("pyproj", "georeferenced output needs", "pip install 'lidarslam[geo]'")
    latitude_deg, longitude_deg = np.median(geodetic[:, :2], axis=0).tolist()
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    epsg = (_NORTH if latitude_deg >= 0.0 else _SOUTH) + zone
    crs = pyproj.CRS.from_epsg(epsg)
    factors = pyproj.Proj(crs).get_factors(longitude_deg, latitude_deg)
    return Utm(
        epsg=epsg,
        name=str(crs.name),
        wkt=str(crs.to_wkt("WKT1_GDAL")),
        scale=float(factors.meridional_scale),
        convergence_deg=float(factors.meridian_convergence),
        _forward=pyproj.Transformer.from_crs(4326, crs, always_xy=True),
    )


def export_geo(run: Path, out: Path, overwrite: bool) -> Iterator[str]:
    """Write map, trajectory and the pose of the world, aligned with the recording's GNSS track; lines about them."""
    trajectory, of = read_trajectory(run), read_source(run, "has the GNSS positions")
    track = read_gnss(of.source, of.reader)
    utm = utm_around(track.geodetic)
    try:
        placed = align_to_track(trajectory, track, utm.project(track.geodetic), utm.scale)
    except TooFewPositionsError as error:
        raise InputError(f"{of.source}: {error}") from error
    if placed.heading_sigma_deg > _LARGEST_HEADING_SIGMA_DEG:
        raise InputError(
            f"{run}: too short to determine the heading from its GNSS positions: they leave"
            f" {placed.heading_sigma_deg:.1f} deg open, more than {_LARGEST_HEADING_SIGMA_DEG:g}"
        )
    make_directory(out)
    for name in _FILES:
        require_new(out / name, overwrite, run)
    T = placed.T_map_world @ trajectory.T_world_lidar
    T[:, :3, 3] = placed.positions(trajectory.positions)
    cloud, geodetic, name = load_map(run), utm.geodetic(T[:, :3, 3]), run.resolve().name
    if len(cloud):
        normals = cloud.normals @ placed.T_map_world[:3, :3].T
        with written(out / MAP) as partial:
            write_laz(partial, replace(cloud, points=placed.positions(cloud.points), normals=normals), utm.wkt)
    texts = {
        TRAJECTORY: format_tum(Trajectory(trajectory.stamps, T)),
        GEOJSON: json.dumps(_geojson(name, trajectory.stamps, geodetic)) + "\n",
        KML: _kml(name, geodetic) + "\n",
        ABOUT: json.dumps(_about(placed, utm, track), indent=2) + "\n",
    }
    for file, text in texts.items():
        with written(out / file) as partial:
            partial.write_text(text, encoding="utf-8")
    yield f"{utm.name}, EPSG:{utm.epsg}, scale {utm.scale:.6f}"
    yield f"{placed.matched:,} GNSS positions; residual {placed.rms_m:.2f} m RMS, {placed.median_m:.2f} m median"
    yield f"heading known to {placed.heading_sigma_deg:.2f} deg"
    yield from (f"note: {note}" for note in track.notes)
    yield f"written to {', '.join(str(out / name) for name in _FILES if name != MAP or len(cloud))}"


def _about(placed: Georeference, utm: Utm, track: GnssTrack) -> dict[str, Any]:
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
        "lidar_antenna_m": track.lidar_antenna.tolist(),
        "notes": list(track.notes),
    }


def _geojson(name: str, stamps: FloatArray, geodetic: FloatArray) -> dict[str, Any]:
    """RFC 7946: longitude, latitude, height."""
    line = {"type": "LineString", "coordinates": np.round(geodetic[:, [1, 0, 2]], 9).tolist()}
    about = {"name": name, "times": stamps.tolist()}
    return {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": about, "geometry": line}]}


def _kml(name: str, geodetic: FloatArray) -> str:
    """OGC KML 2.2, a line on the ground: heights of GNSS are above the ellipsoid, those of KML above the sea."""
    points = " ".join(f"{longitude:.9f},{latitude:.9f}" for latitude, longitude in geodetic[:, :2])
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark>'
        f"<name>{escape(name)}</name><LineString><tessellate>1</tessellate><coordinates>{points}</coordinates>"
        "</LineString></Placemark></kml>"
    )


def read_gnss(source: Path, config: ReaderConfig) -> GnssTrack:
    """Read the GNSS track of a recording."""
    recording, T_upright_recorded = recorded_axes(open_recording(source, config))
    track = _of_drive(recording) if isinstance(recording, KittiRawRecording) else None
    track = _of_bag(*recording.frames) if isinstance(recording, BagRecording) else track
    if track is None:
        readable = "KITTI raw drives with oxts, and bags with sensor_msgs/NavSatFix"
        raise InputError(f"{source}: has no GNSS positions; it is read from {readable}")
    return replace(track, lidar_antenna=T_upright_recorded[:3, :3] @ track.lidar_antenna)


def _of_drive(drive: KittiRawRecording) -> GnssTrack | None:
    rows = drive.oxts
    if rows is None:
        return None
    T_lidar_imu = None if drive.imu is None else drive.imu.T_lidar_imu
    timed = np.isfinite(rows.stamps)
    return GnssTrack(rows.stamps[timed], rows.geodetic[timed], rows.accuracy_m[timed], *_antenna(T_lidar_imu))


def _of_bag(bag: BagFile, lidar_frame: str) -> GnssTrack | None:
    """Of the topic with the most fixes; those that state no fix are left out."""
    topics = [topic for topic in bag.topics if topic.message_type == _FIX_TYPE]
    if not topics:
        return None
    stamps, geodetic, sigmas, frame_id = [], [], [], ""
    for message in bag.messages(max(topics, key=lambda topic: topic.messages)):
        if message.damage is not None:
            continue
        with suppress(Exception):  # damaged bytes make rosbags raise nearly anything; the others remain
            fix = deserialize(message.raw, _FIX_TYPE, bag.ros2)
            if fix.status.status == _NO_FIX or not np.isfinite([fix.latitude, fix.longitude, fix.altitude]).all():
                continue
            horizontal = fix.position_covariance.reshape(3, 3)[:2, :2]
            variance = 0.5 * horizontal.trace() if fix.position_covariance_type else np.nan
            stamps.append((message.header_ns or message.record_ns) / 10**9)
            geodetic.append([fix.latitude, fix.longitude, fix.altitude])
            sigmas.append(float(np.sqrt(variance)))
            frame_id = message.frame_id
    if not stamps:
        return None
    antenna, order = _antenna(static_transform(bag, lidar_frame, frame_id)), np.argsort(stamps, kind="stable")
    return GnssTrack(np.array(stamps)[order], np.array(geodetic)[order], np.array(sigmas)[order], *antenna)


def _antenna(T_lidar_antenna: FloatArray | None) -> tuple[FloatArray, tuple[str, ...]]:
    """Where the antenna is, and a note where that is not known."""
    return (np.zeros(3), (_SAME_PLACE,)) if T_lidar_antenna is None else (T_lidar_antenna[:3, 3], ())

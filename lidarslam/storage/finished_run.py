"""Runs and comparisons read back from disk, and where they are by default."""

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.files import reading
from lidarslam.core.geometry import FloatArray
from lidarslam.core.json_text import ANY_OBJECT, read_json
from lidarslam.core.scan import PointAttributes
from lidarslam.core.text import require_name, safe_name
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.folders.scan_files import read_pcd, read_ply
from lidarslam.datasets.point_table import coordinates, read_colours, read_intensities, scalar_fields
from lidarslam.datasets.published.evalio import full_name, is_of_evalio, resolved
from lidarslam.datasets.registry import absent, choose_reader, takes_sequence
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.storage import directory as files
from lidarslam.storage.directory import TRAJECTORY_TUM, About, require_whole

_LISTED = 5
# How deep a folder is searched for runs.
_PATTERNS = tuple("*/" * depth + files.TRAJECTORY_TUM for depth in (1, 2, 3))


def not_a_run(path: Path) -> str:
    """Why nothing can be read from a path that should be a run directory."""
    if not path.exists():
        return absent(path)
    with suppress(InputError):
        choose_reader(path)
        return f"{path}: is a recording, not a run directory; make one with lidarslam run {path} --out RUN"
    runs = sorted(str(file.parent) for pattern in _PATTERNS for file in path.glob(pattern))
    hint = f"it holds the runs {', '.join(runs[:_LISTED])}" if runs else "lidarslam run makes one from a recording"
    return f"{path}: is not a run directory (no {files.TRAJECTORY_TUM}); {hint}"


_CLOUD_READERS: dict[str, Callable[[Path], NDArray[np.void]]] = {".ply": read_ply, ".pcd": read_pcd}
# In .ply and in .pcd files.
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run as it is viewed."""

    name: str  # of its directory
    trajectory: Trajectory  # the final poses
    lost: NDArray[np.bool_]  # (N,) which scans were lost
    map_points: FloatArray  # (M, 3) in the world, none when the map is missing
    loops: NDArray[np.intp]  # (L, 2) pairs of scans between which loops were closed
    frame_of: Path | None = None  # the run, or file, in whose map this one was localised
    path: Path | None = None  # its path, resolved


def shown_map(path: Path) -> PointCloud:
    """The map of a run as it is drawn; that in which it was localised, if it has none and that one still exists."""
    cloud = load_map(path)
    other = localised_in(path)
    return load_map(other) if not len(cloud) and other is not None and other.exists() else cloud


def localised_in(path: Path) -> Path | None:
    """The map that a run was localised in; None for any other run, and for a file."""
    about = read_summary(path).get("localisation") if path.is_dir() else None
    return None if about is None else Path(about["map"])


def is_run(path: Path) -> bool:
    """Whether a folder holds a run, finished or not."""
    return (path / files.TRAJECTORY_TUM).is_file() or (path / files.ABOUT).is_file()


def load_run(path: Path) -> FinishedRun:
    """Read a run directory; InputError where there is no run, or a file of it is damaged."""
    trajectory = read_trajectory(path)
    lost, loops = read_scans(path, len(trajectory)).lost, _loops(path, len(trajectory))
    cloud, other = shown_map(path), localised_in(path)
    name, frame_of = path.resolve().name, None if other is None else other.resolve()
    return FinishedRun(name, trajectory, lost, cloud.points, loops, frame_of, path.resolve())


def read_trajectory(path: Path) -> Trajectory:
    """The final poses of a run directory; InputError without a finished run, or where they are damaged or cut off."""
    require_whole(path)
    file = path / files.TRAJECTORY_TUM
    if not file.is_file():
        raise InputError(not_a_run(path))
    trajectory, scans = read_tum(file), read_summary(path).get("scans")
    if scans not in (None, len(trajectory)):
        raise InputError(
            f"{file}: holds {len(trajectory):,} poses, {files.SUMMARY} says {scans:,} scans: one of them is cut off;"
            " copy it or make the run again"
        )
    return trajectory


def load_map(path: Path) -> PointCloud:
    """The map of a run directory, or a .ply or .pcd file, with normals and attributes; empty when the run has none."""
    file = path / files.MAP_PLY if path.is_dir() else path
    if not path.exists():
        raise InputError(absent(path))
    require_whole(path)
    if path.is_dir() and not file.is_file() and not (path / files.TRAJECTORY_TUM).is_file():
        raise InputError(not_a_run(path))
    if not file.is_file() or not file.stat().st_size:
        return PointCloud(np.empty((0, 3)), np.empty((0, 3)))
    read = _CLOUD_READERS.get(file.suffix.lower())
    if read is None:
        raise InputError(f"{file}: not a readable point cloud; expected a .ply or .pcd file with points")
    table = read(file)
    try:
        points = coordinates(table)
    except ValueError as error:
        raise InputError(f"{file}: not a readable point cloud: {error}") from None
    known = next((names for names in _NORMALS if set(names) <= set(table.dtype.names or ())), None)
    normals = np.tile([0.0, 0.0, 1.0], (len(table), 1))  # upright where there are none
    if known is not None:
        normals = np.column_stack([table[name].astype(np.float64) for name in known])
    usable = np.asarray(np.isfinite(np.hstack([points, normals])).all(axis=1))
    if not usable.any():
        raise InputError(f"{file}: not a readable point cloud; no point is finite")
    names = scalar_fields(table)
    attributes = PointAttributes(
        intensity=read_intensities(table),
        rgb=read_colours(table),
        ring=table["ring"].astype(np.int32) if "ring" in names else None,
        time=table["time"].astype(np.float64) if "time" in names else None,
    )
    return PointCloud(points[usable], normals[usable], attributes.select(usable))


def _loops(path: Path, scans: int) -> NDArray[np.intp]:
    """The loops that a run closed; none for a run without a graph."""
    loops = (read_summary(path).get("pose_graph") or {"loops": []})["loops"]
    pairs = [(loop["first_scan"], loop["second_scan"]) for loop in loops if loop["accepted"]]
    found = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return found[((found >= 0) & (found < scans)).all(axis=1)]


@dataclass(frozen=True, eq=False)
class ScanTable:
    """scans.csv of a run."""

    file: Path
    rows: Sequence[Mapping[str, str]]  # of each scan; none where no table has been kept
    statuses: Sequence[Status]  # of each scan; ok where no table has been kept

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(N,) whether tracking was lost."""
        return np.array([status is Status.LOST for status in self.statuses], dtype=np.bool_)

    def numbers(self, name: str) -> FloatArray:
        """A column (N,), NaN where there is no number."""
        if not self.rows:
            return np.full(len(self.statuses), np.nan)
        try:
            return np.array([float(row.get(name) or "nan") for row in self.rows])
        except ValueError as error:
            raise InputError(f"{self.file}: not a run's table ({error}); make the run again") from error


def read_scans(path: Path, poses: int) -> ScanTable:
    """The table of a run; InputError where it is damaged, or has not a row for each pose."""
    file = path / files.SCANS_CSV
    if not file.is_file():
        return ScanTable(file, (), [Status.OK] * poses)
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = list(csv.DictReader(lines))
        statuses = [Status(row["status"]) for row in rows]
    except (KeyError, ValueError, csv.Error) as error:  # not UTF-8 is a ValueError
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise InputError(f"{file}: not a run's table ({reason}); make the run again") from error
    if len(rows) != poses:
        raise InputError(f"{file}: has {len(rows):,} rows for {poses:,} poses; it is cut off, make the run again")
    return ScanTable(file, rows, statuses)


# Share of the path, of a metre at least, that may be unconstrained.
_MOST_UNCONSTRAINED, _SHORTEST_M = 0.1, 1.0


def is_unconstrained(unconstrained_m: float, length_m: float) -> bool:
    """Whether the length of a path is unknown because hardly any surface constrains much of it."""
    return unconstrained_m > _MOST_UNCONSTRAINED * max(length_m, _SHORTEST_M)


# Share of a recording's scans that may be unreadable.
_MOST_UNREADABLE = 0.1
# Share of the mapped points that other scans see through: up to 15 % amid a crowd or next to traffic at right poses,
# 23 % and more where scans were registered to their own range noise. A sensor that stands in traffic has more.
_MOST_MOVED, _STANDING_MPS = 0.2, 0.1


def too_many_unreadable(unreadable: int, scans: int) -> str | None:
    """The fault of a run if much of its recording is unreadable, given the numbers of unreadable and of used scans."""
    if unreadable <= _MOST_UNREADABLE * (unreadable + scans):
        return None
    return f"{unreadable:,} of {unreadable + scans:,} scans could not be read"


def seen_through(points: int, moved: int, length_m: float, duration_s: float) -> str | None:
    """The fault of a moving sensor's map if scans see through many of the mapped points, which were then removed."""
    if not points or moved <= _MOST_MOVED * (points + moved) or length_m <= _STANDING_MPS * duration_s:
        return None
    return f"scans see through {100.0 * moved / (points + moved):.0f} % of the points that others mapped"


def where_astray(summary: Mapping[str, Any]) -> str | None:
    """Why a run ends with exit status 3, by its summary.json; None where it is reliable."""
    for first in summary["lost"]:
        return f"first lost on scan {first['first']}: {first['reason']}"
    for slid in summary.get("map_contradictions", []):
        return f"its map contradicts itself between scans {slid['first']} and {slid['last']}"
    unconstrained_m = summary.get("unconstrained_m", 0.0)
    if is_unconstrained(unconstrained_m, summary.get("length_m", 0.0)):
        return f"{unconstrained_m:.1f} m of its path are hardly constrained"
    if (lacking := too_many_unreadable(summary.get("unreadable_scans", 0), summary.get("scans", 0))) is not None:
        return lacking
    return seen_through(*(summary.get(key, 0) for key in ("map_points", "map_points_moved", "length_m", "duration_s")))


def read_summary(path: Path) -> dict[str, Any]:
    """The content of a run's summary.json, empty when there is none; InputError where it is damaged."""
    file = path / files.SUMMARY
    if not file.is_file():
        return {}
    with reading(file, "not a run's summary", "make the run again"):
        return read_json(file, ANY_OBJECT)


# Each recording's folder holds its own comparison.json, where there are several.
COMPARISON, REPORT_HTML, REPORT_MD = "comparison.json", "report.html", "report.md"
# Next to the recordings' folders: recordings that a benchmark has made.
RECORDINGS = "recordings"
RESERVED = frozenset({COMPARISON, REPORT_HTML, REPORT_MD, RECORDINGS})


def run_directories(path: Path) -> list[Path]:
    """The run directories of a comparison of one recording, in its order; any other path itself.

    InputError where the comparison is of several recordings, has no run, or its file is damaged.
    """
    file = path / COMPARISON
    if not file.is_file() or (path / TRAJECTORY_TUM).is_file():
        return [path]
    try:
        content = read_json(file, ANY_OBJECT)
        sequences = content.get("sequences")
        if sequences is not None:
            names = ", ".join(str(path / sequence["sequence"]) for sequence in sequences)
            raise InputError(f"{path}: compares several recordings, in worlds of their own; name one of {names}")
        places = [method["run"] for method in content["methods"].values() if method["run"]]
        # A recording's name and a method's: a comparison names no runs elsewhere.
        runs = [Path(*(require_name(part, "run") for part in place.split("/"))) for place in places]
    except (OSError, ValueError, KeyError, TypeError, ConfigError) as error:
        raise InputError(f"{file}: not a comparison ({error!r}); make it again") from error
    if not runs:
        raise InputError(f"{path}: none of its methods came to a result")
    # Next to its methods' folders, or, of one of several recordings, in the same folder as these.
    return [path / run if (path / run).is_dir() else path.parent / run for run in runs]


RUNS = Path("runs")
_TIME = "%Y-%m-%d_%H-%M-%S"
# Of a simulated recording that was itself written to a default place.
_TIMED = re.compile(r"_\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d(-\d+)?$")


def new_place(folder: Path, name: str) -> Path:
    """A path that does not exist yet: FOLDER/NAME_TIME, with the local time; a number follows if the name is taken."""
    first = folder / f"{safe_name(name)}_{datetime.now():{_TIME}}"
    numbered = (first.with_name(f"{first.name}-{number}") for number in count(2))
    return first if not first.exists() else next(path for path in numbered if not path.exists())


def source_name(source: Path, sequence: str | None = None) -> str:
    """The name for the results of a recording: its file or folder, without suffix and time.

    Of a folder with several sequences, followed by the one that is read; of evalio's, with that of the data set.
    """
    source = resolved(source)
    if is_of_evalio(source):
        return safe_name(full_name(source))
    name = _TIMED.sub("", source.name if source.is_dir() else source.stem)
    chooses = sequence not in (None, source.name) and takes_sequence(source)
    return safe_name(f"{name}_{sequence}" if chooses else name)


def latest_run() -> Path | None:
    """The run in `runs` whose trajectory was written last; None without any. Running ones are left out."""
    runs = (path.parent for path in RUNS.glob(f"*/{TRAJECTORY_TUM}"))
    found = [run for run in runs if (about := _about(run)) is None or about.standing != "at work"]
    return max(found, key=lambda run: (run / TRAJECTORY_TUM).stat().st_mtime, default=None)


def unfinished_run(source: Path, sequence: str | None = None) -> Path:
    """The only unfinished run of a recording in `runs`; InputError where there is none, or there are several."""
    found = [path for path in sorted(RUNS.glob("*/")) if _is_of(path, source, sequence)]
    if not found:
        raise InputError(
            f"{RUNS}: holds no unfinished run of {source}; name one with --out, or leave --resume out to begin one"
        )
    if len(found) > 1:
        listed = ", ".join(map(str, found))
        raise InputError(f"{source}: has several unfinished runs ({listed}); name the one to resume with --out")
    return found[0]


def _is_of(run: Path, source: Path, sequence: str | None) -> bool:
    about = _about(run)
    if about is None or "merge" in about.description:
        return False
    reader = about.description.get("reader")
    same_sequence = not isinstance(reader, dict) or reader.get("sequence") == sequence
    return about.description.get("source") == str(resolved(source)) and same_sequence


def _about(run: Path) -> About | None:
    """The unfinished run there; None also where its file is damaged."""
    try:
        return About.read(run)
    except InputError:
        return None

"""One run on disk: names every file of it and writes each so that it is whole or absent."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from lidarslam.core.errors import OutputError

CONFIG = "config.yaml"
TRAJECTORY_TUM = "trajectory.tum"
TRAJECTORY_KITTI = "trajectory.kitti"
ODOMETRY_TUM = "odometry.tum"
MAP_PLY = "map.ply"
MAP_PCD = "map.pcd"
POSE_GRAPH = "pose_graph.g2o"
SCANS_CSV = "scans.csv"
SUMMARY = "summary.json"
METRICS = "metrics.json"
RERUN = "recording.rrd"

FILES = (
    CONFIG,
    TRAJECTORY_TUM,
    TRAJECTORY_KITTI,
    ODOMETRY_TUM,
    MAP_PLY,
    MAP_PCD,
    POSE_GRAPH,
    SCANS_CSV,
    SUMMARY,
    METRICS,
    RERUN,
)


class RunDirectory:
    """The directory of one run; only files named above are ever replaced or removed."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, path: Path, overwrite: bool = False) -> "RunDirectory":
        """Make the directory, or take over an existing one.

        An earlier run's files are removed when `overwrite` is given; whatever else lies there stays.

        Raises:
            OutputError: the directory holds a run already, or cannot be written.
        """
        try:
            path.mkdir(parents=True, exist_ok=True)
            earlier = [name for name in FILES if (path / name).exists()]
            if earlier and not overwrite:
                raise OutputError(
                    f"{path}: holds a run already ({', '.join(earlier[:3])}{', ...' if len(earlier) > 3 else ''});"
                    " name another directory, or replace it with --overwrite"
                )
            for name in earlier:
                (path / name).unlink()
            directory = cls(path)
            with directory.replacing(SUMMARY) as probe:
                probe.touch()
            (path / SUMMARY).unlink()
        except (FileExistsError, NotADirectoryError) as error:
            raise OutputError(f"{path}: a file is in the way; name another directory") from error
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
        return directory

    def __getitem__(self, name: str) -> Path:
        return self.path / name

    @contextlib.contextmanager
    def replacing(self, name: str) -> Iterator[Path]:
        """A path to write to; it takes the name when the block ends without an error, and is gone otherwise."""
        final = self.path / name
        partial = final.with_name(f".partial-{os.getpid()}-{name}")
        try:
            yield partial
            partial.replace(final)
        except OSError as error:
            raise OutputError(f"{final}: cannot be written ({error.strerror or error})") from error
        finally:
            partial.unlink(missing_ok=True)

    @contextlib.contextmanager
    def open_text(self, name: str) -> Iterator[TextIO]:
        """A text file to write to, whole or absent."""
        with self.replacing(name) as partial, partial.open("w", encoding="utf-8", newline="") as out:
            yield out

    def write_text(self, name: str, text: str) -> None:
        """Write one text file."""
        with self.open_text(name) as out:
            out.write(text)

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        """Write one JSON file; a number that is not finite is a mistake of ours and refused."""
        self.write_text(name, json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n")

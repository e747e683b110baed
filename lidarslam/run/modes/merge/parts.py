"""The recordings of a merge: opened and checked before anything is written, each with a run directory of its own."""

import re
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.files import only_writer, remove_partial_files
from lidarslam.core.tasks.tasks import SERIAL, Where
from lidarslam.core.text.names import safe_name
from lidarslam.datasets.published.evalio_names import resolved
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.config import MapFormat
from lidarslam.run.request import RunRequest
from lidarslam.run.run import require_apart
from lidarslam.storage import directory as files
from lidarslam.storage.about import About
from lidarslam.storage.directory import remove_run
from lidarslam.storage.summary_file import read_summary
from lidarslam.storage.unfinished import remove_unfinished

# The names that `open_parts` gives to directories; whatever else a summary names is not ours to remove.
_PART = re.compile(r"\d{2,}_[\w.-]+")


@dataclass(frozen=True)
class MergeRequest:
    """Several recordings to be merged into one map."""

    # two recordings or more, each once; the first of those that are connected gives the frame
    sources: tuple[Path, ...]
    out: Path  # the directory of the merged map
    config: Config  # loops are closed whatever it says
    map_formats: tuple[MapFormat, ...] = ()  # what the maps are written as beside .ply
    overwrite: bool = False  # whether an earlier merge, or a run, in `out` is replaced
    resume: bool = False  # whether the merge in `out`, which was killed or stopped, is continued
    where: Where = SERIAL  # where recordings are tracked

    def describe(self) -> dict[str, Any]:
        """For config.yaml, and for the parts of an unfinished merge."""
        return {"version": version("lidarslam"), "sources": [str(resolved(source)) for source in self.sources]}


def closing_loops(config: Config) -> Config:
    """The configuration with the pose graph.

    Raises:
        ConfigError: the odometry is a trajectory of one recording.
    """
    if config.odometry.method == "external":
        raise ConfigError(
            "odometry.method is external: one trajectory is not that of several recordings; choose another"
        )
    return config.model_copy(update={"pose_graph": config.pose_graph.model_copy(update={"enabled": True})})


def open_parts(request: MergeRequest) -> list[tuple[RunRequest, Recording]]:
    """The run of each recording; directories count from 1 and take the recordings' names, as file names allow.

    Raises:
        InputError: a recording cannot be read, or is named twice.
        OutputError: the output is a recording, or holds an unfinished merge.
    """
    if len(request.sources) < 2:
        raise InputError("expected two recordings or more; for the map of a single one use lidarslam run")
    parts: list[tuple[RunRequest, Recording]] = []
    for number, source in enumerate(request.sources, start=1):
        if source.resolve() in {earlier.source.resolve() for earlier, _ in parts}:
            raise InputError(f"{source}: is named twice; name every recording once")
        require_apart(request.out, source)
        recording = open_recording(source, request.config.reader)
        if not len(recording):
            raise InputError(f"{source}: holds no scan; leave it out")
        name = safe_name(re.sub(r"[^\w.-]+", "_", recording.name).strip("._"))
        out = request.out / f"{number:02d}_{name}"
        require_apart(out, source)
        parts.append((RunRequest(source, out, request.config, map_formats=request.map_formats), recording))
    about = None if request.overwrite or request.resume else About.read(request.out)
    if about is not None:
        raise OutputError(f"{request.out}: {about.remedy(request.out)}")
    return parts


def earlier_parts(out: Path) -> set[str]:
    """The directories of the recordings of an earlier merge, finished or not."""
    names: list[str] = []
    with suppress(InputError):
        names += [entry["directory"] or "" for entry in read_summary(out).get("recordings", [])]
    with suppress(InputError):
        about = About.read(out)
        names += [] if about is None else about.description.get("parts", [])
    return {name for name in names if _PART.fullmatch(name)}


def remove_part(path: Path) -> None:
    """Remove the run of a recording that is no longer merged, however far it came."""
    if path.is_symlink():  # what it leads to is not of this merge
        return
    if (path / files.ABOUT).exists():
        remove_unfinished(path)
        return
    if path.is_dir():
        with only_writer(path):
            remove_partial_files(path)
    remove_run(path)

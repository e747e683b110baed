"""The demonstration: an indoor recording with turns on the spot, made here, and what becomes of it.

A tracked robot drives through a simulated office and turns on the spot at 120 deg/s. KISS-ICP expects the robot to go
on moving as it did, and loses the way; scan-to-map refinement sees each turn begin in the sweep it begins in. Both are
held against the true trajectory and the true map.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lidarslam.compare.comparison import CompareOutcome, Narrator, compare
from lidarslam.compare.methods import parse_methods
from lidarslam.compare.plan import REPORT_HTML
from lidarslam.compare.request import CompareRequest, RecordingEntry
from lidarslam.compare.text import format_comparison
from lidarslam.config.settings import ViewerConfig
from lidarslam.run.finished_run import load_map, load_run
from lidarslam.run.progress import show_count
from lidarslam.simulation.recording.record import record
from lidarslam.simulation.recording.request import RecordRequest
from lidarslam.viewer.picture import draw, height_colours, save_picture

RECORDING, REPLAY = "recording", "demo.rrd"
METHODS = "learned+map+graph,kiss-icp"
_NAME = "office"


@dataclass(frozen=True)
class Demo:
    """A finished demonstration.

    Attributes:
        out: the folder that everything is in.
        outcome: both methods beside the truth.
        pictures: of the true map and those that the methods made.
    """

    out: Path
    outcome: CompareOutcome
    pictures: tuple[Path, ...]


def run_demo(out: Path, scans: int = 400, seed: int = 0, tell: Callable[[str], None] = lambda _: None) -> Demo:
    """Record, run both methods, compare them, draw the maps.

    Args:
        out: the folder everything goes to; an earlier demonstration in it is replaced.
        scans: how many sweeps are recorded, ten a second.
        seed: of the office, the drive and the noise.
        tell: told a line a finished method.
    """
    source = out / RECORDING
    with show_count("recording") as counted:
        request = RecordRequest(
            source, "office", "vlp-16", "tracked", "upright", scans, seed, format="mcap", overwrite=True
        )
        record(request, counted)
    outcome = compare(
        CompareRequest(
            out=out,
            recordings=(RecordingEntry(source, name=_NAME),),
            methods=parse_methods(METHODS),
            overwrite=True,
            title="A tracked robot turns on the spot in an office",
            command=f"lidarslam demo --out {out} --scans {scans}",
        ),
        Narrator(show_count, tell),
    )
    runs = _runs(out, outcome)
    if runs:
        from lidarslam.viewer.rerun_runs import save_runs

        save_runs([load_run(run) for run in runs], ViewerConfig(), out / REPLAY)
    pictures = tuple(_picture(out, place) for place in (source, *runs))
    return Demo(out, outcome, pictures)


def format_demo(demo: Demo) -> str:
    """The table of the demonstration, and where to look."""
    return "\n".join(_lines(demo))


def _runs(out: Path, outcome: CompareOutcome) -> list[Path]:
    (sequence,) = outcome.comparison.sequences
    return [out / result.run for result in sequence.methods if result.run and result.trajectory is not None]


def _picture(out: Path, place: Path) -> Path:
    cloud = load_map(place)
    path = out / f"{place.name}.png"
    save_picture(path, draw(cloud.points, height_colours(cloud.points), cloud.normals))
    return path


def _lines(demo: Demo) -> Iterator[str]:
    yield ""
    yield format_comparison(demo.outcome.comparison, demo.out)
    yield f"maps      {', '.join(str(picture) for picture in demo.pictures)}"
    yield f"replay    rerun {demo.out / REPLAY}"
    yield ""
    yield f"Open {demo.out / REPORT_HTML} in a browser. KISS-ICP expects the robot to go on moving as it did, and a"
    yield "turn on the spot breaks that; the network sees a turn whatever its size, and the map corrects the rest."

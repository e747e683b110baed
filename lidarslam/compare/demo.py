"""The demonstration: an indoor recording with turns on the spot, made here, and three methods on it.

A tracked robot drives through a simulated office and turns on the spot at 120 deg/s. KISS-ICP, which predicts
constant velocity, runs with its defaults, which suit streets, and with a range and voxels by the size of the scene. All
are compared with the true trajectory and the true map.
"""

from collections.abc import Callable
from pathlib import Path

from lidarslam.assessment.inputs import truth_of_run
from lidarslam.compare.comparison import CompareOutcome, compare, format_comparison
from lidarslam.compare.plan import CompareRequest, RecordingEntry, parse_methods
from lidarslam.config.settings import ViewerConfig
from lidarslam.core.text import as_typed, command_line
from lidarslam.run.progress import show_count
from lidarslam.simulation.record import RecordRequest, record
from lidarslam.storage.finished_run import REPORT_HTML, load_run
from lidarslam.viewer.picture import draw_apart, fit_frame, load_drawn_runs

RECORDING, REPLAY = "recording", "demo.rrd"
METHODS = "learned+map+graph,kiss-icp,kiss-icp@scene"


def run_demo(
    out: Path, scans: int, say: Callable[[str], None], tell: Callable[[str], None] = lambda _: None
) -> CompareOutcome:
    """Record, run the methods, compare, draw the maps.

    `say` prints the table of the methods, and where to look; `tell` is called with a line for each finished method.
    """
    source = out / RECORDING
    with show_count("recording") as counted:
        request = RecordRequest(source, "office", "vlp-16", "tracked", "upright", scans, 0, "mcap", overwrite=True)
        record(request, counted)
    comparison = CompareRequest(
        out=out,
        recordings=(RecordingEntry(source, name="office"),),
        methods=parse_methods(METHODS),
        overwrite=True,
        title="A tracked robot turns on the spot in an office",
        command=f"lidarslam demo --out {out} --scans {scans}",
    )
    outcome = compare(comparison, tell)
    (sequence,) = outcome.comparison.sequences
    runs = [out / result.run for result in sequence.methods if result.run and result.trajectory is not None]
    if runs:
        from lidarslam.viewer.rerun_recording import save
        from lidarslam.viewer.rerun_scenes import show_runs

        finished, truth = [load_run(run) for run in runs], truth_of_run(runs[0])
        save(show_runs(finished, truth, ViewerConfig()), out / REPLAY)
    drawn = load_drawn_runs([source, *runs])
    pictures = draw_apart(drawn, out, fit_frame(drawn))
    say(f"""
{format_comparison(outcome.comparison, out)}
maps      {", ".join(map(str, pictures))}
replay    {command_line(as_typed("lidarslam"), "view", str(out / REPLAY), "--web")}

Open {out / REPORT_HTML} in a browser. KISS-ICP predicts constant velocity, and a turn on the spot breaks that,
with its defaults, which suit streets, and with a range and voxels by the size of the scene (kiss-icp@scene). The
network measures a turn whatever its size, and the map corrects the rest.""")
    return outcome

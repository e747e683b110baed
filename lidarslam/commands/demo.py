"""`lidarslam demo`: everything on a simulated recording."""

from pathlib import Path

import click

from lidarslam.commands.shared.options import PATH, CommandWithExample
from lidarslam.commands.shared.terminal import note, say


@click.command(cls=CommandWithExample, epilog="lidarslam demo -o demo")
@click.option(
    "-o", "--out", type=PATH, default=Path("demo"), show_default=True, metavar="DIR", help="Folder of the results."
)
@click.option("--scans", type=click.IntRange(min=20), default=400, show_default=True, help="Length of the recording.")
def demo(out: Path, scans: int) -> None:
    """Simulate a recording in an office, map it, and compare with KISS-ICP and the ground truth."""
    from lidarslam.compare.demo import format_demo, run_demo

    say(format_demo(run_demo(out, scans, tell=note)))

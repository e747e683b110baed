"""`lidarslam demo`: the whole story, without data."""

from pathlib import Path

import click

from lidarslam.commands.options import PATH, CommandWithExample
from lidarslam.commands.terminal import say, tell


@click.command(cls=CommandWithExample, epilog="lidarslam demo --out demo")
@click.option("--out", type=PATH, default=Path("demo"), show_default=True, metavar="DIR", help="Where it all goes.")
@click.option("--scans", type=click.IntRange(min=20), default=400, show_default=True, help="Length of the recording.")
def demo(out: Path, scans: int) -> None:
    """Record an indoor run in a simulated office, map it, and compare that with KISS-ICP and the truth."""
    from lidarslam.compare.demo import format_demo, run_demo

    say(format_demo(run_demo(out, scans, tell=tell)))

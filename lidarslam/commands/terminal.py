"""Output of the commands on the terminal, and their exit status."""

import click

from lidarslam.core.plain_text import one_line, printable

EXIT_MENDABLE = 1
EXIT_LOST = 3


def say(text: str) -> None:
    """The result, on standard output."""
    click.echo(printable(text))


def note(line: str) -> None:
    """A warning or an error, a line on standard error."""
    click.echo(f"lidarslam: {one_line(line)}", err=True)

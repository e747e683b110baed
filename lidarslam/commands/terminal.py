"""What commands leave behind on the terminal: lines of theirs, and an exit status."""

import click

from lidarslam.core.plain_text import one_line, printable

EXIT_MENDABLE = 1
EXIT_LOST = 3


def say(text: str) -> None:
    """The result, on standard output."""
    click.echo(printable(text))


def tell(line: str) -> None:
    """What there is to know beside it, a line on standard error."""
    click.echo(f"lidarslam: {one_line(line)}", err=True)

"""Output of the commands on the terminal, and their exit status."""

import contextlib
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

import click

from lidarslam.core.plain_text import one_line, printable

if TYPE_CHECKING:
    from lidarslam.viewer.web_page import WebPage

EXIT_MENDABLE = 1
EXIT_LOST = 3


def say(text: str) -> None:
    """The result, on standard output."""
    click.echo(printable(text))


def note(line: str) -> None:
    """A warning or an error, a line on standard error."""
    click.echo(f"lidarslam: {one_line(line)}", err=True)


@contextlib.contextmanager
def serving() -> "Iterator[WebPage]":
    """A page, whose address is printed when there is something to show."""
    from lidarslam.viewer.rerun_program import served_page

    with served_page(_announce) as page:
        yield page


def wait_for_interrupt() -> None:
    """Serve on until Ctrl-C or SIGTERM, which is how it ends well."""
    with contextlib.suppress(KeyboardInterrupt):
        signal.pause()


def _announce(address: str) -> None:
    port = address.rpartition(":")[2]
    say(address)
    say(f"for browsers on this machine, until Ctrl-C; on another, first ssh -L {port}:127.0.0.1:{port} to this one")

"""Output of the commands on the terminal, and their exit status; `-v`, before the command or after it."""

import contextlib
import logging
import time
from typing import TYPE_CHECKING

import click

from lidarslam.core.text import one_line, printable

if TYPE_CHECKING:
    from lidarslam.viewer.rerun_program import WebPage

EXIT_MENDABLE = 1
EXIT_LOST = 3
EXIT_GATE = 4


def say(text: str) -> None:
    """The result, on standard output."""
    click.echo(printable(text))


def note(line: str) -> None:
    """A warning or an error, a line on standard error."""
    click.echo(f"lidarslam: {one_line(line)}", err=True)


def serving() -> "contextlib.AbstractContextManager[WebPage]":
    """A page, whose address is printed when there is something to show."""
    from lidarslam.viewer.rerun_program import served_page

    return served_page(_announce)


def wait_for_interrupt(announcement: str | None = None) -> None:
    """Announce it, and keep serving until Ctrl-C or SIGTERM, the regular end."""
    with contextlib.suppress(KeyboardInterrupt):
        if announcement is not None:
            say(announcement)
        while True:  # signal.pause would sleep on after a signal that came just before it
            time.sleep(0.5)


def _announce(address: str) -> None:
    port = address.rpartition(":")[2]
    say(address)
    say(f"for browsers on this machine, until Ctrl-C; on another, first ssh -L {port}:127.0.0.1:{port} to this one")


class _StandardError(logging.Handler):
    """Log lines as the other lines of the program; above a progress bar, where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        click.echo(printable(self.format(record)), err=True)


def prepare_log() -> None:
    """Send warnings to standard error; may be called again."""
    handler = _StandardError()
    handler.setFormatter(logging.Formatter("lidarslam: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])


def _log_more(ctx: click.Context, _param: click.Parameter, is_asked: bool) -> None:
    if is_asked or ctx.parent is None:  # before the command, where one that comes after it is not known yet
        logging.getLogger("lidarslam").setLevel(logging.INFO if is_asked else logging.NOTSET)


def verbose_option() -> click.Option:
    """The option, of the program and of each command."""
    return click.Option(
        ["-v", "--verbose"], is_flag=True, expose_value=False, callback=_log_more, help="Log what is chosen and done."
    )

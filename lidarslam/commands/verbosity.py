"""`-v`, before the command or after it."""

import logging

import click

from lidarslam.core.plain_text import printable


class _StandardError(logging.Handler):
    """Log lines as the other lines of the program; above a progress bar, where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        click.echo(printable(self.format(record)), err=True)


def prepare_log() -> None:
    """Send warnings to standard error; may be called again."""
    handler = _StandardError()
    handler.setFormatter(logging.Formatter("lidarslam: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])


def _log_more(_ctx: click.Context, _param: click.Parameter, is_asked: bool) -> None:
    if is_asked:
        logging.getLogger("lidarslam").setLevel(logging.INFO)


def verbose_option() -> click.Option:
    """The option, of the program and of each command."""
    return click.Option(
        ["-v", "--verbose"], is_flag=True, expose_value=False, callback=_log_more, help="Log what is chosen and done."
    )

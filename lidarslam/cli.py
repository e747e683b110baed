"""The command line: what is around every command, and where the program begins; the commands have a file each."""

import errno
import io
import logging
import os
import sys
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.compare import compare
from lidarslam.commands.config import config
from lidarslam.commands.demo import demo
from lidarslam.commands.evaluate import evaluate
from lidarslam.commands.export import export
from lidarslam.commands.info import info
from lidarslam.commands.merge import merge
from lidarslam.commands.run import run
from lidarslam.commands.simulate import simulate
from lidarslam.commands.terminal import EXIT_MENDABLE, tell
from lidarslam.commands.train import train
from lidarslam.commands.view import view
from lidarslam.core.errors import InputError, LidarSlamError
from lidarslam.core.plain_text import printable
from lidarslam.run.interruption import ended_like_interrupted
from lidarslam.viewer.rerun_environment import keep_rerun_to_itself, leave_if_abandoned

logger = logging.getLogger(__name__)


class _Group(click.Group):
    """Turns what the user can mend into one line on standard error and exit status 1."""

    def invoke(self, ctx: click.Context) -> Any:
        _hold_standard_streams()
        _speak_any_encoding()
        keep_rerun_to_itself()
        try:
            _require_place()
            with ended_like_interrupted():
                return super().invoke(ctx)
        except LidarSlamError as error:
            tell(str(error))
            ctx.exit(EXIT_MENDABLE)
        except UnicodeEncodeError as error:
            tell(f"{error.object}: not a name that every program can read; rename it")
            ctx.exit(EXIT_MENDABLE)
        except MemoryError:
            tell("memory ran out; close other programs, or take fewer scans at a time with --start and --stop")
            logger.info("where it came from", exc_info=True)
            ctx.exit(EXIT_MENDABLE)
        except OSError as error:
            if error.errno == errno.EPIPE:  # a reader that has had enough, such as head; click ends quietly
                raise
            _drop_unwritable_output()
            place = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
            tell(f"{place}{error.strerror or error}")
            logger.info("where it came from", exc_info=True)
            ctx.exit(EXIT_MENDABLE)


def _drop_unwritable_output() -> None:
    """Spare Python from trying, and complaining, once more at its end when standard output is a full disk."""
    try:
        sys.stdout.flush()
    except OSError:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115


def _hold_standard_streams() -> None:
    """Where a standard stream is closed, a file opened next would take its number, and a library's words with it."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115


def _require_place() -> None:
    """Libraries fail in strange ways where the folder one stands in was removed."""
    try:
        Path.cwd()
    except FileNotFoundError:
        raise InputError("the folder you stand in is gone; change to another") from None


def _speak_any_encoding() -> None:
    """What the terminal has no letter for is spelt out, instead of ending a run at its last line."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


class _PlainFormatter(logging.Formatter):
    """Log lines may hold names out of recordings too."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


@click.group(
    "lidarslam", cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(package_name="lidarslam", message="%(prog)s %(version)s")
@click.option("-v", "--verbose", is_flag=True, help="Say more about what is going on.")
def main(verbose: bool) -> None:
    """Trajectories and maps from recorded LiDAR runs, and how good they are."""
    for stream in (sys.stdout, sys.stderr):  # a file's name may hold what the terminal cannot show
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    level = logging.INFO if verbose else logging.WARNING
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_PlainFormatter("lidarslam: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])


for _command in (demo, info, run, merge, simulate, train, export, evaluate, view, compare, config):
    main.add_command(_command)


def entry_point() -> None:
    """The program: what `lidarslam` starts."""
    status = 0
    try:
        main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        raise
    finally:
        leave_if_abandoned(status)

"""The command line; its commands are in `lidarslam.commands`."""

import contextlib
import errno
import io
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.compare import compare, demo, evaluate
from lidarslam.commands.exports import edit, export_bag, export_geo, export_grid, export_mesh
from lidarslam.commands.network import export, train
from lidarslam.commands.options import config
from lidarslam.commands.recordings import datasets, info, simulate
from lidarslam.commands.runs import live, localise, merge, run
from lidarslam.commands.terminal import EXIT_MENDABLE, note, prepare_log, verbose_option
from lidarslam.commands.view import view
from lidarslam.core.errors import LidarSlamError
from lidarslam.run.interruption import ended_like_interrupted
from lidarslam.viewer.rerun_environment import keep_rerun_to_itself, leave_if_abandoned

logger = logging.getLogger(__name__)


class _Group(click.Group):
    """Turns errors that the user can correct into one line on standard error; exit status 1, or 2 of a wrong usage."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not args:  # the help
            return super().parse_args(ctx, args)
        with _usage_in_one_line():
            return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        _prepare_streams()
        keep_rerun_to_itself()
        try:
            with ended_like_interrupted(), _usage_in_one_line():
                return super().invoke(ctx)
        except LidarSlamError as error:
            note(str(error))
        except KeyboardInterrupt:
            note("interrupted")
        except UnicodeEncodeError as error:
            note(f"{error.object}: the name is not valid Unicode; rename it")
        except MemoryError:
            note("out of memory; close other programs, or take fewer scans with --start and --stop")
            logger.info("raised here:", exc_info=True)
        except OSError as error:
            if error.errno == errno.EPIPE:  # the reader of the output has ended, such as head; click ends quietly
                raise
            _drop_unwritable_output()
            place = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
            note(f"{place}{error.strerror or error}")
            logger.info("raised here:", exc_info=True)
        raise click.exceptions.Exit(EXIT_MENDABLE)


@contextlib.contextmanager
def _usage_in_one_line() -> Iterator[None]:
    """Print the error of a wrong usage as others; the usage itself is in the help."""
    try:
        yield
    except click.UsageError as error:
        message = " ".join(error.format_message().split()).removesuffix(".")
        if message[1:2].islower():  # not the name of an option or argument
            message = message[0].lower() + message[1:]
        command = "lidarslam" if error.ctx is None else error.ctx.command_path
        note(f"{message} (see {command} --help)")
        raise click.exceptions.Exit(error.exit_code) from None


def _prepare_streams() -> None:
    """Open closed standard streams, whose numbers the next file would get, and escape unknown characters."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    sys.stdout = sys.stdout or Path(os.devnull).open("w")  # noqa: SIM115
    sys.stderr = sys.stderr or Path(os.devnull).open("w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _drop_unwritable_output() -> None:
    """Keep Python from writing to a full disk once more at its end."""
    try:
        sys.stdout.flush()
    except OSError:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115


@click.group(
    "lidarslam",
    cls=_Group,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
)
@click.version_option(package_name="lidarslam", message="%(prog)s %(version)s")
def main() -> None:
    """LiDAR SLAM: trajectories and maps of recordings, and their accuracy."""
    prepare_log()


main.params.append(verbose_option())


for _command in (
    *(demo, datasets, info, simulate),
    *(run, live, localise, merge),
    *(train, export),
    *(evaluate, view, compare, config),
    *(edit, export_bag, export_grid, export_mesh, export_geo),
):
    main.add_command(_command)


def entry_point() -> None:
    """The program `lidarslam`."""
    status = 0
    try:
        main(prog_name="lidarslam")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        raise
    finally:
        leave_if_abandoned(status)

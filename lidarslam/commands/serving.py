"""A page for browsers, served by a command until Ctrl-C."""

import contextlib
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

from lidarslam.commands.terminal import say

if TYPE_CHECKING:
    from lidarslam.viewer.web_page import WebPage


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

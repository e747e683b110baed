"""Child processes that end with this one, also where it is killed and no code of its own is run any more."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from typing import Any

# A shell waits for the end of its standard input, which the system closes with this process, and kills a group.
_WATCH = 'read -r _; kill -s KILL -- "-$1"'


@contextlib.contextmanager
def bound(process: "subprocess.Popen[Any]") -> Iterator[None]:
    """End a process and its descendants with the context, or with this process, whichever comes first.

    It was started with `start_new_session=True`; descendants with a session of their own are not covered.
    """
    quiet = subprocess.DEVNULL
    watch = subprocess.Popen(
        ["/bin/sh", "-c", _WATCH, "sh", str(process.pid)],
        stdin=subprocess.PIPE,
        stdout=quiet,
        stderr=quiet,
        start_new_session=True,  # neither Ctrl-C nor a closed terminal is meant for it
    )
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        watch.kill()
        watch.communicate()

"""What Rerun is told through the environment; it must stand there before the library is loaded."""

import os
import sys

# Whether a recording was given up: at the end of the program Rerun 0.41 waits without end for a writer that died.
abandoned = False


def keep_rerun_to_itself() -> None:
    """No reports to its makers, and no words on standard error.

    The viewer reports its use unless it runs in continuous integration. The library's log stops the program for good
    where standard error is a file on a full disk; whether its files are whole is seen without it.
    """
    os.environ.setdefault("CI", "1")
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    os.environ.setdefault("RUST_LOG", "off")


def leave_if_abandoned(status: int) -> None:
    """End the program here, once everything is said and written, where it could not end by itself."""
    if abandoned:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)

"""Environment variables for Rerun, which must be set before it is imported."""

import os
import sys

# Whether a writer died; at the end of the program Rerun 0.41 waits for it without end.
abandoned = False


def keep_rerun_to_itself() -> None:
    """No telemetry, and no log on standard error.

    The viewer sends telemetry unless it runs in continuous integration. Its log blocks the program where standard error
    is a file on a full disk.
    """
    os.environ.setdefault("CI", "1")
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    os.environ.setdefault("RUST_LOG", "off")


def leave_if_abandoned(status: int) -> None:
    """End the program at once where Rerun would keep it from ending."""
    if abandoned:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)

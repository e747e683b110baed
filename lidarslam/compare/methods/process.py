"""One method of a comparison in a process of its own: a run that reports its progress.

The arguments are the folder to stand in and the request as JSON. After every scan a line goes to standard output: its
number from 1, and how many there are. Libraries' output goes to standard error. The exit status is that of
`lidarslam run`.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

from pydantic import TypeAdapter

from lidarslam.core.errors import LidarSlamError
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute

STOPPED, LOST = 1, 3
_REQUEST = TypeAdapter(RunRequest)


def encode(request: RunRequest) -> tuple[str, str]:
    """The arguments; the run overwrites, and saves no state and draws no page, which would count as its time."""
    request = replace(request, overwrite=True, resumable=False, report=False)
    return str(Path.cwd()), _REQUEST.dump_json(request).decode()


def main() -> int:
    """Run; the exit status."""
    folder, request = sys.argv[1:]
    os.chdir(folder)
    with os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8") as progress:
        os.dup2(2, 1)
        try:
            run = _REQUEST.validate_json(request)
            outcome = execute(run, lambda number, total, _: print(number, total, file=progress))
        except LidarSlamError as error:
            print(f"lidarslam: {error}", file=sys.stderr)
            return STOPPED
    if outcome.stopped is not None:
        print(f"lidarslam: stopped after {outcome.summary.scans} scans: {outcome.stopped}", file=sys.stderr)
        return STOPPED
    return LOST if outcome.summary.went_astray else 0


if __name__ == "__main__":
    sys.exit(main())

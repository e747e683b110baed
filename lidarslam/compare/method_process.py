"""One method of a comparison in a process of its own: a run that says how far it is.

The argument is the request as JSON, see `encode`. After every scan a line goes to standard output: its number from 1,
and how many there are. Whatever a library prints goes to standard error. The exit status is that of `lidarslam run`.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

from lidarslam.config.settings import Config
from lidarslam.core.errors import LidarSlamError
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute

STOPPED, LOST = 1, 3


def encode(request: RunRequest) -> str:
    """The request as the one argument of this module; of what it shows, nothing."""
    return json.dumps(
        {
            "folder": str(Path.cwd()),
            "source": str(request.source),
            "out": str(request.out),
            "config": request.config.model_dump(mode="json"),
            "start": request.start,
            "stop": request.stop,
            "step": request.step,
            "prior": None if request.prior is None else str(request.prior),
        }
    )


def decode(text: str) -> RunRequest:
    """The request; paths stay relative to the folder it was made in, which becomes the current one."""
    values: dict[str, Any] = json.loads(text)
    os.chdir(values.pop("folder"))
    prior = values.pop("prior")
    return RunRequest(
        source=Path(values.pop("source")),
        out=Path(values.pop("out")),
        config=Config.model_validate(values.pop("config")),
        prior=None if prior is None else Path(prior),
        overwrite=True,
        resumable=False,  # a comparison runs it again, and saving would count as its time
        **values,
    )


def main() -> int:
    """Run; the exit status."""
    with os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8") as progress:
        os.dup2(2, 1)
        try:
            outcome = execute(decode(sys.argv[1]), lambda number, total, _: print(number, total, file=progress))
        except LidarSlamError as error:
            print(f"lidarslam: {error}", file=sys.stderr)
            return STOPPED
    if outcome.stopped is not None:
        print(f"lidarslam: stopped after {outcome.summary.scans} scans: {outcome.stopped}", file=sys.stderr)
        return STOPPED
    return LOST if outcome.summary.went_astray else 0


if __name__ == "__main__":
    sys.exit(main())

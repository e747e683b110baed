"""Recordings in rotated axes: ATE and lost scans as recorded, with a guessed and with a given `reader.mounting`.

    python benchmarks/mounting.py recordings/street --scans 40 --starts 0 60
    python benchmarks/mounting.py KITTI --sequence 04 --methods learned constant-velocity+map kiss-icp

Every scan and the ground truth are rotated about the sensor before the program reads them. `as it is` is
`reader.mounting=upright`; `guessed` is the default, with the rotation found; `set` is the true rotation. A recording
without ground truth is compared with the trajectory of the same method in the original axes.
"""

import warnings
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
from mapping_accuracy import make_parser, trajectory_of
from scipy.spatial.transform import Rotation

from lidarslam.config.settings import load_config
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import Mounting, ReaderConfig, RollPitchYaw
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.mounting import MountedRecording
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.evaluation.trajectory.metrics import evaluate_trajectory
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline

TURNS: dict[str, RollPitchYaw] = {
    "none": (0.0, 0.0, 0.0),
    "roll 90": (90.0, 0.0, 0.0),
    "roll -90": (-90.0, 0.0, 0.0),
    "roll 180": (180.0, 0.0, 0.0),
    "pitch 90": (0.0, 90.0, 0.0),
    "pitch -90": (0.0, -90.0, 0.0),
    "camera": (90.0, -90.0, 0.0),
    "roll 45": (45.0, 0.0, 0.0),
    "odd": (70.0, 25.0, 110.0),
}
SETTINGS = ("as it is", "guessed", "set")
METHODS = ("learned", "learned+map", "constant-velocity+map", "kiss-icp")


class From:
    """A recording from one of its scans on."""

    def __init__(self, recording: Recording, start: int) -> None:
        self._recording, self._start = recording, start

    def __getattr__(self, name: str) -> object:
        return getattr(self._recording, name)

    def __len__(self) -> int:
        return len(self._recording) - self._start

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans, counted from the start."""
        stop = None if stop is None else stop + self._start
        return self._recording.scans(start + self._start, stop, step, faults)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("--sequence")
    parser.add_argument("--starts", type=int, nargs="+", default=[0])
    parser.add_argument("--scans", type=int, default=40)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--settings", nargs="+", default=SETTINGS, choices=SETTINGS)
    parser.add_argument("--turns", nargs="+", default=list(TURNS), choices=list(TURNS))
    arguments = parser.parse_args()
    recorded = open_recording(arguments.source, ReaderConfig(sequence=arguments.sequence, mounting="upright"))
    print(f"ATE [m] / lost scans of {arguments.scans}; {recorded.name}\n")
    print(f"| start | turned by | reader.mounting | {' | '.join(arguments.methods)} |")
    print("|---" * (3 + len(arguments.methods)) + "|")
    for start in arguments.starts:
        upright = MountedRecording(From(recorded, start), "upright")  # type: ignore[arg-type]
        truths = {method: reference(upright, method, arguments.scans) for method in arguments.methods}
        for name in arguments.turns:
            turned = MountedRecording(upright, TURNS[name])
            with warnings.catch_warnings(action="ignore"):  # gimbal lock at 90 degrees of pitch
                back = Rotation.from_euler("xyz", TURNS[name], degrees=True).inv().as_euler("xyz", degrees=True)
            given: RollPitchYaw = tuple(np.round(back, 6).tolist())
            settings: dict[str, Mounting] = {"as it is": "upright", "guessed": "auto", "set": given}
            for setting, mounting in settings.items():
                if setting not in arguments.settings or (name == "none" and setting == "set"):
                    continue
                mounted = MountedRecording(turned, mounting)
                cells = [cell(mounted, method, arguments.scans, truth) for method, truth in truths.items()]
                print(f"| {start} | {name} | {shown(mounted, setting, mounting)} | {' | '.join(cells)} |", flush=True)


def shown(recording: MountedRecording, setting: str, mounting: Mounting) -> str:
    """The setting, for a guess with the tilt of z."""
    if mounting != "auto":
        return setting
    tilt_deg = np.rad2deg(np.arccos(np.clip(recording.T_upright_recorded[2, 2], -1.0, 1.0)))
    return f"{setting}: turned by {tilt_deg:.0f} degrees"


def reference(recording: Recording, method: str, count: int) -> Trajectory:
    """The ground truth, or else the trajectory of a method."""
    truth = recording.ground_truth
    return tracked(recording, method, count)[0] if truth is None else truth


def cell(recording: MountedRecording, method: str, count: int, truth: Trajectory) -> str:
    """ATE and lost scans of a method; positions do not depend on the mounting."""
    trajectory, lost = tracked(recording, method, count)
    return f"{evaluate_trajectory(trajectory, truth).errors.ate_rmse_m:.3f} / {lost}"


def tracked(recording: Recording, method: str, count: int) -> tuple[Trajectory, int]:
    """Trajectory of the first scans by a method, and the number of lost ones."""
    odometry, _, mapping = method.partition("+")
    config = load_config(settings=[f"odometry.method={odometry}", f"mapping.method={'surfels' if mapping else 'off'}"])
    scans = islice(take_in(recording, range(count), Faults()), count)
    with closing(make_odometry(config.odometry)) as estimator:
        results = list(Pipeline(estimator, make_localiser(config), config.global_map).run(scans))
    return trajectory_of(results), sum(result.status is Status.LOST for result in results)


if __name__ == "__main__":
    main()

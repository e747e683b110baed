"""Map consistency check on the poses of a run, and on the same poses with inserted slips.

    python benchmarks/map_check.py KITTI/sequences/04 2011_09_26/2011_09_26_drive_0005_sync

The poses come from `--odometry constant-velocity --set mapping.continuous_time=false`, or from a TUM file given after
the recording's name and a comma; they are passed to `lidarslam run --prior --no-mapping` unchanged and distorted.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory, chain, read_tum
from lidarslam.run.request import RunRequest
from lidarslam.run.run import execute
from lidarslam.run.summary import RunSummary

_STRETCH = 15


def scaled(T_world_lidar: FloatArray, factors: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) with translations between them scaled by factors (N - 1,)."""
    motions = inverse(T_world_lidar[:-1]) @ T_world_lidar[1:]
    motions[:, :3, 3] *= factors[:, None]
    return chain(T_world_lidar[0], motions)


def scaled_stretch(T_world_lidar: FloatArray, factor: float) -> FloatArray:
    """Scale the motions of fifteen scans in the middle."""
    factors, middle = np.ones(len(T_world_lidar) - 1), len(T_world_lidar) // 2
    factors[middle : middle + _STRETCH] = factor
    return scaled(T_world_lidar, factors)


def offset(T_world_lidar: FloatArray, along_m: float) -> FloatArray:
    """Offset fifteen scans in the middle forwards."""
    poses, middle = T_world_lidar.copy(), len(T_world_lidar) // 2
    poses[middle : middle + _STRETCH, :3, 3] += along_m * poses[middle : middle + _STRETCH, :3, 0]
    return poses


DISTORTIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "as they are": lambda poses: poses,
    "all motion x 0.97": lambda poses: scaled(poses, np.full(len(poses) - 1, 0.97)),
    "all motion x 0.9": lambda poses: scaled(poses, np.full(len(poses) - 1, 0.9)),
    "all motion x 0.05": lambda poses: scaled(poses, np.full(len(poses) - 1, 0.05)),
    "15 scans x 0.05": lambda poses: scaled_stretch(poses, 0.05),
    "15 scans + 0.5 m": lambda poses: offset(poses, 0.5),
    "15 scans + 1 m": lambda poses: offset(poses, 1.0),
}


def run(source: Path, out: Path, settings: dict[str, object], prior: Path | None = None) -> RunSummary:
    config = Config.model_validate(settings)
    return execute(RunRequest(source, out, config, prior=prior, resumable=False), lambda *_: None).summary


def row(name: str, distortion: str, summary: RunSummary) -> str:
    found = summary.map_contradictions
    clearest = max(found, key=lambda one: one.votes - one.votes_at_pose, default=None)
    what = "none" if clearest is None else f"{clearest.shift_m:+.1f} m, {sum(one.pairs for one in found)} pairs"
    votes = "" if clearest is None else f"{clearest.votes_at_pose:.0f} of {clearest.votes:.0f}"
    entropy = "" if summary.map.entropy is None else f"{summary.map.entropy:.2f}"
    return f"| {name} | {distortion} | {what} | {votes} | {summary.lost_scans} | {entropy} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", help="RECORDING, or RECORDING,POSES.tum")
    print("| recording | poses | contradiction | votes at the poses | lost scans | map entropy |")
    print("| --- | --- | --- | --- | ---: | ---: |")
    for argument in parser.parse_args().recordings:
        source, _, poses = argument.partition(",")
        with tempfile.TemporaryDirectory() as folder:
            good = Path(poses) if poses else Path(folder) / "good" / "trajectory.tum"
            if not poses:
                mapping = {"continuous_time": False}
                run(Path(source), good.parent, {"odometry": {"method": "constant-velocity"}, "mapping": mapping})
            trajectory = read_tum(good)
            for number, (name, distort) in enumerate(DISTORTIONS.items()):
                prior = Path(folder) / f"{number}.tum"
                Trajectory(trajectory.stamps, distort(trajectory.T_world_lidar)).save(prior)
                settings: dict[str, object] = {"odometry": {"method": "external"}, "mapping": {"method": "off"}}
                summary = run(Path(source), Path(folder) / str(number), settings, prior)
                print(row(Path(source).name, name, summary), flush=True)


if __name__ == "__main__":
    main()

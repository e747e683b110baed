"""Outcomes of the guess of the mounting: correct, a warning, left as recorded, or wrong.

    python benchmarks/mounting_guess.py KITTI --sequence 04
    python benchmarks/mounting_guess.py --worlds street office --sensors vlp-16 os1-64

Guesses are made from several starts of a recording. Recordings on disk are assumed to be upright and are rotated about
the sensor as a whole (`axes`). In simulated ones, the sensor is also mounted in that pose, with the resulting view
(`mounted`). Each cell has four counts: turned upright / warned / left as recorded / turned wrongly, by more than 30
degrees from upright. Upright and tilted recordings should be left as recorded, and the last count should be 0.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from mapping_accuracy import in_world, make_parser
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.scan import ScanSequence
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.mounting import Guess, guess_mounting, transform_of
from lidarslam.datasets.registry import open_recording
from lidarslam.simulation.mesh import Caster
from lidarslam.simulation.recorder import Simulation
from lidarslam.simulation.sensors import SENSORS
from lidarslam.simulation.world import WORLDS, build_world

# Roll, pitch, yaw of the sensor, degrees.
POSES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "upright": ((0, 0, 0),),
    "tilted": ((30, 0, 0), (-45, 0, 0), (0, 25, 0), (0, -45, 90), (0, 45, 0)),
    "on its side": ((90, 0, 0), (-90, 0, 0), (0, 90, 0), (0, -90, 0)),
    "camera": ((90, -90, 0),),  # x to the right, y down
    "upside down": ((180, 0, 0), (160, 15, 0)),
}
OUTCOMES = ("turned", "warned", "left", "wrong")
STEP, LOOK = 4, 17  # step between the scans used, as in the program, and their span
WRONG_DEG = 30.0


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("sources", type=Path, nargs="*")
    parser.add_argument("--sequence")
    parser.add_argument("--every", type=int, default=8, help="scans between starts, of recordings on disk")
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=[])
    parser.add_argument("--sensors", nargs="+", choices=list(SENSORS), default=list(SENSORS))
    parser.add_argument("--starts", type=int, default=2, help="of simulated recordings")
    arguments = parser.parse_args()
    print(f"| recording | turned | {' | '.join(POSES)} |\n{'|---' * (2 + len(POSES))}|")
    for source in arguments.sources:
        recorded = open_recording(source, ReaderConfig(sequence=arguments.sequence, mounting="upright"))
        row(recorded.name, "axes", (on_disk(recorded, pose, arguments.every) for pose in POSES))
    for world in arguments.worlds:
        made = list(simulations(world, arguments.sensors))
        for turned in ("axes", "mounted"):
            row(world, turned, (simulated(made, pose, turned, arguments.starts) for pose in POSES))


def row(name: str, turned: str, columns: Iterator[Iterator[tuple[Guess, float]]]) -> None:
    """Print a row with the guesses of each pose."""
    cells = []
    for guesses in columns:
        counts = Counter(outcome(*guess) for guess in guesses)
        cells.append(" / ".join(str(counts[result]) for result in OUTCOMES))
    print(f"| {name} | {turned} | {' | '.join(cells)} |", flush=True)


def outcome(guess: Guess, tilt_deg: float) -> str:
    """Outcome of a guess, by the tilt of the scans after it."""
    if guess.mounting == "upright":
        return "left" if guess.warning is None else "warned"
    return "turned" if tilt_deg < WRONG_DEG else "wrong"


def on_disk(recorded: ScanSequence, pose: str, every: int) -> Iterator[tuple[Guess, float]]:
    """Guesses from every start, with the tilts after them."""
    for start in range(0, max(1, len(recorded) - LOOK), every):
        scans = [scan.points for scan in recorded.scans(start, start + LOOK, STEP)]
        for angles in POSES[pose]:
            yield guessed(scans, matrix(angles), np.array([0.0, 0.0, 1.0]))


def simulations(world: str, sensors: Sequence[str]) -> Iterator[Simulation]:
    """Handheld upright recordings of a world with each sensor."""
    built = build_world(world, 0)
    caster = Caster(built)
    for sensor in sensors:
        simulation = in_world(built, "handheld", sensor, None, 0)
        vars(simulation)["_caster"] = caster
        yield simulation


def simulated(made: Sequence[Simulation], pose: str, turned: str, starts: int) -> Iterator[tuple[Guess, float]]:
    """Guesses from starts along the whole route, with the tilts after them."""
    for upright in made:
        for start in np.linspace(0, len(upright) - LOOK, starts + 1, dtype=int)[:-1].tolist():
            looks = range(start, start + LOOK, STEP)
            scans = [upright.scan(index).scan.points for index in looks] if turned == "axes" else []
            for angles in POSES[pose]:
                R = matrix(angles)
                if turned == "axes":
                    up = upright.ground_truth_at(upright.stamps[start : start + 1]).T_world_lidar[0, 2, :3]
                    yield guessed(scans, R, up)
                else:
                    yield guessed(*mounted(upright, R, looks))


def mounted(upright: Simulation, R: FloatArray, looks: range) -> tuple[Iterator[FloatArray], FloatArray, FloatArray]:
    """Scans of a sensor mounted with rotation R, the identity, and the up vector (3,) as recorded."""
    T = upright.T_body_lidar @ make_transform(R.T, np.zeros(3))
    simulation = replace(upright, T_body_lidar=T)
    vars(simulation)["_caster"] = upright._caster  # building one takes longer than the scans
    up = simulation.ground_truth_at(simulation.stamps[looks.start : looks.start + 1]).T_world_lidar[0, 2, :3]
    return (simulation.scan(index).scan.points for index in looks), np.eye(3), up


def guessed(scans: Iterable[FloatArray], R: FloatArray, up: FloatArray) -> tuple[Guess, float]:
    """Guess from scans rotated by R, with the tilt after it; the up vector (3,) is before the rotation."""
    guess = guess_mounting(points @ R.T for points in scans)
    after = transform_of(guess.mounting)[:3, :3] @ R @ up
    return guess, float(np.rad2deg(np.arccos(np.clip(after[2], -1.0, 1.0))))


def matrix(angles: Sequence[float]) -> FloatArray:
    """Rotation matrix of roll, pitch and yaw."""
    return np.asarray(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())


if __name__ == "__main__":
    main()

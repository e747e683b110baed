"""Coverage-guided fuzzing (Atheris) of the decoders: every input ends in a result or in an error for the user.

    python benchmarks/fuzz_decoders.py mcap --runs 100000

Failing inputs are kept as `crash-*` in the folder of the corpus and are tried first in later runs.
"""

import argparse
import logging
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import atheris

os.environ["NUMBA_DISABLE_JIT"] = "1"  # Numba cannot compile instrumented functions

with atheris.instrument_imports(include=["lidarslam", "rosbags", "yaml", "laspy"]):
    import numpy as np

    from lidarslam.config.settings import load_config
    from lidarslam.core.errors import LidarSlamError
    from lidarslam.core.scan import Scan
    from lidarslam.core.trajectory import read_tum
    from lidarslam.datasets.config import ReaderConfig
    from lidarslam.datasets.faults import Faults
    from lidarslam.datasets.registry import open_recording
    from lidarslam.live.messages import CloudDecoder
    from lidarslam.mapping.global_map.point_cloud import PointCloud, write_cloud
    from lidarslam.simulation.recorder import Rig, SimulatedScan
    from lidarslam.simulation.writers import FORMATS
    from lidarslam.storage.directory import About
    from lidarslam.storage.finished_run import read_summary

# Memory, seconds per input, and bytes per input.
_LIMITS = ("-rss_limit_mb=2048", "-timeout=20", "-max_len=65536")
CLOUD = "sensor_msgs/msg/PointCloud2"


def scans(path: Path) -> None:
    """Read the description and all scans of a recording."""
    recording = open_recording(path, ReaderConfig())
    recording.describe()
    list(recording.scans(faults=Faults()))


def live(path: Path) -> None:
    """Decode the same message at two times."""
    decoder, raw = CloudDecoder(ReaderConfig(), CLOUD, Faults()), path.read_bytes()
    for published_ns in (2 * 10**18, 2 * 10**18 + 10**8):
        decoder.scan(raw, published_ns)


# Decoder -> file name, and the function that reads the file or its folder.
TARGETS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "ply": ("0.ply", lambda path: scans(path.parent)),
    "pcd": ("0.pcd", lambda path: scans(path.parent)),
    "npy": ("0.npy", lambda path: scans(path.parent)),
    "mcap": ("0.mcap", scans),
    "bag": ("0.bag", scans),
    "db3": ("0.db3", scans),
    "message": ("message", live),
    "tum": ("trajectory.tum", read_tum),
    "yaml": ("config.yaml", lambda path: load_config(path, [])),
    "summary": ("summary.json", lambda path: read_summary(path.parent)),
    "about": ("unfinished/run.json", lambda path: About.read(path.parent.parent)),
}


# Small complete text files.
TEXTS = {
    "tum": "1.0 0 0 0 0 0 0 1\n1.1 1 0 0 0 0 0 1\n",
    "yaml": "odometry: {method: learned}\nmapping:\n  method: loam\n",
    "summary": '{"scans": 3, "length_m": 1.0, "warnings": []}',
    "about": '{"description": {"merge": "all"}, "standing": "stopped", "resumed_after": [1]}',
}
RECORDINGS = {"mcap": "mcap", "bag": "rosbag1", "db3": "rosbag2", "ply": "ply"}


def write_seeds(corpus: Path, name: str) -> None:
    """Write small complete files of a kind."""
    rng = np.random.default_rng(0)
    times = np.linspace(0.0, 0.1, 40)
    sweeps = [Scan(rng.normal(size=(40, 3)), stamp, times) for stamp in (0.1, 0.2, 0.3)]
    simulated = [SimulatedScan(sweep, np.ones(40, dtype=np.float32)) for sweep in sweeps]
    rig = Rig("ouster", 0.1, lambda stamps: np.tile(np.eye(4), (len(stamps), 1, 1)), None)
    seed = corpus / "seed-0"
    if name in TEXTS:
        seed.write_text(TEXTS[name])
        return
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made"
        if name in RECORDINGS:
            FORMATS[RECORDINGS[name]].write(made, simulated, rig)
            for number, path in enumerate(made.rglob(f"*.{name}")):
                (corpus / f"seed-{number}").write_bytes(path.read_bytes())
        elif name == "message":
            seed.write_bytes(_message(made, simulated, rig))
        elif name == "npy":
            with seed.open("wb") as file:
                np.save(file, sweeps[0].points)
        else:
            write_cloud(
                cloud := Path(folder) / "0.pcd", PointCloud(sweeps[0].points, np.tile([0.0, 0.0, 1.0], (40, 1)))
            )
            seed.write_bytes(cloud.read_bytes())


def _message(folder: Path, simulated: list[SimulatedScan], rig: Rig) -> bytes:
    from rosbags.rosbag2 import Reader

    FORMATS["mcap"].write(folder, simulated, rig)
    with Reader(folder) as reader:
        return next(bytes(raw) for connection, _, raw in reader.messages() if connection.msgtype == CLOUD)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--seconds", type=int, default=60, help="time limit")
    parser.add_argument("--corpus", type=Path, help="folder kept between runs")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as folder:
        name, read = TARGETS[arguments.target]
        corpus, path = arguments.corpus or Path(folder) / "corpus", Path(folder) / "here" / name
        corpus.mkdir(exist_ok=True)
        path.parent.mkdir(parents=True)
        write_seeds(corpus, arguments.target)

        def one(data: bytes) -> None:
            path.write_bytes(data)
            with suppress(LidarSlamError):
                read(path)

        limits = [f"-runs={arguments.runs}", f"-max_total_time={arguments.seconds}", *_LIMITS]
        atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={corpus}/", str(corpus)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()

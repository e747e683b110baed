"""Values of a checkpoint that were forged one by one are refused on restoring; the interpreter never ends.

Kernels check no index. Everything happens in a process of its own, which a wrong access to memory would end.
"""

import copy
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarslam.config.settings import Config
from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.core.state.stateful import Saved
from lidarslam.mapping.config import PoseGraphConfig
from lidarslam.mapping.global_map.tile_store import TileStore
from lidarslam.mapping.pose_graph.slam_graph import SlamGraph
from lidarslam.odometry.methods.constant_velocity import ConstantVelocity
from lidarslam.odometry.registry import make_odometry
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline
from lidarslam.storage.state_file import read_state, write_state

BEFORE, AFTER = 7, 3
# Numbers of cells, voxels, colours and lasers, and countdowns: another one is another map, and nothing to be told.
FREE = ("keys", "_cells", "rings", "_checksums", "_to_confirm", "_scans_until_search")
# Large numbers, and what is absent, may be another state: a run goes on from it, or refuses it.
PLAUSIBLE = ("large", "absent")


class Keeper:
    """Writes the state after some scans; see `Checkpointer`."""

    def __init__(self, folder: Path, graph: SlamGraph, odometry: Any) -> None:
        self.folder, self.graph, self.odometry, self.scans = folder, graph, odometry, 0

    def is_due(self) -> bool:
        self.scans += 1
        return self.scans == BEFORE

    def save(self, pipeline: Pipeline) -> None:
        parts = {"pipeline": pipeline.state(), "graph": self.graph.state(), "odometry": self.odometry.state()}
        write_state(self.folder / "state.npz", parts)


@cache
def learned(config: Config) -> Any:
    """The network takes a while to load; restoring replaces all of its state."""
    return make_odometry(config.odometry)


class Run:
    """A pipeline with its graph and its odometry."""

    def __init__(self, folder: Path, method: str) -> None:
        mapping = {"method": "off" if method == "learned" else method, "keypoints": 300}
        config = Config(mapping=mapping, pose_graph={"enabled": True}, global_map={"most_points": 5_000})
        self.odometry = learned(config) if method == "learned" else ConstantVelocity()
        self.graph = SlamGraph(PoseGraphConfig(enabled=True), file=folder / "submaps.bin", local_radius_m=50.0)
        keeper, localiser = Keeper(folder, self.graph, self.odometry), make_localiser(config)
        store = TileStore(file=folder / "tiles.bin")
        self.pipeline = Pipeline(self.odometry, localiser, config.global_map, self.graph, keeper, store)

    def restore(self, tree: dict[str, Any]) -> None:
        saved = Saved(tree)
        for name in ("odometry", "graph", "pipeline"):
            getattr(self, name).restore(saved.part(name))

    def take(self, scans: list[Scan]) -> None:
        for _ in self.pipeline.run(scans):
            pass


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """All arrays, numbers and texts of a tree: the path, the branch, and the name in it."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for name, value in list(items):
        if isinstance(value, dict | list):
            yield from leaves(value, f"{path}/{name}")
        elif value is not None:
            yield f"{path}/{name}", tree, name


def forgeries(value: Any) -> Iterator[tuple[str, Any]]:
    yield "absent", None
    if isinstance(value, np.ndarray):
        yield from forged_arrays(value)
        return
    yield "type", [value]
    yield "type", "1" if isinstance(value, bool | int | float) else 1.0
    if type(value) is int:
        yield from (("negative", -7), ("endless", 10**30), ("type", True), ("large", 2**63 - 1), ("large", 10**6))
    if type(value) is float:
        yield from (("nan", np.nan), ("inf", np.inf), ("endless", 10**400), ("large", 1e300), ("large", -1e300))


def forged_arrays(array: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    yield "shape", array[None]
    yield "type", array.astype({"f": "c16", "i": "f8", "u": "f8", "b": "i8"}[array.dtype.kind])
    values = {"f": [np.nan, np.inf], "i": [-7, np.iinfo(array.dtype).max if array.dtype.kind == "i" else 0]}
    for value in values.get(array.dtype.kind, []) if array.size else []:
        forged = array.copy()
        forged.flat[0] = value
        yield str(value), forged


def main(folder: Path, method: str) -> None:
    """Save, forge, restore; prints what was tried and what was accepted."""
    table = np.load(folder / "scans.npy", allow_pickle=False)
    scans = [Scan(one[:, :3], 0.1 * n, one[:, 3], one[:, 4].astype(np.int32)) for n, one in enumerate(table, 1)]
    Run(folder, method).take(scans)
    state = read_state(folder / "state.npz")._values
    whole = Run(folder, method)
    whole.restore(copy.deepcopy(state))
    whole.take(scans[BEFORE + 1 :])
    tried = 0
    for path, branch, name in list(leaves(state)):
        true = branch[name]
        for kind, forged in forgeries(true):
            tried += 1
            branch[name] = forged
            print("trying", kind, path, flush=True)
            try:
                again = Run(folder, method)
                again.restore(copy.deepcopy(state))
                print("accepted", kind, path, flush=True)
                again.take(scans[BEFORE + 1 :])
            except InputError as error:
                if "begin again with --overwrite" not in str(error):
                    raise
            except Exception as error:
                print("failed", kind, path, repr(error), flush=True)
        branch[name] = true
    print("tried", tried)


@pytest.mark.parametrize("method", ["surfels", "off", "loam", "learned"])
def test_forged_values_are_refused(method: str, tmp_path: Path, room_scans: list[Scan]) -> None:
    if method == "learned":
        pytest.importorskip("onnxruntime")
    chosen = [scan.select(np.arange(0, len(scan), 4)) for scan in room_scans[: BEFORE + AFTER]]
    rings = (np.arange(len(chosen[0])) % 16).astype(np.float64)
    np.save(tmp_path / "scans.npy", [np.column_stack([one.points, one.time_offsets, rings]) for one in chosen])
    done = subprocess.run(
        [sys.executable, __file__, tmp_path, method], capture_output=True, text=True, check=False, timeout=900
    )
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"{lines[-1:]}: {done.stderr[-2000:]}"
    assert not [line for line in lines if line.startswith("failed")]
    accepted = [line for line in lines if line.startswith("accepted") and line.split()[1] not in PLAUSIBLE]
    accepted = [line for line in accepted if not line.endswith(FREE)]
    assert not accepted
    assert int(lines[-1].removeprefix("tried ")) > 50


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])

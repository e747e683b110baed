"""Methods of a comparison as the command line names them: BASE[@VOXEL][+map|+loam][+graph], or PEER[@scene]."""

import re
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from lidarslam.compare.peers.interface import MAX_RANGE_M
from lidarslam.compare.peers.registry import ALL_PEERS, PEERS, peer_named
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.text import require_name
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.config import MappingName
from lidarslam.odometry.config import ODOMETRIES
from lidarslam.storage.finished_run import RESERVED

# Name for the user -> name of the odometry in the configuration.
_BASES = {
    "learned": "learned",
    "kiss-icp": "kiss-icp",
    "kiss-icp-no-deskew": "kiss-icp",
    "constant-velocity": "constant-velocity",
    "imu": "imu",
    "learned+imu": "learned+imu",
    "prior": "external",
}
_NO_DESKEW = "kiss-icp-no-deskew"
# Behind a method's name, the maximum range by the size of the scene: KISS-ICP's voxels are a hundredth of its maximum
# range, 100 m by default, which suits streets; its authors advise a shorter range indoors. One rule for KISS-ICP and
# every peer with voxels: twice the range of 99 % of the points of the first scans, as the default is on streets.
BY_SCENE = "scene"
_SCANS, _PERCENT, _TIMES = 10, 99.0, 2.0
# As KISS-ICP's authors advise for indoor data; finer voxels than a tenth of the default would hold single points.
_SHORTEST_M = 10.0
DEFAULT_METHODS = "learned+map,kiss-icp"
# A peer's run: its poses as they are.
_PEER = ("odometry.method=external", "mapping.method=off", "pose_graph.enabled=false")
_ONLY_WITH_MAP = ("constant-velocity", "imu", "learned+imu")
_NAME = re.compile(
    r"(?P<base>[A-Za-z][\w.-]*(\+imu)?)(@(?P<voxel>[^+@]+))?(?P<mapping>\+map|\+loam)?(?P<graph>\+graph)?"
)
_MAPPINGS: dict[str | None, MappingName] = {"+map": "surfels", "+loam": "loam", None: "off"}


@dataclass(frozen=True)
class Method:
    """One method of a comparison."""

    name: str  # as the user named it, such as `kiss-icp@0.5` or `learned+map`, and of its run directory
    settings: tuple[str, ...]  # of the configuration, `key.path=value`
    peer: str | None = None  # the peer that estimates the poses, see `lidarslam.compare.peers`
    by_scene: bool = False  # whether maximum range and voxels follow the size of the scene

    def __post_init__(self) -> None:
        require_name(self.name, "method", RESERVED)

    @property
    def needs_prior(self) -> bool:
        """Whether it takes its motions from a given trajectory."""
        return self.peer is None and "odometry.method=external" in self.settings

    def settings_at(self, range_m: float) -> tuple[str, ...]:
        """Its settings where the size of the scene asks for this maximum range."""
        if not self.by_scene:
            return self.settings
        by_scene = (f"odometry.kiss_icp.max_range_m={range_m!r}", "odometry.kiss_icp.voxel_size_m=null")
        return (*self.settings, *by_scene)


def _grammar() -> str:
    return (
        f"{', '.join([*_BASES, *ODOMETRIES.added])}; each with +map or +loam, with +graph, or with both as in"
        " learned+map+graph; kiss-icp@0.5 for a voxel size of 0.5 m; and as they are "
        f"{', '.join(ALL_PEERS.names)}; kiss-icp@{BY_SCENE}, and likewise a peer with voxels, for a range by the size"
        " of the scene"
    )


def parse_method(name: str) -> Method:
    """The method of that name."""
    peer, by_scene = name.removesuffix(f"@{BY_SCENE}"), name.endswith(f"@{BY_SCENE}")
    match = _NAME.fullmatch(name)
    base = "" if match is None else match["base"]
    if peer in PEERS or (base not in _BASES and peer in ALL_PEERS.added):
        if not peer_named(peer).has_voxels and by_scene:
            raise ConfigError(f"{name}: {peer} has no voxel size that could follow the size of the scene")
        return Method(name, _PEER, peer, by_scene)
    odometry = _BASES.get(base) or (base if base in ODOMETRIES.added else None)
    if match is None or odometry is None:
        raise ConfigError(f"no method is called {name!r}; there are: {_grammar()}")
    if odometry in _ONLY_WITH_MAP and not match["mapping"]:
        raise ConfigError(f"{name}: estimates a motion with a map alone; compare {odometry}+map or {odometry}+loam")
    by_scene = match["voxel"] == BY_SCENE and odometry == "kiss-icp"
    voxel = () if match["voxel"] is None or by_scene else (f"odometry.kiss_icp.voxel_size_m={match['voxel']}",)
    if voxel and odometry != "kiss-icp":
        raise ConfigError(f"{name}: only kiss-icp takes a voxel size, as in kiss-icp@0.5")
    deskew = ("odometry.kiss_icp.deskew=false",) if base == _NO_DESKEW else ()
    pose_graph = str(match["graph"] is not None).lower()
    switches = (f"mapping.method={_MAPPINGS[match['mapping']]}", f"pose_graph.enabled={pose_graph}")
    return Method(name, (f"odometry.method={odometry}", *voxel, *deskew, *switches), by_scene=by_scene)


def parse_methods(names: str) -> tuple[Method, ...]:
    """The methods of a list with commas."""
    chosen = [name.strip() for name in names.split(",") if name.strip()]
    if not chosen:
        raise ConfigError(f"no method is named; there are: {_grammar()}")
    if len(set(chosen)) < len(chosen):
        raise ConfigError(f"a method is named twice in {names!r}; name each once")
    return tuple(parse_method(name) for name in chosen)


def scene_range_m(recording: Recording, chosen: range) -> float:
    """Twice the range of 99 % of the points of the first ten chosen scans, within 10 and 100 m; no truth is used."""
    ranges = [np.empty(0)]
    with suppress(InputError):  # raised again when the methods read the scans
        for scan in recording.scans(chosen.start, chosen[:_SCANS].stop, chosen.step, Faults()):
            ranges.append(np.linalg.norm(scan.points, axis=1))
    found = np.concatenate(ranges)
    if not len(found):
        return MAX_RANGE_M
    return round(float(np.clip(_TIMES * np.percentile(found, _PERCENT), _SHORTEST_M, MAX_RANGE_M)), 1)


def scene_note(range_m: float) -> str:
    """A sentence on the meaning of the name on this recording."""
    return (
        f"@{BY_SCENE}: maximum range {range_m:g} m instead of {MAX_RANGE_M:g} m, and voxels in proportion, by the"
        " ranges of the first scans"
    )

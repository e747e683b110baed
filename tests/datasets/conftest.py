"""Point clouds as the drivers lay them out, bags that hold them, and files of scans."""

import sqlite3
import struct
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lidarslam.datasets.registry import READERS
from lidarslam.datasets.ros import bag_message, made_messages

STAMP_NS = 1_700_000_000_250_000_000
PERIOD_NS = 100_000_000
LATENCY_NS = 37_000_123  # from the stamp of the header to the recording

# Kinds of bags and how they are compressed.
COMPRESSIONS = [
    ("bag", (Rosbag1Writer.CompressionFormat.BZ2,)),
    ("bag", (Rosbag1Writer.CompressionFormat.LZ4,)),
    ("db3", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
    ("mcap", (CompressionMode.STORAGE, CompressionFormat.ZSTD)),
]


def stamps_ns(count: int) -> list[int]:
    return [STAMP_NS + number * PERIOD_NS for number in range(count)]


def execute(file: Path, statement: str, *values: Any) -> list[Any]:
    """The rows that a statement finds in a database, or none if it changes it."""
    with closing(sqlite3.connect(file)) as database, database:
        return database.execute(statement, values).fetchall()


def point_table(points: np.ndarray, **columns: np.ndarray) -> np.ndarray:
    """Coordinates (N, 3) in float32, and further columns as they are."""
    parts = {**dict(zip("xyz", points.T.astype("<f4"), strict=True)), **columns}
    table = np.empty(len(points), [(name, part.dtype, part.shape[1:]) for name, part in parts.items()])
    for name, part in parts.items():
        table[name] = part
    return table


def _layout(point_step: int, **fields: tuple[str, int]) -> np.dtype:
    """A record type from `name=(type, offset)`."""
    kinds, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": kinds, "offsets": offsets, "itemsize": point_step})


_XYZ = {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8)}
_OUSTER = {"intensity": ("f4", 16), "t": ("u4", 20), "reflectivity": ("u2", 24), "ring": ("u2", 26)}
_OUSTER |= {"ambient": ("u2", 28), "range": ("u4", 32)}


# Driver -> record type, time field, its unit, its reference, and how it fills it.
_DRIVERS = {
    "velodyne": (
        _layout(22, **_XYZ, intensity=("f4", 12), ring=("u2", 16), time=("f4", 18)),
        ("time", "s", "relative", lambda seconds, _: np.round(seconds, 9).astype("f4")),
    ),
    "ouster": (
        _layout(48, **_XYZ, **_OUSTER),
        ("t", "ns", "relative", lambda seconds, _: np.round(seconds * 1e9).astype("u4")),
    ),
    "hesai": (
        _layout(48, **_XYZ, intensity=("f4", 16), timestamp=("f8", 24), ring=("u2", 32)),
        ("timestamp", "s", "absolute", lambda seconds, ns: ns / 10**9 + seconds),
    ),
    "livox": (
        _layout(26, **_XYZ, intensity=("f4", 12), tag=("u1", 16), line=("u1", 17), timestamp=("f8", 18)),
        ("timestamp", "ns", "absolute", lambda seconds, ns: (ns + np.round(seconds * 1e9).astype("i8")).astype("f8")),
    ),
}


@pytest.fixture(params=list(_DRIVERS))
def driver(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def make_sweep(rng: np.random.Generator) -> Callable[..., SimpleNamespace]:
    """Make the records of a driver's cloud together with what a reader should find in them.

    The result has records (height, width), points (N, 3), raw times, their exact offsets from the stamp, rings, and
    the time field's name, unit and reference. With `holes`, every fifth point is NaN and every seventh at the origin.
    """

    def make(name: str, stamp_ns: int, height: int = 4, width: int = 50, holes: bool = False) -> SimpleNamespace:
        dtype, (time_field, unit, reference, fill) = _DRIVERS[name]
        count = height * width
        records = np.zeros((height, width), dtype)
        records.view("u1")[:] = rng.integers(0, 255, records.view("u1").shape)  # padding is never clean
        points = rng.uniform(-50.0, 50.0, (count, 3)).astype("f4")
        if holes:
            points[::5] = np.nan
            points[::7] = 0.0
        for column, axis in enumerate("xyz"):
            records[axis] = points[:, column].reshape(height, width)
        times = fill(np.tile(np.linspace(0.0, 0.1, width), height), stamp_ns)
        records[time_field] = times.reshape(height, width)
        ring_field = "ring" if "ring" in dtype.names else "line"
        rings = np.repeat(np.arange(height), width)
        records[ring_field] = rings.reshape(height, width)
        per_second = {"s": 1, "ns": 10**9}[unit]
        # Offsets count from the stamp as float64 holds it, which is what Scan.stamp is.
        zero = Fraction(stamp_ns / 10**9) if reference == "absolute" else 0
        offsets = np.array([float(Fraction(time.item()) / per_second - zero) for time in times])
        return SimpleNamespace(
            records=records,
            points=points.astype(np.float64),
            times=times,
            offsets=offsets,
            rings=rings,
            time_field=time_field,
            unit=unit,
            reference=reference,
            returns=np.isfinite(points).all(axis=1) & points.any(axis=1),
        )

    return make


class BagKit:
    """Messages and bags of ROS 1 ("bag") or ROS 2 ("db3", "mcap")."""

    def __init__(self, kind: str, folder: Path) -> None:
        self.kind = kind
        self.ros2 = kind != "bag"
        self.folder = folder
        self.store = get_typestore(Stores.ROS2_HUMBLE if self.ros2 else Stores.ROS1_NOETIC)
        for package in ("livox_ros_driver", "livox_ros_driver2"):
            self.store.register(get_types_from_msg(bag_message.CUSTOM_POINT_DEFINITION, f"{package}/msg/CustomPoint"))
            self.store.register(get_types_from_msg(bag_message.CUSTOM_MESSAGE_DEFINITION, f"{package}/msg/CustomMsg"))
        if not self.ros2:  # which rosbags has for ROS 2 alone
            self.store.register(get_types_from_msg(bag_message.TRANSFORMS_DEFINITION, bag_message.TRANSFORMS_TYPE))

    def new(self, type_name: str, /, **values: Any) -> Any:
        """A message of a type given as package/Name."""
        return self.store.types[type_name.replace("/", "/msg/")](**values)

    def header(self, stamp_ns: int) -> Any:
        return made_messages.header(self.store, stamp_ns, "lidar", sequence=7)

    def cloud(self, records: np.ndarray, stamp_ns: int, row_padding: int = 0, **changes: Any) -> Any:
        height, width = records.shape
        point_step = records.dtype.itemsize
        rows = np.zeros((height, width * point_step + row_padding), np.uint8)
        if records.size:
            rows[:, : width * point_step] = np.ascontiguousarray(records).view(np.uint8).reshape(height, -1)
        empty = made_messages.point_cloud(self.store, self.header(stamp_ns), records.reshape(-1)[:0])
        shape = {"height": height, "width": width, "row_step": rows.shape[1]}
        return replace(empty, **{**shape, "data": rows.reshape(-1), **changes})

    def livox(
        self, points: np.ndarray, offset_ns: np.ndarray, lines: np.ndarray, stamp_ns: int, timebase: int, package: str
    ) -> Any:
        named = [dict(zip("xyz", map(float, point), strict=True)) for point in points]
        return self.new(
            f"{package}/CustomMsg",
            header=self.header(stamp_ns),
            timebase=timebase,
            point_num=len(points),
            lidar_id=1,
            rsvd=np.zeros(3, np.uint8),
            points=[
                self.new(f"{package}/CustomPoint", offset_time=int(time), line=int(line), reflectivity=9, tag=16, **xyz)
                for xyz, time, line in zip(named, offset_ns, lines, strict=True)
            ],
        )

    def imu(self, stamp_ns: int, frame_id: str, angular_velocity: np.ndarray, acceleration: np.ndarray) -> Any:
        return self.new(
            "sensor_msgs/Imu",
            header=made_messages.header(self.store, stamp_ns, frame_id),
            orientation=self.new("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.full(9, 1.0),
            angular_velocity=made_messages.vector(self.store, angular_velocity),
            angular_velocity_covariance=np.full(9, 2.0),
            linear_acceleration=made_messages.vector(self.store, acceleration),
            linear_acceleration_covariance=np.full(9, 3.0),
        )

    def serialize(self, message: Any) -> bytes:
        serialize = self.store.serialize_cdr if self.ros2 else self.store.serialize_ros1
        return bytes(serialize(message, message.__msgtype__))

    def write(
        self,
        topics: dict[str, list[tuple[int, Any]]],
        name: str = "drive",
        definitions: bool = True,
        extra: Callable[[Any], None] | None = None,
        in_order: bool = True,
        **options: Any,
    ) -> Path:
        """Write a bag of `topic: [(record stamp in ns, message), ...]`; a topic of no messages takes a type's name."""
        if self.ros2:
            path = self.folder / name
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
        else:
            path = self.folder / f"{name}.bag"
            writer = Rosbag1Writer(path)
        if options.get("compression"):
            writer.set_compression(*options["compression"])
        with writer:
            pending = []
            for topic, messages in topics.items():
                message_type = messages if isinstance(messages, str) else messages[0][1].__msgtype__
                missing = {"msgdef": "", "rihs01" if self.ros2 else "md5sum": "*"}
                definition = {"typestore": self.store} if definitions else missing
                connection = writer.add_connection(topic, message_type, **definition)
                if not isinstance(messages, str):
                    pending += [(record_ns, connection, message) for record_ns, message in messages]
            if extra is not None:
                extra(writer)
            for record_ns, connection, message in sorted(pending, key=lambda row: row[0]) if in_order else pending:
                writer.write(connection, record_ns, self.serialize(message))
        return path

    def storage_file(self, path: Path) -> Path:
        return path / f"{path.name}.{self.kind}" if path.is_dir() else path


@pytest.fixture(params=["bag", "db3", "mcap"])
def bag_kit(request: pytest.FixtureRequest, tmp_path: Path) -> BagKit:
    return BagKit(request.param, tmp_path)


@pytest.fixture
def ros2_kit(tmp_path: Path) -> BagKit:
    """A ROS 2 bag in MCAP, where the kind does not matter."""
    return BagKit("mcap", tmp_path)


@pytest.fixture
def uncorrected(monkeypatch: pytest.MonkeyPatch) -> None:
    """KITTI's scans as they lie on disk."""
    for name in ("kitti-odometry", "kitti-raw"):
        monkeypatch.setitem(READERS, name, READERS[name]._replace(elevation_deg=0.0))


@pytest.fixture
def velodyne_clouds(make_sweep: Callable[..., SimpleNamespace]) -> Callable[[BagKit, int], list[tuple[int, Any]]]:
    """So many clouds of a Velodyne, with their times of recording."""

    def made(kit: BagKit, count: int) -> list[tuple[int, Any]]:
        clouds = [kit.cloud(make_sweep("velodyne", ns).records, ns) for ns in stamps_ns(count)]
        return [(ns + LATENCY_NS, cloud) for ns, cloud in zip(stamps_ns(count), clouds, strict=True)]

    return made


@pytest.fixture
def make_bag_kit(tmp_path: Path) -> Callable[[str], BagKit]:
    return lambda kind: BagKit(kind, tmp_path)


def write_pcap(path: Path, payloads: Iterable[bytes], stamps: Iterable[float]) -> Path:
    """A capture of UDP packets over Ethernet."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for payload, stamp in zip(payloads, stamps, strict=True):
            udp = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0) + payload
            ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, b"\xc0\xa8\1\xc9", b"\xff" * 4)
            frame = b"\xff" * 6 + b"\1" * 6 + b"\x08\x00" + ip + udp
            file.write(struct.pack("<IIII", *divmod(round(1e6 * stamp), 10**6), len(frame), len(frame)) + frame)
    return path


_PLY_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "u4": "uint", "i4": "int"}


def pcd_bytes(table: np.ndarray, data: str = "binary") -> bytes:
    kinds = {"f": "F", "u": "U", "i": "I"}
    types = [table.dtype[name] for name in table.dtype.names]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "FIELDS " + " ".join(table.dtype.names),
        "SIZE " + " ".join(str(t.base.itemsize) for t in types),
        "TYPE " + " ".join(kinds[t.base.kind] for t in types),
        "COUNT " + " ".join(str(int(np.prod(t.shape)) if t.shape else 1) for t in types),
        f"POINTS {len(table)}",
        f"DATA {data}",
    ]
    header = ("\n".join(lines) + "\n").encode()
    if data == "ascii":
        return header + _ascii(table)
    if data == "binary":
        return header + table.tobytes()
    columns = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
    # LZF without copies, as a compressor writes what does not repeat.
    packed = b"".join(bytes([len(part := columns[i : i + 32]) - 1]) + part for i in range(0, len(columns), 32))
    return header + struct.pack("<II", len(packed), len(columns)) + packed


def _ascii(table: np.ndarray) -> bytes:
    return "".join(" ".join(repr(value.item()) for value in row) + "\n" for row in table).encode()


def ply_bytes(table: np.ndarray, encoding: str, faces: bool = False) -> bytes:
    """A PLY file; a face may come behind the vertices."""
    properties = "".join(f"property {_PLY_NAMES[table.dtype[n].str[1:]]} {n}\n" for n in table.dtype.names)
    header = f"ply\nformat {encoding} 1.0\ncomment made by a test\nelement vertex {len(table)}\n{properties}"
    header += "element face 1\nproperty list uchar int vertex_indices\n" * faces + "end_header\n"
    if encoding == "ascii":
        return header.encode() + _ascii(table) + b"3 0 1 2\n" * faces
    rows = table.astype(table.dtype.newbyteorder("<" if "little" in encoding else ">"))
    return header.encode() + rows.tobytes() + (b"\3" + bytes(12)) * faces

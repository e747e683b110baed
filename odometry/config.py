"""Settings of the odometry methods, of networks and of their training; imports no method and no torch."""

from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import BeforeValidator, Field, model_validator

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.plugins import PlugPoint
from lidarslam.core.settings import RangeSettings, Settings

OdometryName = Literal["learned", "kiss-icp", "constant-velocity", "imu", "learned+imu", "external"]
ODOMETRIES = PlugPoint("odometry", get_args(OdometryName))
NetworkName = Literal["correlation", "delora"]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0)]
Metres = Annotated[float, Field(ge=-100.0, le=100.0)]


class LearnedConfig(Settings):
    """The learned odometry; see `odometry.methods.learned`."""

    weights: Path | None = Field(
        None, description="file of `lidarslam train` or folder of `lidarslam export`; null: the shipped network"
    )
    device: str = Field("cpu", min_length=1, description="torch's name of the device, such as cpu or cuda")
    threads: int = Field(1, ge=1, le=256, description="of the network; registration has its own")
    alignment: bool = Field(
        True, description="refine the network's motion by point-to-plane alignment; false: for ablations"
    )
    when: Literal["needed", "always"] = Field(
        "needed",
        description="needed: with a mapping, only for scans whose motion the mapping does not predict well enough",
    )


class KissConfig(RangeSettings):
    """KISS-ICP; the defaults are its own."""

    max_range_m: float = Field(100.0, ge=1.0, le=1000.0, description="farther points are ignored")
    min_range_m: float = Field(0.0, ge=0.0, le=1000.0, description="nearer points are ignored")
    voxel_size_m: float | None = Field(
        None, ge=0.05, le=10.0, description="of the map; null: a hundredth of max_range_m"
    )
    max_points_per_voxel: int = Field(20, ge=1, le=1000, description="of the map")
    initial_threshold_m: float = Field(
        2.0, ge=0.1, le=100.0, description="initial correspondence distance, then adaptive"
    )
    deskew: bool = Field(True, description="compensate the sensor's motion within each scan")
    threads: int = Field(0, ge=0, le=256, description="0: all cores")


class OdometryConfig(Settings):
    """The scan-to-scan odometry."""

    method: Annotated[str, BeforeValidator(ODOMETRIES.check)] = Field(
        "learned",
        description="learned, kiss-icp, constant-velocity, imu, learned+imu, external (--prior), or another package's",
    )
    learned: LearnedConfig = LearnedConfig()
    kiss_icp: KissConfig = KissConfig()
    imu_rotation_deg: tuple[Degrees, Degrees, Degrees] | None = Field(
        None,
        description="roll, pitch, yaw of the IMU in the LiDAR's recorded axes; null: the recording's, else found by its"
        " turns",
    )
    imu_position_m: tuple[Metres, Metres, Metres] = Field(
        (0.0, 0.0, 0.0), description="of the IMU in the LiDAR's recorded axes"
    )

    @model_validator(mode="after")
    def _position_has_a_rotation(self) -> Self:
        if any(self.imu_position_m) and self.imu_rotation_deg is None:
            raise ValueError("imu_position_m needs imu_rotation_deg")
        return self

    @property
    def is_learned(self) -> bool:
        """Whether the network runs."""
        return self.method in ("learned", "learned+imu")

    @property
    def uses_imu(self) -> bool:
        """Whether the recording needs an IMU."""
        return self.method in ("imu", "learned+imu")

    @property
    def T_recorded_imu(self) -> FloatArray | None:
        """(4, 4) in the LiDAR's recorded axes, as given; None where it is not."""
        from scipy.spatial.transform import Rotation  # takes a while to load

        if self.imu_rotation_deg is None:
            return None
        R = Rotation.from_euler("xyz", self.imu_rotation_deg, degrees=True).as_matrix()
        return make_transform(R, self.imu_position_m)


class ImageConfig(Settings):
    """Size of the network's range images; columns go round once, rows span the sensor's elevations."""

    rows: int = Field(16, ge=16, le=256, multiple_of=4, description="of elevation")
    columns: int = Field(720, ge=64, le=4096, multiple_of=4, description="of azimuth")


class NetworkConfig(Settings):
    """The network that compares two scans."""

    name: NetworkName = Field("correlation", description="correlation (default), or delora, the paper's")


Teacher = Literal["alignment", "map"]


class LossConfig(Settings):
    """The geometric losses of the paper; see `odometry.training.losses`."""

    point_to_plane: bool = Field(True, description="distances of points from planes")
    plane_to_plane: bool = Field(True, description="differences of normals")
    robust: bool = Field(True, description="gate and down-weight outliers; false: as in the paper")

    @model_validator(mode="after")
    def _something_is_minimised(self) -> Self:
        if not (self.point_to_plane or self.plane_to_plane):
            raise ValueError("point_to_plane and plane_to_plane are both off, which leaves no loss")
        return self


class TrainingConfig(Settings):
    """Training of a network; see `lidarslam.train.train`."""

    network: NetworkConfig = NetworkConfig()
    images: ImageConfig = ImageConfig()
    geometric: LossConfig | None = Field(LossConfig(), description="the geometric losses; null: none")
    alignment_weight: float = Field(1.0, ge=0.0, le=1e6, description="of the distance from the pseudo-labels")
    teacher: Teacher = Field(
        "alignment",
        description="pseudo-labels of recordings: alignment of consecutive scans, or mapping without a network",
    )
    steps: int = Field(12_000, ge=1, le=10**9, description="of the optimizer")
    batch: int = Field(16, ge=1, le=10**4, description="pairs per step")
    learning_rate: float = Field(1e-3, ge=1e-9, le=1.0, description="the highest, after the warm-up")
    warmup_steps: int = Field(300, ge=0, le=10**9, description="in which the learning rate rises")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="of weights, pairs and augmentation")
    hold_out: float = Field(0.1, ge=0.0, le=0.9, description="part of the recordings kept for validation")

    @model_validator(mode="after")
    def _something_is_minimised(self) -> Self:
        if not self.alignment_weight and self.geometric is None:
            raise ValueError("geometric and alignment_weight are both off, which leaves no loss")
        return self


class SimulatedConfig(Settings):
    """Recordings simulated for the training, of worlds, sensors and carriers drawn at random."""

    recordings: int = Field(0, ge=0, le=10**6, description="how many")
    scans: int = Field(60, ge=2, le=10**5, description="of each")
    worlds: tuple[str, ...] | None = Field(None, description="worlds of these recordings; null: all")
    sensors: tuple[str, ...] | None = Field(None, description="their sensors; null: all")

"""Settings of the readers."""

from typing import Annotated, Literal

from pydantic import Field

from lidarslam.core.settings import Settings

TimeUnit = Literal["auto", "s", "ms", "us", "ns"]
TimeReference = Literal["auto", "relative", "absolute", "azimuth", "none"]
Name = Annotated[str, Field(min_length=1)]
MountingName = Literal["upright", "upside-down", "left", "right", "forward", "backward", "camera"]
_Angle = Annotated[float, Field(ge=-360.0, le=360.0)]
RollPitchYaw = tuple[_Angle, _Angle, _Angle]
Mounting = Literal["auto"] | MountingName | RollPitchYaw


class ReaderConfig(Settings):
    """Settings of the readers; every reader takes the ones that concern it."""

    name: Name | None = Field(None, description="name of the reader; null: the one that recognises the source")
    topic: Name | None = Field(None, description="point cloud topic of a bag; null: the only one there is")
    frame_id: Name | None = Field(None, description="sensor's frame in a bag's topic; null: that of the first scans")
    imu_topic: Name | None = Field(None, description="IMU topic of a bag; null: the one nearest to the point clouds'")
    sequence: Name | None = Field(None, description="sequence of a data set's root, such as 04 of KITTI odometry")
    rate_hz: float = Field(10.0, ge=0.1, le=1000.0, description="scans per second, for recordings without stamps")
    time_field: Name | None = Field(None, description="point field with the per-point time; null: found by its name")
    time_unit: TimeUnit = Field("auto", description="unit of the per-point time; auto: inferred from the values")
    time_reference: TimeReference = Field(
        "auto",
        description="per-point time: relative to the scan's stamp, a reading of a clock, from the azimuth, or none",
    )
    time_scale: float = Field(
        1.0, ge=-2.0, le=2.0, description="factor on the per-point times, counted from the scan's stamp"
    )
    sweep_s: Annotated[float, Field(ge=0.0, le=10.0)] | Literal["auto"] = Field(
        "auto",
        description="seconds of a sweep, to which shorter scans are joined; 0: none are; auto: until their directions"
        " recur, or 0.1",
    )
    mounting: Mounting = Field(
        "auto",
        description="where the recorded z axis points: upright, upside-down, left, right, forward, backward, camera, or"
        " roll, pitch, yaw of the recorded axes in degrees; auto: seen from the ground",
    )
    carrier: Literal["remove", "keep"] = Field(
        "remove",
        description="surfaces that stay at one place in the sensor's frame while the scene passes by: remove them where"
        " they are certain, or keep them",
    )
    elevation_correction_deg: Annotated[float, Field(ge=-5.0, le=5.0)] | Literal["auto"] | None = Field(
        None,
        description="by how much all points are raised; null: 0.205 for KITTI, else 0; auto: that, and what `run` finds"
        " in a part of the recording beforehand",
    )

    def raised_deg(self, of_reader: float = 0.0) -> float:
        """The angle by which all points are raised: that of the settings, else the one given by their reader."""
        setting = self.elevation_correction_deg
        return setting if isinstance(setting, float) else of_reader

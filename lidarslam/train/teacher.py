"""Self-training: pseudo-labels from scan-to-map registration without a network."""

from dataclasses import replace

import numpy as np
import torch

from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.training.preparation import PreparedRecording


class MapTeacher:
    """Registers a recording at constant velocity, scan after scan."""

    def __init__(self) -> None:
        self._mapper = Mapper(MappingConfig())
        self._T_world_middle: list[FloatArray] = []
        self._is_ok: list[bool] = []

    def follow(self, scan: Scan) -> None:
        """Register the next scan."""
        mapped = self._mapper.process(scan, Prior())
        state = mapped.state
        self._T_world_middle.append(state.T_world_lidar @ exp(state.velocity * scan.middle_offset_s))
        # When the first scan is registered its velocity is not known, and so not where the middle of its sweep lies.
        self._is_ok.append(mapped.status is Status.OK and len(self._T_world_middle) > 1)

    def relabelled(self, recording: PreparedRecording) -> PreparedRecording:
        """The recording of these scans with the motions between the middles of sweeps on the map.

        A motion is valid where both poses have the status ok.
        """
        T = np.stack(self._T_world_middle)
        T_prev_curr = inverse(T[:-1]) @ T[1:]
        is_ok = torch.tensor(self._is_ok)
        return replace(recording, T_prev_curr=torch.from_numpy(T_prev_curr).float(), valid=is_ok[:-1] & is_ok[1:])

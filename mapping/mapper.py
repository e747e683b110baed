"""Scan-to-map refinement: scan after scan is predicted, laid on the map, judged, and added to it.

LOAM's mapping (Zhang and Singh, RSS 2014), with any odometry before it or none.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, displacement_m, inverse, log, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved
from lidarslam.core.state import State as Tree
from lidarslam.core.tracking import Status
from mapping.config import MappingConfig
from mapping.deskew import body_velocity
from mapping.fit import Fit
from mapping.local_map import LocalMap
from mapping.placement import Placed, place, search
from mapping.prediction import Carrier, Prediction, Prior, State, predict
from mapping.refinement import Refined, compensated
from mapping.sampling import SampledScan, Sampler

# Predictions that were off by less than this share of a cell need no coarser cells first; what they were off by is
# forgotten by this factor a scan.
_FINE_ENOUGH = 0.5
_CAUTION = 0.8
_UNKNOWN_M = 10.0
# A pose so far from where it was expected, in standard deviations and at least in degrees and metres, is suspicious
# however it fits.
_MOST_SIGMAS = 5.0
_LEAST_JUMP = np.array([np.deg2rad(10.0)] * 3 + [0.5] * 3)
# Nothing goes on as it did for ever: while lost, the velocity fades by this from scan to scan.
_FADING = 0.7
# How often the first sweep is drawn anew when the second has shown how it moved.
_BEGINNINGS = 2


@dataclass(frozen=True, eq=False)
class MappedScan:
    """A scan laid on the map.

    Attributes:
        state: pose at the stamp, velocity during the sweep, and how sure they are.
        T_world_expected: (4, 4) the pose that was expected.
        registered: whether the pose is that of a registration; else it is the expected one.
        status, message: whether to believe it, and why not.
        fit: how it lies on the map; None when it was not held against one.
        degenerate: names of the directions along which the expected pose was kept.
        iterations: how many the registration took.
        added: whether the scan became part of the map.
    """

    state: State
    T_world_expected: FloatArray
    registered: bool
    status: Status
    message: str = ""
    fit: Fit | None = None
    degenerate: tuple[str, ...] = ()
    iterations: int = 0
    added: bool = False


class Mapper:
    """Holds the local map and the state of the last scan."""

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._sampler = Sampler(config)
        self._map: LocalMap | None = None
        self._state: State | None = None
        self._carrier = Carrier()
        self._expected_error_m = _UNKNOWN_M
        self._lost_in_a_row = 0
        self._was_degraded = False  # a second scan that lies badly is reason to look around
        self._first: SampledScan | None = None  # while the map is one sweep whose motion was made up
        self._has_velocity = False  # no change of velocity is seen from one that was made up

    @property
    def local_map(self) -> LocalMap | None:
        """What scans are laid on; None before the first."""
        return self._map

    def state(self) -> Tree:
        """The map, the last scan, and what is supposed of the next."""
        return {
            "sampler": self._sampler.state(),
            "map": None if self._map is None else self._map.state(),
            "last": None if self._state is None else dict(vars(self._state)),
            "carrier": dict(vars(self._carrier)),
            "expected_error_m": self._expected_error_m,
            "lost_in_a_row": self._lost_in_a_row,
            "was_degraded": self._was_degraded,
            "first": None if self._first is None else self._first.state(),
            "has_velocity": self._has_velocity,
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""
        self._sampler.restore(saved.part("sampler"))
        self._map = saved.optional("map", LocalMap.restored)
        self._state = saved.optional("last", State.restored)
        self._carrier = Carrier.restored(saved.part("carrier"))
        self._expected_error_m = saved.number("expected_error_m")
        self._lost_in_a_row = saved.integer("lost_in_a_row")
        self._was_degraded = saved.flag("was_degraded")
        self._first = saved.optional("first", SampledScan.restored)
        self._has_velocity = saved.flag("has_velocity")

    def process(self, scan: Scan, prior: Prior) -> MappedScan:
        """Lay the next scan on the map, and add it."""
        sampled = self._sampler.sample(scan)
        last = self._state or State.first(scan.stamp, prior.velocity)
        prediction = predict(last, scan.stamp, prior, self._carrier, self._config)
        if self._map is None:
            mapped = self._begin(sampled, prediction, last)
            made_up = prior.velocity is None and sampled.times is not None and self._config.continuous_time
            self._first = sampled if made_up else None
        elif self._first is not None:
            mapped = self._lay_second(sampled, prior, prediction, last, self._first, self._map)
            self._first = None
        else:
            mapped = self._lay(sampled, prediction, last, self._map)
        self._state = mapped.state
        return mapped

    def _begin(self, sampled: SampledScan, prediction: Prediction, last: State) -> MappedScan:
        """The first scan makes the map."""
        T_world_lidar = prediction.T_world_lidar
        if not len(sampled):
            lost = State.astray(sampled.stamp, T_world_lidar, prediction.velocity)
            return MappedScan(lost, T_world_lidar, False, Status.LOST, "there is no point within range")
        self._map = LocalMap(sampled.cell_m, self._config.radius_m)
        self._add(sampled, T_world_lidar, prediction.velocity, self._map)
        first = State(sampled.stamp, T_world_lidar, prediction.velocity, last.covariance, sampled.seen_until_s)
        return MappedScan(first, T_world_lidar, False, Status.OK, added=True)

    def _lay_second(
        self, sampled: SampledScan, prior: Prior, prediction: Prediction, last: State, first: SampledScan,
        local_map: LocalMap,
    ) -> MappedScan:  # fmt: skip
        """Register the second scan; when the first turns out to have been moving, draw that anew, and register again.

        Two sweeps bent alike fit one another, and hide a motion that both have in common; the way between their poses
        does not.
        """
        carrier = self._carrier
        mapped = self._lay(sampled, prediction, last, local_map)
        if sampled.stamp <= last.stamp:  # no time went by, and no velocity shows
            return mapped
        for _ in range(_BEGINNINGS):
            way = log(inverse(last.T_world_lidar) @ mapped.state.T_world_lidar)
            if not mapped.registered or displacement_m(way, sampled.range_m) < local_map.cell_m:
                break
            last = self._begin_again(first, last, mapped.state)
            self._carrier, self._has_velocity = carrier, False
            prediction = predict(last, sampled.stamp, prior, carrier, self._config)
            assert self._map is not None
            mapped = self._lay(sampled, prediction, last, self._map)
        return mapped

    def _begin_again(self, first: SampledScan, last: State, curr: State) -> State:
        """Draw the first sweep with the motion that the second has shown.

        The way between the two poses is gone partly with the one's velocity and partly with the other's.
        """
        interval_s = curr.stamp - last.stamp
        share = min(1.0, last.seen_until_s / interval_s)
        seen = share * last.velocity + (1.0 - share) * curr.velocity
        hidden = body_velocity(inverse(last.T_world_lidar) @ curr.T_world_lidar, interval_s) - seen
        last = replace(last, velocity=last.velocity + hidden)
        self._map = LocalMap(first.cell_m, self._config.radius_m)
        self._add(first, last.T_world_lidar, last.velocity, self._map)
        return last

    def _lay(self, sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap) -> MappedScan:
        """Register a scan to the map; when it fits nowhere near, search; when it fits nowhere, keep it out."""
        if sampled.cell_m != local_map.cell_m:
            local_map = self._map = local_map.resized(sampled.cell_m)
        coarse_first = self._expected_error_m > _FINE_ENOUGH * local_map.cell_m
        placed = place(sampled, prediction, last, local_map, self._config, coarse_first)
        doubtful = self._lost_in_a_row > 0 and not placed.is_certain
        if doubtful or placed.status is Status.LOST:
            found = search(sampled, prediction, last, local_map, self._config)
            if found is None:
                return self._miss(sampled, prediction, placed.fit)
            placed = found
        elif placed.status is Status.DEGRADED and self._was_degraded:
            placed = search(sampled, prediction, last, local_map, self._config) or placed
        self._was_degraded = placed.status is Status.DEGRADED
        assert placed.refined is not None
        interval_s = sampled.stamp - last.stamp
        if interval_s > 0.0 and self._has_velocity:
            self._carrier = self._carrier.seen(placed.refined.velocity - last.velocity, interval_s)
        self._has_velocity = True
        return self._accept(sampled, prediction, last, placed, placed.refined)

    def _accept(
        self, sampled: SampledScan, prediction: Prediction, last: State, placed: Placed, refined: Refined
    ) -> MappedScan:
        """A scan that lies on the map where it was expected becomes part of it."""
        was_lost, self._lost_in_a_row = self._lost_in_a_row > 0, 0
        interval_s = sampled.stamp - last.stamp
        correction = log(inverse(prediction.T_world_lidar) @ refined.T_world_lidar)
        self._expected_error_m = max(_CAUTION * self._expected_error_m, displacement_m(correction, sampled.range_m))
        state = State(sampled.stamp, refined.T_world_lidar, refined.velocity, refined.covariance, sampled.seen_until_s)
        jumped = _has_jumped(correction, prediction)
        added = placed.status is Status.OK and not jumped
        if jumped:
            way = np.zeros(6)  # found again: where the last scan was is not known
            if not was_lost and interval_s > 0.0:  # one of the two sweeps was bent by a wrong velocity: go on with
                way = body_velocity(inverse(last.T_world_lidar) @ refined.T_world_lidar, interval_s)  # the way between
            state = State.astray(sampled.stamp, refined.T_world_lidar, way)
            self._has_velocity = False
        elif added:
            assert self._map is not None
            self._add(sampled, refined.T_world_lidar, refined.velocity, self._map)
        status, message = self._judge(placed, refined, correction, jumped)
        return MappedScan(
            state=state,
            T_world_expected=prediction.T_world_lidar,
            registered=True,
            status=status,
            message=message,
            fit=placed.fit,
            degenerate=refined.degeneracy.names,
            iterations=refined.iterations,
            added=added,
        )

    def _miss(self, sampled: SampledScan, prediction: Prediction, fit: Fit) -> MappedScan:
        """A scan that fits nowhere stays where it was expected, out of the map."""
        T_world_lidar = prediction.T_world_lidar
        message = fit.explain(self._config.tracking) if len(sampled) else "there is no point within range"
        self._lost_in_a_row += 1
        self._has_velocity = False
        self._expected_error_m = _UNKNOWN_M
        if self._lost_in_a_row >= self._config.tracking.give_up_after and len(sampled):
            self._map = LocalMap(sampled.cell_m, self._config.radius_m)
            self._add(sampled, T_world_lidar, prediction.velocity, self._map)
            self._lost_in_a_row = 0
            message += "; a new map is begun here"
        lost = State.astray(sampled.stamp, T_world_lidar, _FADING * prediction.velocity)
        return MappedScan(lost, T_world_lidar, False, Status.LOST, message, fit)

    def _judge(self, placed: Placed, refined: Refined, correction: FloatArray, jumped: bool) -> tuple[Status, str]:
        """The fit decides; one that fits far from where it was expected is degraded, and one that the prior holds."""
        if placed.status is not Status.OK:
            return placed.status, placed.fit.explain(self._config.tracking)
        if jumped:
            angle_deg, distance_m = np.rad2deg(np.linalg.norm(correction[:3])), np.linalg.norm(correction[3:])
            return Status.DEGRADED, f"{angle_deg:.0f} deg and {distance_m:.2f} m from where it was expected"
        if len(refined.degeneracy):
            return Status.DEGRADED, f"nothing to see along {', '.join(refined.degeneracy.names)}; the prior was kept"
        return Status.OK, ""

    @staticmethod
    def _add(sampled: SampledScan, T_world_lidar: FloatArray, velocity: FloatArray, local_map: LocalMap) -> None:
        points = compensated(sampled.points, sampled.times, velocity)
        edges = compensated(sampled.edges, sampled.edge_times, velocity)
        local_map.add(
            planes=transform_points(T_world_lidar, points),
            elevations=sampled.elevations,
            edges=transform_points(T_world_lidar, edges),
            sensor=T_world_lidar[:3, 3],
        )


def _has_jumped(correction: FloatArray, prediction: Prediction) -> bool:
    """Whether a pose lies farther from where it was expected than any carrier explains."""
    usual = np.maximum(_MOST_SIGMAS * np.sqrt(np.diag(prediction.pose_covariance)), _LEAST_JUMP)
    return bool((np.abs(correction) > usual).any())

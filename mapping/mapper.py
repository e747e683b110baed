"""Scan-to-map refinement: scan after scan is predicted, laid on the map, judged, and added to it.

LOAM's mapping (Zhang and Singh, RSS 2014), with any odometry before it or none.
"""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, displacement_m, inverse, log, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved
from lidarslam.core.state import State as Tree
from lidarslam.core.tracking import Status
from mapping.config import MappingConfig
from mapping.deskew import body_velocity
from mapping.prediction import Carrier, OdometryNoise, Prediction, Prior, State, predict
from mapping.registration import Refined, compensated
from mapping.sampling import SampledScan, Sampler
from mapping.surfels.surfel_map import LocalMap
from mapping.tracking.archived_maps import EarlierMaps
from mapping.tracking.attempts import (
    Placed,
    is_rivalled,
    place,
    place_displaced,
    place_surprised,
    search,
    search_everywhere,
)
from mapping.tracking.fit import Fit
from mapping.tracking.pose_status import Circumstances, has_jumped, judge
from mapping.tracking.tracking_state import Doubt

# Predictions that were off by less than this share of a cell need no coarser cells first; what they were off by is
# forgotten by this factor a scan.
_FINE_ENOUGH = 0.5
_CAUTION = 0.8
_UNKNOWN_M = 10.0
# Nothing goes on as it did for ever: while lost, the velocity fades by this from scan to scan.
_FADING = 0.7
# What was found without the prediction must fit better than what was found with it: a little when the carrier may have
# done anything, clearly when all displacements were searched.
_BETTER = 1.05
_CLEARLY_BETTER = 1.1
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
        way_known: whether it was followed here from the scan before; else it was found again, or is only expected here.
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
    way_known: bool = True


class Mapper:
    """Holds the local map and the state of the last scan."""

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._sampler = Sampler(config)
        self._map: LocalMap | None = None
        self._state: State | None = None
        self._carrier = Carrier()
        self._noise = OdometryNoise()
        self._expected_error_m = _UNKNOWN_M
        self._doubt = Doubt()
        self._earlier = EarlierMaps()
        self._scans_in_map = 0
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
            "noise": dict(vars(self._noise)),
            "expected_error_m": self._expected_error_m,
            "doubt": self._doubt.state(),
            "earlier": self._earlier.state(),
            "scans_in_map": self._scans_in_map,
            "first": None if self._first is None else self._first.state(),
            "has_velocity": self._has_velocity,
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""
        self._sampler.restore(saved.part("sampler"))
        self._map = saved.optional("map", LocalMap.restored)
        self._state = saved.optional("last", State.restored)
        self._carrier = Carrier.restored(saved.part("carrier"))
        self._noise = OdometryNoise.restored(saved.part("noise"))
        self._expected_error_m = saved.number("expected_error_m")
        self._doubt.restore(saved.part("doubt"))
        self._earlier.restore(saved.part("earlier"))
        self._scans_in_map = saved.integer("scans_in_map")
        self._first = saved.optional("first", SampledScan.restored)
        self._has_velocity = saved.flag("has_velocity")

    def process(self, scan: Scan, prior: Prior) -> MappedScan:
        """Lay the next scan on the map, and add it."""
        sampled = self._sampler.sample(scan)
        last = self._state or State.first(scan.stamp, prior.velocity)
        prediction = self._predict(sampled, prior, last, self._carrier)
        if self._map is None:
            mapped = self._begin(sampled, prediction, last)
            self._first = sampled if sampled.times is not None and self._config.continuous_time else None
        elif self._first is not None and (prior.velocity is None or _follows(sampled, self._first)):
            mapped = self._lay_second(sampled, prior, prediction, last, self._first, self._map)
            self._first = None
        else:
            mapped = self._lay(sampled, prior, prediction, last, self._map)
            self._first = None
        self._state = mapped.state
        return mapped

    def _predict(self, sampled: SampledScan, prior: Prior, last: State, carrier: Carrier) -> Prediction:
        return predict(last, sampled.stamp, prior, carrier, self._config, sampled.seen_from_s, self._noise)

    def _begin(self, sampled: SampledScan, prediction: Prediction, last: State) -> MappedScan:
        """The first scan makes the map."""
        T_world_lidar = prediction.T_world_lidar
        if self._is_blind(sampled):
            lost = State.astray(sampled.stamp, T_world_lidar, prediction.velocity)
            return MappedScan(lost, T_world_lidar, False, Status.LOST, _little_to_see(sampled), way_known=False)
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
        carrier, noise, doubt = self._carrier, self._noise, copy(self._doubt)
        mapped = self._lay(sampled, prior, prediction, last, local_map)
        if sampled.stamp <= last.stamp:  # no time went by, and no velocity shows
            return mapped
        for _ in range(_BEGINNINGS):
            way = log(inverse(last.T_world_lidar) @ mapped.state.T_world_lidar)
            if not mapped.registered or displacement_m(way, sampled.range_m) < local_map.cell_m:
                break
            last = self._begin_again(first, last, mapped.state)
            self._carrier, self._noise, self._doubt, self._has_velocity = carrier, noise, copy(doubt), False
            prediction = self._predict(sampled, prior, last, carrier)
            assert self._map is not None
            mapped = self._lay(sampled, prior, prediction, last, self._map)
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

    def _lay(
        self, sampled: SampledScan, prior: Prior, prediction: Prediction, last: State, local_map: LocalMap
    ) -> MappedScan:
        """Register a scan to the map; when it fits nowhere near, search; when it fits nowhere, keep it out."""
        if sampled.cell_m != local_map.cell_m:
            local_map = self._map = local_map.resized(sampled.cell_m)
        if self._is_blind(sampled):
            return self._see_nothing(sampled, prediction)
        near, expected = self._place_expected(sampled, prior, prediction, last, local_map)
        placed = self._look(near, sampled, expected, last, local_map)
        if placed is None:
            return self._miss(sampled, expected, near.fit)
        assert placed.refined is not None
        found = placed is not near
        if not found and self._doubt.is_unconfirmed and self._is_contradicted(placed, prior, expected, last):
            return self._miss(sampled, expected, near.fit)
        self._doubt.laid(placed.status, found, placed.quality, sampled.stamp)
        if not found:
            self._learn(placed.refined, prior, last, sampled.stamp - last.stamp)
        self._has_velocity = True
        unexpected = not found and has_jumped(_correction(prediction, placed.refined), prediction)
        return self._accept(sampled, expected, last, placed, placed.refined, found, unexpected)

    def _learn(self, refined: Refined, prior: Prior, last: State, interval_s: float) -> None:
        """Adapt the noise of carrier and odometry to a registered motion."""
        if interval_s > 0.0 and self._has_velocity:
            variance = np.diag(refined.covariance + last.covariance)[6:]
            self._carrier = self._carrier.seen(refined.velocity - last.velocity, interval_s, variance)
        self._noise = self._noise.seen(prior, inverse(last.T_world_lidar) @ refined.T_world_lidar, self._config)

    def _place_expected(
        self, sampled: SampledScan, prior: Prior, prediction: Prediction, last: State, local_map: LocalMap
    ) -> tuple[Placed, Prediction]:
        """A scan registered from where it is expected, with that expectation.

        Where odometry and motion contradict one another both are tried, and where the velocity is not known, or neither
        fits, all displacements.
        """
        best = self._place_near(sampled, prior, prediction, last, local_map), prediction
        if self._doubt.is_surprised(sampled.stamp - last.stamp):  # it may be anywhere, and what is found is confirmed
            return best
        if prediction.contradicted and self._has_velocity:
            alone = self._predict(sampled, Prior(), last, self._carrier)
            other = self._place_near(sampled, Prior(), alone, last, local_map), alone
            best = max(best, other, key=lambda tried: tried[0].quality)
        misled = prior.T_prev_curr is not None and best[0].status is not Status.OK
        if misled or not self._has_velocity:
            poses = (prediction.T_world_lidar, last.T_world_lidar)
            best = self._displaced(best, place_displaced(sampled, poses, last, local_map, self._config), local_map)
        return best

    def _displaced(
        self, best: tuple[Placed, Prediction], others: list[tuple[Placed, Prediction]], local_map: LocalMap
    ) -> tuple[Placed, Prediction]:
        """Of a registration and those from displacements the best, and whether another fits nearly as well."""
        for other in others:
            sure = other[0].is_beyond_doubt or not self._has_velocity
            if sure and other[0].quality > _CLEARLY_BETTER * best[0].quality:
                best = other
        placed, expected = best
        if placed.refined is None or self._has_velocity:
            return best
        rivalled = is_rivalled(placed, [other for other, _ in others], local_map)
        return replace(placed, rivalled=rivalled), expected

    def _place_near(
        self, sampled: SampledScan, prior: Prior, prediction: Prediction, last: State, local_map: LocalMap
    ) -> Placed:
        """A scan registered from where it is expected; when it fits badly, as if the carrier could do anything.

        An unexpected motion bends the sweep, and what is in reach of the expected one fits halfway: with the velocity
        that comes of it, the next scan would be expected farther off still.
        """
        coarse_first = self._expected_error_m > _FINE_ENOUGH * local_map.cell_m
        near = place(sampled, prediction, last, local_map, self._config, coarse_first)
        surprised = self._doubt.is_surprised(sampled.stamp - last.stamp)
        if surprised or not self._doubt.lies_badly(near.status, near.quality):
            return near
        anyhow = self._predict(sampled, prior, last, Carrier.wildest())
        again = place_surprised(sampled, anyhow, last, local_map, self._config)
        return again if again.is_beyond_doubt and again.quality > _BETTER * near.quality else near

    def _look(
        self, near: Placed, sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap
    ) -> Placed | None:
        """A scan that was laid on the map near where it was expected, or where it fits better; None when nowhere."""
        doubt, config = self._doubt, self._config
        surprised = doubt.is_surprised(sampled.stamp - last.stamp) or doubt.is_unconfirmed
        if near.status is Status.LOST or (surprised and not near.is_beyond_doubt):
            return self._look_everywhere(near, sampled, prediction, last, local_map)
        if near.status is Status.DEGRADED and doubt.looks_around:
            found = search(sampled, prediction, last, local_map, config)
            return found if found is not None and found.quality > near.quality else near
        if near.status is Status.OK and not doubt.is_unconfirmed:
            back = self._earlier.look(sampled, prediction, last, config)
            if back is not None:
                self._map = back.local_map
                return back.placed
        return near

    def _is_contradicted(self, placed: Placed, prior: Prior, prediction: Prediction, last: State) -> bool:
        """Whether the way since the last scan contradicts the place where the sensor was found again."""
        assert placed.refined is not None
        jumped = has_jumped(_correction(prediction, placed.refined), prediction)
        way = inverse(last.T_world_lidar) @ placed.refined.T_world_lidar
        return jumped or self._noise.contradicts(prior, way, self._config)

    def _look_everywhere(
        self, near: Placed, sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap
    ) -> Placed | None:
        """Turned on the spot, then all over the map; what fits best counts, if it fits well."""
        believable = near.is_beyond_doubt if self._doubt.is_unconfirmed else near.is_certain
        places = [near] if near.status is not Status.LOST and believable else []
        places += [found] if (found := search(sampled, prediction, last, local_map, self._config)) else []
        if not any(placed.is_beyond_doubt for placed in places) and self._doubt.looks_everywhere:
            there = search_everywhere(sampled, prediction, last, local_map, self._config)
            places += [there] if there else []
        return max(places, key=lambda placed: placed.quality, default=None)

    def _accept(
        self, sampled: SampledScan, prediction: Prediction, last: State, placed: Placed, refined: Refined, found: bool,
        unexpected: bool,
    ) -> MappedScan:  # fmt: skip
        """A scan that lies on the map where it was expected becomes part of it."""
        interval_s = sampled.stamp - last.stamp
        correction = _correction(prediction, refined)
        self._expected_error_m = max(_CAUTION * self._expected_error_m, displacement_m(correction, sampled.range_m))
        state = State(sampled.stamp, refined.T_world_lidar, refined.velocity, refined.covariance, sampled.seen_until_s)
        jumped = has_jumped(correction, prediction)
        added = placed.status is Status.OK and not jumped and not self._doubt.is_unconfirmed
        if jumped or found:
            # Found again: where the last scan was is not known. How it moved shows within the sweep, if anywhere.
            seen = self._config.continuous_time and sampled.times is not None
            way = refined.velocity if found and seen else np.zeros(6)
            if not found and interval_s > 0.0:  # one of the two sweeps was bent by a wrong velocity: go on with
                way = body_velocity(inverse(last.T_world_lidar) @ refined.T_world_lidar, interval_s)  # the way between
            state = State.astray(sampled.stamp, refined.T_world_lidar, way)
            self._has_velocity = False
        elif added:
            assert self._map is not None
            self._add(sampled, refined.T_world_lidar, refined.velocity, self._map)
        now = Circumstances(found, self._doubt.is_unconfirmed, len(self._earlier) > 0, unexpected)
        status, message = judge(placed, correction, jumped, now, self._config.tracking)
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
            way_known=not found,
        )

    def _is_blind(self, sampled: SampledScan) -> bool:
        """Whether the sensor sees next to nothing: it is covered, or looks into the open."""
        return len(sampled.keys) < self._config.refinement.min_matches

    def _see_nothing(self, sampled: SampledScan, prediction: Prediction) -> MappedScan:
        """What has nothing to see says nothing of where it is: it waits, and the map with it."""
        self._doubt.saw_nothing()
        return self._lose(sampled, prediction, None, _little_to_see(sampled))

    def _miss(self, sampled: SampledScan, prediction: Prediction, fit: Fit) -> MappedScan:
        """A scan that fits nowhere stays where it was expected, out of the map."""
        message = fit.explain(self._config.tracking) or "it may lie here, or elsewhere in the map"
        self._doubt.missed()
        if self._doubt.lost_in_a_row >= self._config.tracking.give_up_after:
            assert self._map is not None
            self._earlier.set_aside(self._map, self._scans_in_map)
            self._map, self._scans_in_map = LocalMap(sampled.cell_m, self._config.radius_m), 0
            self._add(sampled, prediction.T_world_lidar, prediction.velocity, self._map)
            self._doubt.began_anew()
            message += "; a new map is begun here"
        return self._lose(sampled, prediction, fit, message)

    def _lose(self, sampled: SampledScan, prediction: Prediction, fit: Fit | None, message: str) -> MappedScan:
        self._has_velocity = False
        self._expected_error_m = _UNKNOWN_M
        lost = State.astray(sampled.stamp, prediction.T_world_lidar, _FADING * prediction.velocity)
        return MappedScan(lost, prediction.T_world_lidar, False, Status.LOST, message, fit, way_known=False)

    def _add(self, sampled: SampledScan, T_world_lidar: FloatArray, velocity: FloatArray, local_map: LocalMap) -> None:
        self._scans_in_map += 1
        points = compensated(sampled.points, sampled.times, velocity)
        local_map.add(
            planes=transform_points(T_world_lidar, points),
            elevations=sampled.elevations,
            sensor=T_world_lidar[:3, 3],
        )


def _follows(sampled: SampledScan, first: SampledScan) -> bool:
    """Whether a sweep begins about where the first one ended, so that the way between them shows how that moved."""
    gap_s = sampled.stamp - sampled.seen_from_s - first.stamp - first.seen_until_s
    return gap_s < first.seen_from_s + first.seen_until_s


def _correction(prediction: Prediction, refined: Refined) -> FloatArray:
    """(6,) from the expected pose to the registered one."""
    return log(inverse(prediction.T_world_lidar) @ refined.T_world_lidar)


def _little_to_see(sampled: SampledScan) -> str:
    if not len(sampled):
        return "there is no point within range"
    return f"only {len(sampled)} points within range: too few to tell anything"

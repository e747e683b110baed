"""Search for a scan's pose near its prediction: one strategy after another, each for what the others miss."""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.tracking import Status
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.motion.prediction import (
    LARGEST_PROCESS_NOISE,
    UNKNOWN_VELOCITY,
    Prediction,
    Prior,
    ProcessNoise,
    predict,
)
from lidarslam.mapping.surfels.surfel_map import constraining_points
from lidarslam.mapping.tracking.budget import Steps
from lidarslam.mapping.tracking.mapped_scan import Attempt
from lidarslam.mapping.tracking.scan_matcher import (
    SCORED_POINTS,
    ScanMatcher,
    best_supported,
    best_velocity,
    positions_around,
)
from lidarslam.mapping.tracking.tracking_state import TrackingState

# Factors by which the quality of a result with any acceleration, of one from elsewhere, and of one that contradicts the
# odometry, or with any acceleration leaves a direction unconstrained, must be better.
_BETTER, _CLEARLY_BETTER, _MUCH_BETTER = 1.05, 1.1, 1.3
# A scan constrains its weakest direction poorly below this support or evidence: a fifth of the scans on stairs, in
# offices, streets and crowds none. There an odometry counts with this many times its own standard deviations, after
# motions of fewer cells than this: after longer ones it may itself be off by a step.
_WEAK_SUPPORT, _WEAK_EVIDENCE, WEAK_CAUTION, _WEAK_CELLS = 0.65, 40.0, 1.0, 6.0
# Where even less constrains it, as in a corridor, only the prediction does: evidence in units of the least.
_LEAST_CONSTRAINT = 2.0
# Changes of the yaw rate tried on a scan that fits poorly, rad/s: from full speed one way to full speed the other.
_YAW_RATES = np.deg2rad(np.arange(-400.0, 401.0, 50.0))
# Displacements tried where the velocity is unknown: the speed of a car, at most the median range, and their spacing in
# cells, within reach of the coarse cells.
_FASTEST_M_S = 50.0
_DISPLACED_CELLS = 3.0
# Where the velocity is known, but the position not to this many cells and not measured, those within so many standard
# deviations, at most so many on each side.
_OPEN_CELLS, _OPEN_SIGMAS, _MOST_DISPLACED = 3.0, 3.0, 8
# An IMU that predicts the position to this many cells leaves no other displacement to try, if the scan fits.
_CERTAIN_CELLS = 0.25
# Most points that constrain directions that few others do, by which a displacement is chosen.
_MOST_CONSTRAINING = 600
# Displacements tried along the least constrained direction, and the largest that is taken, cells.
_ALONG_CELLS, _MOST_ALONG_CELLS = (-2.0, -1.0, 1.0, 2.0), 3.0
# Factor on the odometry's own standard deviations in the likelihood of these.
_LIKELIHOOD_CAUTION = 2.0
# Distance of another optimum, cells.
_APART_CELLS = 1.0
# Standard deviations of the prediction within which rivals are looked for along the least constrained direction, where
# one is at least so many cells; their spacing and largest distance from the prediction, cells.
_RIVAL_SIGMAS, _LEAST_RIVAL_CELLS, _RIVAL_CELLS, _MOST_RIVAL_CELLS = 2.0, 2.0, 2.0, 16.0


@dataclass(frozen=True, eq=False)
class NearSearch:
    """Registers a scan near its prediction."""

    matcher: ScanMatcher
    state: TrackingState  # before the scan
    prior: Prior
    prediction: Prediction  # from the last motion and the prior

    def best(self) -> Attempt:
        """The best attempt of all strategies, each of which takes the best so far and returns that or a better one."""
        best = self.at_prediction()
        for strategy in (
            self.held_by_odometry,
            self.with_any_acceleration,
            self.without_odometry,
            self.at_any_speed,
            self.from_odometry,
            self.along_weakest,
            self.against_rivals,
        ):
            if self.matcher.budget.is_spent:
                break
            best = strategy(best)
        return best

    def at_prediction(self) -> Attempt:
        """The attempt from the prediction alone."""
        return self.matcher.register(self.prediction, self.state.begins_coarse(self.matcher.scan, self.prediction))

    def contradicts(self, attempt: Attempt, caution: float = WEAK_CAUTION) -> bool:
        """Whether an attempt contradicts an odometry that was consistent so far, as the next step of stairs does."""
        prior = replace(self.prior, caution=caution)
        return self.state.odometry_noise.agrees(prior, self._motion(attempt), self.matcher.config) is False

    def continued(self, prediction: Prediction) -> Prediction:
        """Where a scan without a registration is: by a proven odometry at its own covariance, else as predicted."""
        if not self.state.is_measured or self.prior.inertial is not None:
            return prediction
        return self._predict(replace(self.prior, caution=WEAK_CAUTION))

    def _predict(self, prior: Prior, process_noise: ProcessNoise | None = None) -> Prediction:
        return self.state.predict(self.matcher.scan, prior, self.matcher.last, self.matcher.config, process_noise)

    def held_by_odometry(self, near: Attempt) -> Attempt:
        """Where the scan constrains a direction poorly, or is lost: held closer to the odometry's motion.

        Errors of an odometry are correlated in time, but so are those of the few surfaces that constrain the scan.
        """
        prior, fit = self.prior, near.fit
        if prior.covariance is None or prior.T_prev_curr is None or prior.inertial is not None:
            return near
        moved_m = float(np.linalg.norm(prior.T_prev_curr[:3, 3]))
        is_weak = (fit.support or 0.0) < _WEAK_SUPPORT or (fit.evidence or 0.0) < _WEAK_EVIDENCE
        counts = fit.constraint >= _LEAST_CONSTRAINT or not self.matcher.scan.has_rings
        is_weak &= counts or near.status is Status.LOST
        if not is_weak or moved_m > _WEAK_CELLS * self.matcher.scan.cell_m:
            return near
        held = self.matcher.register(self._predict(replace(prior, caution=WEAK_CAUTION)), coarse_first=False)
        factor = _MUCH_BETTER if self.contradicts(near) else _BETTER
        return replace(held, prediction=near.prediction) if factor * held.quality > near.quality else near

    def with_any_acceleration(self, near: Attempt) -> Attempt:
        """Where the scan fits poorly: from several yaw rates, patiently, with any acceleration.

        An unexpected motion bends the sweep, which then fits halfway at a wrong pose and velocity.
        """
        if not self.state.fits_poorly(near.status, near.quality):
            return near
        matcher, prediction = self.matcher, self._predict(self.prior, LARGEST_PROCESS_NOISE)
        keypoints, attempts = matcher.scan.keypoints, [matcher.attempt(prediction, prediction, patient=True)]
        if matcher.config.continuous_time and keypoints.times is not None and not matcher.budget.is_spent:
            up = prediction.T_world_lidar[:3, :3].T @ matcher.local_map.vertical()
            velocities = prediction.velocity + np.outer(_YAW_RATES, np.concatenate([up, np.zeros(3)]))
            velocity = best_velocity(keypoints, velocities, prediction.T_world_lidar, matcher.local_map)
            if not (np.array_equal(velocity, prediction.velocity) or matcher.budget.is_spent):
                attempts.append(matcher.attempt(prediction, replace(prediction, velocity=velocity), patient=True))
        turning = max(attempts, key=lambda attempt: attempt.quality)
        is_near = near.status is not Status.LOST and _apart_m(turning, near) < matcher.scan.cell_m  # the same optimum
        factor = _MUCH_BETTER if turning.unconstrained else _BETTER
        is_better = (turning.is_reliable or is_near) and turning.quality > factor * near.quality
        if not is_better or self._is_similar(turning, near):
            return near
        return replace(turning, prediction=self.prediction)

    def without_odometry(self, near: Attempt) -> Attempt:
        """Where the odometry is contradicted, or the scan fits poorly with it: by the last motion alone."""
        if not self.state.velocity_known or not (self.prediction.contradicted or self._is_poor(near)):
            return near
        prior = Prior(inertial=self.prior.inertial)
        alone = replace(self, prior=prior, prediction=self._predict(prior))
        other = alone.at_prediction()
        other = other if self.matcher.budget.is_spent else alone.with_any_acceleration(other)
        # Where odometry and last motion agree, another pose is that of a similar place, as the next flight.
        is_similar = not self.prediction.contradicted and self.contradicts(other)
        return other if other.quality > near.quality and not is_similar else near

    def at_any_speed(self, near: Attempt) -> Attempt:
        """Where velocity or position is open, or the odometry poor: displaced; a rival is a place that fits as well."""
        # Sparse strokes fit many places: their smoothed motion is better known, as is one by an IMU, if the scan fits.
        is_sparse = not (self.matcher.scan.has_rings or self.prediction.is_inertial)
        within_m = _CERTAIN_CELLS * self.matcher.scan.cell_m
        is_held = near.status is Status.OK and self.prediction.is_held_within(within_m)
        is_known = self.state.velocity_known or is_held or (is_sparse and self.prediction.is_smoothed)
        is_open = not is_known or self._is_open
        if not is_open and not self._is_poor(near):
            return near
        displaced = self.matcher.budget.run(self._displaced())
        if displaced is None:
            return near
        best, (others,) = near, displaced
        for other in others:
            # With a known velocity, a place that leaves a direction unconstrained is no better than the prediction.
            counts = (other.is_reliable and not other.unconstrained) or not is_known
            is_better = counts and other.quality > _CLEARLY_BETTER * best.quality
            if is_better and not self._is_similar(other, near):
                best = other
        if not is_open or best.registration is None:
            return best
        return replace(best, rival=best.rival_of(others), elsewhere=tuple(other.T_world_lidar for other in others))

    def _displaced(self) -> Steps[list[Attempt]]:
        """Attempts that fit, from displacements since the last scan in every horizontal direction.

        A sensor at speed at the first scan, or with a wrong odometry, is out of reach of the predicted pose, and most
        of a street fits there too. The rotations are the predicted and the last one.
        """
        scan, last, local_map = self.matcher.scan, self.matcher.last, self.matcher.local_map
        interval_s = scan.stamp - last.stamp
        if interval_s <= 0.0:
            return []
        radius_m, up = min(_FASTEST_M_S * interval_s, scan.range_m), local_map.vertical()
        spacing_m, starts = _DISPLACED_CELLS * local_map.cell_m, []
        if self.state.velocity_known and self._is_open:
            radius_m = min(radius_m, _OPEN_SIGMAS * self.prediction.sigma_m)
            spacing_m = max(spacing_m, radius_m / _MOST_DISPLACED)
        for rotation in (self.prediction.T_world_lidar, last.T_world_lidar):
            T = last.T_world_lidar.copy()
            T[:3, :3] = rotation[:3, :3]
            starts.append(positions_around(T, up, radius_m, spacing_m))
        few = constraining_points(scan.sweep.points, scan.elevations, local_map.cell_m, _MOST_CONSTRAINING)
        parts = self.matcher.some(SCORED_POINTS), scan.sweep.take(few)
        points = np.concatenate([part.compensated(last.velocity) for part in parts])
        attempts = []
        best = yield from best_supported(points, np.concatenate(starts), local_map)
        for start in {start.tobytes(): start for start in best}.values():
            yield
            velocity = body_velocity(inverse(last.T_world_lidar) @ start, interval_s)
            moving = replace(last, velocity=velocity, covariance=UNKNOWN_VELOCITY)
            prediction = predict(moving, scan.stamp, Prior(), ProcessNoise(), self.matcher.config, scan.seen_from_s)
            attempts.append(self.matcher.attempt(prediction, prediction, patient=True))
        return [attempt for attempt in attempts if attempt.status is Status.OK]

    def from_odometry(self, near: Attempt) -> Attempt:
        """Where the prediction is uncertain along the weakest direction: from the odometry's motion.

        Of several optima, as on stairs, the prediction's may be the next step's. Where nothing constrains the scan any
        more, as off the faces of a few boxes in a corridor, any pose fits.
        """
        prior, prediction = self.prior, near.prediction
        if prior.T_prev_curr is None or prediction.is_inertial or not near.fit.is_constrained:  # an IMU's is better
            return near
        if near.fit.weakest is None:
            return near
        direction, apart_m = np.array(near.fit.weakest), _APART_CELLS * self.matcher.local_map.cell_m
        T_world_lidar = self.matcher.last.T_world_lidar @ prior.T_prev_curr
        away_m = abs(float(direction @ (T_world_lidar - near.T_world_lidar)[:3, 3]))
        if prediction.sigma_along(direction) < apart_m or away_m < apart_m:
            return near
        start = replace(prediction, T_world_lidar=T_world_lidar)
        other = self.matcher.attempt(prediction, start, coarse_first=False)
        return other if other.fit.is_constrained and other.quality > _CLEARLY_BETTER * near.quality else near

    def along_weakest(self, near: Attempt) -> Attempt:
        """Where the scan fits poorly: a few cells away along its weakest direction.

        Steps and boxes make several optima, and coarse cells merge them; farther away, another step looks the same. The
        likelihood of their motions by the odometry counts, too.
        """
        if near.status is Status.OK or near.fit.weakest is None or not near.fit.is_constrained:
            return near
        cell_m, here = self.matcher.local_map.cell_m, replace(near.prediction, T_world_lidar=near.T_world_lidar)
        offsets_m = [cells * cell_m for cells in _ALONG_CELLS]
        starts = self.matcher.displaced(here, offsets_m, np.array(near.fit.weakest))
        others = [self.matcher.attempt(near.prediction, start, coarse_first=False) for start in starts]
        others = [other for other in others if _apart_m(other, near) < _MOST_ALONG_CELLS * cell_m]
        best = max(others, key=self._likely_quality, default=near)
        return best if self._likely_quality(best) > _CLEARLY_BETTER * self._likely_quality(near) else near

    def against_rivals(self, near: Attempt) -> Attempt:
        """Where an odometry leaves the weakest direction uncertain: another place along it that fits is a rival.

        At low rates on stairs, the odometry is uncertain by more than the next step, and half of the steps fit.
        """
        prediction, cell_m = near.prediction, self.matcher.local_map.cell_m
        is_measured = self.prior.T_prev_curr is not None and self.state.velocity_known
        if near.status is Status.LOST or near.fit.weakest is None or not is_measured:
            return near
        direction = np.array(near.fit.weakest)
        sigma_m = prediction.sigma_along(direction)
        if sigma_m < _LEAST_RIVAL_CELLS * cell_m:
            return near
        away_m = float(direction @ (near.T_world_lidar - prediction.T_world_lidar)[:3, 3])
        count = int(min(_RIVAL_SIGMAS * sigma_m / cell_m, _MOST_RIVAL_CELLS) / _RIVAL_CELLS)
        offsets_m = np.arange(-count, count + 1) * _RIVAL_CELLS * cell_m - away_m
        here = replace(prediction, T_world_lidar=near.T_world_lidar)
        farther_m = sorted(offsets_m[np.abs(offsets_m) > _RIVAL_CELLS * cell_m], key=abs)
        for start in self.matcher.displaced(here, farther_m, direction):
            rival = near.rival_of([self.matcher.attempt(prediction, start, coarse_first=False)])
            if rival is not None:
                return replace(near, rival=rival)
        return near

    def _likely_quality(self, attempt: Attempt) -> float:
        """The quality of an attempt, times the likelihood of its motion by a proven odometry."""
        prior, noise = replace(self.prior, caution=_LIKELIHOOD_CAUTION), self.state.odometry_noise
        return attempt.quality * noise.likelihood(prior, self._motion(attempt), self.matcher.config)

    def _is_similar(self, other: Attempt, near: Attempt) -> bool:
        """Whether of two attempts only the other contradicts the odometry: a similar place, as the next step of stairs.

        Where the scan is lost near the prediction, the odometry may be wrong.
        """
        return near.status is not Status.LOST and self.contradicts(other) and not self.contradicts(near)

    def _motion(self, attempt: Attempt) -> FloatArray:
        """(4, 4) since the last scan."""
        return inverse(self.matcher.last.T_world_lidar) @ attempt.T_world_lidar

    @property
    def _is_open(self) -> bool:
        """Whether the position is predicted worse than a registration converges, and not measured."""
        is_measured = self.prior.T_prev_curr is not None or self.prediction.is_inertial
        return not is_measured and self.prediction.sigma_m > _OPEN_CELLS * self.matcher.local_map.cell_m

    def _is_poor(self, near: Attempt) -> bool:
        """Whether a scan fits poorly where an odometry measured its motion."""
        return self.prior.T_prev_curr is not None and near.status is not Status.OK


def _apart_m(one: Attempt, other: Attempt) -> float:
    return float(np.linalg.norm(one.T_world_lidar[:3, 3] - other.T_world_lidar[:3, 3]))

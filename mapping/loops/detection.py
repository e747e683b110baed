"""Loop closures: each new keyframe is held against earlier ones near it or like it, and what fits is judged.

Precision comes before recall: a false closure tears a map apart, a missed one leaves it as good as it was. What drift
cannot explain is not believed within a session; where tracking was lost, go on with a new session number.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State, stack
from mapping.loops.candidates import Candidate, FoundBy, Keyframes, most_sigmas
from mapping.loops.consistency import Link, beyond_drift, close_circle
from mapping.loops.loop_config import LoopConfig
from mapping.loops.verification import Verification, verify

Verdict = Literal["accepted", "rejected"]

# Circles that may be off by more than this, of the median range, tell nothing.
_TELLING_RANGES = 0.25
# Places found by how they look need so many times the agreement of what contradicts them, of which the last count.
_OUTVOTED = 3
_RIVALS = 5
# A closure is held against at most so many of those before it.
_MEMORY = 40
# What is saved of a closure beside its arrays.
_COLUMNS = (
    "first", "second", "overlap", "residual_m", "inlier_ratio", "found_by", "consistent", "verdict", "reason",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Submap:
    """What was seen around a keyframe.

    Attributes:
        index: of the keyframe, from 0 without gaps, over all sessions.
        session: which recording; keyframes of one follow one another.
        way_m: path length from the session's start.
        points: (N, 3) in the keyframe's LiDAR frame, compensated and thinned.
    """

    index: int
    session: int
    way_m: float
    points: FloatArray


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """One place seen twice, or said to be.

    Attributes:
        first, second: the keyframes; the second is the later one.
        T_first_second: (4, 4).
        covariance: (6, 6) of xi in `T_true = T_first_second @ exp(xi)`, rotation first.
        overlap: 0 to 1, share of what each sees of the other that fits; the worse side.
        residual_m: root mean square distance of what fits.
        inlier_ratio: share of the second's points that fit.
        found_by: by the estimate, or by how the place looks.
        consistent: how many other closures agree.
        verdict, reason: whether to believe it; why not.
    """

    first: int
    second: int
    T_first_second: FloatArray
    covariance: FloatArray
    overlap: float
    residual_m: float
    inlier_ratio: float
    found_by: FoundBy
    consistent: int
    verdict: Verdict
    reason: str

    @property
    def link(self) -> Link:
        """As consistency sees it."""
        return Link(self.first, self.second, self.T_first_second, self.covariance)


def closures_state(closures: Sequence[LoopClosure]) -> State:
    """All of several closures, column by column: an array of them is written sooner than arrays of each."""
    state: State = {name: [getattr(closure, name) for closure in closures] for name in _COLUMNS}
    state["T_first_second"] = stack([closure.T_first_second for closure in closures], (4, 4))
    state["covariance"] = stack([closure.covariance for closure in closures], (6, 6))
    return state


def restored_closures(saved: Saved) -> list[LoopClosure]:
    """The closures with a state."""
    firsts = saved.integers("first")
    T_first_second = saved.array("T_first_second", (len(firsts), 4, 4))
    covariance = saved.array("covariance", (len(firsts), 6, 6))
    found_by, verdicts = saved.texts("found_by"), saved.texts("verdict")
    if not (set(found_by) <= set(get_args(FoundBy)) and set(verdicts) <= set(get_args(Verdict))):
        raise saved.refuse(f"closures found by {set(found_by)} were {set(verdicts)}")
    columns = (
        firsts, saved.integers("second"), T_first_second, covariance, saved.numbers("overlap"),
        saved.numbers("residual_m"), saved.numbers("inlier_ratio"), found_by, saved.integers("consistent"), verdicts,
        saved.texts("reason"),
    )  # fmt: skip
    if {len(column) for column in columns} != {len(firsts)}:
        raise saved.refuse("closures have columns of several lengths")
    return [LoopClosure(*values) for values in zip(*columns, strict=True)]


class LoopDetector:
    """Keeps what is needed of every keyframe, and finds closures among them."""

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self._kept = Keyframes(config)
        self._accepted: list[LoopClosure] = []
        self._pending: list[LoopClosure] = []

    @property
    def nbytes(self) -> int:
        """Memory of what is kept."""
        return self._kept.nbytes

    def cell_m(self, index: int) -> float:
        """The size of detail that suits what a keyframe saw."""
        return self._kept.patches[index].cell_m

    def state(self) -> State:
        """The closures, and the estimates of keyframes; not what is kept of their submaps."""
        return {
            "keyframes": self._kept.state(),
            "accepted": closures_state(self._accepted),
            "pending": closures_state(self._pending),
        }

    def restore(self, saved: Saved, submaps: Iterable[FloatArray]) -> None:
        """Go on from a state, and the points (N, 3) of all submaps there were."""
        self._kept.restore(saved.part("keyframes"), submaps)
        self._accepted = restored_closures(saved.part("accepted"))
        self._pending = restored_closures(saved.part("pending"))

    def add(self, submap: Submap, poses: FloatArray) -> list[LoopClosure]:
        """Take the next keyframe, and say which closures are decided by now.

        Args:
            submap: of the keyframe.
            poses: (K, 4, 4) `T_world_lidar` of all keyframes, this one last, as they are estimated now.

        Raises:
            ValueError: keyframes do not come one by one, or the poses are not theirs.
        """
        kept = self._kept
        if submap.index != len(kept) or poses.shape != (submap.index + 1, 4, 4):
            raise ValueError(f"expected keyframe {len(kept)} with as many poses, got {submap.index}")
        kept.add(submap.points, submap.way_m, submap.session, poses)
        decided = self._drop_old(submap)
        if len(kept.patches[-1]) < self._config.min_inliers or self._is_soon(submap):
            return decided
        return decided + self._look(submap.index)

    def finish(self) -> list[LoopClosure]:
        """Closures that nothing agreed with to the end, as rejected."""
        left = [self._refused(closure, "no other closure agrees") for closure in self._pending]
        self._pending = []
        return left

    def _is_soon(self, submap: Submap) -> bool:
        """Whether the last closure is so recent that another would say the same."""
        if self._pending or not self._accepted:
            return False
        last, track = self._accepted[-1].second, self._kept.track
        return bool(track.session[last] == submap.session and submap.way_m - track.way_m[last] < self._config.spacing_m)

    def _look(self, index: int) -> list[LoopClosure]:
        """Verify a keyframe's candidates, and decide on those that fit."""
        decided: list[LoopClosure] = []
        source = self._kept.place(index)
        for candidate in self._kept.candidates(index):
            found = verify(self._kept.place(candidate.index), source, candidate.T_first_second)
            if found is None:
                continue
            closure = _closure(candidate, index, found)
            objection = found.objection(self._config) or self._beyond_drift(closure)
            if objection:
                decided.append(self._refused(closure, objection))
                continue
            self._pending.append(closure)
            accepted = self._decide()
            decided += accepted
            if any(one.second == index for one in accepted):
                break
        return decided

    def _beyond_drift(self, closure: LoopClosure) -> str:
        return beyond_drift(closure.link, self._kept.track, most_sigmas(closure.found_by, self._config), self._config)

    def _decide(self) -> list[LoopClosure]:
        """Accept what enough others support, again and again until nothing changes."""
        accepted: list[LoopClosure] = []
        while True:
            for closure in self._pending:
                supported, count = self._support(closure)
                if supported:
                    break
            else:
                return accepted
            self._pending.remove(closure)
            accepted.append(replace(closure, consistent=count))
            self._accepted.append(accepted[-1])

    def _support(self, closure: LoopClosure) -> tuple[bool, int]:
        """Whether to believe a closure, and how many others agree; those not decided upon count too."""
        config, track = self._config, self._kept.track
        range_m = self._kept.patches[closure.second].range_m
        agreeing, against = self._judged_by_others(closure)
        # What disagrees weighs as much as agrees with it in turn: a wrong closure mostly stands alone. Where places
        # repeat, wrong ones agree among themselves; then the estimate is what to go by.
        rival = max((len(self._judged_by_others(other)[0]) for other in against[-_RIVALS:]), default=0)
        if against and rival * (1 if closure.found_by == "nearby" else _OUTVOTED) >= max(len(agreeing), 1):
            return False, len(agreeing)
        if track.session[closure.first] == track.session[closure.second]:
            _, drift_m = track.drift(np.array([closure.first]), closure.second, config)
            if closure.found_by == "nearby" and drift_m[0] < config.alone_ranges * range_m:
                return True, len(agreeing)
        places = track.way_m[[closure.second, *(other.second for other in agreeing)]]
        spread = float(np.ptp(places)) >= config.agreeing_span_ranges * range_m
        return len(agreeing) >= config.agreeing and (spread or not config.agreeing), len(agreeing)

    def _judged_by_others(self, closure: LoopClosure) -> tuple[list[LoopClosure], list[LoopClosure]]:
        """Which others agree with a closure and which do not, of those near enough for that to tell."""
        most_m = _TELLING_RANGES * self._kept.patches[closure.second].range_m
        agreeing: list[LoopClosure] = []
        against: list[LoopClosure] = []
        for other in [*self._accepted[-_MEMORY:], *self._pending[-_MEMORY:]]:
            circle = (
                None if other is closure else close_circle(closure.link, other.link, self._kept.track, self._config)
            )
            # A long way round closes whatever the links say.
            if circle is not None and circle.sigma_m <= most_m:
                (agreeing if circle.closes else against).append(other)
        return agreeing, against

    def _drop_old(self, submap: Submap) -> list[LoopClosure]:
        """Closures that nothing agreed with for too long, as rejected."""
        way_m, session = self._kept.track.way_m, self._kept.track.session
        old = [
            c for c in self._pending
            if session[c.second] != submap.session or submap.way_m - way_m[c.second] > self._config.pending_m
        ]  # fmt: skip
        self._pending = [closure for closure in self._pending if closure not in old]
        return [self._refused(closure, "no other closure agrees") for closure in old]

    def _refused(self, closure: LoopClosure, reason: str) -> LoopClosure:
        return replace(closure, verdict="rejected", reason=reason)


def _closure(candidate: Candidate, second: int, found: Verification) -> LoopClosure:
    return LoopClosure(
        candidate.index, second, found.T_target_source, found.covariance, found.overlap, found.residual_m,
        found.inlier_ratio, candidate.found_by, 0, "accepted", "",
    )  # fmt: skip

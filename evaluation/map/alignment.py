"""Bringing a map to the frame of a reference map; the pose is returned, nothing is moved."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from evaluation.map.global_registration import candidate_poses, is_same
from evaluation.map.voxel_thinning import thin
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, rotation_angle, transform_points

GLOBAL = "global"

# A wrong pose in a building puts a quarter of a map on some wall or floor, a right one most of it.
TRUSTED_FITNESS = 0.5
_DISTINCT_SHARE = 0.9
_DISTINCT_M = 1.0

_FINEST_CELL_M = 0.1
_MOST_POINTS = 150_000
_LEAST_INLIER_M = 0.2
# ICP looks for partners this far away, coarse to fine.
_ICP_STAGES_M = (2.0, 1.0, 0.5)
_ICP_ITERATIONS = 40
# Fewer lie on anything.
_FEWEST_POINTS = 30
# Extents that differ by this factor differ in unit: no recording sees a hundredth of its survey and fits nowhere.
_OTHER_UNIT = 100.0
# Of the map's points, while many poses are tried.
_SEARCH_POINTS = 10_000


@dataclass(frozen=True, eq=False)
class MapAlignment:
    """The pose of a map in the frame of its reference, and what speaks for it.

    Attributes:
        T_reference_map: (4, 4).
        method: the guess that it goes back to: "trajectory", "file", "none" or "global".
        refined: whether ICP had its say.
        fitness: share of the map's points that have a point of the reference within `inlier_m`, 0 to 1.
        inlier_rmse_m: root mean square distance of those; None when there are none.
        inlier_m: how near is near.
        moved_m: how far ICP moved the map's middle; this much misplacement no longer shows in the map's errors.
        moved_deg: how far ICP turned it.
        runner_up: fitness of the next best, different pose of a global search.
    """

    T_reference_map: FloatArray
    method: str
    refined: bool
    fitness: float
    inlier_rmse_m: float | None
    inlier_m: float
    moved_m: float = 0.0
    moved_deg: float = 0.0
    runner_up: float | None = None

    @property
    def is_trustworthy(self) -> bool:
        """Whether half of the map lies on the reference, and in no other way nearly as well."""
        distinct = self.runner_up is None or self.runner_up < _DISTINCT_SHARE * self.fitness
        return self.fitness >= TRUSTED_FITNESS and distinct

    def to_json(self) -> dict[str, object]:
        """All of it, for metrics.json."""
        return {
            "method": self.method,
            "refined": self.refined,
            "T_reference_map": self.T_reference_map.tolist(),
            "fitness": self.fitness,
            "inlier_rmse_m": self.inlier_rmse_m,
            "inlier_m": self.inlier_m,
            "moved_m": self.moved_m,
            "moved_deg": self.moved_deg,
            "trustworthy": self.is_trustworthy,
        }


def align_map(
    map_points: FloatArray,
    reference_points: FloatArray,
    guesses: Mapping[str, FloatArray],
    search: bool = False,
    refine: bool = True,
) -> MapAlignment:
    """The pose of a map (N, 3) in the frame of a reference (M, 3).

    With `search`, the guesses are tried in their order and the first trustworthy one is taken, else a global search
    decides. Without, there is one guess, which is taken whatever its fitness. ICP from point to plane, coarse to
    fine, improves on each, unless `refine` is off.

    Args:
        map_points: in the map's own frame.
        reference_points: in the reference's frame.
        guesses: name -> `T_reference_map` (4, 4).
        search: whether to go on when no guess is trustworthy.
        refine: whether ICP follows; a global search always needs it.

    Raises:
        InputError: no pose was found that can be trusted.
        ValueError: there is nothing to start from, or several guesses and no search among them.
    """
    if not search and len(guesses) != 1:
        raise ValueError(f"expected one guess, or a search, got {len(guesses)} guesses")
    clouds = _Clouds.prepare(map_points, reference_points)
    tried = []
    for name, T_reference_map in guesses.items():
        alignment = clouds.judge(T_reference_map, name, refine)
        if alignment.is_trustworthy or not search:
            return alignment
        tried.append(alignment)
    found = _search(clouds)
    if found is None or not found.is_trustworthy:
        raise InputError(_explain([*tried, *([] if found is None else [found])]) + _other_unit(clouds))
    return found


def _search(clouds: "_Clouds") -> MapAlignment | None:
    """The best pose that a global search finds, with the fitness of the next best."""
    poses = candidate_poses(clouds.mapped, clouds.reference)
    judged = [clouds.judge(clouds.to_given(T), GLOBAL, True, _SEARCH_POINTS) for T in poses]
    if not judged:
        return None
    # What the search may have missed: buildings tend to look alike when they are turned by right angles.
    likeliest = clouds.to_local(max(judged, key=lambda found: found.fitness).T_reference_map)
    turned = (clouds.to_given(likeliest @ T) for T in _turns(clouds.mapped))
    judged += [clouds.judge(T, GLOBAL, True, _SEARCH_POINTS) for T in turned]
    judged.sort(key=lambda found: -found.fitness)
    best = clouds.judge(judged[0].T_reference_map, GLOBAL, refine=True)
    T_best = clouds.to_local(best.T_reference_map)
    others = [o.fitness for o in judged[1:] if not is_same(T_best, clouds.to_local(o.T_reference_map), _DISTINCT_M)]
    # How far ICP moved it from a rough candidate tells nobody anything.
    return replace(best, moved_m=0.0, moved_deg=0.0, runner_up=max(others, default=0.0))


def _turns(points: FloatArray) -> list[FloatArray]:
    """Right angles about the vertical through the middle of a cloud's extent, as transforms (4, 4)."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    to_middle, back = make_transform(np.eye(3), -middle), make_transform(np.eye(3), middle)
    return [back @ exp([0.0, 0.0, angle, 0.0, 0.0, 0.0]) @ to_middle for angle in (0.5 * np.pi, np.pi, 1.5 * np.pi)]


@dataclass(frozen=True, eq=False)
class _Clouds:
    """Both clouds, thinned, each about its own middle, where ICP keeps its digits whatever the survey's origin."""

    mapped: FloatArray
    reference: FloatArray
    tree: cKDTree
    inlier_m: float
    middle_map: FloatArray
    middle_reference: FloatArray

    @classmethod
    def prepare(cls, map_points: FloatArray, reference_points: FloatArray) -> "_Clouds":
        if not len(map_points) or not len(reference_points):
            raise InputError("the map or its reference holds no point; nothing can be aligned")
        cell_m = _FINEST_CELL_M
        mapped, reference = thin(map_points, cell_m), thin(reference_points, cell_m)
        while max(len(mapped), len(reference)) > _MOST_POINTS:
            cell_m *= 1.3
            mapped, reference = thin(mapped, cell_m), thin(reference, cell_m)
        for cloud, what in ((mapped, "the map"), (reference, "its reference")):
            if len(cloud) < _FEWEST_POINTS:
                raise InputError(
                    f"{what} has points in {len(cloud)} places {cell_m:g} m apart; expected {_FEWEST_POINTS} or more"
                    " to align by; name a whole map"
                )
        middle_map, middle_reference = np.median(mapped, axis=0), np.median(reference, axis=0)
        mapped, reference = mapped - middle_map, reference - middle_reference
        inlier_m = max(_LEAST_INLIER_M, 2.0 * cell_m)
        return cls(mapped, reference, cKDTree(reference), inlier_m, middle_map, middle_reference)

    def to_local(self, T_reference_map: FloatArray) -> FloatArray:
        """From the frames given to those about the middles."""
        R = T_reference_map[:3, :3]
        return make_transform(R, R @ self.middle_map + T_reference_map[:3, 3] - self.middle_reference)

    def to_given(self, T_local: FloatArray) -> FloatArray:
        """The way back."""
        R = T_local[:3, :3]
        return make_transform(R, T_local[:3, 3] + self.middle_reference - R @ self.middle_map)

    def judge(
        self, T_reference_map: FloatArray, method: str, refine: bool, most_points: int = _MOST_POINTS
    ) -> MapAlignment:
        """The guess, refined where that brings more of the map onto the reference, with its fitness.

        ICP moves `most_points` of the map.
        """
        T_guess = self.to_local(T_reference_map)
        T_local, (fitness, rmse_m) = T_guess, self._fitness(T_guess)
        if refine:
            T_icp = self._icp(T_guess, self.mapped[:: -(-len(self.mapped) // most_points)])
            after = self._fitness(T_icp)
            if after[0] >= fitness:
                T_local, (fitness, rmse_m) = T_icp, after
        moved = inverse(T_guess) @ T_local
        return MapAlignment(
            T_reference_map=self.to_given(T_local),
            method=method,
            refined=refine,
            fitness=fitness,
            inlier_rmse_m=rmse_m,
            inlier_m=self.inlier_m,
            moved_m=float(np.linalg.norm(moved[:3, 3])),
            moved_deg=float(np.rad2deg(rotation_angle(moved))),
        )

    @cached_property
    def _with_normals(self) -> Any:
        """The reference as Open3D's cloud; its normals are estimated once for all poses."""
        import open3d as o3d

        still = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.reference))
        still.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
        return still

    def _icp(self, T_local: FloatArray, mapped: FloatArray) -> FloatArray:
        """The pose (4, 4) of some of the map, improved from point to plane, partners nearer and nearer.

        Chen, Medioni, "Object modelling by registration of multiple range images", IVC 1992.
        """
        import open3d as o3d

        moving = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mapped))
        registration = o3d.pipelines.registration
        to_plane = registration.TransformationEstimationPointToPlane()
        stop = registration.ICPConvergenceCriteria(max_iteration=_ICP_ITERATIONS)
        for distance_m in _ICP_STAGES_M:
            found = registration.registration_icp(moving, self._with_normals, distance_m, T_local, to_plane, stop)
            T_local = np.array(found.transformation, dtype=np.float64)
        return T_local

    def _fitness(self, T_local: FloatArray) -> tuple[float, float | None]:
        moved = transform_points(T_local, self.mapped)
        distances, _ = self.tree.query(moved, distance_upper_bound=self.inlier_m, workers=-1)
        near = np.asarray(distances)[np.isfinite(distances)]
        return len(near) / len(moved), float(np.sqrt(np.mean(near**2))) if len(near) else None


def _other_unit(clouds: _Clouds) -> str:
    """A likely reason, where the clouds are of very different size."""
    size, of_reference = (
        float(np.abs(np.percentile(c, [10, 90], axis=0)).max()) for c in (clouds.mapped, clouds.reference)
    )
    factor = of_reference / max(size, 1e-9)
    if 1.0 / _OTHER_UNIT < factor < _OTHER_UNIT:
        return ""
    return f". The reference is {factor:.3g} times as large: is it in metres?"


def _explain(tried: list[MapAlignment]) -> str:
    """What was tried, how badly each fits, and what to do."""
    fits = "; ".join(f"{a.method}: {100.0 * a.fitness:.0f} % of the map within {a.inlier_m:g} m" for a in tried)
    last = tried[-1] if tried else None
    if last is not None and last.fitness >= TRUSTED_FITNESS:
        why = f"lies on its reference in more than one way ({100.0 * (last.runner_up or 0.0):.0f} % in another)"
    else:
        why = "cannot be laid on its reference so that half of it fits"
    return f"the map {why} ({fits or 'no pose was found'}); give the pose as a 4x4 text file with --map-alignment FILE"

"""Registration of a map with a reference map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, exp, inverse, make_transform, rotation_angle, transform_points
from lidarslam.core.thinning import first_per_cell

GLOBAL = "global"

# At a wrong pose in a building, all floors and a quarter of the walls may coincide; at the right one, most of each do.
TRUSTED_FITNESS = 0.5
# Least share at which no other pose can have as much.
_UNRIVALLED = 0.8
# Directions of surfaces count as such from this share of the points on; a surface faces along a direction within this
# cosine.
_LEAST_SURFACES, _FACING = 0.05, 0.7
# A second pose with this share of the best fitness makes the registration ambiguous; poses nearer than this are one.
_AMBIGUOUS_SHARE = 0.9
_SAME_PLACE_M, _SAME_ANGLE_RAD = 1.0, np.deg2rad(8.0)

_FINEST_CELL_M = 0.1
_MOST_POINTS = 150_000
_LEAST_INLIER_M = 0.2
# Correspondence distances of ICP, coarse to fine.
_ICP_STAGES_M = (2.0, 1.0, 0.5)
_ICP_ITERATIONS = 40
# ICP has converged when no component of a step, in radians and metres, exceeds this.
_ICP_STEP = 1e-6
_NORMAL_NEIGHBOURS = 12
_FEWEST_POINTS = 30

# Points of the map while several poses are tried.
_SEARCH_POINTS = 10_000
# Cells across the target; features of both sizes propose a pose.
_CELLS_ACROSS = (80, 160)
_MOST_FEATURES = 12_000
# Radii of the normals' and the features' neighbourhoods, in cells (the choice of Open3D's tutorials).
_NORMAL_CELLS, _FEATURE_CELLS, _INLIER_CELLS = 2.0, 5.0, 1.5
_LEAST_EDGE_RATIO = 0.9
_ITERATIONS, _CONFIDENCE = 50_000, 0.9999


@dataclass(frozen=True, eq=False)
class MapAlignment:
    """Pose of a map in the frame of its reference, and its quality."""

    T_reference_map: FloatArray  # (4, 4)
    method: str  # its initial guess: "trajectory", "file", "none" or "global"
    refined: bool  # whether ICP followed
    fitness: float  # share of inliers, the map's points with a point of the reference within `inlier_m`, 0 to 1
    inlier_rmse_m: float | None  # root mean square distance of the inliers; None without any
    inlier_m: float  # largest distance of an inlier
    # the least of the inliers' shares of surfaces that face along the commonest normal, a floor's, and of all others
    least_fitness: float
    # moved_m, moved_deg: translation of the map's median and rotation by ICP, a misplacement that does not show in the
    # map's errors
    moved_m: float = 0.0
    moved_deg: float = 0.0
    runner_up: float | None = None  # least fitness of the next best, different pose of a global search

    @property
    def is_trustworthy(self) -> bool:
        """Whether half of the surfaces of either direction are inliers, and at no other pose nearly as many."""
        distinct = self.runner_up is None or self.runner_up < _AMBIGUOUS_SHARE * self.least_fitness
        return self.least_fitness >= TRUSTED_FITNESS and distinct

    def to_json(self) -> dict[str, object]:
        """All of it, for metrics.json."""
        keys = ("method", "refined", "fitness", "inlier_rmse_m", "inlier_m", "moved_m", "moved_deg")
        values = {key: getattr(self, key) for key in keys}
        return {**values, "T_reference_map": self.T_reference_map.tolist(), "trustworthy": self.is_trustworthy}


def align_map(
    map_points: FloatArray,
    reference_points: FloatArray,
    guesses: Mapping[str, FloatArray],
    search: bool = False,
    refine: bool = True,
) -> MapAlignment:
    """Pose of a map (N, 3) in the frame of a reference (M, 3), by point-to-plane ICP, coarse to fine.

    With `search`, the first guess at which most of either direction's surfaces coincide is taken, else the best of the
    guesses and a global registration, if it is trustworthy. Without, there is one guess, which is taken whatever its
    fitness.

    Guesses are `T_reference_map` (4, 4) by name; with `refine`, ICP follows.
    """
    clouds = _Clouds.prepare(map_points, reference_points)
    tried = []
    for name, T_reference_map in guesses.items():
        tried.append(clouds.judge(clouds.to_local(T_reference_map), name, refine))
        if tried[-1].least_fitness >= _UNRIVALLED or not search:
            return clouds.to_given(tried[-1])
    best = _search(clouds, tried)
    if not best.is_trustworthy:
        raise InputError(_explain(best, tried))
    return clouds.to_given(best)


def _search(clouds: "_Clouds", tried: Sequence[MapAlignment]) -> MapAlignment:
    """The best of the poses that were tried and those of a global registration, with the fitness of the next best."""
    judged = [clouds.judge(T, GLOBAL, True, _SEARCH_POINTS) for T in candidate_poses(clouds.mapped, clouds.reference)]
    likeliest = max(judged, key=lambda found: found.least_fitness).T_reference_map
    # Buildings look similar when they are turned by right angles about the vertical through their middle.
    middle = make_transform(np.eye(3), 0.5 * (clouds.mapped.min(axis=0) + clouds.mapped.max(axis=0)))
    for quarters in (1, 2, 3):
        turn = middle @ exp([0.0, 0.0, quarters * np.pi / 2.0, 0.0, 0.0, 0.0]) @ inverse(middle)
        judged.append(clouds.judge(likeliest @ turn, GLOBAL, True, _SEARCH_POINTS))
    best, *others = sorted([*tried, *judged], key=lambda found: -found.least_fitness)
    if best.method == GLOBAL:
        best = replace(clouds.judge(best.T_reference_map, GLOBAL, refine=True), moved_m=0.0, moved_deg=0.0)
    rivals = [other.least_fitness for other in others if not _is_same(best.T_reference_map, other.T_reference_map)]
    return replace(best, runner_up=max(rivals, default=0.0))


def _is_same(T_a: FloatArray, T_b: FloatArray) -> bool:
    near = float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])) < _SAME_PLACE_M
    return near and float(rotation_angle(inverse(T_a) @ T_b)) < _SAME_ANGLE_RAD


@dataclass(frozen=True, eq=False)
class _Clouds:
    """Both clouds, thinned, each relative to its own median, for the digits of ICP; poses are between these frames."""

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
        mapped, reference = first_per_cell(map_points, cell_m), first_per_cell(reference_points, cell_m)
        while max(len(mapped), len(reference)) > _MOST_POINTS:
            cell_m *= 1.3
            mapped, reference = first_per_cell(mapped, cell_m), first_per_cell(reference, cell_m)
        for cloud, name in ((mapped, "the map"), (reference, "its reference")):
            if len(cloud) < _FEWEST_POINTS:
                few = f"{name} has points in {len(cloud)} cells of {cell_m:g} m"
                raise InputError(f"{few}; expected {_FEWEST_POINTS} or more to align by; name a whole map")
        middle_map, middle_reference = np.median(mapped, axis=0), np.median(reference, axis=0)
        mapped, reference = mapped - middle_map, reference - middle_reference
        inlier_m = max(_LEAST_INLIER_M, 2.0 * cell_m)
        return cls(mapped, reference, cKDTree(reference), inlier_m, middle_map, middle_reference)

    def to_local(self, T_reference_map: FloatArray) -> FloatArray:
        """A pose between the given frames as one between the local frames."""
        R = T_reference_map[:3, :3]
        return make_transform(R, R @ self.middle_map + T_reference_map[:3, 3] - self.middle_reference)

    def to_given(self, alignment: MapAlignment) -> MapAlignment:
        """The alignment with its pose between the given frames."""
        R, t = alignment.T_reference_map[:3, :3], alignment.T_reference_map[:3, 3]
        return replace(alignment, T_reference_map=make_transform(R, t + self.middle_reference - R @ self.middle_map))

    def judge(self, T_guess: FloatArray, method: str, refine: bool, most_points: int = _MOST_POINTS) -> MapAlignment:
        """The guess with its fitness, refined by ICP on `most_points` of the map where that adds inliers."""
        T, distances = T_guess, self._distances(T_guess)
        if refine:
            T_icp = self._icp(T_guess, self.mapped[:: -(-len(self.mapped) // most_points)])
            after = self._distances(T_icp)
            if np.isfinite(after).mean() >= np.isfinite(distances).mean():
                T, distances = T_icp, after
        near = np.isfinite(distances)
        rmse_m = float(np.sqrt(np.mean(distances[near] ** 2))) if near.any() else None
        shares = [float(near[surface].mean()) for surface in self._surfaces]
        moved = inverse(T_guess) @ T
        moved_m, moved_deg = float(np.linalg.norm(moved[:3, 3])), float(np.rad2deg(rotation_angle(moved)))
        fit = float(near.mean()), rmse_m, self.inlier_m, min(shares)
        return MapAlignment(T, method, refine, *fit, moved_m, moved_deg)

    @cached_property
    def _normals(self) -> FloatArray:
        """Unit normals (M, 3) of the reference."""
        return _estimate_normals(self.reference)

    @cached_property
    def _surfaces(self) -> list[NDArray[np.bool_]]:
        """Masks (N,) of the map's points whose surfaces face along the commonest normal, and of all others."""
        normals = _estimate_normals(self.mapped)
        commonest = np.linalg.eigh(normals.T @ normals)[1][:, -1]
        facing = np.abs(normals @ commonest) > _FACING
        return [surface for surface in (facing, ~facing) if surface.mean() > _LEAST_SURFACES]

    def _icp(self, T: FloatArray, mapped: FloatArray) -> FloatArray:
        """Pose (4, 4) after point-to-plane ICP (Chen, Medioni, IVC 1992) with ever shorter correspondences.

        Sums over correspondences have one order, whatever the number of threads; those of Open3D's ICP have none.
        """
        for distance_m in _ICP_STAGES_M:
            for _ in range(_ICP_ITERATIONS):
                moved = transform_points(T, mapped)
                distances, found = self.tree.query(moved, distance_upper_bound=distance_m, workers=-1)
                near = np.isfinite(distances)
                nearest = np.asarray(found)[near]
                p, n, q = moved[near], self._normals[nearest], self.reference[nearest]
                J, residuals = np.hstack([np.cross(p, n), n]), np.einsum("ij,ij->i", n, p - q)
                H, g = np.einsum("ij,ik->jk", J, J), np.einsum("ij,i->j", J, residuals)
                step = np.linalg.lstsq(H, -g, rcond=None)[0]
                T = exp(step) @ T
                if float(np.abs(step).max()) < _ICP_STEP:
                    break
        return T

    def _distances(self, T: FloatArray) -> FloatArray:
        """Distances (N,) of the map's points to the reference, infinite beyond those of inliers."""
        points = transform_points(T, self.mapped)
        return np.asarray(self.tree.query(points, distance_upper_bound=self.inlier_m, workers=-1)[0])


def _estimate_normals(points: FloatArray) -> FloatArray:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    return np.array(cloud.normals, dtype=np.float64)


def _explain(best: MapAlignment, tried: Sequence[MapAlignment]) -> str:
    fits = "; ".join(
        f"{a.method}: {100.0 * a.fitness:.0f} % of the map within {a.inlier_m:g} m, {100.0 * a.least_fitness:.0f} %"
        " in the worse of two directions"
        for a in (*tried, *([best] if best.method == GLOBAL else []))
    )
    reason = "cannot be aligned with its reference so that half of it fits"
    if best.least_fitness >= TRUSTED_FITNESS:
        reason = f"fits its reference at more than one pose ({100.0 * (best.runner_up or 0.0):.0f} % at another)"
    return f"the map {reason} ({fits}); are both in metres? Else give the pose as a 4x4 text file, --map-alignment FILE"


def candidate_poses(source: FloatArray, target: FloatArray) -> list[FloatArray]:
    """Poses `T_target_source` (4, 4) good to a few cells, one for each of two cell sizes.

    Correspondences of FPFH features (Rusu, Blodow, Beetz, ICRA 2009) that are mutual nearest neighbours, and RANSAC on
    triples of them, by Open3D. On 16 turned maps of rooms, an office and a street, RANSAC found every pose, fast global
    registration (Zhou, Park, Koltun, ECCV 2016) 14.

    Both clouds are about the origin.
    """
    import open3d as o3d

    o3d.utility.random.seed(0)
    size_m = float(np.linalg.norm(np.ptp(target, axis=0)))
    return [_register(source, target, size_m / cells) for cells in _CELLS_ACROSS]


def _register(source: FloatArray, target: FloatArray, cell_m: float) -> FloatArray:
    import open3d as o3d

    clouds = first_per_cell(source, cell_m), first_per_cell(target, cell_m)
    while max(map(len, clouds)) > _MOST_FEATURES:
        cell_m *= 1.2
        clouds = first_per_cell(source, cell_m), first_per_cell(target, cell_m)
    registration, described = o3d.pipelines.registration, []
    for points in clouds:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(_NORMAL_CELLS * cell_m, 30))
        # The sensor's path is unknown; a common direction is enough for a feature to be the same in both clouds.
        cloud.orient_normals_to_align_with_direction([0.0, 0.0, 1.0])
        neighbourhood = o3d.geometry.KDTreeSearchParamHybrid(_FEATURE_CELLS * cell_m, 100)
        described.append((cloud, registration.compute_fpfh_feature(cloud, neighbourhood)))  # type: ignore[call-arg]
    (moving, features), (still, target_features) = described
    inlier_m = _INLIER_CELLS * cell_m
    checkers = [
        registration.CorrespondenceCheckerBasedOnEdgeLength(_LEAST_EDGE_RATIO),
        registration.CorrespondenceCheckerBasedOnDistance(inlier_m),
    ]
    estimation = registration.TransformationEstimationPointToPoint(False)
    end = registration.RANSACConvergenceCriteria(_ITERATIONS, _CONFIDENCE)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        found = registration.registration_ransac_based_on_feature_matching(
            moving, still, features, target_features, True, inlier_m, estimation, 3, checkers, end
        )
    return np.array(found.transformation, dtype=np.float64)

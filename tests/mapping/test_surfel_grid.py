"""Surfels of surfaces that have formulas: planes, lines, rings; the eigenvalues and the hash table behind them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels import grid as grids
from lidarslam.mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector
from lidarslam.mapping.surfels.voxel_hash import (
    ABSENT,
    OTHER_SIDE,
    Rows,
    VoxelHash,
    cell_keys,
    find_around,
    key_cells,
    key_steps,
)

from .shapes import across_x

CELL = 0.5


def unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))


def on_plane(
    rng: np.random.Generator, normal: FloatArray, through: FloatArray, half_size: float = 1.5, count: int = 4_000
) -> FloatArray:
    """Points (N, 3) on a square piece of a plane."""
    along = unit(np.cross(normal, [0.3, 0.5, 0.8]))
    coordinates = rng.uniform(-half_size, half_size, (count, 2))
    return through + coordinates @ np.stack([along, np.cross(normal, along)])


def grid_of(points: FloatArray, elevations: FloatArray | None = None) -> grids.SurfelGrid:
    grid = grids.SurfelGrid(CELL)
    grid.insert(points, np.zeros(len(points)) if elevations is None else elevations, from_above(len(points)))
    return grid


def surfels_at(grid: grids.SurfelGrid, points: FloatArray) -> FloatArray:
    return grid.surfels(grid.find(points))


def from_above(count: int) -> FloatArray:
    """Seen from high above (N, 3)."""
    return np.tile([0.0, 0.0, 1.0], (count, 1))


def cloud(rng: np.random.Generator, count: int = 5_000, half_size: float = 5.0) -> FloatArray:
    return rng.uniform(-half_size, half_size, (count, 3))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("away_m", [0.0, 10_000.0])
def test_surfels_of_a_plane_lie_on_it_wherever_it_is(seed, away_m):
    rng = np.random.default_rng(seed)
    normal, through = unit(rng.normal(size=3)), away_m * unit(rng.normal(size=3))
    points = on_plane(rng, normal, through)
    surfels = surfels_at(grid_of(points), points)
    assert surfels[:, grids.IS_PLANE].all()
    np.testing.assert_allclose(np.abs(surfels[:, grids.NORMAL] @ normal), 1.0, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(np.cross(surfels[:, grids.NORMAL], normal), 0.0, atol=2e-5)
    np.testing.assert_allclose((surfels[:, grids.MEAN] - through) @ normal, 0.0, atol=2e-6)
    assert surfels[:, grids.SPREADS][:, 0].max() < 1e-3


def test_a_surfel_is_as_thick_as_the_noise(rng):
    normal = unit(np.array([0.2, -0.3, 0.9]))
    points = on_plane(rng, normal, np.zeros(3), count=20_000)
    grid = grid_of(points + rng.normal(0.0, 0.02, (len(points), 1)) * normal)
    inner = np.abs(points).max(axis=1) < 0.5
    thickness = surfels_at(grid, points[inner])[:, grids.SPREADS][:, 0]
    np.testing.assert_allclose(thickness, 0.02, rtol=0.1)


@pytest.mark.parametrize("weight", [1.0, 3.0], ids=["in batches", "weighed"])
def test_batches_make_what_one_makes_and_a_point_counts_as_many_as_it_weighs(rng, weight):
    points, elevations, times = cloud(rng, 20_000), rng.normal(size=20_000), round(weight)
    grid, whole = grids.SurfelGrid(CELL), grid_of(np.repeat(points, times, axis=0), np.repeat(elevations, times))
    for part in np.array_split(np.arange(len(points)), 7):
        grid.insert(points[part], elevations[part], from_above(len(part)), weight)
    assert len(grid) == len(whole)
    one, other = surfels_at(grid, points), surfels_at(whole, points)
    for columns in (grids.MEAN, grids.SPREADS, grids.ELEVATION_SPREAD):
        np.testing.assert_allclose(one[:, columns], other[:, columns], atol=1e-4)
    np.testing.assert_allclose(one[:, grids.COUNT], other[:, grids.COUNT], rtol=1e-5)


@pytest.mark.parametrize("offset", [-0.004, 0.004])
def test_a_wall_along_the_border_of_cells_is_one_plane(rng, offset):
    """Noise throws half of its points into the cells on either side."""
    points = np.column_stack([rng.normal(offset, 0.005, 6_000), rng.uniform(-2, 2, (6_000, 2))])
    inner = np.abs(points[:, 1:]).max(axis=1) < 1.0
    surfels = surfels_at(grid_of(points), points[inner])
    assert surfels[:, grids.IS_PLANE].all()
    np.testing.assert_allclose(surfels[:, grids.MEAN][:, 0], offset, atol=0.002)
    assert np.rad2deg(np.arccos(np.abs(surfels[:, grids.NORMAL][:, 0]).min())) < 0.5


def test_samples_of_cells_are_seen_from_where_their_points_were(rng):
    wall = across_x(rng, 0.25, 1.0, 5_000)
    grid, other = grids.SurfelGrid(CELL), grids.SurfelGrid(0.5 * CELL)
    grid.insert(wall, np.zeros(5_000), np.tile([-0.6, 0.8, 0.0], (5_000, 1)))
    samples, elevations, views = grid.samples()
    np.testing.assert_allclose(views, np.tile([-0.6, 0.8, 0.0], (len(samples), 1)), atol=1e-5)
    other.insert(samples, elevations, views)
    assert surfels_at(other, samples)[:, grids.NORMAL][:, 0].max() < -0.99


def test_neighbours_count_less_than_the_cell_itself():
    """Two points beside one another in neighbouring cells: the surfel lies nearer to the cell's own."""
    points = np.array([[0.25, 0.25, 0.25], [0.75, 0.25, 0.25]])
    surfel = surfels_at(grid_of(points), points[:1])
    np.testing.assert_allclose(surfel[:, grids.MEAN], [[(0.25 + 0.8 * 0.75) / 1.8, 0.25, 0.25]], atol=1e-6)
    np.testing.assert_allclose(surfel[:, grids.COUNT], 1.8, rtol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_a_line_has_its_direction(seed):
    rng = np.random.default_rng(seed)
    direction, through = unit(rng.normal(size=3)), 100.0 * rng.normal(size=3)
    points = through + rng.uniform(-3.0, 3.0, (600, 1)) * direction
    surfels = surfels_at(grid_of(points), points)
    assert not surfels[:, grids.IS_PLANE].any()
    np.testing.assert_allclose(np.cross(surfels[:, grids.DIRECTION], direction), 0.0, atol=2e-5)
    np.testing.assert_allclose(np.cross(surfels[:, grids.MEAN] - through, direction), 0.0, atol=1e-5)


def test_a_ball_of_points_is_no_plane_nor_are_five_points(rng):
    few = np.array([[0.1, 0.1, 0.1], [0.4, 0.1, 0.1], [0.1, 0.4, 0.1], [0.4, 0.4, 0.1], [0.2, 0.3, 0.1]])
    for points, asked in ((cloud(rng, 20_000, half_size=1.5), [0.1, 0.2, 0.3]), (few, [0.2, 0.2, 0.1])):
        assert not surfels_at(grid_of(points), np.array([asked]))[:, grids.IS_PLANE].any()


def test_an_empty_cell_shows_the_nearest_around_it():
    held = np.array([[0.75, 0.25, 0.25], [0.25, 0.95, 0.25], [-0.45, 0.25, 0.25]])
    grid = grid_of(held)
    asked = np.array([[0.3, 0.3, 0.3], [0.05, 0.3, 0.3], [0.3, 0.4, 0.3], [-0.4, 0.45, 0.7]])
    asked[1, 0] = 0.01
    rows = grid.find(asked)
    distances = np.linalg.norm(asked[:, None] - held, axis=2)
    np.testing.assert_array_equal(rows, grid.find(held)[distances.argmin(axis=1)])
    assert len(set(rows.tolist())) > 1
    assert (grid.find(np.array([[1.51, 0.25, 0.25], [1e4, 1e4, 1e4]])) == ABSENT).all()


def test_means_are_those_of_the_cells_points(rng):
    points = cloud(rng, 3_000) - 200.0
    cells, inverse = np.unique(np.floor(points / CELL), axis=0, return_inverse=True)
    expected = np.stack([np.bincount(inverse, points[:, k]) for k in range(3)], axis=1)
    expected /= np.bincount(inverse)[:, None]
    means = grid_of(points).means()
    order, other = np.lexsort(np.floor(means / CELL).T), np.lexsort(cells.T)
    np.testing.assert_allclose(means[order], expected[other], atol=1e-5)


def test_what_is_near_stays_with_its_surfels_when_the_rest_is_forgotten(rng):
    points = cloud(rng, 20_000)
    grid = grid_of(points)
    centre = np.array([1.0, 0.0, -1.0])
    middles = (np.floor(points / CELL) + 0.5) * CELL
    distance = np.linalg.norm(middles - centre, axis=1)
    # Patches are worked out before: what is kept must not be worked out from what is gone.
    before = surfels_at(grid, points)
    held = len(grid)
    grid.drop_beyond(centre, 3.0)
    near = distance <= 3.0
    assert len(grid) == len(np.unique(middles[near], axis=0)) < held
    np.testing.assert_array_equal(surfels_at(grid, points[near]), before[near])
    far = distance > 3.0 + 2.0 * CELL * 3**0.5
    assert (grid.find(points[far]) == ABSENT).all()


def test_a_cell_that_has_seen_enough_moves_no_more(rng):
    wall = across_x(rng, 0.25, 1.0, 9_000)
    grid = grid_of(wall)
    before = surfels_at(grid, wall)
    drifted = wall + np.array([0.1, 0.0, 0.0])
    grid.insert(drifted, np.zeros(len(wall)), from_above(len(wall)))
    np.testing.assert_array_equal(surfels_at(grid, wall), before)


def test_one_ring_has_no_spread_of_elevation_and_two_have_half_their_distance(rng):
    points = np.column_stack([np.full(400, 10.1), rng.uniform(-0.2, 0.2, 400), np.full(400, 0.1)])
    one = grid_of(points, np.full(400, 0.25))
    assert surfels_at(one, points)[:, grids.ELEVATION_SPREAD].max() < 3e-4
    two = grid_of(points, np.repeat([0.25, 0.29], 200))
    np.testing.assert_allclose(surfels_at(two, points)[:, grids.ELEVATION_SPREAD], 0.02, rtol=0.1)


def test_what_a_cell_shows_follows_its_neighbours_once_it_is_tidied(rng):
    """A cell beside a wall keeps what a few stray points made of it, until it is worked out anew."""
    stray = np.array([[0.25, 0.25, 0.6]]) + rng.normal(0.0, 0.02, (10, 3))
    wall = on_plane(rng, np.array([0.0, 0.0, 1.0]), np.array([0.25, 0.25, 0.45]), half_size=2.0)
    grid = grid_of(stray)
    assert not surfels_at(grid, stray)[:, grids.IS_PLANE].any()
    grid.insert(wall, np.zeros(len(wall)), from_above(len(wall)))
    assert not surfels_at(grid, stray)[:, grids.IS_PLANE].any()
    grid._tidied = len(grid)  # so that no cell is forgotten
    grid.tidy()
    surfels = surfels_at(grid, stray)
    assert surfels[:, grids.IS_PLANE].all()
    np.testing.assert_allclose(np.abs(surfels[:, grids.NORMAL][:, 2]), 1.0, atol=1e-3)


def test_strays_are_forgotten_where_much_was_seen_and_nowhere_else(rng):
    wall = on_plane(rng, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.25]), half_size=2.9, count=100_000)
    strays = rng.uniform([-2.9, -2.9, 1.2], [2.9, 2.9, 2.9], (40, 3))
    once = on_plane(rng, np.array([1.0, 0.0, 0.0]), np.array([30.25, 0.0, 0.0]), count=60)  # as few as a stray, alone
    grid = grid_of(np.concatenate([wall, strays, once]))
    inner = wall[np.abs(wall).max(axis=1) < 1.9]  # at its border cells have few points, too
    seen = surfels_at(grid, inner)[:, grids.MEAN]
    grid.tidy()
    assert (grid.find(strays[strays[:, 2] > 1.8]) == ABSENT).all()
    assert (grid.find(once) != ABSENT).all()
    np.testing.assert_allclose(surfels_at(grid, inner)[:, grids.MEAN], seen, atol=1e-3)


def eigenvalues(M: FloatArray) -> FloatArray:
    values = np.full((len(M), 3), np.nan)
    for matrix, written in zip(M, values, strict=True):
        write_eigenvalues(matrix, written)
    return values


def eigenvectors(M: FloatArray, values: FloatArray) -> FloatArray:
    vectors = np.full((len(M), 3), np.nan)
    for matrix, value, written in zip(M, values, vectors, strict=True):
        write_eigenvector(matrix, value, written)
    return vectors


def entries(M: FloatArray) -> FloatArray:
    return np.stack([M[:, i, j] for i, j in SYMMETRIC], axis=1)


def with_spectrum(rng: np.random.Generator, values: list[float], count: int = 300) -> FloatArray:
    Q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    M = Q @ (np.array(values)[:, None] * np.swapaxes(Q, 1, 2))
    return np.asarray(0.5 * (M + np.swapaxes(M, 1, 2)))


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1.0, 1e6])
def test_values_of_random_matrices_of_any_size(rng, scale):
    A = rng.normal(size=(1000, 3, 3))
    M = scale * (A + np.swapaxes(A, 1, 2))
    np.testing.assert_allclose(eigenvalues(entries(M)), np.linalg.eigvalsh(M), rtol=0.0, atol=1e-7 * scale)


@pytest.mark.parametrize(
    "spectrum",
    [[0, 0, 0], [1, 1, 1], [0, 1, 1], [0, 0, 1], [1, 1, 3], [-2, -2, 5], [0, 1e-9, 1]],
    ids=["zero", "ball", "disc", "needle", "long", "indefinite", "noisy needle"],
)
def test_values_of_special_spectra(rng, spectrum):
    values = eigenvalues(entries(with_spectrum(rng, spectrum)))
    np.testing.assert_allclose(values, np.tile(spectrum, (len(values), 1)), rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("spectrum", "which"), [
    *(([0.2, 1.0, 3.0], which) for which in range(3)),
    ([0.0, 1.0, 1.0], 0), ([0.0, 0.0, 1.0], 2), ([0.0, 1e-4, 1.0], 0),
])  # fmt: skip
def test_vectors_of_simple_values_are_only_scaled(rng, spectrum, which, scale):
    """Also beside repeated ones: a disc's normal, a needle's direction, the normal of a narrow strip."""
    M = with_spectrum(rng, spectrum)
    vectors = eigenvectors(scale * entries(M), eigenvalues(scale * entries(M))[:, which])
    residual = np.einsum("nij,nj->ni", M, vectors) - spectrum[which] * vectors
    assert np.abs(residual).max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("value", [0.0, 2.0])
def test_where_every_direction_is_one_a_unit_vector_is_given(value):
    M = value * np.eye(3)[None]
    vectors = eigenvectors(entries(M), np.array([value]))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=0.0, atol=1e-12)


Cell = tuple[int, int, int]
near = st.integers(-3, 3)
anywhere = st.integers(-(1 << 19), (1 << 19) - 1)
cells_anywhere = st.lists(st.tuples(anywhere, anywhere, anywhere), min_size=1, max_size=40)
cells_near = st.lists(st.tuples(near, near, near), min_size=1, max_size=40)


def keys_of(cells: list[Cell]) -> NDArray[np.int64]:
    return cell_keys(np.array(cells, dtype=np.int64).reshape(-1, 3))


def random_cells(rng: np.random.Generator, count: int, reach: int = 1000) -> NDArray[np.int64]:
    return rng.integers(-reach, reach, (count, 3))


@given(st.lists(st.one_of(cells_near, cells_anywhere), max_size=6), cells_near)
def test_equals_a_dictionary_after_any_insertions(batches, asked):
    table, oracle = VoxelHash(), {}
    for batch in batches:
        rows = table.insert(keys_of(batch))
        for cell, row in zip(batch, rows.tolist(), strict=True):
            assert oracle.setdefault(cell, row) == row
    assert len(table) == len(oracle)
    assert sorted(oracle.values()) == list(range(len(oracle)))
    wanted = [*asked, *oracle]
    assert table.find(keys_of(wanted)).tolist() == [oracle.get(cell, ABSENT) for cell in wanted]


@compiled
def _around(key: int, table: tuple[int, NDArray[np.int64], Rows], around: Rows) -> None:
    find_around(key, table[0], table[1], table[2], around)


@given(cells_near, cells_near)
def test_a_neighbourhood_is_that_of_single_cells(cells, asked):
    table, around, steps = VoxelHash(), np.empty(27, dtype=np.int32), np.stack(np.mgrid[-1:2, -1:2, -1:2], axis=-1)
    table.insert(keys_of(cells))
    for key in keys_of(asked):
        _around(key | OTHER_SIDE, table.slots, around)
        np.testing.assert_array_equal(around, table.find(key + key_steps(steps.reshape(-1, 3))))


@given(cells_anywhere)
def test_cells_come_back_from_their_keys(cells):
    assert [tuple(cell) for cell in key_cells(keys_of(cells)).tolist()] == cells


@given(cells_anywhere, cells_near)
def test_a_step_leads_to_the_neighbours_key(cells, offsets):
    inside = np.clip(np.array(cells), -(1 << 19) + 3, (1 << 19) - 4)
    steps = np.array(offsets)
    np.testing.assert_array_equal(cell_keys(inside)[:, None] + key_steps(steps), cell_keys(inside[:, None] + steps))


def test_rows_of_before_stay_while_the_table_grows(rng):
    table = VoxelHash()
    first = cell_keys(random_cells(rng, 3_000))
    rows = table.insert(first)
    for _ in range(4):
        table.insert(cell_keys(random_cells(rng, 15_000)))
    assert len(table) > 50_000
    np.testing.assert_array_equal(table.find(first), rows)


def test_rebuilt_it_holds_the_new_keys_only_in_their_order(rng):
    table = VoxelHash()
    before = np.unique(cell_keys(random_cells(rng, 20_000)))
    table.insert(before)
    kept, dropped = before[::3], np.setdiff1d(before, before[::3])
    kept = rng.permutation(kept)
    table.rebuild(kept)
    assert len(table) == len(kept)
    np.testing.assert_array_equal(table.find(kept), np.arange(len(kept)))
    assert (table.find(dropped) == ABSENT).all()
    back = [kept[1], dropped[0], kept[0]]
    assert table.insert(np.array(back)).tolist() == [1, len(kept), 0], "it goes on counting"

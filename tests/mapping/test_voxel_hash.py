"""The hash table of cells against a dictionary."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lidarslam.mapping.surfels.voxel_hash import ABSENT, VoxelHash, cell_keys, key_cells, key_steps

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


@given(cells_anywhere)
def test_cells_come_back_from_their_keys(cells):
    assert [tuple(cell) for cell in key_cells(keys_of(cells)).tolist()] == cells


@given(cells_anywhere, cells_near)
def test_a_step_leads_to_the_neighbours_key(cells, offsets):
    inside = np.clip(np.array(cells), -(1 << 19) + 3, (1 << 19) - 4)
    steps = np.array(offsets)
    np.testing.assert_array_equal(
        cell_keys(inside)[:, None] + key_steps(steps), cell_keys(inside[:, None] + steps[None])
    )


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

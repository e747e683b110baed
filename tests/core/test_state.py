"""States come back as they were, and what is none is refused by name."""

from typing import Any

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.state import Saved, stack

VALUES: dict[str, Any] = {
    "points": np.arange(6.0).reshape(2, 3),
    "none": None,
    "ratio": 0.5,
    "count": 3,
    "on": True,
    "name": "x",
    "rows": [{"a": 1}, {"a": 2}],
}


def test_values_come_back() -> None:
    saved = Saved(VALUES)
    np.testing.assert_array_equal(saved.array("points", (None, 3)), VALUES["points"])
    assert saved.number("ratio") == 0.5
    assert saved.number("count") == 3.0
    assert saved.integer("count") == 3
    assert saved.flag("on") is True
    assert saved.text("name") == "x"
    assert [row.integer("a") for row in saved.parts("rows")] == [1, 2]
    assert not saved.has("none")
    assert saved.optional_array("none", (3,)) is None
    assert saved.optional_number("none") is None
    assert saved.optional("none", lambda part: part) is None


@pytest.mark.parametrize(
    ("take", "told"),
    [
        (lambda s: s.array("points", (None, 4)), r"points should be float64 \(None, 4\), and is float64 \(2, 3\)"),
        (lambda s: s.array("points", (2, 3), np.float32), "points should be float32"),
        (lambda s: s.array("ratio", (2,)), "and is float"),
        (lambda s: s.array("none", (2,)), "and is NoneType"),
        (lambda s: s.integer("on"), "on should be a whole number, and is bool"),
        (lambda s: s.number("on"), "on should be a number"),
        (lambda s: s.integer("ratio"), "ratio should be a whole number"),
        (lambda s: s.flag("count"), "count should be true or false"),
        (lambda s: s.text("count"), "count should be a text"),
        (lambda s: s.part("name"), "name should be a tree"),
        (lambda s: s.parts("name"), "name should be a list of trees"),
        (lambda s: s.integers("rows"), "rows should be a list of whole numbers"),
        (lambda s: s.has("nothing"), "nothing is missing"),
    ],
)
def test_another_thing_is_refused_with_its_name_and_place(take: Any, told: str) -> None:
    with pytest.raises(InputError, match=told) as caught:
        take(Saved(VALUES, "here.npz"))
    assert str(caught.value).startswith("here.npz: ")


def test_an_array_that_cannot_be_written_to_is_copied() -> None:
    fixed = np.zeros(3)
    fixed.flags.writeable = False
    Saved({"a": fixed}).array("a", (3,))[0] = 1.0
    assert fixed[0] == 0.0


def test_none_stack_to_none_of_the_shape() -> None:
    assert stack([], (4, 4)).shape == (0, 4, 4)
    assert stack([np.eye(4)], (4, 4)).shape == (1, 4, 4)

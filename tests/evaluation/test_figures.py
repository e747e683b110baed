"""The parts figures and tables are made of: styles, thinning, rasters, marks."""

import json
import math

import numpy as np
import pytest

from lidarslam.evaluation.comparison.comparison import MapErrors
from lidarslam.evaluation.comparison.table import Table, TableCell, TableColumn, TableRow, number_text, printable
from lidarslam.evaluation.report.figures.figure import Panel, line_trace, method_styles, plot_text, thin_curve
from lidarslam.evaluation.report.figures.maps import raster


def test_a_thinned_curve_keeps_its_peaks_and_ends(rng):
    y = rng.normal(0.0, 1.0, 20_000)
    y[12_345], y[777] = 50.0, -40.0
    rows = thin_curve(y)
    assert len(rows) <= 2000
    assert {0, 777, 12_345, 19_999} <= set(rows.tolist())
    assert (np.diff(rows) > 0).all()
    assert np.array_equal(thin_curve(y[:100]), np.arange(100))


def test_a_cell_shows_the_median_of_its_points():
    points = np.array([[0.5, 0.5, 0.0]] * 3 + [[2.5, 1.5, 0.0], [9.0, 9.0, 0.0]])
    errors = MapErrors(points, np.array([0.0, 0.5, 9.0, 2.0, 0.1]))
    cells = raster(errors, np.linspace(0.0, 3.0, 4), np.linspace(0.0, 2.0, 3))
    np.testing.assert_array_equal(cells, [[0.5, np.nan, np.nan], [np.nan, np.nan, 2.0]])


def test_many_methods_stay_distinguishable():
    styles = method_styles(f"method {number}" for number in range(40))
    assert len({(style.colour, style.dash) for style in styles.values()}) == 40
    assert len({style.colour for style in list(styles.values())[:8]}) == 8
    assert len({style.key for style in styles.values()}) == 40


@pytest.mark.parametrize("ground", ["#ffffff", "#15171a"])
def test_colours_are_seen_on_both_grounds(ground):
    def luminance(colour: str) -> float:
        channels = np.array([int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    for style in method_styles(map(str, range(8))).values():
        low, high = sorted([luminance(style.colour), luminance(ground)])
        assert (high + 0.05) / (low + 0.05) > 2.9, style.colour


def test_names_are_data_to_plotly_and_to_the_page():
    name = "</script><b>x</b>\ud800"
    (style,) = method_styles([name]).values()
    text = Panel("t", [line_trace(name, style, np.arange(2.0), np.arange(2.0))], {}, 100).json
    assert "<" not in text
    assert json.loads(text)["data"][0]["name"] == "&lt;/script&gt;&lt;b&gt;x&lt;/b&gt;\ufffd"
    assert len(plot_text("x" * 100)) == 40


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (math.nan, "–"), (math.inf, "–"), (1.23456, "1.235"), (-0.0001, "0.000"), (-2.0, "−2.000"),
     ("NA", "NA"), (12345678.0, "1.23e+07"), (7, "7.000")],
)  # fmt: skip
def test_numbers_as_text(value, text):
    assert number_text(value, 3) == text


def test_characters_that_no_page_can_hold_are_replaced():
    assert printable("a\x00\ud800\n") == "a\ufffd\ufffd\n"


def test_equals_share_the_mark_and_a_column_of_equals_has_none():
    columns = [TableColumn("", "q", "", 1, lower_is_better) for lower_is_better in (True, False, None, True)]
    values = [(1.04, 3.0, 1.0, 5.0), (1.01, 9.0, 2.0, 5.0), (2.0, math.nan, 3.0, 5.0), (None, "NA", 4.0, 5.0)]
    table = Table("t", columns, [TableRow("m", [TableCell(value) for value in row]) for row in values])
    assert table.best() == {(0, 0), (1, 0), (1, 1)}

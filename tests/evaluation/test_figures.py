"""The parts figures are made of: ticks, thinning, pictures, tables' marks."""

import math
import struct
import zlib
from itertools import pairwise

import numpy as np
import pytest

from evaluation.comparison.comparison import MapErrors
from evaluation.comparison.number_text import number_text
from evaluation.comparison.table import Cell, Column, Row, Table, with_best
from evaluation.report.figures.maps import raster
from evaluation.report.figures.png import indexed_png
from evaluation.report.figures.scale import Scale, round_up, tick_texts, ticks
from evaluation.report.figures.thinning import thin_curve, thin_path
from evaluation.report.markup import element, escape


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.0, 1.0, ["0.00", "0.25", "0.50", "0.75", "1.00"]),
        (-3.0, 7.0, ["−2", "0", "2", "4", "6"]),
        (0.0, 4541.0, ["0", "1000", "2000", "3000", "4000"]),
        (-2e-4, 2e-4, ["−0.0002", "−0.0001", "0.0000", "0.0001", "0.0002"]),
    ],
)
def test_ticks_are_round_and_say_as_many_decimals_as_they_need(low, high, texts):
    assert tick_texts(ticks(low, high, 5)) == texts


def test_ticks_lie_inside_and_are_about_as_many_as_asked_for(rng):
    for low, span in zip(rng.normal(0.0, 100.0, 200), 10.0 ** rng.uniform(-6.0, 6.0, 200), strict=True):
        for count in (3, 5, 7):
            values = ticks(low, low + span, count)
            assert (values >= low - 1e-5 * span).all()
            assert (values <= low + 1.00001 * span).all()
            assert 0.6 * count < len(values) < 1.6 * count + 1.0


@pytest.mark.parametrize(("value", "expected"), [(0.3, 0.5), (2.0, 2.0), (2.1, 2.5), (99.0, 100.0), (0.0, 1.0)])
def test_round_up(value, expected):
    assert round_up(value) == pytest.approx(expected)


def test_a_thinned_path_stays_within_the_tolerance():
    angle = np.linspace(0.0, 6.0 * np.pi, 5000)
    path = np.stack([100.0 * np.cos(angle), 60.0 * np.sin(2.0 * angle)], axis=1)
    thinned = thin_path(path, tolerance_px=0.2)
    assert len(thinned) < 1000
    assert np.array_equal(thinned[[0, -1]], path[[0, -1]])
    steps = np.linspace(0.0, 1.0, 200)[:, None]
    dense = np.concatenate([a + steps * (b - a) for a, b in pairwise(thinned)])
    farthest = max(np.linalg.norm(dense - point, axis=1).min() for point in path[::101])
    assert farthest < 0.25


def test_a_wild_path_keeps_to_the_limit(rng):
    assert len(thin_path(rng.uniform(0.0, 500.0, (8000, 2)), most=2000)) <= 2000


def test_a_thinned_curve_keeps_its_peaks_and_ends(rng):
    x, y = np.linspace(0.0, 400.0, 20_000), rng.normal(0.0, 1.0, 20_000)
    y[12_345], y[777] = 50.0, -40.0
    rows = thin_curve(x, y)
    assert len(rows) <= 2000
    assert {0, 777, 12_345, 19_999} <= set(rows.tolist())
    assert (np.diff(rows) > 0).all()


def test_a_picture_is_read_back_as_it_was(rng):
    indices = rng.integers(0, 5, (7, 13)).astype(np.uint8)
    palette = rng.integers(0, 255, (5, 3)).astype(np.uint8)
    png = indexed_png(indices, palette)
    chunks, place = {}, 8
    while place < len(png):
        (length,) = struct.unpack(">I", png[place : place + 4])
        kind, content = png[place + 4 : place + 8], png[place + 8 : place + 8 + length]
        assert struct.unpack(">I", png[place + 8 + length : place + 12 + length])[0] == zlib.crc32(kind + content)
        chunks[kind] = content
        place += 12 + length
    assert struct.unpack(">IIBBBBB", chunks[b"IHDR"]) == (13, 7, 8, 3, 0, 0, 0)
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), dtype=np.uint8).reshape(7, 14)
    assert np.array_equal(rows[:, 1:], indices)
    assert chunks[b"PLTE"] == palette.tobytes()
    with pytest.raises(ValueError, match="below 3"):
        indexed_png(indices, palette[:3])


def test_a_pixel_shows_the_median_of_its_points():
    points = np.array([[0.5, 0.5, 0.0]] * 3 + [[2.5, 1.5, 0.0], [9.0, 9.0, 0.0]])
    errors = MapErrors(points, np.array([0.0, 0.5, 9.0, 2.0, 0.1]))
    picture = raster(errors, Scale(0.0, 3.0, 0.0, 3.0), Scale(0.0, 2.0, 2.0, 0.0), 1.0, (2, 3))
    assert picture.tolist() == [[0, 0, 64], [33, 0, 0]]


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (math.nan, "–"), (math.inf, "–"), (1.23456, "1.235"), (-0.0001, "0.000"), (-2.0, "−2.000"),
     ("NA", "NA"), (12345678.0, "1.23e+07"), (7, "7.000")],
)  # fmt: skip
def test_numbers_as_text(value, text):
    assert number_text(value, 3) == text


def test_markup_is_escaped_and_speakable():
    assert element("a", escape("<&>\x00\ud800"), title='"') == '<a title="&quot;">&lt;&amp;&gt;\ufffd\ufffd</a>'


def test_equals_share_the_mark_and_a_column_of_equals_has_none():
    columns = [Column("a", 1, True), Column("b", 1, False), Column("c", 1), Column("d", 1, True)]
    values = [(1.04, 3.0, 1.0, 5.0), (1.01, 9.0, 2.0, 5.0), (2.0, math.nan, 3.0, 5.0), (None, "NA", 4.0, 5.0)]
    table = with_best(Table("t", columns, [Row([Cell(value) for value in row]) for row in values]))
    assert [[cell.best for cell in row.cells] for row in table.rows] == [
        [True, False, False, False],
        [True, True, False, False],
        [False] * 4,
        [False] * 4,
    ]

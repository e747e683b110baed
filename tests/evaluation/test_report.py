"""The report as a page and as Markdown: its numbers, marks and parts, and that nothing in it can run or be fetched."""

import json
import math
import re
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from lidarslam.evaluation.comparison import comparison as compared
from lidarslam.evaluation.map.metrics import CloudErrors
from lidarslam.evaluation.report.accuracy import raster
from lidarslam.evaluation.report.figure import Panel, line_trace, method_styles, plot_text, thin_curve
from lidarslam.evaluation.report.report import render_html, render_markdown

HOSTILE = "<script>alert('x')</script> & \"quoted\" | `tick` ünïcode 测试 \ufffd"


def page_of(comparison: compared.Comparison) -> ElementTree.Element:
    """The page as XML, which it is but for the style sheet and the two scripts."""
    html = re.sub(r"(<script>).*?(</script>)", r"\1\2", render_html(comparison), flags=re.DOTALL)
    return ElementTree.fromstring(html)


def text_of(element: ElementTree.Element | None) -> str:
    return "" if element is None else " ".join(" ".join(element.itertext()).split())


def table_rows(page: ElementTree.Element, title: str) -> dict[str, list[ElementTree.Element]]:
    """The cells of the table whose caption ends so, by the name in each row's first cell."""
    (table,) = (t for t in page.iter("table") if text_of(t.find("caption")).endswith(title))
    return {text_of(row.find("th")).split()[0]: list(row.findall("td")) for row in table.find("tbody").findall("tr")}


def plots(page: ElementTree.Element, title: str) -> list[dict[str, Any]]:
    """Data and layout of the plots of that title."""
    found = [div for div in page.iter("div") if div.get("class") == "plot" and div.get("aria-label") == title]
    return [json.loads(div.find("script").text) for div in found]


def test_the_page_is_well_formed_and_fetches_nothing(comparison):
    html = render_html(comparison)
    elements = list(page_of(comparison).iter())
    assert not {each.tag for each in elements} & {"link", "iframe", "object", "embed", "base", "form", "img"}
    scripts = [each.attrib for each in elements if each.tag == "script"]
    assert scripts.count({}) == 2
    assert all(attributes in ({}, {"type": "application/json"}) for attributes in scripts)
    assert html.count(get_plotlyjs()) == 1
    addresses = [value for each in elements for key, value in each.items() if key in ("src", "href")]
    assert addresses
    assert all(address.startswith("#") for address in addresses)
    assert not [key for each in elements for key in each.attrib if key.startswith("on")]
    written = html.replace(get_plotlyjs(), "")
    assert "url(" not in written
    assert "@import" not in written


def test_what_users_wrote_is_shown_as_text(comparison):
    page = page_of(comparison)
    words = text_of(page)
    assert words.count(HOSTILE) > 10
    for place in ("Title ", "lidarslam compare 'a b' --methods ", "street ", "note ", "some ", "Means ", "no overlap "):
        assert place + HOSTILE in words


def test_the_numbers_are_those_of_the_metrics(comparison):
    page = page_of(comparison)
    corridor = comparison.sequences[1]
    rows = table_rows(page, "corridor: all methods")
    for method in corridor.methods[:2]:
        errors = method.metrics.errors
        shown = [text_of(cell) for cell in rows[method.name]]
        assert shown[1].startswith(f"{errors.ate_rmse_m:.3f}")
        assert shown[2].startswith(f"{errors.ate_rotation_rmse_deg:.2f}")
        assert any(text.startswith(f"{errors.end_error_m:.2f}") for text in shown)
        short = [text_of(cell) for cell in table_rows(page, "corridor: drift over segments of 5 to 100 m")[method.name]]
        reached = [drift for drift in method.metrics.segments.values() if drift]
        expected = [f"{drift.translation_percent:.3f}" for drift in reached]
        assert [text.split()[0] for text in short[: len(reached)]] == expected
    assert [text_of(cell).split()[0] for cell in rows["unmeasured"][1:3]] == ["–", "–"]
    drift = comparison.sequences[0].methods[1].metrics.kitti.overall
    assert f"{drift.translation_percent:.2f}" in text_of(page)


def test_the_best_of_each_column_is_bold_and_starred(comparison):
    rows = table_rows(page_of(comparison), f"street {HOSTILE}: all methods")
    best, other = rows["kiss-icp"], rows["learned"]
    assert best[1].get("class") == "number best"
    assert best[1].find("b") is not None
    assert "★" in text_of(best[1])
    assert "★" not in text_of(other[1])
    assert other[1].find("b") is None
    ate = comparison.sequences[0].methods[1].metrics.errors.ate_rmse_m
    assert f"**{ate:.3f}** ★" in render_markdown(comparison)


def test_what_ended_early_wins_nothing(comparison):
    sequence = comparison.sequences[1]
    first, second, _ = sequence.methods
    methods = [replace(first, status="stopped"), replace(second, status="ok"), compared.MethodResult("x", "failed")]
    changed = replace(sequence, methods=methods)
    rows = table_rows(page_of(replace(comparison, sequences=[changed])), "corridor: all methods")
    assert not any("★" in text_of(cell) for cell in rows["kiss-icp"])


def test_means_over_fewer_recordings_say_so_and_published_rows_their_source(comparison):
    page = page_of(comparison)
    rows = table_rows(page, f"Means {HOSTILE}")
    assert text_of(rows["learned"][1]) == "0.11 over 1 of 2"
    assert text_of(rows["kiss-icp"][0]) == "0.57 ★"
    assert text_of(rows["DeLORA"][1]) == "NA"
    assert "published: Nubert et al., ICRA 2021" in text_of(page)


def test_lost_intervals_and_failures_are_listed_with_reasons_in_a_folded_table(comparison):
    page = page_of(comparison)
    folded = [table for details in page.iter("details") for table in details.iter("table")]
    (table,) = (t for t in folded if text_of(t.find("caption")).endswith("tracking lost") and "street" in text_of(t))
    rows = [[text_of(cell) for cell in row] for row in table.find("tbody").findall("tr")]
    assert [row[2:5] for row in rows[:2]] == [["20", "100", "119"], ["1", "500", "500"]]
    assert rows[0][5:7] == ["10.0", "11.9"]
    assert "ended with signal 11" in rows[2][-1]


def test_a_method_keeps_its_colour_and_name_in_every_figure_and_recording(comparison):
    page = page_of(comparison)
    names, colours = {}, {}
    for div in page.iter("div"):
        if div.get("class") == "plot":
            for trace in json.loads(div.find("script").text)["data"]:
                key = trace.get("legendgroup", "")
                if key.startswith("m"):
                    names.setdefault(key, set()).add(trace["name"])
                    colour = (trace.get("line") or {}).get("color") or trace["marker"]["color"]
                    colours.setdefault(key, set()).add(colour)
    assert {"learned", "kiss-icp", "unmeasured"} <= {name for of in names.values() for name in of}
    assert all(len(of) == 1 for of in (*names.values(), *colours.values()))
    assert len({colour for of in colours.values() for colour in of}) == len(colours)
    entries = {b.get("data-key"): text_of(b) for b in page.iter("button") if b.get("data-key", "").startswith("m")}
    assert {key: {name} for key, name in entries.items()} == {key: names[key] for key in entries}


def test_an_empty_comparison_and_one_without_references_are_rendered(comparison, straight_drive):
    empty = compared.Comparison("Nothing", "", [])
    assert "Nothing" in text_of(page_of(empty))
    assert render_markdown(empty).startswith("# Nothing")
    drive = straight_drive(3, (0.0,) * 6)
    alone = compared.SequenceComparison(
        "a", "b", None, "", [compared.MethodResult("still", "ok", scans=3, trajectory=drive)]
    )
    page = page_of(compared.Comparison("One", "", [alone]))
    assert "Reference: none" in text_of(page)
    assert [text_of(f.find("figcaption"))[:22] for f in page.iter("figure")] == ["Figure 1. Trajectories"]
    page_of(compared.Comparison("None", "", [replace(alone, methods=[compared.MethodResult("gone", "not run")])]))


def test_a_runaway_leaves_the_pictures_instead_of_flattening_them(comparison, finished):
    sequence = comparison.sequences[0]
    good, wild = sequence.methods[1], finished("wild", sequence.reference, 9, 200.0)
    page = page_of(replace(comparison, sequences=[replace(sequence, methods=[good, wild])]))
    largest_m = good.metrics.absolute_errors()[0].max()
    (plot,) = plots(page, "Position error [m]")
    assert plot["layout"]["yaxis"].get("type") is None, "linear"
    np.testing.assert_allclose(plot["layout"]["yaxis"]["range"], [0.0, 1.5 * largest_m], rtol=1e-4)
    assert [trace["name"] for trace in plot["data"]] == ["kiss-icp", "wild"]
    (up,) = plots(page, "z, up [m]")
    assert up["layout"]["yaxis"]["range"][1] <= 1.5 * largest_m
    (top,) = plots(page, "Top view: y over x [m]")
    size_m = np.ptp(sequence.reference.positions[:, 0])
    assert np.ptp(top["layout"]["xaxis"]["range"]) < 1.5 * size_m
    wildest_m = wild.metrics.absolute_errors()[0].max()
    wildest_deg = np.rad2deg(wild.metrics.absolute_errors()[1].max())
    note = f"wild leaves the picture: up to {wildest_m:,.0f} m and {wildest_deg:,.0f}°. A double click shows all."
    assert note in text_of(page)
    assert len(re.findall(r"wild leaves the picture: up to [\d,]+ m outside\.", text_of(page))) == 1
    assert "kiss-icp leaves the picture" not in text_of(page)


def test_markdown_has_the_tables_and_nothing_that_github_would_run(comparison):
    markdown = render_markdown(comparison)
    assert "<script>" not in re.sub(r"^(`{3,})\n.*?^\1$", "", markdown, flags=re.MULTILINE | re.DOTALL)
    assert "| DeLORA (published: Nubert et al., ICRA 2021) | 6.05 | NA |" in markdown
    tables = re.findall(r"(?:^\|.*\n)+", markdown, flags=re.MULTILINE)
    assert len(tables) > 10
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}) == 1
    assert "nan" not in markdown.lower().replace("nant", "")


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
    errors = CloudErrors(points, np.array([0.0, 0.5, 9.0, 2.0, 0.1]))
    cells = raster(errors, np.linspace(0.0, 3.0, 4), np.linspace(0.0, 2.0, 3))
    np.testing.assert_array_equal(cells, [[0.5, np.nan, np.nan], [np.nan, np.nan, 2.0]])


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
    assert compared.number_text(value, 3) == text


def test_equals_share_the_mark_and_a_column_of_equals_has_none():
    columns = [compared.TableColumn("", "q", "", 1, lower_is_better) for lower_is_better in (True, False, None, True)]
    values = [(1.04, 3.0, 1.0, 5.0), (1.01, 9.0, 2.0, 5.0), (2.0, math.nan, 3.0, 5.0), (None, "NA", 4.0, 5.0)]
    table = compared.Table(
        "t", columns, [compared.TableRow("m", [compared.TableCell(value) for value in row]) for row in values]
    )
    assert table.best() == {(0, 0), (1, 0), (1, 1)}

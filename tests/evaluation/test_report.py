"""The report as a page and as Markdown: its numbers, its marks, and that nothing in it can run or be fetched."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from evaluation.comparison.comparison import Comparison, MethodResult, SequenceComparison
from evaluation.report.figures.palette import method_styles
from evaluation.report.report import render_html, render_markdown

HOSTILE = "<script>alert('x')</script> & \"quoted\" | `tick` ünïcode 测试 \ufffd"
STROKES = {f"s{number}" for number in range(8)}
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def elements() -> type[HTMLParser]:
    """A parser as lenient as a browser's, which lists all elements with their attributes."""

    class Elements(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.found: list[tuple[str, dict[str, str | None]]] = []

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            self.found.append((tag, dict(attrs)))

    return Elements


def page_of(comparison: Comparison) -> ElementTree.Element:
    return ElementTree.fromstring(render_html(comparison))


def text_of(element: ElementTree.Element | None) -> str:
    return "" if element is None else " ".join(" ".join(element.itertext()).split())


def table_rows(page: ElementTree.Element, title: str) -> dict[str, list[ElementTree.Element]]:
    """The cells of the table whose caption ends so, by the name in each row's first cell."""
    (table,) = (t for t in page.iter("table") if text_of(t.find("caption")).endswith(title))
    return {text_of(row.find("th")).split()[0]: list(row.findall("td")) for row in table.find("tbody").findall("tr")}


def test_the_page_is_well_formed_and_fetches_nothing(comparison, elements):
    html = render_html(comparison)
    ElementTree.fromstring(html)
    parser = elements()
    parser.feed(html)
    tags = {tag for tag, _ in parser.found}
    assert not tags & {"script", "link", "iframe", "object", "embed", "base", "form"}
    addresses = [
        v for _, attributes in parser.found for k, v in attributes.items() if k in ("src", "href", "xlink:href")
    ]
    assert addresses
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in addresses)
    assert not [key for _, attributes in parser.found for key in attributes if key.startswith("on")]
    assert "url(" not in html
    assert "@import" not in html


def test_what_users_wrote_is_shown_as_text(comparison):
    page = page_of(comparison)
    words = text_of(page)
    assert words.count(HOSTILE) > 10
    for place in ("Title ", "lidarslam compare 'a b' --methods ", "street ", "note ", "some ", "Means ", "no overlap "):
        assert place + HOSTILE in words


def test_every_drawing_stands_alone_and_is_named(comparison):
    drawings = [drawing for drawing in page_of(comparison).iter(f"{SVG}svg") if drawing.get("role") == "img"]
    assert len(drawings) > 20
    for drawing in drawings:
        ElementTree.fromstring(ElementTree.tostring(drawing))
        assert drawing.get("aria-label")
        assert drawing.get("viewBox")
        for path in drawing.iter(f"{SVG}path"):
            assert not re.search("nan|inf", path.get("d", ""))


def test_figures_are_numbered_and_captioned(comparison):
    figures = list(page_of(comparison).iter("figure"))
    captions = [text_of(figure.find("figcaption")) for figure in figures]
    assert [caption.split(".")[0] for caption in captions] == [f"Figure {n}" for n in range(1, len(figures) + 1)]
    titles = (
        "Trajectories",
        "Errors along the way",
        "Deviation along each axis",
        "Drift by segment length",
        "Drift by speed",
    )
    titles += ("Distance of map points", "Time and memory", "Where each method had track")
    for title in titles:
        assert any(title in caption for caption in captions), title


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
    markdown = render_markdown(comparison)
    ate = comparison.sequences[0].methods[1].metrics.errors.ate_rmse_m
    assert f"**{ate:.3f}** ★" in markdown


def test_what_ended_early_wins_nothing(comparison):
    sequence = comparison.sequences[1]
    first, second, _ = sequence.methods
    best_but_stopped = replace(first, status="stopped")
    changed = replace(
        sequence, methods=[best_but_stopped, replace(second, status="ok"), second.__class__("x", "failed")]
    )
    rows = table_rows(page_of(replace(comparison, sequences=[changed])), "corridor: all methods")
    assert not any("★" in text_of(cell) for cell in rows["kiss-icp"])


def test_means_over_fewer_recordings_say_so_and_published_rows_their_source(comparison):
    page = page_of(comparison)
    rows = table_rows(page, f"Means {HOSTILE}")
    assert text_of(rows["learned"][1]) == "0.11 over 1 of 2"
    assert text_of(rows["kiss-icp"][0]) == "0.57 ★"
    assert text_of(rows["DeLORA"][1]) == "NA"
    assert "published: Nubert et al., ICRA 2021" in text_of(page)
    assert "published: Zhang, 2014" in text_of(page)


def test_lost_stretches_and_failures_are_listed_with_reasons(comparison):
    page = page_of(comparison)
    (table,) = (t for t in page.iter("table") if text_of(t.find("caption")).endswith("where tracking was lost")
                and "street" in text_of(t.find("caption")))  # fmt: skip
    rows = [[text_of(cell) for cell in row] for row in table.find("tbody").findall("tr")]
    assert [row[2:4] for row in rows[:2]] == [["20", "100"], ["1", "500"]]
    assert [row[4] for row in rows[:2]] == ["119", "500"]
    assert rows[0][5:7] == ["10.0", "11.9"]
    assert "ended with signal 11" in rows[2][-1]


def test_a_method_keeps_its_colour_in_every_figure_and_recording(comparison):
    page = page_of(comparison)
    colours: dict[str, set[str]] = {}
    for group in page.iter(f"{SVG}g"):
        title = group.find(f"{SVG}title")
        if group.get("class") == "curve" and title is not None:
            colours.setdefault(title.text, set()).update(
                path.get("stroke") for path in group.findall(f"{SVG}path") if path.get("class") in STROKES
            )
    assert {"learned", "kiss-icp", "unmeasured"} <= set(colours)
    assert all(len(found) == 1 for found in colours.values())
    assert len({found.pop() for found in colours.values()}) == len(colours)


def test_many_methods_stay_distinguishable():
    styles = method_styles(f"method {number}" for number in range(40))
    assert len({(style.colour, style.dash, style.marker) for style in styles.values()}) == 40
    assert len({style.colour for style in list(styles.values())[:8]}) == 8


def test_an_empty_comparison_and_one_without_references_are_rendered(comparison, straight_drive):
    empty = Comparison("Nothing", "", [])
    assert "Nothing" in text_of(page_of(empty))
    assert render_markdown(empty).startswith("# Nothing")
    drive = straight_drive(3, (0.0,) * 6)
    alone = SequenceComparison("a", "b", None, "", [MethodResult("still", "ok", scans=3, trajectory=drive)])
    page = page_of(Comparison("One", "", [alone]))
    assert "Reference: none" in text_of(page)
    assert len(list(page.iter("figure"))) == 1
    page_of(Comparison("None", "", [replace(alone, methods=[MethodResult("gone", "not run")])]))


def test_a_runaway_leaves_the_picture_and_is_named(comparison, finished):
    sequence = comparison.sequences[0]
    wild = finished("wild", sequence.reference, 9, 2.0)
    page = page_of(replace(comparison, sequences=[replace(sequence, methods=[sequence.methods[1], wild])]))
    assert "beyond: wild reaches" in text_of(page)


def test_ten_methods_on_five_long_recordings_stay_small(finished, random_drive):
    reference = random_drive(1, scans=4500)
    methods = [finished(f"method {number}", reference, number, 0.003 * (number + 1)) for number in range(10)]
    sequence = SequenceComparison("long", "x", reference, "ground truth", methods)
    html = render_html(Comparison("Large", "", [sequence]))
    assert 5 * len(html) < 4e6
    assert max(len(re.findall("[ML]", d)) for d in re.findall(r' d="([^"]*)"', html)) <= 2000


def test_markdown_has_the_tables_and_nothing_that_github_would_run(comparison):
    markdown = render_markdown(comparison)
    assert "<script>" not in re.sub(r"^(`{3,})\n.*?^\1$", "", markdown, flags=re.MULTILINE | re.DOTALL)
    assert "| LOAM (published: Zhang, 2014) | 1.20 | NA | 0.345 |" in markdown
    tables = re.findall(r"(?:^\|.*\n)+", markdown, flags=re.MULTILINE)
    assert len(tables) > 10
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}) == 1
    assert "nan" not in markdown.lower().replace("nant", "")

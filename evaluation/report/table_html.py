"""A table as HTML."""

from collections.abc import Mapping
from itertools import groupby

from evaluation.comparison.table import Cell, Column, Row, Table
from evaluation.report.figures.palette import Style, swatch
from evaluation.report.markup import NOTHING, Markup, element, escape

BEST = "★"
_MANY_COLUMNS, _LONG_NAME = 8, 28


def table_html(table: Table, number: int, styles: Mapping[str, Style]) -> Markup:
    """The table in a box that scrolls by itself, with caption and note; folded ones open on request."""
    title = [element("b", escape(f"Table {number}. ")), escape(table.title)]
    head = element("thead", *_head(table))
    body = element("tbody", *(_row(table, row, styles) for row in table.rows))
    caption = NOTHING if table.folded else element("caption", *title)
    box = element(
        "div",
        element("table", caption, head, body, class_="dense" if len(table.columns) > _MANY_COLUMNS else None),
        class_="scroll",
        tabindex="0",
        role="region",
        aria_label=table.title,
    )
    note = element("p", escape(table.note), class_="note") if table.note else NOTHING
    if table.folded:
        return element("details", element("summary", *title), box, note, id=f"table-{number}")
    return element("div", box, note, class_="table", id=f"table-{number}")


def _head(table: Table) -> list[Markup]:
    headings = element("tr", *(_heading(column.heading, column) for column in table.columns))
    if not any(column.group for column in table.columns):
        return [headings]
    spans = [(group, len(list(columns))) for group, columns in groupby(table.columns, key=lambda column: column.group)]
    groups = [
        element("th", escape(group), colspan=str(span), scope="colgroup", class_="group" if group else None)
        for group, span in spans
    ]
    return [element("tr", *groups), headings]


def _heading(heading: str, column: Column) -> Markup:
    """The name, and the unit in brackets on a line of its own."""
    name, bracket, unit = heading.partition(" [")
    below = [element("span", escape(f"{bracket}{unit}".strip()), class_="unit")] if bracket else []
    return element("th", escape(name), *below, scope="col", class_="number" if column.numeric else None)


def _row(table: Table, row: Row, styles: Mapping[str, Style]) -> Markup:
    cells = []
    for index, (cell, column) in enumerate(zip(row.cells, table.columns, strict=True)):
        text = table.cell_text(row, index)
        if index == 0:
            cells.append(_first(row, text, cell, styles))
        else:
            cells.append(_cell(text, cell, column))
    return element("tr", *cells, class_="published" if row.source else None)


def _first(row: Row, text: str, cell: Cell, styles: Mapping[str, Style]) -> Markup:
    picture = [swatch(styles[row.method])] if row.method in styles else []
    long = len(text) > _LONG_NAME
    name = element(
        "span", *picture, element("span", escape(text), class_="name"), class_="method long" if long else "method"
    )
    source = [element("span", escape(f"published: {row.source}"), class_="small")] if row.source else []
    return element("th", name, *source, *_note(cell), scope="row")


def _cell(text: str, cell: Cell, column: Column) -> Markup:
    if not column.numeric:
        return element("td", escape(text), *_note(cell))
    # The star has its room in every cell, so that the digits stand below one another.
    star = element("span", escape(BEST if cell.best else ""), class_="star", title="best" if cell.best else None)
    number = element("b", escape(text)) if cell.best else escape(text)
    return element("td", number, star, *_note(cell), class_="number best" if cell.best else "number")


def _note(cell: Cell) -> list[Markup]:
    return [element("span", escape(cell.note), class_="small")] if cell.note else []

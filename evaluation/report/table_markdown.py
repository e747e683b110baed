"""A table as GitHub's Markdown."""

import re

from evaluation.comparison.table import Cell, Row, Table

_SPECIAL = re.compile(r"([\\`*_\[\]|~#$])")
_HTML = {"&": "&amp;", "<": "&lt;", ">": "&gt;"}


def table_markdown(table: Table, number: int) -> str:
    """The table with its title above and its note below."""
    headings = [
        markdown_text(f"{column.group} {column.heading}".strip() if column.group else column.heading)
        for column in table.columns
    ]
    rules = ["---:" if column.numeric else "---" for column in table.columns]
    lines = [f"**Table {number}.** {markdown_text(table.title)}", "", _line(headings), _line(rules)]
    lines += [_line([_cell(table, row, index) for index in range(len(row.cells))]) for row in table.rows]
    if table.note:
        lines += ["", markdown_text(table.note)]
    return "\n".join(lines)


def markdown_text(text: str) -> str:
    """The text in one line, shown as it is."""
    plain = "".join(_HTML.get(character, character) for character in " ".join(text.split()))
    return _SPECIAL.sub(r"\\\1", plain)


def code_block(text: str) -> str:
    """The text between fences longer than any in it."""
    longest = max((len(run) for run in re.findall("`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}\n{text}\n{fence}"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(table: Table, row: Row, index: int) -> str:
    cell: Cell = row.cells[index]
    text = markdown_text(table.cell_text(row, index))
    if cell.best:
        text = f"**{text}** ★"
    notes = [cell.note] if cell.note else []
    notes += [f"published: {row.source}"] if row.source and index == 0 else []
    return " ".join([text, *(f"({markdown_text(note)})" for note in notes)])

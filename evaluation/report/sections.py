"""What a report shows, in order; how it is written down is for others to decide."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evaluation.comparison.comparison import Comparison, SequenceComparison
from evaluation.comparison.table import Table
from evaluation.report.figures.bars import time_figure
from evaluation.report.figures.drift import length_figure, speed_figure
from evaluation.report.figures.errors import deviation_figure, error_figure
from evaluation.report.figures.figure import Figure
from evaluation.report.figures.maps import map_figure
from evaluation.report.figures.palette import Style
from evaluation.report.figures.timeline import timeline_figure
from evaluation.report.figures.trajectories import trajectory_figure
from evaluation.report.overview import made_with_tables, missing_table, overview_tables
from evaluation.report.tables import drift_tables, lost_table, map_table, summary_table, time_table


@dataclass(frozen=True)
class Section:
    """A part of a report under one heading.

    Attributes:
        heading: empty for a part that follows the title.
        about: lines under the heading.
        remarks: what the reader must not miss.
        blocks: tables and figures in order.
    """

    heading: str
    about: Sequence[str]
    remarks: Sequence[str]
    blocks: Sequence[Table | Figure]


def overview_section(comparison: Comparison) -> Section:
    """What is said of all recordings together."""
    missing = missing_table(comparison)
    blocks = [*overview_tables(comparison), *([missing] if missing else [])]
    return Section("", [], comparison.notes, blocks)


def sequence_section(sequence: SequenceComparison, styles: Mapping[str, Style] | None) -> Section:
    """Everything about one recording; without styles, the tables only."""
    blocks: list[Table | Figure | None] = [summary_table(sequence)]
    if styles is not None:
        blocks += [trajectory_figure(sequence, styles), error_figure(sequence, styles)]
        blocks += [deviation_figure(sequence, styles), length_figure(sequence, styles)]
    blocks += drift_tables(sequence)
    if styles is not None:
        blocks += [speed_figure(sequence, styles), map_figure(sequence)]
    blocks += [map_table(sequence)]
    if styles is not None:
        blocks += [time_figure(sequence, styles)]
    blocks += [time_table(sequence)]
    lost = lost_table(sequence)
    if styles is not None and lost is not None:
        blocks += [timeline_figure(sequence, styles)]
    present = [block for block in [*blocks, lost] if block is not None]
    return Section(sequence.sequence, _about(sequence), sequence.notes, present)


def made_with_section(comparison: Comparison) -> Section:
    """Versions, commit and machine."""
    return Section("Made with", [], [], made_with_tables(comparison))


def _about(sequence: SequenceComparison) -> list[str]:
    if sequence.reference is None:
        return [f"Source: {sequence.source}", "Reference: none"]
    reference = sequence.reference
    size = f"{len(reference)} poses, {reference.length_m:.1f} m, {reference.duration_s:.1f} s"
    return [f"Source: {sequence.source}", f"Reference: {sequence.reference_name} ({size})"]

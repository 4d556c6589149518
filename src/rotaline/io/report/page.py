"""What a page of the report consists of: sections with a judgement, tables and pictures. Plain values for the template."""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from matplotlib.figure import Figure

from rotaline.io.report import style
from rotaline.io.report.contents import StageWarning

Level = Literal["good", "fair", "poor", "none"]
"""How a judgement is marked: fine, look at it, do not rely on it, no judgement."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Picture:
    """An inline picture; ``source`` is a data URI, empty if it could not be drawn (then ``failure`` says why)."""

    source: str
    caption: str
    width: Literal["full", "half", "third"] = "full"
    failure: str = ""
    number: int = 0


@dataclass(frozen=True)
class Column:
    """A table column; ``unit`` stands below the label; numbers are right-aligned; neighbours of one ``group`` share a title above."""

    label: str
    unit: str = ""
    numeric: bool = True
    group: str = ""


@dataclass(frozen=True)
class Row:
    """Cells as text.

    ``kind``: ``continued`` belongs to the row above, ``dim`` was left out, ``total`` sums up; a ``failed`` row has a text
    instead of numbers: its last cell runs to the end of the row. ``marks``: for each
    cell "better", "equal" or "worse" than a reference; anything else, or no marks at all, where there is nothing to say.
    """

    cells: tuple[str, ...]
    kind: Literal["plain", "continued", "dim", "total", "failed"] = "plain"
    marks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Table:
    """A table with its caption; ``note`` stands below it; long narrow ones stand in several ``stacks`` side by side."""

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    note: str = ""
    stacks: int = 1
    number: int = 0

    def column_groups(self) -> list[tuple[str, int]]:
        """Titles above the columns, each with the number of columns that it spans."""
        runs = groupby(column.group for column in self.columns)
        return [(title, len(list(columns))) for title, columns in runs]


@dataclass(frozen=True)
class Heading:
    """A sub-heading within a section."""

    text: str
    is_heading: bool = True


@dataclass(frozen=True)
class Paragraph:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Gallery:
    """Pictures side by side, as their widths allow."""

    pictures: tuple[Picture, ...]


Block = Table | Gallery | Heading | Paragraph


@dataclass(frozen=True)
class Section:
    """One section. A stage that was not done has only ``missing``, a sentence that says so."""

    anchor: str
    title: str
    short_title: str
    judgement: str = ""
    level: Level = "none"
    warnings: tuple[StageWarning, ...] = ()
    blocks: tuple[Block, ...] = ()
    missing: str = ""


@dataclass(frozen=True)
class KeyFigure:
    """A figure at the top of the report."""

    label: str
    value: str
    unit: str
    remark: str = ""


def picture(
    draw: Callable[[], Figure],
    caption: str,
    width: Literal["full", "half", "third"] = "full",
    form: Literal["svg", "png", "jpeg"] = "svg",
) -> Picture:
    """Draw a picture and put it inline.

    A picture that cannot be drawn must not cost the report: its place says what went wrong, and the log has the trace.
    """
    try:
        figure = draw()
        source = {"svg": style.svg_uri, "png": style.png_uri, "jpeg": style.jpeg_uri}[form](figure)
    except Exception as error:
        _log.warning("A picture of the report could not be drawn: %s", caption, exc_info=True)
        return Picture(
            "", caption, width, failure=f"This picture could not be drawn ({type(error).__name__}: {error})."
        )
    return Picture(source, caption, width)


def finished(sections: Sequence[Section]) -> tuple[Section, ...]:
    """The sections with their figures and tables numbered in the order of the page.

    A section with warnings is not marked as good, one with a serious warning is marked as poor, whatever its figures say.
    """
    figures, tables = 0, 0
    out = []
    for section in sections:
        blocks: list[Block] = []
        for block in section.blocks:
            if isinstance(block, Table):
                tables += 1
                blocks.append(dataclasses.replace(block, number=tables))
            elif isinstance(block, Gallery):
                pictures = []
                for one in block.pictures:
                    figures += 1
                    pictures.append(dataclasses.replace(one, number=figures))
                blocks.append(Gallery(tuple(pictures)))
            else:
                blocks.append(block)
        out.append(dataclasses.replace(section, blocks=tuple(blocks), level=_level(section)))
    return tuple(out)


def _level(section: Section) -> Level:
    """The mark of a section: its warnings count as well as its figures."""
    if not section.judgement or not section.warnings:
        return section.level
    if any(w.serious for w in section.warnings):
        return "poor"
    return "fair" if section.level == "good" else section.level

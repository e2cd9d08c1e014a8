"""A report as data, whatever its format: warnings, and sections of text, pictures, tables and comparisons."""

import io
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

from bayespbrl.figures import new_figure, png


@dataclass(frozen=True)
class ReportWarning:
    """A problem, in one sentence or two, and its remedy."""

    what: str
    remedy: str


@dataclass(frozen=True)
class Picture:
    """A PNG, the name of its file, its caption, its alternative text and its width in inches."""

    name: str
    png: bytes
    caption: str
    alt: str
    inches: float = 0.0
    kind: str = "picture"

    @property
    def data_uri(self) -> str:
        """The picture as an address that HTML can embed."""
        return "data:image/png;base64," + b64encode(self.png).decode()


@dataclass(frozen=True)
class Table:
    """A caption, column heads and rows of text."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    kind: str = "table"


@dataclass(frozen=True)
class Comparison:
    """One answer and the two trajectories that were shown; `small` where there are many."""

    title: str
    text: str
    pictures: tuple[Picture, ...]
    small: bool = False
    kind: str = "comparison"


Block = Picture | Table | Comparison
Body = tuple[Sequence[str], Sequence[Block]]  # the paragraphs of a section, and what stands below them


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, and what stands below them."""

    name: str
    title: str
    text: Sequence[str]
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Report:
    """The variables of the templates."""

    title: str
    state: str
    facts: Sequence[tuple[str, str]]
    summary: Sequence[str]
    warnings: Sequence[ReportWarning]
    sections: Sequence[Section]
    made: str


def drawn(
    name: str,
    panels: Sequence[tuple[str, Callable[[Axes], object]]],
    caption: str,
    alt: str,
    *,
    columns: int = 2,
    size: tuple[float, float] = (4.4, 3.1),
) -> Picture:
    """A picture of panels.

    Args:
      name: of its file.
      panels: at least one, each a title and a function that draws on axes.
      caption, alt: in words.
      columns: of panels.
      size: of a panel, inches.
    """
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08, wspace=0.05, hspace=0.05)
    figure = new_figure(columns * size[0], rows * size[1], layout=layout)
    grid = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axes, (title, draw) in zip(grid, panels, strict=False):
        draw(axes)
        axes.set_title(title, fontsize=10)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    return Picture(name, _few_colours(figure, dpi=150, colours=256), caption, alt, columns * size[0])


def thumbnail(name: str, draw: Callable[[Axes], object], caption: str, alt: str) -> Picture:
    """A small picture of what `draw` draws, in 64 colours and a few kilobytes."""
    figure = new_figure(4.4, 3.4, layout=None)
    draw(figure.subplots())
    return Picture(name, _few_colours(figure, dpi=85, colours=64, bbox_inches="tight", pad_inches=0.03), caption, alt)


def _few_colours(figure: Figure, *, dpi: int, colours: int, **options: Any) -> bytes:
    small, image = io.BytesIO(), Image.open(io.BytesIO(png(figure, dpi=dpi, **options))).convert("RGB")
    image.quantize(colours, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue()

"""What a report is made of, whatever the format: sections of text, pictures, tables and comparisons."""

import io
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image


@dataclass(frozen=True)
class Picture:
    """A PNG of so many inches' width, its caption, and a text for who cannot see it; `name` is its file's."""

    name: str
    png: bytes
    caption: str
    alt: str
    inches: float = 0.0
    kind: str = "picture"

    @property
    def data_uri(self) -> str:
        return "data:image/png;base64," + b64encode(self.png).decode()


@dataclass(frozen=True)
class Table:
    """Rows of texts under their heads."""

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


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, and what stands below them."""

    name: str
    title: str
    text: Sequence[str] = ()
    blocks: Sequence[Picture | Table | Comparison] = ()


def drawn(
    name: str,
    panels: Sequence[tuple[str, Callable[[Axes], Any]]],
    caption: str,
    alt: str,
    *,
    columns: int = 2,
    size: tuple[float, float] = (4.4, 3.1),
) -> Picture:
    """A picture of panels, each a title and a function that draws on axes.

    Args:
      name: of its file.
      panels: at least one.
      caption, alt: in words.
      columns: of panels.
      size: of a panel, inches.
    """
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    room = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08, wspace=0.05, hspace=0.05)
    figure = Figure(figsize=(columns * size[0], rows * size[1]), layout=room)
    FigureCanvasAgg(figure)
    grid = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for axes, (title, draw) in zip(grid, panels, strict=False):
        draw(axes)
        axes.set_title(title, fontsize=10)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    return Picture(name, _png(figure, dpi=150, colours=256), caption, alt, columns * size[0])


def thumbnail(name: str, draw: Callable[[Axes], Any], caption: str, alt: str) -> Picture:
    """A small picture of what `draw` draws, in few colours and a few kilobytes."""
    figure = Figure(figsize=(4.4, 3.4))
    FigureCanvasAgg(figure)
    draw(figure.subplots())
    return Picture(name, _png(figure, dpi=85, colours=64, bbox_inches="tight", pad_inches=0.03), caption, alt)


def _png(figure: Figure, *, dpi: int, colours: int, **options: Any) -> bytes:
    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi, **options)
    image = Image.open(drawn).convert("RGB")
    image.quantize(colours, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue()

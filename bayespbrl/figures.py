"""Figures without matplotlib's global state, which is imported where one is drawn; what is shown of many pictures."""

import io
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Int, UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import LayoutEngine


def new_figure(
    width: float,
    height: float,
    *,
    layout: "Literal['constrained'] | LayoutEngine | None" = "constrained",
    dpi: float | None = None,
) -> "Figure":
    """An empty figure, inches; the options are matplotlib's."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout, dpi=dpi)


def png(figure: "Figure", *, dpi: int = 110, **options: Any) -> bytes:
    """The figure as a PNG; the options are those of matplotlib's `savefig`."""
    written = io.BytesIO()
    figure.savefig(written, format="png", dpi=dpi, **options)
    return written.getvalue()


def pixels(figure: "Figure") -> UInt8[np.ndarray, "height width 4"]:
    """The drawn figure, RGBA."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).copy()


def spread(number: int, most: int) -> Int[np.ndarray, " n"]:
    """At most `most` of the indices below `number`, evenly spread, first and last among them."""
    return np.linspace(0, number - 1, min(number, most)).round().astype(int)

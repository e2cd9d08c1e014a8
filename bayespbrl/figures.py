"""Figures without matplotlib's global state; it is imported only where one is drawn."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float, *, layout: Any = "constrained", dpi: float | None = None) -> "Figure":
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

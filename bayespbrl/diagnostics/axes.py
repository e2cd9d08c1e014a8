"""Helpers of the figures: labels, whole numbers along the x axis, a legend, numbered cells."""

from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator


def finished(axes: Axes, *, whole: bool = True, **labels: object) -> Axes:
    """`axes` with `labels` set, whole numbers along x if `whole`, and a legend if anything drawn has a name."""
    axes.set(**labels)
    if whole:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
    return axes


def number_cells(axes: Axes, shape: tuple[int, int]) -> None:
    """Number the rows and columns of a drawn grid from 1."""
    rows, columns = shape
    axes.set_xticks(range(columns), [str(j + 1) for j in range(columns)])
    axes.set_yticks(range(rows), [str(i + 1) for i in range(rows)])

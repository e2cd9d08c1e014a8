"""Numbers as the text of a report."""

import numpy as np


def number(value: float) -> str:
    """Four significant digits, whole numbers in full, with a typographic minus sign."""
    whole = value == int(value) and abs(value) < 1e6 if np.isfinite(value) else False
    return (f"{value:.0f}" if whole else f"{value:.4g}").replace("-", "−")


def percent(share: float, digits: int = 0) -> str:
    """A share as a percentage."""
    return f"{100 * share:.{digits}f} %"


def count(total: int, one: str, many: str | None = None) -> str:
    """A number with its noun, in the plural unless it is one."""
    return f"{total} {one if total == 1 else (many or one + 's')}"


def cell(value: str | float) -> str:
    """A text or a number as the cell of a table; a dash for NaN."""
    if isinstance(value, str):
        return value
    return "–" if np.isnan(value) else number(float(value))

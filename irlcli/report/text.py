"""Numbers and their marks as text. A missing one is ``-``, and none is a negative zero."""

from typing import Any

import pandas as pd


def number(value: Any, digits: int = 1) -> str:
    """``value`` to ``digits`` decimals."""
    return "-" if pd.isna(value) else f"{value:z.{digits}f}"


def percent(share: Any) -> str:
    """A share of one, to a tenth of a per cent."""
    return "-" if pd.isna(share) else f"{share:z.1%}"


def incomplete(cell: Any) -> str:
    """Marks a cell that lacks seeds, or evaluations of the seeds it has."""
    few = f" ({cell.seeds}/{cell.seeds_wanted})" if cell.seeds < cell.seeds_wanted else ""
    return few + (" (part)" if cell.partial else "")


def p_value(value: Any) -> str:
    """A p-value to three digits."""
    return "-" if pd.isna(value) else "< .001" if value < 1e-3 else f"{value:.3f}"

"""Numbers as text. A missing one is ``-``, and none is a negative zero."""

from typing import Any

import pandas as pd


def number(value: Any, digits: int = 1) -> str:
    """``value`` to ``digits`` decimals."""
    return "-" if pd.isna(value) else f"{value:z.{digits}f}"


def percent(share: Any) -> str:
    """A share of one, to a tenth of a per cent."""
    return "-" if pd.isna(share) else f"{share:z.1%}"


def p_value(value: Any) -> str:
    """A p-value to three digits."""
    return "-" if pd.isna(value) else "< .001" if value < 1e-3 else f"{value:.3f}"

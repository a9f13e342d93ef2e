"""Figures made without pyplot, which would change the caller's backend (a notebook's, say)."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure


def panels(rows: int, columns: int, size: tuple[float, float], **shared: Any) -> tuple[Figure, Any]:
    """A figure of ``size`` [inch] and its axes [rows, columns]; ``shared`` as for ``subplots``."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **shared)


def offsets(count: int, reach: float) -> np.ndarray:
    """``count`` offsets from -reach to reach, so that points beside each other can be told apart."""
    return np.linspace(-reach, reach, count) if count > 1 else np.zeros(count)


def save(figure: Figure, directory: Path, name: str, dpi: int = 130) -> None:
    """Write ``NAME.png`` and ``NAME.pdf``: the same bytes each time."""
    figure.savefig(directory / f"{name}.png", dpi=dpi)
    figure.savefig(directory / f"{name}.pdf", metadata={"CreationDate": None})

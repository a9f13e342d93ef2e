"""The sources of ``irl import``: demonstrations that were recorded elsewhere."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from irlcli.errors import NotFound, UsageError
from irlcli.experiments.inputs import foreign_source
from irlcli.stages.base import Source

if TYPE_CHECKING:
    from irlcli.stages.import_demonstrations import Form


def recorded(texts: Sequence[str]) -> tuple[Form, list[Source]]:
    """The sources of an import, ``FILE.parquet``, ``minari:DATASET`` or a directory, and their form.

    Raises:
        NotFound: a source does not exist.
        UsageError: sources of several forms, or of none.
    """
    if not texts:
        raise UsageError(
            "no demonstrations to import", "name a file, a directory or minari:DATASET"
        )
    found = [(_form(text), _recorded(text)) for text in texts]
    forms = sorted({form for form, _ in found})
    if len(forms) > 1:
        raise UsageError(
            f"the sources are of several forms: {', '.join(forms)}", "import them one at a time"
        )
    return found[0][0], [source for _, source in found]


def _form(text: str) -> Form:
    if text.startswith("minari:"):
        return "minari"
    return "imitation" if Path(text).is_dir() else "parquet"


def _recorded(text: str) -> Source:
    if text.startswith("minari:"):
        path = minari_directory(text.removeprefix("minari:"))
        hint = f"`minari download {text.removeprefix('minari:')}`, or set MINARI_DATASETS_PATH"
    else:
        path = Path(text)
        hint = "name a Parquet file, minari:DATASET, or a directory of imitation's trajectories"
    if not path.exists():
        raise NotFound(f"there is nothing at {path}", hint)
    source = foreign_source(path)
    if path.is_file() and not _is_parquet(path):
        raise UsageError(f"{path} is not a Parquet file", hint)
    if _form(text) == "imitation":
        from irlcli.data.exchange.imitation import STATE

        if not (path / STATE).is_file():
            raise UsageError(f"{path} holds no trajectories of imitation: no {STATE}", hint)
    return source


def _is_parquet(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(4) == b"PAR1"


def minari_directory(dataset: str) -> Path:
    """Where Minari keeps the data of a dataset on this machine.

    Raises:
        UsageError: the name of no dataset.
    """
    # Minari takes no namespace of one character.
    if not re.fullmatch(r"(?![^/]/[^/]*$)(?:[-\w]+/)*[-\w]+-v\d+", dataset):
        raise UsageError(
            f"{dataset!r} is not the name of a Minari dataset", "write minari:me/hopper-mass-v0"
        )
    root = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    return Path(root) / dataset / "data"

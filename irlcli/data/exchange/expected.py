"""What an import expects of its source, and the conversion of a source's columns to arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from irlcli.data.steps import Irregular
from irlcli.errors import UsageError, first_line
from irlcli.interventions import Setting, parse_setting, same
from irlcli.trajectories import ActionSpace

# From a row to where it stands in its source, for messages.
Locate = Callable[[int], str]
# What exports call the setting.
SETTING = "setting"


@dataclass(frozen=True)
class Expected:
    """The environment and the settings that a source's episodes are of.

    Attributes:
        env: name of the environment.
        settings: the settings as text.
        column: column, or key of an episode's metadata, that names its setting; None where all
            episodes of the source are of the one setting.
        horizon: time limit of the environment [steps].
        actions: the environment's actions.
        irregular: what to do with episodes that are not whole.
        others: the settings of the import's other sources.
    """

    env: str
    settings: tuple[str, ...]
    column: str | None
    horizon: int
    actions: ActionSpace
    irregular: Irregular
    others: tuple[str, ...] = ()

    def index(self, name: Any, place: str) -> int:
        """The index of the setting called ``name``: ``mass=2x``, or ``2x`` of the only knob.

        Raises:
            UsageError: it is none of the settings.
        """
        text = str(name)
        if text in self.settings:
            return self.settings.index(text)
        for found in self._meant(text):
            for index, own in enumerate(self.settings):
                if same(parse_setting(self.env, own), found):
                    return index
        raise UsageError(
            f"{place}: setting {text[:80]!r} is not one of {', '.join(self.settings)}",
            "correct the source (a multiplier is written as 2x), or name all settings that it holds "
            "with --intervention or --setting",
        )

    def _meant(self, text: str) -> Iterator[Setting]:
        """What ``text`` may name: a setting, or a value of the only knob of all settings."""
        listed = (*self.settings, *self.others)
        knobs = {knob for s in listed for knob in parse_setting(self.env, s).knobs}
        of_the_only = [f"{knob}={text}" for knob in knobs] if len(knobs) == 1 else []
        for written in (text, *of_the_only):
            with suppress(UsageError):
                yield parse_setting(self.env, written)

    def contradicts(self, name: Any, place: str) -> None:
        """Refuse a source whose ``setting`` column names another setting than the only one expected.

        The column may mean something else, so what names no setting is accepted.

        Raises:
            UsageError: ``name`` is another setting of the environment, or another value of the knob.
        """
        (only,) = self.settings
        meant = list(self._meant(str(name)))
        if meant and not any(same(found, parse_setting(self.env, only)) for found in meant):
            raise UsageError(
                f"{place}: {SETTING!r} says {name}, but the command names {only}",
                "name the settings that the source holds; if the column means something else, "
                "rename it",
            )

    def shaped(self, actions: np.ndarray) -> np.ndarray:
        """Recorded ``actions`` [B, ...] in the form that the environment's actions have.

        What does not fit keeps at most two dimensions, and is refused with its row.
        """
        fitting = (len(actions), *self.actions.shape)
        if actions.size == math.prod(fitting):
            actions = actions.reshape(fitting)
        elif actions.ndim > 2:
            actions = actions.reshape(len(actions), -1)
        if self.actions.discrete and actions.dtype.kind in "iub":
            return actions.astype(np.int64, copy=False)
        with np.errstate(over="ignore"):
            return actions.astype(np.float32, copy=False)


def vectors(array: np.ndarray) -> np.ndarray:
    """``array`` [B, ...] as float32 [B, D]."""
    # What overflows becomes infinite, which is refused with its row.
    with np.errstate(over="ignore"):
        return array.reshape(len(array), -1).astype(np.float32, copy=False)


def numbers(column: pa.Array, name: str, place: Locate) -> np.ndarray:
    """A column of B numbers, or of lists of equal length, as an array [B] or [B, ...].

    Raises:
        UsageError: another type, a null, or lists of unequal lengths.
    """
    require_all(column, name, place)
    kind = column.type
    if pa.types.is_dictionary(kind):
        return numbers(column.dictionary_decode(), name, place)
    if pa.types.is_list_view(kind) or pa.types.is_large_list_view(kind):
        return numbers(column.cast(pa.large_list(kind.value_type)), name, place)
    if pa.types.is_boolean(kind):
        return column.cast(pa.uint8()).to_numpy().view(bool)
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        return column.to_numpy()
    if pa.types.is_fixed_size_list(kind):
        size = kind.list_size
    elif pa.types.is_list(kind) or pa.types.is_large_list(kind):
        lengths = column.value_lengths().to_numpy()
        size = int(lengths[0]) if len(lengths) else 0
        if (lengths != size).any():
            row = int(np.argmax(lengths != size))
            raise UsageError(
                f"{place(row)}: {name} has {lengths[row]} numbers, but {size} in the rows before",
                "all rows must be of one shape",
            )
    else:
        raise UsageError(
            f"{place(0)}: {name} is of type {str(kind)[:80]}: it holds no numbers",
            "docs/data.md describes the columns",
        )
    if size == 0:
        raise UsageError(f"{place(0)}: {name} is an empty list", "every step needs it")
    inner = numbers(column.flatten(), name, lambda row: place(row // size))
    return inner.reshape(len(column), size, *inner.shape[1:])


def require_all(column: pa.Array, name: str, place: Locate) -> None:
    """Refuse a column with a null.

    Raises:
        UsageError: naming the first row without a value.
    """
    if column.null_count:
        row = pc.index(column.is_null(), True).as_py()
        raise UsageError(f"{place(row)}: {name} is missing", "every step needs it")


def unreadable(source: object, error: Exception) -> str:
    """The message of a source that its format's reader refuses."""
    return f"{source} cannot be read ({first_line(error)[:200]})"

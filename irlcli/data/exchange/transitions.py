"""Demonstrations as one Parquet file with a row per transition (docs/data.md)."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from irlcli.data.demonstrations import action_type, array_column, table_schema
from irlcli.data.exchange.expected import (
    SETTING,
    Expected,
    Locate,
    numbers,
    require_all,
    unreadable,
    vectors,
)
from irlcli.data.parquet import UNREADABLE, batches, open_table, writer
from irlcli.data.steps import PIECE, Steps, pieces
from irlcli.errors import IntegrityError, UsageError

SCHEMA = 1
_REQUIRED = ("obs", "action", "next_obs", "terminated")
_OPTIONAL = ("reward", "truncated", "episode", "seed")


def read_transitions(path: Path, expected: Expected, size: int = PIECE) -> Iterator[Steps]:
    """The steps in ``path``, at most ``size`` at a time. Rows are counted from 0.

    Raises:
        IntegrityError: not a readable Parquet file.
        UsageError: a column is missing or of another type, or a row cannot be used.
    """
    try:
        with open_table(path) as file:
            columns = _columns(path, file.schema_arrow.names, expected)
            episodes = _EpisodeStarts()
            done = 0
            for batch in batches(file, size, columns):
                if batch.num_rows:
                    yield _steps(path, batch, done, expected, episodes)
                done += batch.num_rows
    except FileNotFoundError:
        raise IntegrityError(f"{path} is missing", "name another file") from None
    except UNREADABLE as error:
        raise IntegrityError(unreadable(path, error), "name a Parquet file") from None


def _columns(path: Path, found: Sequence[str], expected: Expected) -> list[str]:
    if len(set(found)) < len(found):
        raise UsageError(f"{path} has two columns of one name", "rename one of them")
    setting = [] if expected.column is None else [expected.column]
    missing = [name for name in (*_REQUIRED, *setting) if name not in found]
    if missing:
        raise UsageError(
            f"{path} has no column {missing[0]!r}; it has: {', '.join(found)[:400]}",
            "--setting-column names the settings' column; or give a source for each setting"
            if missing[0] in setting
            else "docs/data.md describes the columns",
        )
    optional = _OPTIONAL if setting else (*_OPTIONAL, SETTING)
    return [*_REQUIRED, *setting, *(name for name in optional if name in found)]


def _steps(
    path: Path, batch: pa.RecordBatch, done: int, expected: Expected, episodes: _EpisodeStarts
) -> Steps:
    def place(row: int) -> str:
        return f"{path} row {done + row}"

    def column(name: str) -> np.ndarray:
        return numbers(batch.column(name), name, place)

    def flags(name: str) -> np.ndarray:
        if name not in batch.schema.names:
            return np.zeros(batch.num_rows, dtype=bool)
        if not pa.types.is_boolean(batch.schema.field(name).type):
            raise UsageError(f"{place(0)}: {name} is not true or false", "write a boolean column")
        return column(name)

    terminated, truncated = flags("terminated"), flags("truncated")
    named = batch.column("episode") if "episode" in batch.schema.names else None
    rewards = None
    if "reward" in batch.schema.names:
        rewards = column("reward").reshape(batch.num_rows, -1)
        if rewards.shape[1] != 1:
            raise UsageError(f"{place(0)}: reward is a list", "a step has one reward")
        rewards = rewards[:, 0].astype(np.float64)
    seeds = np.full(batch.num_rows, -1, np.int64)
    if "seed" in batch.schema.names:
        if not pa.types.is_integer(batch.schema.field("seed").type):
            raise UsageError(f"{place(0)}: seed is not a whole number", "write whole numbers")
        found = column("seed")
        known = (found >= 0) & (found <= np.iinfo(np.int64).max)
        seeds[known] = found[known]
    return Steps(
        first=episodes.of(named, terminated | truncated, place),
        settings=_settings(batch, expected, place),
        observations=vectors(column("obs")),
        actions=expected.shaped(column("action")),
        rewards=rewards,
        next_observations=vectors(column("next_obs")),
        terminated=terminated,
        truncated=truncated,
        seeds=seeds,
        place=place,
    )


def _settings(batch: pa.RecordBatch, expected: Expected, place: Locate) -> np.ndarray:
    if expected.column is None:
        if SETTING in batch.schema.names:
            _check_settings(batch.column(SETTING), expected, place)
        return np.zeros(batch.num_rows, dtype=np.int64)
    column = batch.column(expected.column)
    if pa.types.is_nested(column.type):
        raise UsageError(
            f"{place(0)}: {expected.column} is a list", "name a column of text or numbers"
        )
    require_all(column, expected.column, place)
    coded = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
    codes = coded.indices.to_numpy()
    found = np.zeros(len(coded.dictionary), dtype=np.int64)
    for code in np.unique(codes).tolist():
        name = _text(coded.dictionary[code])
        found[code] = expected.index(name, place(int(np.argmax(codes == code))))
    return found[codes]


def _text(name: pa.Scalar) -> str:
    """0.1 for the number nearest to it of any width."""
    narrow = {pa.float16(): np.float16, pa.float32(): np.float32}.get(name.type)
    return str(name.as_py() if narrow is None else narrow(name.as_py()))


def _check_settings(column: pa.Array, expected: Expected, place: Locate) -> None:
    if pa.types.is_nested(column.type):
        return
    coded = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
    for code in pc.unique(coded.indices.drop_null()):
        row = pc.index(coded.indices, code).as_py()
        expected.contradicts(_text(coded.dictionary[code.as_py()]), place(row))


class _EpisodeStarts:
    """Which rows begin an episode: those with another number, or that follow an end."""

    def __init__(self) -> None:
        self._seen: set[Any] = set()
        self._last: Any = None
        self._ended = True

    def of(self, named: pa.Array | None, ended: np.ndarray, place: Locate) -> np.ndarray:
        """[B] bool for a batch whose episodes are ``named`` and end where ``ended``."""
        if named is None:
            first = np.append(self._ended, ended[:-1])
            self._ended = bool(ended[-1])
            return first
        if pa.types.is_nested(named.type):
            raise UsageError(f"{place(0)}: episode is a list", "write a number or text")
        require_all(named, "episode", place)
        if pa.types.is_float16(named.type):
            # Arrow compares no half floats.
            named = named.cast(pa.float32())
        if pa.types.is_floating(named.type):
            finite = pc.is_finite(named)
            if not pc.all(finite).as_py():
                row = pc.index(finite, False).as_py()
                raise UsageError(f"{place(row)}: episode is not finite", "number the episodes")
        changes = pc.indices_nonzero(pc.not_equal(named[1:], named[:-1])).to_numpy() + 1
        first = np.zeros(len(named), dtype=bool)
        first[changes] = True
        first[0] = named[0].as_py() != self._last or not self._seen
        for row in np.flatnonzero(first).tolist():
            name = named[row].as_py()
            if name in self._seen:
                raise UsageError(
                    f"{place(row)}: episode {str(name)[:80]} begins again",
                    "the steps of an episode must stand one after the other",
                )
            self._seen.add(name)
        self._last = named[-1].as_py()
        return first


def write_transitions(
    path: Path, env: str, settings: Sequence[str], parts: Iterator[Steps], size: int = PIECE
) -> None:
    """Write ``parts`` to ``path``; :func:`read_transitions` gives the same steps back.

    A row group holds ``size`` steps.

    Raises:
        OSError: the file cannot be written.
        UsageError: there is no step.
    """
    stream = pieces(parts, size)
    first = next(stream, None)
    if first is None:
        raise UsageError("there is no episode to write", "name demonstrations with episodes")
    schema = _schema(first, env)
    names = pa.array(settings)
    done = 0
    with writer(path, schema, repeating=("setting",)) as file:
        for piece in itertools.chain([first], stream):
            table = _table(piece, schema, names, done)
            file.write_table(table, row_group_size=len(piece))
            done += int(piece.ended.sum())


def _schema(first: Steps, env: str) -> pa.Schema:
    obs = pa.list_(pa.float32(), first.observations.shape[1])
    tags = json.dumps({"transitions": SCHEMA, "env": env}, sort_keys=True)
    return table_schema(
        setting=pa.dictionary(pa.int32(), pa.string()),
        episode=pa.int32(),
        seed=pa.int64(),
        obs=obs,
        action=action_type(first.actions),
        **({} if first.rewards is None else {"reward": pa.float64()}),
        next_obs=obs,
        terminated=pa.bool_(),
        truncated=pa.bool_(),
    ).with_metadata({"irlcli": tags})


def _table(steps: Steps, schema: pa.Schema, names: pa.Array, done: int) -> pa.Table:
    arrays = (
        steps.episode_numbers(done).astype(np.int32),
        steps.seeds,
        steps.observations,
        steps.actions,
        *(() if steps.rewards is None else (steps.rewards,)),
        steps.next_observations,
        steps.terminated,
        steps.truncated,
    )
    settings = pa.DictionaryArray.from_arrays(steps.settings.astype(np.int32), names)
    columns = [settings, *map(array_column, arrays)]
    return pa.Table.from_arrays(columns, schema=schema)

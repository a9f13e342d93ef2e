"""Trajectories of the library imitation: a Hugging Face dataset on disk, a row per episode.

Only its Arrow files are read. The column ``infos`` holds pickles in JSON, which are never decoded.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from irlcli.data.exchange.expected import (
    Expected,
    numbers,
    unreadable,
    vectors,
)
from irlcli.data.parquet import UNREADABLE
from irlcli.data.steps import PIECE, Steps
from irlcli.errors import IntegrityError, UsageError
from irlcli.store import read_json

STATE = "state.json"
_COLUMNS = ("obs", "acts", "terminal")


def read_imitation(directory: Path, expected: Expected, size: int = PIECE) -> Iterator[Steps]:
    """The steps of the trajectories in ``directory``, about ``size`` at a time.

    ``terminal`` also marks episodes that a time limit ended: one of the environment's whole horizon
    is truncated, a shorter one terminated. No episode has a seed.

    Raises:
        IntegrityError: not a Hugging Face dataset, or damaged.
        UsageError: a column is missing or of another type, or an episode cannot be used.
    """
    done = 0
    try:
        for path in _data_files(directory):
            with pa.memory_map(str(path)) as file, pa.ipc.open_stream(file) as stream:
                for batch in stream:
                    batch.validate(full=True)
                    yield from _episodes(directory, batch, done, expected, size)
                    done += batch.num_rows
    except (*UNREADABLE, IntegrityError) as error:
        raise IntegrityError(
            unreadable(directory, error), "name a directory that imitation's serialize.save wrote"
        ) from None


def _data_files(directory: Path) -> list[Path]:
    names = [entry["filename"] for entry in read_json(directory / STATE)["_data_files"]]
    for name in names:
        if not isinstance(name, str) or Path(name).name != name:
            raise ValueError(f"{STATE} names a file outside the directory")
    if not names or list(directory.glob("indices*.arrow")):
        raise ValueError("its rows are not stored in order: flatten_indices() it and save it again")
    return [directory / name for name in names]


def _episodes(
    directory: Path, batch: pa.RecordBatch, done: int, expected: Expected, size: int
) -> Iterator[Steps]:
    missing = [name for name in _COLUMNS if name not in batch.schema.names]
    if missing:
        raise UsageError(
            f"{directory} has no column {missing[0]!r}; it has: {', '.join(batch.schema.names)}",
            "name trajectories of imitation",
        )
    lengths = _lengths(directory, batch, done, expected)
    # Episodes whose steps fill a piece, and at least one.
    begin = 0
    while begin < len(lengths):
        end = begin + max(1, int((np.cumsum(lengths[begin:]) <= size).sum()))
        part = batch.slice(begin, end - begin)
        if lengths[begin:end].sum():
            yield _steps(directory, part, lengths[begin:end], done + begin, expected)
        begin = end


def _lengths(directory: Path, batch: pa.RecordBatch, done: int, expected: Expected) -> np.ndarray:
    """The steps of each episode [R], after a check that its columns are of these lengths."""
    found = {}
    for name in ("obs", "acts", *(["rews"] if "rews" in batch.schema.names else [])):
        column = batch.column(name)
        if column.null_count or not hasattr(column, "value_lengths"):
            raise UsageError(f"{directory}: {name} is not a list in each episode", "save it again")
        found[name] = column.value_lengths().to_numpy()
    lengths = found["acts"]
    for row, length in enumerate(lengths):
        place = f"{directory} episode {done + row}"
        if found["obs"][row] != length + 1 or found.get("rews", lengths)[row] != length:
            raise UsageError(
                f"{place} has {length} actions, {found['obs'][row]} observations and "
                f"{found.get('rews', lengths)[row]} rewards",
                "an episode of T actions has T + 1 observations and T rewards",
            )
        if length == 0:
            expected.irregular.found_empty(place)
    return lengths


def _terminal(directory: Path, column: pa.Array, done: int) -> np.ndarray:
    """Whether each episode [R] ended."""
    if not pa.types.is_boolean(column.type):
        raise UsageError(
            f"{directory}: terminal is not true or false in each episode", "save it again"
        )
    return numbers(column, "terminal", lambda row: f"{directory} episode {done + row}")


def _steps(
    directory: Path, batch: pa.RecordBatch, lengths: np.ndarray, done: int, expected: Expected
) -> Steps:
    starts = np.cumsum(lengths) - lengths
    episode = np.repeat(np.arange(len(lengths)), lengths)
    t = np.arange(len(episode)) - starts[episode]

    def place(row: int) -> str:
        return f"{directory} episode {done + episode[row]}, step {t[row]}"

    # An episode has one observation more than steps.
    shown = np.repeat(np.arange(len(lengths)), lengths + 1)
    at = np.arange(len(shown)) - (starts + np.arange(len(lengths)))[shown]
    rows = np.arange(len(episode)) + episode

    def place_of_observation(row: int) -> str:
        return f"{directory} episode {done + shown[row]}, observation {at[row]}"

    observations = vectors(numbers(batch.column("obs").flatten(), "obs", place_of_observation))
    terminal = _terminal(directory, batch.column("terminal"), done)
    last = t == lengths[episode] - 1
    ended = last & terminal[episode]
    at_limit = lengths[episode] == expected.horizon
    rewards = None
    if "rews" in batch.schema.names:
        rewards = numbers(batch.column("rews").flatten(), "rews", place).astype(np.float64)
    actions = numbers(batch.column("acts").flatten(), "acts", place)
    return Steps(
        first=t == 0,
        settings=np.zeros(len(t), dtype=np.int64),
        observations=observations[rows],
        actions=expected.shaped(actions),
        rewards=rewards,
        next_observations=observations[rows + 1],
        terminated=ended & ~at_limit,
        truncated=ended & at_limit,
        seeds=np.full(len(t), -1),
        place=place,
    )

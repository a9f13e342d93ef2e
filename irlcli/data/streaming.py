"""Datasets of demonstrations written and read piece by piece, in bounded memory."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from irlcli.data.demonstrations import (
    EPISODES,
    STEPS,
    Episodes,
    action_type,
    array_column,
    check_numbers,
    column_array,
    episodes_schema,
    file_metadata,
    intervention_numbers,
    open_files,
    read_episodes,
    refuse_nulls,
    steps_schema,
)
from irlcli.data.descriptions import MOST_EPISODES
from irlcli.data.parquet import batches, write_table, writer
from irlcli.data.steps import PIECE, Steps, mixed_rewards, nowhere, pieces
from irlcli.errors import UsageError
from irlcli.interventions import Setting
from irlcli.trajectories import Trajectory


def write_stream(
    directory: Path,
    env: str,
    settings: Sequence[Setting],
    parts: Iterator[Steps],
    metadata: Mapping[str, Any],
    size: int = PIECE,
) -> pa.Table:
    """Write whole episodes as a dataset; a setting's index is its place in ``settings``.

    A row group holds ``size`` steps. Returns the rows of ``episodes.parquet``.

    Raises:
        OSError: the directory cannot be written.
        UsageError: no step, too many episodes, or a true reward that only some steps have.
    """
    return _write(directory, env, settings, pieces(parts, size), metadata)


def write_demonstrations(
    directory: Path,
    env: str,
    groups: Sequence[tuple[Setting, Sequence[Trajectory]]],
    metadata: Mapping[str, Any],
) -> None:
    """Write ``groups`` of trajectories as a dataset, with a row group for each episode.

    Raises:
        OSError: the directory cannot be written.
        UsageError: no trajectory.
    """
    settings = [setting for setting, _ in groups]
    episodes = [(index, t) for index, (_, group) in enumerate(groups) for t in group]
    _write(directory, env, settings, itertools.starmap(_steps, episodes), metadata)


def _steps(setting: int, trajectory: Trajectory) -> Steps:
    t = np.arange(len(trajectory))
    last = t == len(t) - 1
    return Steps(
        first=t == 0,
        settings=np.full(len(t), setting),
        observations=trajectory.observations[:-1],
        actions=trajectory.actions,
        rewards=trajectory.rewards,
        next_observations=trajectory.observations[1:],
        terminated=last & trajectory.terminated,
        truncated=last & trajectory.truncated,
        seeds=np.full(len(t), trajectory.seed),
        place=nowhere,
    )


def _write(
    directory: Path,
    env: str,
    settings: Sequence[Setting],
    parts: Iterator[Steps],
    metadata: Mapping[str, Any],
) -> pa.Table:
    """Write each of ``parts`` as a row group; the rows of ``episodes.parquet``."""
    first = next(parts, None)
    if first is None:
        raise UsageError("the recordings hold no episode", "name recordings with episodes")
    width, rewarded = first.observations.shape[1], first.rewards is not None
    schema = steps_schema(width, action_type(first.actions), rewarded)
    tags = file_metadata(env, metadata, schema)
    schema = schema.with_metadata(tags)
    table = _EpisodeTable(rewarded)
    # With dictionaries, recorded numbers take a third more bytes.
    with writer(directory / STEPS, schema, repeating=()) as file:
        for part in itertools.chain([first], parts):
            file.write_table(table.add(schema, part), row_group_size=max(1, len(part)))
    rows = table.rows(settings, episodes_schema(width, rewarded=rewarded).with_metadata(tags))
    write_table(rows, directory / EPISODES)
    return rows


class _EpisodeTable:
    """The episodes of a stream of steps, and the numbers of the one that is still open."""

    def __init__(self, rewarded: bool):
        self._rewarded = rewarded
        self._count = self._length = 0
        self._open_rewards: list[np.ndarray] = []
        self._returns: list[float] = []
        self._parts: list[tuple[np.ndarray, ...]] = []

    def add(self, schema: pa.Schema, steps: Steps) -> pa.Table:
        """The rows of ``steps.parquet`` for ``steps``, with ``schema``."""
        if (steps.rewards is not None) != self._rewarded:
            raise mixed_rewards()
        ends = np.flatnonzero(steps.ended)
        t = steps.times(self._length)
        episode = steps.episode_numbers(self._count)
        self._parts.append(
            (
                steps.settings[ends],
                steps.seeds[ends],
                t[ends] + 1,
                steps.terminated[ends],
                steps.next_observations[ends],
            )
        )
        self._count += len(ends)
        if self._count > MOST_EPISODES:
            raise UsageError(
                f"more than the {MOST_EPISODES:,} episodes of one dataset", "split the source"
            )
        open_ = not len(ends) or ends[-1] < len(steps) - 1
        self._length = int(t[-1]) + 1 if open_ else 0
        if steps.rewards is not None:
            self._add_returns(steps.rewards, ends)
        columns = (
            episode.astype(np.int32),
            t.astype(np.int32),
            steps.observations,
            steps.actions,
            *(() if steps.rewards is None else (steps.rewards,)),
        )
        return pa.Table.from_arrays([array_column(array) for array in columns], schema=schema)

    def _add_returns(self, rewards: np.ndarray, ends: np.ndarray) -> None:
        begin = 0
        for end in ends:
            self._open_rewards.append(rewards[begin : end + 1])
            # Summed in one go over the whole episode, as a reader sums it: to the last bit.
            self._returns.append(float(np.concatenate(self._open_rewards).sum()))
            self._open_rewards, begin = [], end + 1
        self._open_rewards.append(rewards[begin:])

    def rows(self, settings: Sequence[Setting], schema: pa.Schema) -> pa.Table:
        """The rows of ``episodes.parquet``."""
        places, seeds, lengths, terminated, final = (
            np.concatenate(column) for column in zip(*self._parts, strict=True)
        )
        texts = pa.array([str(setting) for setting in settings])
        numbers = pa.array(
            [intervention_numbers(setting) for setting in settings], pa.list_(pa.float64())
        )
        columns = [
            pa.array(np.arange(len(seeds), dtype=np.int32)),
            texts.take(pa.array(places)),
            numbers.take(pa.array(places)),
            pa.array(seeds),
            pa.array(lengths.astype(np.int32)),
            *([pa.array(self._returns, pa.float64())] if self._rewarded else []),
            pa.array(terminated),
            pa.array(~terminated),
            array_column(final),
        ]
        return pa.Table.from_arrays(columns, schema=schema)


def read_stream(directory: Path, size: int = PIECE) -> tuple[list[str], Iterator[Steps]]:
    """The settings of the dataset in ``directory``, in order of appearance, and its steps.

    At most ``size`` steps are read at a time.

    Raises:
        IntegrityError: missing, damaged, or written with a newer schema; also while the steps are
            read.
    """
    with open_files(directory) as (steps, episodes, _):
        found = read_episodes(episodes, steps.metadata.num_rows)
    settings = list(dict.fromkeys(found.settings))
    return settings, _stream(directory, found, settings, size)


def _stream(directory: Path, episodes: Episodes, settings: list[str], size: int) -> Iterator[Steps]:
    place = {text: index for index, text in enumerate(settings)}
    indices = np.array([place[text] for text in episodes.settings])
    seeds, terminated = np.array(episodes.seeds), np.array(episodes.terminated)
    truncated = np.array(episodes.truncated)
    stops = np.cumsum(episodes.lengths, dtype=np.int64)
    starts = stops - episodes.lengths
    done, kept = 0, None
    with open_files(directory) as (file, _, _):
        for batch in batches(file, size):
            table = pa.Table.from_batches([batch])
            refuse_nulls(table)
            arrays = {name: column_array(table[name]) for name in table.column_names}
            if kept is not None:
                arrays = {n: np.concatenate([kept[n], array]) for n, array in arrays.items()}
            rows = done + np.arange(len(arrays["t"]))
            episode = np.searchsorted(stops, rows, side="right")
            check_numbers(arrays, episode, rows - starts[episode])
            ends = rows == stops[episode] - 1
            # The successor of the last row may stand in the next batch.
            count = len(rows) if ends[-1] else len(rows) - 1
            kept = None if ends[-1] else {n: array[-1:] for n, array in arrays.items()}
            if count == 0:
                continue
            observations = arrays["obs"]
            successors = np.concatenate([observations[1:], observations[-1:]])[:count]
            ends, episode = ends[:count], episode[:count]
            successors[ends] = episodes.final[episode[ends]]
            yield Steps(
                first=arrays["t"][:count] == 0,
                settings=indices[episode],
                observations=observations[:count],
                actions=arrays["action"][:count],
                rewards=arrays["reward"][:count] if "reward" in arrays else None,
                next_observations=successors,
                terminated=ends & terminated[episode],
                truncated=ends & truncated[episode],
                seeds=seeds[episode],
                place=_place(directory, done),
            )
            done += count


def _place(directory: Path, first: int):
    return lambda row: f"{directory / STEPS} row {first + row}"

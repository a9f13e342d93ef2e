"""Demonstrations as Parquet: ``steps.parquet`` and ``episodes.parquet``.

``steps`` has a row per step, ``episodes`` a row per episode; docs/data.md describes them. Recorded
steps are written as one row group per episode, imported ones in larger pieces. The key-value
metadata holds the schema version, the environment and the experts' digests, but no times and no
paths: equal demonstrations are equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from irlcli.data.parquet import UNREADABLE, open_table
from irlcli.errors import IntegrityError, NewerFormat, first_line
from irlcli.interventions import MAX_SETTING_LENGTH, Setting
from irlcli.trajectories import Trajectory

# Version 2 may be without the columns reward and return (the true reward is unknown), and an action may
# be several indices. What version 1 can hold is written as version 1.
SCHEMA = 2
STEPS = "steps.parquet"
EPISODES = "episodes.parquet"
_METADATA_KEY = b"irlcli"


@dataclass(frozen=True)
class Demonstrations:
    """Trajectories by setting (as text), in the order of collection, and the file's metadata."""

    env: str
    trajectories: Mapping[str, tuple[Trajectory, ...]]
    metadata: Mapping[str, Any]

    def require(self, env: str, settings: Sequence[str]) -> None:
        """Refuse demonstrations of another environment, or without one of ``settings``.

        Raises:
            IntegrityError: naming what they are of, and what is needed.
        """
        if self.env != env or not set(settings) <= set(self.trajectories):
            raise IntegrityError(
                f"the demonstrations are of {self.env} {', '.join(self.trajectories)}, but "
                f"{env} {', '.join(settings)} is needed"
            )


def file_metadata(env: str, metadata: Mapping[str, Any], steps: pa.Schema) -> dict[bytes, bytes]:
    """The key-value metadata of both files, of which one has the columns ``steps``."""
    action = steps.field("action").type
    several = pa.types.is_fixed_size_list(action) and pa.types.is_integer(action.value_type)
    version = 1 if "reward" in steps.names and not several else 2
    tags = {"schema": version, "env": env, **metadata}
    return {_METADATA_KEY: json.dumps(tags, sort_keys=True).encode()}


def action_type(actions: np.ndarray) -> pa.DataType:
    """The type of the column of ``actions``: [B] or [B, K] int64, or [B, A] float32."""
    number = pa.from_numpy_dtype(actions.dtype)
    return number if actions.ndim == 1 else pa.list_(number, actions.shape[1])


def steps_schema(observation_size: int, action: pa.DataType, rewarded: bool) -> pa.Schema:
    """The columns of ``steps.parquet``."""
    return table_schema(
        episode=pa.int32(),
        t=pa.int32(),
        obs=pa.list_(pa.float32(), observation_size),
        action=action,
        **({"reward": pa.float64()} if rewarded else {}),
    )


def episodes_schema(
    observation_size: int, setting: pa.DataType | None = None, *, rewarded: bool
) -> pa.Schema:
    """The columns of ``episodes.parquet``."""
    return table_schema(
        episode=pa.int32(),
        setting=setting or pa.string(),
        intervention=pa.list_(pa.float64()),
        seed=pa.int64(),
        length=pa.int32(),
        **({"return": pa.float64()} if rewarded else {}),
        terminated=pa.bool_(),
        truncated=pa.bool_(),
        final_obs=pa.list_(pa.float32(), observation_size),
    )


def table_schema(**columns: pa.DataType) -> pa.Schema:
    """``columns`` by name, none of which holds nulls."""
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in columns.items()])


def intervention_numbers(setting: Setting) -> list[float]:
    """The numbers of a setting's values, as ``episodes.parquet`` lists them."""
    return [x for _, value in setting.changes for x in value.numbers]


def _read_metadata(directory: Path) -> dict[str, Any]:
    """The key-value metadata of the demonstrations in ``directory``; reads only the footer."""
    path = directory / EPISODES
    try:
        with open_table(path) as file:
            tags = json.loads((file.schema_arrow.metadata or {})[_METADATA_KEY])
        version, env = tags["schema"], tags["env"]
        if type(version) is not int or not isinstance(env, str):
            raise ValueError("malformed metadata")
    except FileNotFoundError:
        raise IntegrityError(
            f"{directory} holds no demonstrations: {EPISODES} is missing"
        ) from None
    except UNREADABLE as error:
        raise IntegrityError(
            f"{path} is not a demonstrations file ({first_line(error)})",
            "`irl collect-experts` writes demonstrations",
        ) from None
    if version > SCHEMA:
        raise NewerFormat(str(path), version, SCHEMA)
    return tags


def read_demonstrations(directory: Path) -> Demonstrations:
    """The demonstrations in ``directory``, every trajectory validated.

    Raises:
        IntegrityError: missing, damaged, inconsistent, or written with a newer schema.
    """
    with open_files(directory) as (steps, episodes, tags):
        trajectories = _parse(steps.read(), read_episodes(episodes, steps.metadata.num_rows))
    return Demonstrations(tags["env"], trajectories, tags)


@contextmanager
def open_files(
    directory: Path,
) -> Iterator[tuple[pq.ParquetFile, pq.ParquetFile, dict[str, Any]]]:
    """The two files of a dataset and their key-value metadata.

    Their columns are checked, but no row is read.

    Raises:
        IntegrityError: missing, damaged, or written with a newer schema; also for what is raised
            while they are read.
    """
    # First: a newer schema may have other columns.
    tags = _read_metadata(directory)
    try:
        with (
            open_table(directory / STEPS) as steps,
            open_table(directory / EPISODES, texts=["setting"]) as episodes,
        ):
            # Before any column is read: these columns cannot be nested or of unlimited width.
            _check_schemas(steps.schema_arrow, episodes.schema_arrow)
            yield steps, episodes, tags
    except FileNotFoundError as error:
        missing = Path(error.filename or STEPS).name
        raise IntegrityError(f"{directory} holds no demonstrations: {missing} is missing") from None
    except UNREADABLE as error:
        raise IntegrityError(
            f"the demonstrations in {directory} are damaged ({first_line(error)})"
        ) from None


def _check_schemas(steps: pa.Schema, episodes: pa.Schema) -> None:
    obs, action = steps.field("obs").type, steps.field("action").type
    if not pa.types.is_fixed_size_list(obs):
        raise ValueError("obs is not a fixed_size_list")
    if pa.types.is_fixed_size_list(action):
        number = action.value_type
        action = pa.list_(number, action.list_size)
    else:
        number = action
    if number not in (pa.int64(), pa.float32()) or action == pa.float32():
        raise ValueError("action is neither int64 nor a fixed_size_list of int64 or float")
    rewarded = "reward" in steps.names
    setting = pa.dictionary(pa.int32(), pa.string())
    for found, expected in (
        (steps, steps_schema(obs.list_size, action, rewarded)),
        (episodes, episodes_schema(obs.list_size, setting, rewarded=rewarded)),
    ):
        if not found.equals(expected, check_metadata=False):
            raise ValueError("its columns are not those of demonstrations")


class Episodes(NamedTuple):
    """The rows of ``episodes.parquet``, one of each list or array per episode.

    ``returns`` is None where the true reward is unknown.
    """

    settings: list[str]
    lengths: np.ndarray
    seeds: list[int]
    returns: list[float] | None
    terminated: list[bool]
    truncated: list[bool]
    final: np.ndarray


def read_episodes(file: pq.ParquetFile, steps: int) -> Episodes:
    """The episodes of a dataset of ``steps`` steps.

    Raises:
        ValueError: they do not fit together.
    """
    # The settings' texts already hold the intervention values.
    table = file.read([name for name in file.schema_arrow.names if name != "intervention"])
    refuse_nulls(table)
    settings = _texts(table["setting"])
    indices, lengths = table["episode"].to_numpy(), table["length"].to_numpy()
    if len(table) == 0:
        raise ValueError("it holds no episode")
    # The sum is checked first: the arrays made from the lengths have that size.
    if lengths.min() < 1 or lengths.sum(dtype=np.int64) != steps:
        raise ValueError("the episodes' lengths do not match the number of steps")
    if not np.array_equal(indices, np.arange(len(table))):
        raise ValueError("the episodes are not numbered")
    return Episodes(
        settings,
        lengths,
        table["seed"].to_pylist(),
        table["return"].to_pylist() if "return" in table.column_names else None,
        table["terminated"].to_pylist(),
        table["truncated"].to_pylist(),
        column_array(table["final_obs"]),
    )


def _parse(steps: pa.Table, episodes: Episodes) -> dict[str, tuple[Trajectory, ...]]:
    refuse_nulls(steps)
    stops = np.cumsum(episodes.lengths, dtype=np.int64)
    starts = stops - episodes.lengths
    numbers = np.arange(len(stops))
    check_numbers(
        {name: steps[name].to_numpy() for name in ("episode", "t")},
        np.repeat(numbers, episodes.lengths),
        np.arange(len(steps)) - np.repeat(starts, episodes.lengths),
    )
    observations, actions = column_array(steps["obs"]), column_array(steps["action"])
    rewards = np.full(len(steps), np.nan)
    if episodes.returns is not None:
        rewards = column_array(steps["reward"])
        if not np.isfinite(rewards).all():
            raise ValueError("rewards are not finite")
    groups: dict[str, list[Trajectory]] = {}
    for k, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        trajectory = Trajectory(
            observations=np.vstack([observations[start:stop], episodes.final[k]]),
            actions=np.array(actions[start:stop]),
            rewards=np.array(rewards[start:stop]),
            terminated=episodes.terminated[k],
            truncated=episodes.truncated[k],
            seed=episodes.seeds[k],
        )
        if episodes.returns is not None and trajectory.episode_return != episodes.returns[k]:
            raise ValueError(f"episode {k}: its rewards do not add up to its return")
        groups.setdefault(episodes.settings[k], []).append(trajectory)
    return {setting: tuple(group) for setting, group in groups.items()}


def refuse_nulls(table: pa.Table) -> None:
    """Check that ``table`` holds no nulls.

    Raises:
        ValueError: it does.
    """
    if any(column.null_count for column in table.columns):
        raise ValueError("a column holds nulls")


def check_numbers(steps: Mapping[str, np.ndarray], episode: np.ndarray, t: np.ndarray) -> None:
    """Check that rows of ``steps`` have the numbers ``episode`` and ``t`` [R].

    Raises:
        ValueError: they do not.
    """
    if not (np.array_equal(steps["episode"], episode) and np.array_equal(steps["t"], t)):
        raise ValueError("the steps are not numbered by episode and time")


def _texts(column: pa.ChunkedArray) -> list[str]:
    """The texts of a dictionary column, none of them long."""
    for chunk in column.chunks:
        longest = max(map(len, chunk.dictionary.to_pylist()), default=0)
        if longest > MAX_SETTING_LENGTH:
            raise ValueError(f"a setting has {longest:,} characters")
    return column.to_pylist()


def column_array(column: pa.ChunkedArray) -> np.ndarray:
    """A column of R numbers or of lists of N numbers as an array [R] or [R, N]."""
    if not pa.types.is_fixed_size_list(column.type):
        return column.to_numpy()
    return column.combine_chunks().flatten().to_numpy().reshape(-1, column.type.list_size)


def array_column(array: np.ndarray) -> pa.Array:
    """An array [R] or [R, N] as a column: the inverse of :func:`column_array`."""
    numbers = pa.array(np.ascontiguousarray(array).reshape(-1))
    return (
        numbers if array.ndim == 1 else pa.FixedSizeListArray.from_arrays(numbers, array.shape[1])
    )

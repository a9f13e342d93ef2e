"""Demonstrations as Parquet: ``steps.parquet`` and ``episodes.parquet`` (design: Demonstrations).

One row group per episode, zstd, page checksums. The key-value metadata holds the schema's
version, the environment and the experts' digests; no times and no paths, so equal
demonstrations are equal bytes.
"""

from __future__ import annotations

import json
import os
import resource
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from irlcli.errors import IntegrityError, NewerFormat
from irlcli.interventions import Setting
from irlcli.trajectories import Trajectory

SCHEMA = 1
STEPS = "steps.parquet"
EPISODES = "episodes.parquet"
_MAX_SETTING_LENGTH = 200
_MAX_TEXT_BYTES = 1 << 20
_METADATA_KEY = b"irlcli"
# A kilobyte of Parquet can stand for terabytes, so what a file declares is read first: refused is
# more than 2 GiB that is also more than 100 times the file, which no recorded numbers are.
_MAX_FILE_BYTES = 8 << 30
_MAX_DECODED_BYTES = 2 << 30
_MAX_RATIO = 100
# A step is decoded to arrays, an episode to Python's objects.
_BYTES_PER_VALUE = {STEPS: 8, EPISODES: 100}


@dataclass(frozen=True)
class Demonstrations:
    """Trajectories by setting (printed form), in the order collected, with their origin."""

    env: str
    trajectories: Mapping[str, tuple[Trajectory, ...]]
    metadata: Mapping[str, Any]


def write_table(table: pa.Table, path: Path, row_group_size: int | None = None) -> None:
    """Write one Parquet file in the project's form: zstd, page checksums, no nulls."""
    pq.write_table(
        table,
        path,
        compression="zstd",
        write_page_checksum=True,
        row_group_size=row_group_size or max(1, table.num_rows),
    )


def write_demonstrations(
    directory: Path,
    env: str,
    groups: Sequence[tuple[Setting, Sequence[Trajectory]]],
    metadata: Mapping[str, Any],
) -> None:
    """Write ``groups`` of trajectories into ``directory``.

    Raises:
        OSError: the directory cannot be written.
        ValueError: no trajectory, or trajectories of different shapes.
    """
    episodes = [(setting, t) for setting, group in groups for t in group]
    if not episodes:
        raise ValueError("there is no trajectory to write")
    first = episodes[0][1]
    tags = {"schema": SCHEMA, "env": env, **metadata}
    schema = _steps_schema(
        first.observations.shape[1], None if first.actions.ndim == 1 else first.actions.shape[1]
    ).with_metadata({_METADATA_KEY: json.dumps(tags, sort_keys=True).encode()})
    with pq.ParquetWriter(
        directory / STEPS, schema, compression="zstd", write_page_checksum=True
    ) as writer:
        for index, (_, trajectory) in enumerate(episodes):
            writer.write_table(_steps_table(schema, index, trajectory), row_group_size=2**30)
    rows = [_episode_row(i, setting, t) for i, (setting, t) in enumerate(episodes)]
    table = pa.Table.from_pylist(rows, schema=_episodes_schema(first.observations.shape[1]))
    write_table(table.replace_schema_metadata(schema.metadata), directory / EPISODES)


def _steps_schema(observation_size: int, action_size: int | None) -> pa.Schema:
    action = pa.int64() if action_size is None else pa.list_(pa.float32(), action_size)
    return pa.schema(
        [
            pa.field("episode", pa.int32(), nullable=False),
            pa.field("t", pa.int32(), nullable=False),
            pa.field("obs", pa.list_(pa.float32(), observation_size), nullable=False),
            pa.field("action", action, nullable=False),
            pa.field("reward", pa.float64(), nullable=False),
        ]
    )


def _episodes_schema(observation_size: int) -> pa.Schema:
    return pa.schema(
        [
            pa.field("episode", pa.int32(), nullable=False),
            pa.field("setting", pa.string(), nullable=False),
            pa.field("intervention", pa.list_(pa.float64()), nullable=False),
            pa.field("seed", pa.int64(), nullable=False),
            pa.field("length", pa.int32(), nullable=False),
            pa.field("return", pa.float64(), nullable=False),
            pa.field("terminated", pa.bool_(), nullable=False),
            pa.field("truncated", pa.bool_(), nullable=False),
            pa.field("final_obs", pa.list_(pa.float32(), observation_size), nullable=False),
        ]
    )


def _steps_table(schema: pa.Schema, index: int, trajectory: Trajectory) -> pa.Table:
    steps, size = len(trajectory), trajectory.observations.shape[1]
    action_type = schema.field("action").type
    actions = pa.array(trajectory.actions.ravel())
    if not pa.types.is_integer(action_type):
        actions = pa.FixedSizeListArray.from_arrays(actions, action_type.list_size)
    columns = [
        pa.array(np.full(steps, index, dtype=np.int32)),
        pa.array(np.arange(steps, dtype=np.int32)),
        pa.FixedSizeListArray.from_arrays(pa.array(trajectory.observations[:-1].ravel()), size),
        actions,
        pa.array(trajectory.rewards),
    ]
    return pa.Table.from_arrays(columns, schema=schema)


def _episode_row(index: int, setting: Setting, trajectory: Trajectory) -> dict[str, Any]:
    return {
        "episode": index,
        "setting": str(setting),
        "intervention": [] if setting.value is None else list(setting.value.numbers),
        "seed": trajectory.seed,
        "length": len(trajectory),
        "return": trajectory.episode_return,
        "terminated": trajectory.terminated,
        "truncated": trajectory.truncated,
        "final_obs": trajectory.observations[-1],
    }


def read_metadata(directory: Path) -> dict[str, Any]:
    """The key-value metadata of the demonstrations in ``directory``; reads only the footer.

    Raises:
        IntegrityError: no demonstrations, damaged ones, or of a newer schema.
    """
    path = directory / EPISODES
    try:
        with _opened(path) as file:
            tags = json.loads((file.schema_arrow.metadata or {})[_METADATA_KEY])
        version, env = tags["schema"], tags["env"]
        if type(version) is not int or not isinstance(env, str):
            raise ValueError("its metadata is malformed")
    except FileNotFoundError:
        raise IntegrityError(
            f"{directory} holds no demonstrations: {EPISODES} is missing"
        ) from None
    except (pa.ArrowException, KeyError, TypeError, ValueError, OSError, RecursionError) as error:
        raise IntegrityError(
            f"{path} is not a demonstrations file ({_first_line(error)})",
            "demonstrations come from `irl collect-experts`",
        ) from None
    if version > SCHEMA:
        raise NewerFormat(str(path), version, SCHEMA)
    return tags


def read_demonstrations(directory: Path) -> Demonstrations:
    """The demonstrations in ``directory``, every trajectory validated.

    Raises:
        IntegrityError: missing, truncated, of another form, or inconsistent.
    """
    tags = read_metadata(directory)
    try:
        with _opened(directory / STEPS) as steps, _opened(directory / EPISODES) as episodes:
            # Before anything is decoded: the columns of a dataset cannot be nested or long.
            _check_schemas(steps.schema_arrow, episodes.schema_arrow)
            trajectories = _parse(steps.read(), episodes.read())
    except FileNotFoundError as error:
        raise IntegrityError(f"{error.filename or STEPS} is missing in {directory}") from None
    except (pa.ArrowException, KeyError, TypeError, ValueError, OSError, RecursionError) as error:
        raise IntegrityError(
            f"the demonstrations in {directory} are damaged ({_first_line(error)})"
        ) from None
    return Demonstrations(tags["env"], trajectories, tags)


def _opened(path: Path) -> pq.ParquetFile:
    """The Parquet file ``path``, its footer read, nothing of it too large.

    Raises:
        ValueError: no plain file, or too large.
        OSError, ArrowException: not a readable Parquet file.
    """
    information = path.stat()
    if not stat.S_ISREG(information.st_mode):
        # Opening a named pipe would wait for a writer that never comes.
        raise ValueError("it is not a plain file")
    if information.st_size > _MAX_FILE_BYTES:
        raise ValueError(f"it is larger than {_MAX_FILE_BYTES >> 30} GiB")
    _check_footer(path)
    # As a dictionary a long text counts once, however many rows say it.
    texts = ["setting"] if path.name == EPISODES else []
    file = pq.ParquetFile(path, read_dictionary=texts, page_checksum_verification=True)
    declared = _declared_bytes(file.metadata, _BYTES_PER_VALUE[path.name])
    if declared > max(_MAX_DECODED_BYTES, _MAX_RATIO * information.st_size):
        file.close()
        raise ValueError(f"{information.st_size:,} bytes that declare {declared:,}")
    return file


def _check_footer(path: Path) -> None:
    """Describe every column in a child process: of some footers that aborts pyarrow's process.

    ``RowGroupMetaData.column`` lets an exception of C++ through where the statistics of sizes do
    not fit the schema (pyarrow 26).

    Raises:
        ValueError: the child did not survive.
    """
    child = os.fork()
    if child == 0:
        try:
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            for _ in _chunks(pq.read_metadata(path)):
                pass
        finally:
            # What it raises, reading it here raises too.
            os._exit(0)
    if os.WIFSIGNALED(os.waitpid(child, 0)[1]):
        raise ValueError("its footer is malformed")


def _declared_bytes(metadata: pq.FileMetaData, bytes_per_value: int) -> int:
    """What decoding takes if the footer is honest: unpacked pages, and so much for every value."""
    total = bytes_per_value * metadata.num_rows * metadata.num_columns
    texts = sum(
        column.total_uncompressed_size - _MAX_SETTING_LENGTH * column.num_values
        for column in _chunks(metadata)
        if column.physical_type == "BYTE_ARRAY"
    )
    if texts > _MAX_TEXT_BYTES:
        raise ValueError(f"its texts take {texts:,} bytes")
    for column in _chunks(metadata):
        total += column.total_uncompressed_size + bytes_per_value * column.num_values
    return total


def _chunks(metadata: pq.FileMetaData) -> Iterator[pq.ColumnChunkMetaData]:
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        yield from map(group.column, range(group.num_columns))


def _check_schemas(steps: pa.Schema, episodes: pa.Schema) -> None:
    obs_type, action_type = steps.field("obs").type, steps.field("action").type
    if not pa.types.is_fixed_size_list(obs_type):
        raise ValueError("obs is no fixed_size_list")
    discrete = pa.types.is_integer(action_type)
    if not discrete and not pa.types.is_fixed_size_list(action_type):
        raise ValueError("action is neither int64 nor a fixed_size_list")
    size = obs_type.list_size
    index = episodes.get_field_index("setting")
    if index >= 0 and pa.types.is_dictionary(episodes.field(index).type):
        text = episodes.field(index).type.value_type
        episodes = episodes.set(index, episodes.field(index).with_type(text))
    expected = _steps_schema(size, None if discrete else action_type.list_size)
    for found, schema in ((steps, expected), (episodes, _episodes_schema(size))):
        if not found.equals(schema, check_metadata=False):
            raise ValueError("columns or their types are not those of a dataset")


def _parse(steps: pa.Table, episodes: pa.Table) -> dict[str, tuple[Trajectory, ...]]:
    for table in (steps, episodes):
        if any(column.null_count for column in table.columns):
            raise ValueError("a column holds nulls")
    longest = max(
        (len(text) for chunk in episodes["setting"].chunks for text in chunk.dictionary.tolist()),
        default=0,
    )
    if longest > _MAX_SETTING_LENGTH:
        raise ValueError(f"a setting of {longest:,} characters")
    rows = episodes.to_pylist()
    if not rows:
        raise ValueError("there is no episode in it")
    lengths = [row["length"] for row in rows]
    # First their sum: what is made of them is as large.
    if (
        min(lengths) < 1
        or sum(lengths) != len(steps)
        or not np.array_equal(steps["episode"].to_numpy(), np.repeat(np.arange(len(rows)), lengths))
    ):
        raise ValueError("steps and episodes do not fit each other")
    observations = _matrix(steps["obs"])
    discrete = pa.types.is_integer(steps["action"].type)
    actions = steps["action"].to_numpy() if discrete else _matrix(steps["action"])
    rewards = steps["reward"].to_numpy()
    groups: dict[str, list[Trajectory]] = {}
    start = 0
    for row in rows:
        stop = start + row["length"]
        final = np.asarray(row["final_obs"], dtype=np.float32)
        trajectory = Trajectory(
            observations=np.vstack([observations[start:stop], final]),
            actions=np.array(actions[start:stop]),
            rewards=np.array(rewards[start:stop]),
            terminated=row["terminated"],
            truncated=row["truncated"],
            seed=row["seed"],
        )
        if trajectory.episode_return != row["return"]:
            raise ValueError(f"episode {row['episode']} does not add up to its return")
        groups.setdefault(row["setting"], []).append(trajectory)
        start = stop
    return {setting: tuple(group) for setting, group in groups.items()}


def _matrix(column: pa.ChunkedArray) -> np.ndarray:
    flat = column.combine_chunks()
    if isinstance(flat, pa.ChunkedArray):
        flat = flat.chunk(0)
    return flat.flatten().to_numpy().reshape(len(column), -1)


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]

"""Datasets of Minari, read and written through Minari's own storage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from irlcli.data.demonstrations import intervention_numbers
from irlcli.data.exchange.expected import (
    SETTING,
    Expected,
    unreadable,
    vectors,
)
from irlcli.data.steps import PIECE, Steps, episodes
from irlcli.envs.registry import environment
from irlcli.envs.spec import EnvironmentSpec
from irlcli.errors import IntegrityError, IrlError, StageFailed, UsageError
from irlcli.interventions import Setting
from irlcli.store import read_json

_ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")


class _Episode(NamedTuple):
    """An episode as it is stored: observations [T + 1, ...], and T of everything else."""

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray
    metadata: Mapping[str, Any]

    @property
    def form(self) -> tuple[Any, ...]:
        """What episodes have in common that are put together."""
        return tuple((array.shape[1:], array.dtype) for array in self[:2])


def read_minari(directory: Path, expected: Expected, size: int = PIECE) -> Iterator[Steps]:
    """The steps of the dataset whose data are in ``directory``, about ``size`` at a time.

    Raises:
        StageFailed: Minari is not installed.
        IntegrityError: not a dataset of Minari, or damaged.
        UsageError: spaces other than vectors and indices, or an episode that cannot be used.
    """
    storage = _open(directory)
    try:
        if storage.FORMAT == "hdf5":
            data, count = directory / "main_data.hdf5", storage.total_episodes
            found = _from_hdf5(data, count, expected.column)
        else:
            found = _from_storage(storage)
        yield from _pieces(directory, found, expected, size)
    except (MemoryError, IrlError):
        raise
    # A crafted file makes h5py and numpy raise almost anything.
    except Exception as error:
        raise IntegrityError(unreadable(directory, error), "download the dataset again") from None


def _pieces(
    directory: Path, found: Iterator[_Episode], expected: Expected, size: int
) -> Iterator[Steps]:
    waiting: dict[int, _Episode] = {}
    count = 0
    for number, episode in enumerate(found):
        place = f"{directory} episode {number}"
        lengths = [len(array) for array in episode[:-1]]
        if lengths[1] == 0:
            expected.irregular.found_empty(place)
            continue
        for name, array in zip(_ARRAYS[2:], episode[2:5], strict=True):
            if array.ndim != 1:
                raise UsageError(
                    f"{place}: {name} are of shape {array.shape}, not ({len(array)},)",
                    "every step has one number in each",
                )
        if lengths[0] != lengths[1] + 1 or len(set(lengths[1:])) > 1:
            raise UsageError(
                f"{place} has {lengths[0]} observations, {lengths[1]} actions and {lengths[2]} "
                "rewards",
                "an episode of T actions has T + 1 observations and T rewards",
            )
        alike = not waiting or next(iter(waiting.values())).form == episode.form
        if count >= size or not alike:
            yield _steps(directory, waiting, expected)
            waiting, count = {}, 0
        waiting[number] = episode
        count += lengths[1]
    if waiting:
        yield _steps(directory, waiting, expected)


def _steps(directory: Path, episodes: Mapping[int, _Episode], expected: Expected) -> Steps:
    """The steps of ``episodes``, which are known by their numbers."""
    numbers, found = list(episodes), list(episodes.values())
    lengths = np.array([len(episode.rewards) for episode in found])
    starts = np.cumsum(lengths) - lengths

    def place(row: int) -> str:
        k = int(np.searchsorted(starts, row, side="right")) - 1
        return f"{directory} episode {numbers[k]}, step {row - starts[k]}"

    settings, seeds = [], []
    for number, episode in episodes.items():
        settings.append(_setting(episode.metadata, expected, f"{directory} episode {number}"))
        seeds.append(_seed(episode.metadata.get("seed")))
    first = np.zeros(int(lengths.sum()), dtype=bool)
    first[starts] = True
    return Steps(
        first=first,
        settings=np.repeat(settings, lengths),
        observations=vectors(np.concatenate([e.observations[:-1] for e in found])),
        actions=expected.shaped(np.concatenate([e.actions for e in found])),
        rewards=np.concatenate([e.rewards for e in found]).astype(np.float64, copy=False),
        next_observations=vectors(np.concatenate([e.observations[1:] for e in found])),
        terminated=np.concatenate([e.terminations for e in found]).astype(bool),
        truncated=np.concatenate([e.truncations for e in found]).astype(bool),
        seeds=np.repeat(np.array(seeds, np.int64), lengths),
        place=place,
    )


def _seed(found: Any) -> int:
    """An episode's seed; -1 if it is no whole number that int64 holds. Minari draws 64 bits."""
    whole = isinstance(found, int | np.integer) and 0 <= found <= np.iinfo(np.int64).max
    return int(found) if whole else -1


def _setting(metadata: Mapping[str, Any], expected: Expected, place: str) -> int:
    """The index of an episode's setting."""
    if expected.column is None:
        expected.contradicts(_text(metadata.get(SETTING, "")), place)
        return 0
    if expected.column not in metadata:
        raise UsageError(
            f"{place} has no {expected.column!r}; it has: {', '.join(sorted(metadata))[:400]}",
            "--setting-column names the key of the episode's metadata",
        )
    return expected.index(_text(metadata[expected.column]), place)


def _text(name: Any) -> str:
    return name.decode() if isinstance(name, bytes) else str(name)


def _from_hdf5(path: Path, episodes: int, column: str | None) -> Iterator[_Episode]:
    """Episodes through h5py's low-level interface, without what is not needed of them.

    Minari reads every attribute and what ``info`` held. h5py's own objects cost more than the
    numbers in an episode of some hundred steps.
    """
    import h5py

    wanted = ["seed", column or SETTING]
    with h5py.File(path, "r") as file:
        for number in range(episodes):
            group = _group(file, f"episode_{number}")
            arrays: dict[str, Any] = {}
            for name in _ARRAYS:
                stored = h5py.h5d.open(group, name.encode())
                layout = stored.get_create_plist()
                if layout.get_external_count() or layout.get_layout() == h5py.h5d.VIRTUAL:
                    raise ValueError(f"{name} of episode {number} is stored in another file")
                shape, kind = stored.shape, stored.dtype
                if kind.kind not in "biuf" or not shape:
                    raise ValueError(f"{name} of episode {number} are not rows of numbers")
                array = np.empty(shape, kind)
                stored.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
                arrays[name] = array
            attributes = h5py.Group(group).attrs
            found = {name: attributes[name] for name in wanted if name in attributes}
            # For the message, all of them.
            metadata = found if column in (*found, None) else dict(attributes)
            yield _Episode(**arrays, metadata=metadata)


def _group(file: Any, name: str) -> Any:
    """The group ``name`` of ``file``, which has all its numbers in ``file`` itself.

    The key covers this file alone, so links to other files are refused.
    """
    import h5py

    def check(parent: Any, link: str) -> None:
        if parent.links.get_info(link.encode()).type != h5py.h5l.TYPE_HARD:
            raise ValueError(f"{link} is a link")

    root = h5py.h5g.open(file.id, b"/")
    check(root, name)
    group = h5py.h5g.open(root, name.encode())
    for array in _ARRAYS:
        check(group, array)
    return group


def _from_storage(storage: Any) -> Iterator[_Episode]:
    indices = range(storage.total_episodes)
    about = storage.get_episode_metadata(indices)
    for episode, metadata in zip(storage.get_episodes(indices), about, strict=True):
        arrays = {name: np.asarray(episode[name]) for name in _ARRAYS}
        yield _Episode(**arrays, metadata=metadata)


def write_minari(
    directory: Path,
    dataset: str,
    env: str,
    settings: Sequence[Setting],
    parts: Iterator[Steps],
    spaces: tuple[gymnasium.Space, gymnasium.Space],
) -> None:
    """Write ``parts`` as the dataset of Minari called ``dataset``, whose data go to ``directory``.

    The metadata of each episode hold its ``setting`` and the numbers of its ``intervention``;
    :func:`read_minari` gives the same steps back. ``spaces`` are those of observations and actions.

    Raises:
        StageFailed: Minari is not installed.
        UsageError: the true reward is unknown: Minari has no place for that.
        OSError: the directory cannot be written.
    """
    storage_class = _storage_class()
    from minari import __version__
    from minari.data_collector.episode_buffer import EpisodeBuffer

    found: list[int] = []

    def buffers() -> Iterator[EpisodeBuffer]:
        for steps in episodes(parts):
            if steps.rewards is None:
                raise UsageError(
                    "the true reward of these demonstrations is unknown, but every step of a "
                    "Minari dataset has one",
                    "export them with --to parquet:FILE",
                )
            found.append(int(steps.settings[0]))
            seed = int(steps.seeds[0])
            last = steps.next_observations[-1:]
            yield EpisodeBuffer(
                id=len(found) - 1,
                seed=None if seed < 0 else seed,
                observations=np.concatenate([steps.observations, last]),
                actions=steps.actions,
                rewards=steps.rewards,
                terminations=steps.terminated,
                truncations=steps.truncated,
                # Without it Minari cannot print the episode.
                infos={},
            )

    storage = storage_class.new(
        directory, *spaces, env_spec=_registered(environment(env)), data_format="hdf5"
    )
    storage.update_episodes(buffers())
    texts, numbers = [str(s) for s in settings], [intervention_numbers(s) for s in settings]
    storage.update_episode_metadata(
        {"setting": texts[index], "intervention": numbers[index]} for index in found
    )
    storage.update_metadata(
        {
            "dataset_id": dataset,
            "minari_version": __version__,
            "description": f"Demonstrations of {env} in {', '.join(texts)}.",
        }
    )


def _registered(spec: EnvironmentSpec) -> gymnasium.envs.registration.EnvSpec | None:
    """Gymnasium's description of the environment; None where that makes another one.

    A grid's size and horizon are in its demonstrations, and one's own environment may have
    arguments and a time limit of its own.
    """
    found = gymnasium.registry.get(spec.gym_id)
    if spec.tabular or found is None or (spec.own is not None and spec.own.arguments):
        return None
    return found if found.max_episode_steps == spec.max_episode_steps else None


def declare_namespace(dataset: str) -> None:
    """Tell Minari of the namespace of ``dataset``, so that `minari list local` shows it."""
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = dataset.rpartition("/")[0]
    if namespace and namespace not in list_local_namespaces():
        create_namespace(namespace)


def _storage_class() -> Any:
    try:
        import h5py  # noqa: F401
        from minari.dataset.minari_storage import MinariStorage
    except ImportError as error:
        raise StageFailed(
            f"{error.name or 'Minari'} is not installed",
            "in irlcli's checkout: pip install '.[minari]'",
        ) from None
    return MinariStorage


def _open(directory: Path) -> Any:
    from gymnasium import spaces

    storage_class = _storage_class()
    from minari.dataset.minari_storage import is_image_space

    try:
        metadata = read_json(directory / "metadata.json")
        # Without them Minari would make the environment that the metadata name: it runs code.
        if not {"observation_space", "action_space"} <= set(metadata):
            raise ValueError("its metadata describe no spaces")
        storage = storage_class.read(directory)
    except Exception as error:
        raise IntegrityError(
            unreadable(directory, error), "name a dataset that Minari can load"
        ) from None
    allowed = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    for name in ("observation_space", "action_space"):
        space = getattr(storage, name)
        if not isinstance(space, allowed):
            raise UsageError(
                f"{directory}: its {name.replace('_', ' ')} is a {type(space).__name__}",
                "only vectors and indices can be imported; flatten them first",
            )
    if is_image_space(storage.observation_space):
        raise UsageError(
            f"{directory}: its observations are images", "only vectors can be imported"
        )
    return storage

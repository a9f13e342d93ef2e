"""Demonstrations that were recorded elsewhere, as the dataset that collect-experts writes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from irlcli.envs.registry import environment
from irlcli.errors import UsageError
from irlcli.interventions import Setting, parse_setting
from irlcli.stages.base import EnvironmentKey, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import means_of

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa

    from irlcli.data.exchange.expected import Expected
    from irlcli.data.steps import Irregular, Steps
    from irlcli.trajectories import ActionSpace

Form = Literal["parquet", "minari", "imitation"]
# Actions that are so many times as far from the middle as their bounds were not sampled by a policy.
_FAR = 10


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a dataset depends on, besides the content of its sources.

    ``setting_column`` is None where a source is of one setting; then there is one source for each
    setting. ``cut`` tells what is done with episodes that are not whole.
    """

    environment: EnvironmentKey
    settings: tuple[str, ...]
    form: Form
    setting_column: str | None
    cut: bool


def request(
    form: Form,
    sources: Sequence[Source],
    env: str,
    settings: Sequence[Setting],
    setting_column: str | None = None,
    cut: bool = False,
) -> Request:
    """The demonstrations in ``sources``, all of the same ``form``, made in ``settings`` of ``env``.

    One source of several settings names them in ``setting_column``, by default ``setting``. Several
    sources are of one setting each, in the order of ``settings``.

    Outputs ``steps.parquet``, ``episodes.parquet`` and ``summary.json``.

    Raises:
        UsageError: a tabular environment, or sources that do not fit the settings.
    """
    if environment(env).tabular:
        raise UsageError(
            f"demonstrations of {env} cannot be imported: rewards are learned from them exactly, in "
            "the grid that they were recorded in",
            f"`irl collect-experts --env {env}` records them",
        )
    if len(sources) not in (1, len(settings)):
        raise UsageError(
            f"the number of sources is {len(sources)}, that of settings {len(settings)}",
            "give one source that names the setting of each episode, or one source per setting",
        )
    if len({source.sha256 for source in sources}) < len(sources):
        raise UsageError(
            "two of the sources are the same, but each is of another setting",
            "give each setting its own recordings",
        )
    if len(sources) > 1 and setting_column is not None:
        raise UsageError(
            f"--setting-column {setting_column}, but each of {len(sources)} sources is of one setting",
            "omit --setting-column, or give one source that names the setting of each episode",
        )
    if len(sources) < len(settings):
        setting_column = setting_column or "setting"
    if setting_column is not None and form == "imitation":
        raise UsageError(
            "imitation's trajectories name no setting",
            "give one directory per setting, and no column",
        )
    parameters = Parameters(
        environment=environment_key(env, settings),
        settings=tuple(str(s) for s in settings),
        form=form,
        setting_column=setting_column,
        cut=cut,
    )
    inputs = {"source": sources[0]}
    if len(sources) > 1:
        inputs = {f"source {s}": source for s, source in zip(settings, sources, strict=True)}
    label = f"import {form} {env} {', '.join(parameters.settings)}"
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """Read, check and write the steps in pieces; memory does not grow with their number."""
    from irlcli.data.exchange.expected import Expected
    from irlcli.data.outputs import write_json
    from irlcli.data.steps import Check, Irregular
    from irlcli.data.streaming import write_stream

    p: Parameters = job.parameters
    env, horizon = p.environment.name, p.environment.max_episode_steps
    settings = [parse_setting(env, text) for text in p.settings]
    bounds, actions, start = _spaces(env, settings)
    irregular = Irregular(p.cut)
    expected = Expected(env, p.settings, p.setting_column, horizon, actions, irregular)
    check = Check(horizon, bounds.shape[1], actions, f"{env} {p.settings[0]}", irregular, start)
    parts = _bounded(job, check(_read(job.inputs, p, expected)), bounds, actions)
    episodes = write_stream(job.output, env, settings, parts, {"imported": p.form})
    present = set(episodes["setting"].to_pylist())
    for text in p.settings:
        if text not in present:
            raise UsageError(f"no episode is of {text}", "omit settings without demonstrations")
    _report(job, irregular, episodes)
    summary = {"env": env, "settings": [_means(text, episodes) for text in p.settings]}
    write_json(job.output / "summary.json", summary)


def _bounded(
    job: Job, parts: Iterator[Steps], bounds: np.ndarray, actions: ActionSpace
) -> Iterator[Steps]:
    """``parts``, and in the end a warning of observations outside ``bounds`` [2, D] and of far actions.

    An action beyond its bounds is no mistake: policies sample such actions, and environments clip them.
    """
    import numpy as np

    outside = far = total = 0
    for part in parts:
        # The last observation of an episode is in no other step.
        for seen in (part.observations, part.next_observations[part.ended]):
            outside += int(((seen < bounds[0]) | (seen > bounds[1])).any(-1).sum())
        total += len(part)
        if not actions.discrete:
            middle, reach = (actions.high + actions.low) / 2, (actions.high - actions.low) / 2
            far += int((np.abs(part.actions - middle) > _FAR * reach).any(-1).sum())
        yield part
    if far:
        job.console.warn(
            f"actions more than {_FAR} times as far out as their bounds: {far:,} of {total:,} steps; check "
            "their units"
        )
    if outside:
        job.console.warn(
            f"observations outside the environment's bounds: {outside:,} in {total:,} steps; check their "
            "units, and that they are not normalised"
        )


def _spaces(env: str, settings: Sequence[Setting]) -> tuple[np.ndarray, ActionSpace, Any]:
    """Bounds [2, D] of observations over all settings, the actions, and the first index of one."""
    from contextlib import closing

    import numpy as np
    from gymnasium.spaces import Box

    from irlcli.envs.adapted import first_index
    from irlcli.envs.registration import make
    from irlcli.envs.spaces import check_spaces
    from irlcli.rl.worlds import action_space

    check_spaces(env, settings)
    found = []
    for setting in settings:
        with closing(make(env, setting)) as world:
            observations = world.observation_space
            assert isinstance(observations, Box)
            found.append((observations, world.action_space))
            start = first_index(world)
    sizes = sorted({len(space.low) for space, _ in found})
    if len(sizes) > 1:
        raise UsageError(
            f"observations of {env} have {sizes[0]} numbers in some settings and {sizes[-1]} in "
            "others",
            "import settings with a goal apart from the others",
        )
    low = np.min([space.low for space, _ in found], axis=0)
    high = np.max([space.high for space, _ in found], axis=0)
    return np.stack([low, high]), action_space(found[0][1]), start


def _read(inputs: Mapping[str, Path], p: Parameters, expected: Expected) -> Iterator[Steps]:
    from dataclasses import replace

    from irlcli.data.exchange import imitation, minari, transitions

    readers: dict[Form, Callable[[Path, Expected], Iterator[Steps]]] = {
        "parquet": transitions.read_transitions,
        "minari": minari.read_minari,
        "imitation": imitation.read_imitation,
    }
    read = readers[p.form]
    if "source" in inputs:
        yield from read(inputs["source"], expected)
        return
    for index, text in enumerate(p.settings):
        others = tuple(other for other in p.settings if other != text)
        one = replace(expected, settings=(text,), others=others)
        for steps in read(inputs[f"source {text}"], one):
            yield replace(steps, settings=steps.settings + index)


def _report(job: Job, irregular: Irregular, episodes: pa.Table) -> None:
    if "return" not in episodes.column_names:
        job.console.warn("the demonstrations hold no true reward: their returns are unknown")
    for count, what in (
        (irregular.long, "longer than the time limit, cut there"),
        (irregular.unended, "without an end, counted as truncated"),
        (irregular.empty, "without steps, left out"),
    ):
        if count:
            job.console.warn(f"{count} {'episode' if count == 1 else 'episodes'} {what}")
    if irregular.terminated and not environment(job.parameters.environment.name).terminates:
        job.console.warn(
            f"{irregular.terminated} of {len(episodes)} episodes are terminated, but no episode of this "
            "environment terminates: the absorbing states after their end would tell the expert from "
            "the policy. Write truncated instead"
        )
    elif irregular.terminated_at_limit:
        job.console.warn(
            f"{irregular.terminated_at_limit} of {len(episodes)} episodes are terminated in the last "
            "step that the time limit allows: if the time limit ended them, write truncated instead"
        )


def _means(text: str, episodes: pa.Table) -> dict[str, Any]:
    """The means of the episodes in one setting, as ``summary.json`` has them."""
    import pyarrow.compute as pc

    mine = episodes.filter(pc.equal(episodes["setting"], text))
    returns = mine["return"].to_numpy() if "return" in mine.column_names else None
    return means_of(text, returns, mine["length"].to_numpy())


STAGE = Stage("import", 1, run, reads=())

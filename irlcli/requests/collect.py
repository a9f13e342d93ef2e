"""``collect-experts`` and ``import``: demonstrations."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

from irlcli.configs import Config
from irlcli.configs.load import field_of
from irlcli.data.descriptions import DemonstrationSummary
from irlcli.envs.registry import resolve
from irlcli.envs.spaces import check_spaces
from irlcli.errors import IntegrityError, UsageError
from irlcli.experiments.recordings import recorded
from irlcli.experiments.references import output
from irlcli.interventions import Setting, listed_settings, parse_setting, without_cue
from irlcli.requests import arguments
from irlcli.requests.session import StageSession, check_path
from irlcli.stages import collect_experts as collect_stage
from irlcli.stages import import_demonstrations as import_stage
from irlcli.stages.base import Request
from irlcli.store import Artefact


def collect_experts(
    session: StageSession,
    *,
    env: str,
    intervention: str | None,
    setting: Sequence[str],
    expert: Sequence[str],
    trust: bool,
    episodes: str | None,
    seed: int,
) -> Request:
    """Demonstrations of the expert of each setting.

    Raises:
        UsageError: no setting is named, or one is malformed or named twice; ``trust`` without
            ``expert``; settings whose actions or observations differ.
        NotFound: no such environment or expert.
        IntegrityError: an expert's .zip that is no archive.
    """
    env = resolve(env).name
    if intervention is None and not setting:
        raise UsageError(
            "neither --intervention nor --setting names a setting",
            "give --intervention KNOB=VALUE,VALUE or --setting KNOB=VALUE,KNOB=VALUE",
        )
    if trust and not expert:
        raise UsageError("--trust needs --expert, whose files it is about", "omit --trust")
    config = session.config(env)
    where = arguments.where(None, intervention, setting)
    settings = where.settings(env, config)
    counts: Sequence[int] = ()
    if episodes is not None:
        counts = arguments.counts(episodes)
        if len(counts) > 1:
            where.check_ordered("several --episodes")
        if any(field_of(item) == "demonstrations.episodes" for item in session.overrides):
            raise UsageError(
                "--episodes and --set demonstrations.episodes are both given", "omit one of them"
            )
    else:
        counts = _listed_counts(env, config, settings)
    experts, normalisers = arguments.experts(session.store, env, expert)
    for own in settings if not experts else ():
        arguments.warn_of_several(session.console, config, "expert", [without_cue(env, own)])
    request = collect_stage.request(
        env, settings, config, seed, counts, experts, trust, normalisers
    )
    # Experts may be trained for hours before the stage compares spaces and loads these files.
    check_spaces(env, settings)
    for source in experts.values():
        if source.path.suffix == ".zip" and not zipfile.is_zipfile(source.path):
            raise IntegrityError(
                f"{source.path} was not saved by stable-baselines3: it is no zip file",
                "name a file that model.save() wrote",
            )
    return request


def _listed_counts(env: str, config: Config, settings: Sequence[Setting]) -> Sequence[int]:
    """The own ``episodes`` of the only knob of all ``settings``; none if it does not have each one's."""
    knobs = {knob for setting in settings for knob in setting.knobs}
    if len(knobs) != 1:
        return ()
    (knob,) = knobs
    listed = config.interventions.get(knob)
    if listed is None:
        return ()
    if len(listed.episodes) == 1:
        return listed.episodes
    counts = dict(zip(listed_settings(env, knob, listed.id), listed.episodes, strict=False))
    found = [counts[setting] for setting in settings if setting in counts]
    return found if len(found) == len(settings) else ()


def summary(session: StageSession, artefact: Artefact) -> DemonstrationSummary:
    """What the demonstrations in ``artefact`` are worth, by setting."""
    return output(session.store, artefact, "summary.json", DemonstrationSummary)


def warn_of_missed_bars(session: StageSession, summary: DemonstrationSummary) -> None:
    """Warn of each expert whose mean true return is below the config's bar."""
    config = session.config(summary.env)
    for row in summary.settings:
        setting = without_cue(summary.env, parse_setting(summary.env, row.setting))
        bar = config.expert_of(setting).bar
        if bar is not None and row.mean_return is not None and row.mean_return < bar:
            session.console.warn(
                f"the expert of {summary.env} {row.setting} is below its bar: mean true return "
                f"{row.mean_return:.1f} over {row.episodes} episodes, bar {bar:g}"
            )


def import_demonstrations(
    session: StageSession,
    *,
    recordings: Sequence[str],
    env: str,
    intervention: str | None,
    setting: Sequence[str],
    setting_column: str | None,
    cut: bool,
) -> Request:
    """Demonstrations that were recorded elsewhere.

    Raises:
        UsageError: no setting is named, or one is malformed or named twice, or the sources are of
            several forms.
        NotFound: no such environment or source.
    """
    if intervention is None and not setting:
        raise UsageError(
            "neither --intervention nor --setting names the settings of the episodes",
            "give --intervention KNOB=VALUE,VALUE, or --setting default for the unchanged "
            "environment",
        )
    for source in recordings:
        check_path(Path(source), "SOURCE")
    env = resolve(env).name
    where = arguments.where(None, intervention, setting)
    settings = where.settings(env, session.config(env))
    form, found = recorded(recordings)
    if len(found) > 1 and setting_column is None:
        where.check_ordered("several SOURCES")
    return import_stage.request(form, found, env, settings, setting_column, cut)

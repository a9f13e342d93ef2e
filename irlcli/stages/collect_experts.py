"""Demonstrations of each setting's own expert, as one Parquet dataset."""

from collections.abc import Sequence

import msgspec

from irlcli.errors import UsageError
from irlcli.interventions import Setting, parse_setting
from irlcli.settings import Settings
from irlcli.stages import From, Job, Request, Stage, train_expert


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a dataset depends on, besides its experts."""

    env: str
    settings: tuple[str, ...]
    episodes: tuple[int, ...]
    deterministic: bool
    seed: int
    bar: float | None


def request(
    env: str,
    settings_: Sequence[Setting],
    config: Settings,
    seed: int = 0,
    episodes: Sequence[int] | None = None,
) -> Request:
    """Demonstrations in ``settings_``; ``episodes`` is one count for all or one for each.

    Outputs ``steps.parquet``, ``episodes.parquet`` and ``summary.json``.

    Raises:
        UsageError: counts that do not fit the settings.
    """
    counts = tuple(episodes) if episodes else (config.demonstrations.episodes,)
    if len(counts) == 1:
        counts *= len(settings_)
    if len(counts) != len(settings_) or min(counts) < 1:
        raise UsageError(
            f"{len(counts)} episode counts for {len(settings_)} settings",
            "give one count for all settings or one for each, all at least 1",
        )
    parameters = Parameters(
        env=env,
        settings=tuple(str(s) for s in settings_),
        episodes=counts,
        deterministic=config.demonstrations.deterministic,
        seed=seed,
        bar=config.expert.bar,
    )
    # Experts do not depend on the seed of the sampling: every dataset shares them.
    experts = {
        f"expert {s}": From(train_expert.request(env, s, 0, config.expert), "policy.pt")
        for s in settings_
    }
    label = f"collect-experts {env} {', '.join(parameters.settings)} seed {seed}"
    return Request(STAGE, parameters, experts, label)


def run(job: Job) -> None:
    """Roll every expert out in its own setting; one that misses its bar is named aloud."""
    import numpy as np

    from irlcli import rl
    from irlcli.checkpoints import load_policy_file
    from irlcli.dataset import write_demonstrations
    from irlcli.stages.outputs import shown, warn_of_errors, write_json
    from irlcli.store import file_digest

    p: Parameters = job.parameters
    groups, summary = [], []
    for index, (text, episodes) in enumerate(zip(p.settings, p.episodes, strict=True)):
        setting = parse_setting(p.env, text)
        policy, _ = load_policy_file(job.inputs[f"expert {text}"])
        seed = int(np.random.SeedSequence([p.seed, index]).generate_state(1)[0])
        trajectories = rl.roll_out(p.env, setting, policy, episodes, seed, p.deterministic)
        returns = np.array([t.episode_return for t in trajectories])
        warn_of_errors(job, text, trajectories)
        met = None if p.bar is None else bool(returns.mean() >= p.bar)
        if met is False:
            job.console.warn(
                f"the expert of {p.env} {text} misses its bar: mean true return "
                f"{returns.mean():.0f} over {episodes} episodes, bar {p.bar:.0f}"
            )
        progress = float(np.mean([t.progress for t in trajectories]))
        groups.append((setting, trajectories))
        summary.append(
            {
                "setting": text,
                "episodes": episodes,
                "mean_return": float(returns.mean()),
                "std_return": float(returns.std()),
                "mean_progress": None if np.isnan(progress) else progress,
                "mean_length": float(np.mean([len(t) for t in trajectories])),
                "bar": p.bar,
                "bar_met": met,
            }
        )
        facts = {text: shown(returns.mean(), progress)}
        job.console.progress(index + 1, len(p.settings), "settings", facts)
    metadata = {
        "experts": {text: file_digest(job.inputs[f"expert {text}"]) for text in p.settings},
        "deterministic": p.deterministic,
    }
    write_demonstrations(job.output, p.env, groups, metadata)
    write_json(job.output / "summary.json", {"env": p.env, "settings": summary})


STAGE = Stage("collect-experts", 1, run)

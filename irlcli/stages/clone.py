"""A behavioural clone of demonstrations: with noise added to its actions, it gives policies of graded quality."""

from collections.abc import Sequence

import msgspec

from irlcli.configs import Config
from irlcli.configs.fields import Activation, Finite, Widths
from irlcli.configs.relevance import check_actions, relevant_ppo
from irlcli.configs.schema import CloneConfig
from irlcli.envs.registry import environment
from irlcli.interventions import Setting, check_tabular, parse_setting
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key


class Network(msgspec.Struct, frozen=True, kw_only=True):
    """The fields of ``airl.ppo`` that a policy which is never trained by PPO depends on."""

    net_arch: Widths
    activation: Activation
    ortho_init: bool
    normalise_observations: bool
    log_std_init: Finite
    log_std_max: Finite | None


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a clone depends on, besides its demonstrations."""

    environment: EnvironmentKey
    settings: tuple[str, ...]
    seed: int
    actions: str
    network: Network
    clone: CloneConfig


def request(
    demos: Source | From, env: str, settings: Sequence[Setting], config: Config, seed: int = 0
) -> Request:
    """A policy cloned from those of ``demos`` that are of ``settings``.

    Its network is that of the student (``airl.ppo``), and ``airl.actions`` says whether the
    likelihood is that of sampled or of executed actions.

    Outputs ``policy.pt`` and ``policy.json``.

    Raises:
        UsageError: a tabular environment, or an option that does not fit its actions.
    """
    check_tabular(env, "clone", wanted=False)
    airl, discrete = config.airl_of(settings), environment(env).discrete_actions
    check_actions(airl.actions, discrete)
    ppo = relevant_ppo(airl.ppo, discrete, "airl.ppo")
    texts = tuple(str(s) for s in settings)
    parameters = Parameters(
        environment=environment_key(env, settings),
        settings=texts,
        seed=seed,
        actions=airl.actions,
        network=Network(**{name: getattr(ppo, name) for name in Network.__struct_fields__}),
        clone=config.clone,
    )
    label = f"clone {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, {"demonstrations": demos}, label)


def run(job: Job) -> None:
    """Maximise the likelihood of the demonstrated actions."""
    from contextlib import closing

    from irlcli.configs import PPOConfig
    from irlcli.data.demonstrations import read_demonstrations
    from irlcli.data.outputs import write_policy
    from irlcli.envs.spaces import check_spaces
    from irlcli.errors import IntegrityError
    from irlcli.learners.actions import ActionView, check_fit
    from irlcli.learners.cloning import clone
    from irlcli.rl.ppo import PPOTrainer
    from irlcli.rl.worlds import action_space, make_worlds, observation_size
    from irlcli.trajectories import transitions

    p: Parameters = job.parameters
    env = p.environment.name
    demos = read_demonstrations(job.inputs["demonstrations"])
    demos.require(env, p.settings)
    # The trainer is only there for its policy: it never acts.
    ppo = PPOConfig(n_envs=1, n_steps=2, batch_size=2, **msgspec.structs.asdict(p.network))
    settings = [parse_setting(env, text) for text in p.settings]
    check_spaces(env, settings)
    episodes = [t for text in p.settings for t in demos.trajectories[text]]
    with closing(make_worlds(env, settings[:1], 1)) as worlds:
        trainer = PPOTrainer(worlds, ppo, 2, p.seed, STAGE.name, keep_moments=True)
        space = action_space(worlds.action_space)
        size = observation_size(worlds.observation_space)
        view = ActionView(p.actions, space)
        try:
            data = transitions(episodes, p.environment.max_episode_steps)
            check_fit(data, size, space)
        except ValueError as error:
            raise IntegrityError(f"{env} {settings[0]}: {error}") from None
        clone(trainer, view.of(data), view, p.clone.epochs, p.seed)
    write_policy(
        job.output,
        trainer.policy,
        ppo,
        env=env,
        agent="clone",
        settings=p.settings,
        seed=p.seed,
    )


STAGE = Stage(
    "clone",
    1,
    run,
    reads=("airl.actions", "clone", *(f"airl.ppo.{name}" for name in Network.__struct_fields__)),
)

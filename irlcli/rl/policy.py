"""Policies: SB3's networks, and how one is described, saved and rebuilt."""

from __future__ import annotations

from collections.abc import Iterable

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.distributions import Distribution, MultiCategoricalDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor

from irlcli.configs import PPOConfig, SACConfig
from irlcli.data.descriptions import PolicyNetwork
from irlcli.envs.registration import make
from irlcli.errors import UsageError
from irlcli.interventions import Setting
from irlcli.networks import ACTIVATIONS, ObservationNormaliser
from irlcli.rl.worlds import observation_size

# Categorical re-checks its support on every one of millions of calls. SB3 builds it from logits
# that are finite, or the run has failed already.
torch.distributions.Distribution.set_default_validate_args(False)


class NormalisingExtractor(FlattenExtractor):
    """SB3's features extractor that normalises observations by running moments."""

    def __init__(self, observation_space: gymnasium.Space):
        super().__init__(observation_space)
        self.normaliser = ObservationNormaliser(self.features_dim)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalised observations [B, D] float32."""
        return self.normaliser(observations)


def extractor(normalising: bool) -> type[FlattenExtractor]:
    """The features extractor of a policy that does, or does not, normalise observations."""
    return NormalisingExtractor if normalising else FlattenExtractor


def _no_optimiser(parameters: Iterable[torch.nn.Parameter], lr: float) -> None:
    """The optimiser of a policy that only acts.

    SB3 gives each of its policies one, and the first optimiser of a process imports PyTorch's
    compiler, which takes longer than a short evaluation.
    """


class Policy:
    """A stochastic policy pi(a|s), as SB3's actor-critic network.

    For a policy trained with gSDE this is the distribution of a single action: its noise is drawn
    anew at every step, while in training it is held for ``sde_sample_freq`` steps.
    """

    def __init__(self, network: ActorCriticPolicy):
        self.network = network

    @property
    def observation_size(self) -> int:
        """The length D of the observations that it takes."""
        return observation_size(self.network.observation_space)

    def act(self, observations: np.ndarray, deterministic: bool = False) -> np.ndarray:
        """Actions [N], [N, K] or [N, A] for observations [N, D].

        Samples are drawn from torch's global generator.
        """
        with torch.no_grad():
            found = self.network.get_distribution(torch.as_tensor(observations))
            actions = found.mode() if deterministic else _sample(found)
            return actions.numpy()

    def log_prob(
        self, observations: torch.Tensor, actions: torch.Tensor, gradient: bool = False
    ) -> torch.Tensor:
        """log pi(a|s) [B] for observations [B, D] and actions [B], [B, K] or [B, A].

        K indices are chosen independently of each other: their log-probabilities add up.
        """
        with torch.set_grad_enabled(gradient):
            return self.network.get_distribution(observations).log_prob(actions)

    def gaussian(
        self, observations: torch.Tensor, gradient: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation [B, A] of pi(.|s) for observations [B, D]."""
        with torch.set_grad_enabled(gradient):
            found = _torch_distribution(self.network.get_distribution(observations))
            return found.mean, found.stddev

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The network's tensors."""
        return self.network.state_dict()

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replace the network's tensors."""
        self.network.load_state_dict(state)


class SquashedPolicy(Policy):
    """SAC's actor: a Gaussian squashed by tanh into the action bounds. It only acts: no learner asks for
    its likelihoods.
    """

    network: Actor  # type: ignore[assignment]

    def __init__(self, network: Actor):
        self.network = network

    def act(self, observations: np.ndarray, deterministic: bool = False) -> np.ndarray:
        """Actions [N, A] within the bounds for observations [N, D]; samples as :class:`Policy`."""
        with torch.no_grad():
            actions = self.network(torch.as_tensor(observations), deterministic)
            return self.network.unscale_action(actions.numpy())


def _torch_distribution(found: Distribution) -> torch.distributions.Distribution:
    """Torch's distribution inside SB3's: its samples need no gSDE noise matrix."""
    assert isinstance(found.distribution, torch.distributions.Distribution)
    return found.distribution


def _sample(found: Distribution) -> torch.Tensor:
    if isinstance(found, MultiCategoricalDistribution):
        return found.sample()
    return _torch_distribution(found).sample()


def describe(config: PPOConfig | SACConfig) -> PolicyNetwork:
    """What :func:`load_policy` needs besides the tensors and a setting."""
    squashed = isinstance(config, SACConfig)
    return PolicyNetwork(
        net_arch=config.net_arch,
        activation=config.activation,
        normalise_observations=config.normalise_observations,
        use_sde=isinstance(config, PPOConfig) and config.use_sde,
        squashed=squashed,
    )


def load_policy(
    env: str, setting: Setting, description: PolicyNetwork, state: dict[str, torch.Tensor]
) -> Policy:
    """The policy that :func:`describe` and ``Policy.state_dict`` wrote down.

    ``setting`` is one it was trained in: a goal, for example, extends the observation.

    Raises:
        RuntimeError: the description and the tensors do not fit each other.
    """
    torch.set_num_threads(1)
    world = make(env, setting)
    spaces = world.observation_space, world.action_space
    world.close()
    policy = (
        _squashed(*spaces, description) if description.squashed else _plain(*spaces, description)
    )
    policy.load_state_dict(state)
    policy.network.set_training_mode(False)
    return policy


def _plain(
    observations: gymnasium.Space, actions: gymnasium.Space, description: PolicyNetwork
) -> Policy:
    return Policy(
        ActorCriticPolicy(
            observations,
            actions,
            lambda _: 0.0,
            net_arch=list(description.net_arch),
            activation_fn=ACTIVATIONS[description.activation],
            # The file's tensors replace the first weights, whatever they are.
            ortho_init=False,
            features_extractor_class=extractor(description.normalise_observations),
            use_sde=description.use_sde,
            optimizer_class=_no_optimiser,  # type: ignore[arg-type]
        )
    )


def _squashed(
    observations: gymnasium.Space, actions: gymnasium.Space, description: PolicyNetwork
) -> SquashedPolicy:
    if not isinstance(actions, gymnasium.spaces.Box):
        raise ValueError("a squashed policy needs continuous actions")
    features = extractor(description.normalise_observations)(observations)
    return SquashedPolicy(
        Actor(
            observations,
            actions,
            list(description.net_arch),
            features,
            features.features_dim,
            ACTIVATIONS[description.activation],
        )
    )


def require_observations(policy: Policy, space: gymnasium.Space, where: str) -> None:
    """Check that ``policy`` takes the observations of ``space``, which are those of ``where``.

    Raises:
        UsageError: their sizes differ.
    """
    if observation_size(space) != policy.observation_size:
        raise UsageError(
            f"the policy takes observations of size {policy.observation_size}, but {where} has size "
            f"{observation_size(space)}",
            "a goal (goal-y, direction) or a cue is part of the observation: name a setting with "
            "the same kind of intervention as in training",
        )

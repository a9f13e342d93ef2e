"""Maximum causal entropy IRL with an invariance penalty, exact on finite MDPs (paper Sec. 4.2).

The algorithm, as this module reads from top to bottom:

1. the demonstrations are grouped into risks (:func:`group_risks`);
2. the reward is a network's scalar output phi_theta(s) (DeepMaxEnt, Wulfmeier et al. 2015; the
   paper's psi = 1), or psi^T features(s) (:class:`RewardNetworks`);
3. every iteration solves all settings for the current reward, forms the gradient of the penalised
   risk by phi, and takes one RMSProp step (:meth:`MaxEnt.step`).

R rewards that do not affect each other (seeds, penalty weights, datasets) are fitted side by side
over the same E settings. Arrays in, arrays out: files and logging stay outside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from irlcli.errors import StageFailed
from irlcli.learners.grouping import Group, group
from irlcli.learners.occupancy import IndexedDemonstrations, mean_occupancy
from irlcli.learners.soft_values import Solution, solve
from irlcli.networks import all_finite
from irlcli.penalties import Occupancies, loss_divisor, occupancy_penalty
from irlcli.seeds import derive
from irlcli.tabular import StackedMDPs

# Relative change of the reward in a finite difference of occupancies.
_STEP = 1e-6

# The risks


class Risks(NamedTuple):
    """K risks of one dataset over E settings.

    Risk k holds demonstrations of one or several settings. A demonstration is always explained
    under the dynamics of the setting that it was recorded in, whatever risk it belongs to:

        L_k = sum_e shares[k, e] ( log Z^e - occupancy[k, e] . phi )

    is the mean negative causal log-likelihood of the risk's demonstrations, in expectation over
    the dynamics (Ziebart et al. 2010). Its gradient with respect to phi(s) is -gap_k(s), where

        gap_k = sum_e shares[k, e] ( occupancy[k, e] - rho_pi^e ).

    The log-likelihood that a grouping maximises is therefore sum_e v_e L^e, with
    v_e = sum_k weights[k] shares[k, e]. Dealing episodes out at random (``shuffled``) keeps every
    v_e at 1/E, so that without a penalty it equals ``balanced``: only the penalty sees labels.

    Attributes:
        occupancy: rho_E [K, E, S] of the risk's demonstrations in each setting.
        shares: [K, E], of each setting in the risk; a row sums to one.
        weights: [K], of each risk; they sum to one.
    """

    occupancy: np.ndarray
    shares: np.ndarray
    weights: np.ndarray


def group_risks(
    settings: StackedMDPs,
    demos: IndexedDemonstrations,
    grouping: str,
    horizon: int,
    seed: int,
) -> Risks:
    """The risks of ``demos`` under ``grouping``, see :func:`irlcli.learners.grouping.group`.

    ``pooled`` and ``balanced`` make one risk, ``per-setting`` E, ``shuffled`` also E, dealt out by
    ``seed``.
    """
    e, n, _ = settings.shape
    rng = np.random.default_rng(derive("shuffled settings", seed, 0)[0])
    groups = group(grouping, demos.counts.tolist(), rng)
    if grouping == "balanced":
        parts = [p._replace(share=g.weight * p.share) for g in groups for p in g.parts]
        groups = [Group(tuple(parts), 1.0)]
    occupancy, shares = np.zeros((len(groups), e, n)), np.zeros((len(groups), e))
    for k, risk in enumerate(groups):
        for part in risk.parts:
            paths = [demos.states[part.setting][i] for i in part.episodes]
            rho = mean_occupancy(settings.mdps[part.setting], paths, horizon)
            occupancy[k, part.setting] = rho
            shares[k, part.setting] = part.share
    return Risks(occupancy, shares, np.array([risk.weight for risk in groups]))


def stack_risks(runs: Sequence[Risks]) -> Risks:
    """The risks of R runs, each array with a leading R; missing risks have weight zero."""
    most = max(len(risks.weights) for risks in runs)

    def padded(array: np.ndarray) -> np.ndarray:
        return np.pad(array, [(0, most - len(array)), *[(0, 0)] * (array.ndim - 1)])

    return Risks(
        *(np.stack([padded(array) for array in arrays]) for arrays in zip(*runs, strict=True))
    )


# The reward


class RewardNetworks(torch.nn.Module):
    """R independent rewards phi(s) = v^T tanh(W features(s) + b) + c, or psi^T features(s).

    Args:
        n_features: F.
        hidden: width of the hidden layer; 0 for the linear reward.
        seeds: one per run. A run's initial weights depend on its seed only.
    """

    def __init__(self, n_features: int, hidden: int, seeds: Sequence[int]):
        super().__init__()

        def draw(*shape: int, fan_in: int) -> torch.nn.Parameter:
            bound = fan_in**-0.5
            values = [
                torch.empty(shape, dtype=torch.float64).uniform_(-bound, bound, generator=g)
                for g in generators
            ]
            return torch.nn.Parameter(torch.stack(values))

        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self.hidden = hidden
        if hidden == 0:
            self.psi = torch.nn.Parameter(torch.zeros(len(seeds), n_features, 1).double())
        else:
            self.weight = draw(n_features, hidden, fan_in=n_features)
            self.bias = draw(1, hidden, fan_in=n_features)
            self.output = draw(hidden, 1, fan_in=hidden)
            self.offset = torch.nn.Parameter(torch.zeros(len(seeds), 1, 1).double())

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[R, T] float64 from ``features`` [T, F] float64."""
        if self.hidden == 0:
            return (features @ self.psi).squeeze(-1)
        layer = torch.tanh(features @ self.weight + self.bias)
        return (layer @ self.output + self.offset).squeeze(-1)


# The learner


class Record(NamedTuple):
    """Diagnostics of one iteration, before its update.

    The likelihood is rho_E . phi - log Z, the log-likelihood in expectation over the dynamics: with few
    episodes it differs from sum log pi by the randomness of the transitions
    (:func:`irlcli.learners.tabular_quality.log_likelihood` has the latter). It covers the whole
    horizon. A choice in the absorbing goal is as likely as any other, so each step there costs log A
    nats. Compare it within a run only.
    """

    iteration: int
    log_likelihood: np.ndarray  # [R, E], of each setting's demonstrations [nats per episode]
    penalty: np.ndarray  # [R], sum_k w_k D_k, which lambda multiplies
    occupancy_gap: np.ndarray  # [R, E], sum_s |rho_E - rho_pi|


class MaxEnt:
    """R rewards, each minimising (paper Eq. 8)

        sum_k w_k [ L_k + lambda D(phi, gap_k) ] + l2 / 2 ||theta||^2

    by RMSProp (App. C). L, w and the gap are those of :class:`Risks`.

    Args:
        settings: the dynamics of the E settings.
        features: [S, F], of each state; with ``kinds`` [T, F], of each kind of state.
        risks: of each of R runs.
        penalty_weight: lambda [R].
        l2: [R].
        seeds: R, for the networks' initial weights.
        penalty: D, a key of ``irlcli.penalties.PENALTIES``.
        horizon: H [steps].
        hidden: width of the hidden layer; 0 learns psi of r = psi^T features.
        learning_rate: of RMSProp.
        kinds: [R, E, S], the kind of each state, where the settings look different or runs have
            different MDPs; None: every state is a kind of its own, the same in every setting
            (T = S).
        penalty_warmup: iterations at lambda = 0. After them the whole objective is divided by
            :func:`irlcli.penalties.loss_divisor`, as the discriminator's is: RMSProp has then adapted
            to the risk's scale.

    Raises:
        ValueError: a learning rate that is negative or not a number.
    """

    def __init__(
        self,
        settings: StackedMDPs,
        features: np.ndarray,
        risks: Sequence[Risks],
        penalty_weight: np.ndarray,
        l2: np.ndarray,
        seeds: Sequence[int],
        *,
        penalty: str,
        horizon: int,
        hidden: int = 32,
        learning_rate: float = 1e-3,
        kinds: np.ndarray | None = None,
        penalty_warmup: int = 0,
    ):
        features = np.asarray(features, dtype=np.float64)
        self._settings, self._horizon = settings, horizon
        self._kinds, self._n_kinds = kinds, len(features)
        stacked = stack_risks(risks)
        self._risks = stacked._replace(occupancy=self._visits(stacked.occupancy))
        self._expert = _expert_occupancy(self._risks)
        self._penalty = occupancy_penalty(penalty)
        self._penalty_weight = np.asarray(penalty_weight)
        self._divisor = np.array([loss_divisor(penalty, w) for w in self._penalty_weight])
        self._penalty_warmup = penalty_warmup
        self._l2 = torch.as_tensor(np.asarray(l2, dtype=np.float64)).reshape(-1, 1, 1)
        self._features = torch.as_tensor(features)
        self._solution: Solution | None = None
        self._rescaled: Solution | None = None
        self.networks = RewardNetworks(features.shape[1], hidden, seeds)
        self._optimizer = torch.optim.RMSprop(self.networks.parameters(), lr=learning_rate)
        self.iterations = 0
        self.records: list[Record] = []

    def rewards(self) -> np.ndarray:
        """The current rewards [R, T] float64."""
        with torch.no_grad():
            return self.networks(self._features).numpy()

    def step(self, record: bool) -> None:
        """One iteration. ``record`` appends its diagnostics to ``records``.

        Raises:
            ValueError: as :func:`irlcli.learners.soft_values.solve`.
            StageFailed: the parameters or the square of their gradient stopped being finite.
        """
        risks = self._risks
        reward = self.networks(self._features)
        phi = reward.detach().numpy()
        solution = self._solve(phi, self._solution)
        self._solution = solution
        visits = self._visits(solution.occupancy)
        gap = np.einsum("rke,rkes->rks", risks.shares, risks.occupancy - visits[:, None])
        each = np.einsum("rkes,rs->rke", risks.occupancy, phi) - solution.log_partition[:, None]

        def response() -> np.ndarray:
            self._rescaled = self._solve((1.0 + _STEP) * phi, self._rescaled)
            moved = self._visits(self._rescaled.occupancy) - visits
            return np.einsum("rke,res->rks", risks.shares, -moved / _STEP)

        weight, divisor = self._penalty_weight, np.ones(len(phi))
        if self.iterations < self._penalty_warmup:
            weight = np.zeros(len(phi))
        elif self._penalty_warmup:
            divisor = self._divisor
        negative = -(risks.shares * each).sum(-1)
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
            penalty, penalty_gradient = self._penalty(
                Occupancies(phi, gap, risks.weights, negative, response, weight)
            )
        if record:
            likelihood = np.einsum("res,rs->re", self._expert, phi) - solution.log_partition
            total = (risks.weights * penalty).sum(-1)
            distance = np.abs(self._expert - visits).sum(-1)
            self.records.append(Record(self.iterations, likelihood, total, distance))
        gradient = np.einsum(
            "rk,rks->rs", risks.weights, weight[:, None, None] * penalty_gradient - gap
        )
        gradient /= divisor[:, None]
        self._optimizer.zero_grad()
        reward.backward(torch.as_tensor(gradient))
        for parameter in self.networks.parameters():
            assert parameter.grad is not None
            parameter.grad += (
                self._l2 / torch.as_tensor(divisor)[:, None, None] * parameter.detach()
            )
            # RMSProp divides by a mean of squares: an infinite one would make every step zero.
            self._require(bool(parameter.grad.square().isfinite().all()))
        self._optimizer.step()
        self._require(all_finite(self.networks))
        self.iterations += 1

    def _require(self, finite: bool) -> None:
        if not finite:
            raise StageFailed(
                f"the reward's parameters or their gradient are not finite in iteration {self.iterations}",
                "a smaller learning rate, lambda or l2 usually helps",
            )

    def _solve(self, phi: np.ndarray, reuse: Solution | None) -> Solution:
        """The policies of ``phi`` [R, T] in every setting."""
        reward = phi
        if self._kinds is not None:
            reward = np.take_along_axis(phi[:, None], self._kinds, axis=2)
        return solve(self._settings, reward, self._horizon, reuse=reuse)

    def _visits(self, occupancy: np.ndarray) -> np.ndarray:
        """``occupancy`` [R, ..., E, S] of states as [R, ..., E, T], of kinds."""
        if self._kinds is None:
            return occupancy
        runs, e, n = self._kinds.shape
        middle = occupancy.reshape(runs, -1, e, n)
        cells = np.arange(middle[..., 0].size).reshape(*middle.shape[:-1], 1) * self._n_kinds
        index = (cells + self._kinds[:, None]).ravel()
        total = np.bincount(index, middle.ravel(), cells.size * self._n_kinds)
        return total.reshape(*occupancy.shape[:-1], self._n_kinds)

    def fit(
        self,
        iterations: int,
        record_every: int = 50,
        after_record: Callable[[], None] = lambda: None,
    ) -> np.ndarray:
        """Iterate until ``iterations`` are done, also those before :meth:`load_state_dict`.

        Records every ``record_every`` iterations and the last one, and calls ``after_record``
        after each of these. Returns the rewards [R, T].

        Raises:
            ValueError, StageFailed: as :meth:`step`.
        """
        while self.iterations < iterations:
            record = self.iterations % record_every == 0 or self.iterations == iterations - 1
            self.step(record)
            if record:
                after_record()
        return self.rewards()

    def state_dict(self) -> dict[str, Any]:
        """What :meth:`load_state_dict` needs to continue to the same bits."""
        # One tensor per field, so that their number does not grow with the iterations.
        fields = [torch.as_tensor(np.stack(field)) for field in zip(*self.records, strict=True)]
        return {
            "iterations": self.iterations,
            "networks": self.networks.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "records": fields,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state of an equal learner.

        Raises:
            Exception: of any kind, if the state is not of an equal learner.
        """
        self.networks.load_state_dict(state["networks"])
        self._optimizer.load_state_dict(state["optimizer"])
        steps, *fields = (field.numpy() for field in state["records"])
        self.records = [Record(*values) for values in zip(steps.tolist(), *fields, strict=True)]
        self.iterations = int(state["iterations"])


def _expert_occupancy(risks: Risks) -> np.ndarray:
    """rho_E [R, E, T] of each setting's demonstrations, whatever risks they belong to."""
    share = risks.weights[..., None] * risks.shares
    return np.einsum("rke,rkes->res", share / share.sum(1, keepdims=True), risks.occupancy)

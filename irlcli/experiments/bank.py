"""The bank of policies that a learned reward is assessed on: which there are, and where.

Idle and random agents, a clone of the demonstrations at several noise levels, the reward's student,
experts, and policies retrained on the reward. Nothing here trains an expert or a retrained policy:
those that exist are measured.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from irlcli import labels
from irlcli.configs import Config
from irlcli.data.descriptions import Reward
from irlcli.errors import NotFound
from irlcli.experiments.inputs import source_in
from irlcli.experiments.references import student_beside
from irlcli.experiments.status import Lookup
from irlcli.interventions import Setting, parse_setting
from irlcli.stages import clone, record, train_expert
from irlcli.stages.assess import Entry
from irlcli.stages.base import From, Request, Source
from irlcli.store import Artefact, Store


class Policies(NamedTuple):
    """The policies of a bank besides the idle and the random agent.

    Attributes:
        clone: of the demonstrations, for its noisy copies.
        student: trained together with the reward.
        reused: experts of other settings, by the setting each was trained in.
        experts: each setting's own, by setting.
        retrained: on the reward, by their entries.
        substitutes: settings whose expert is not the one behind their demonstrations.
    """

    clone: Source | From | None
    student: Source | From | None
    reused: Mapping[str, Source | From]
    experts: Mapping[str, Source | From]
    retrained: Mapping[Entry, Source | From]
    substitutes: Sequence[str] = ()


def bank(
    env: str, settings: Sequence[Setting], config: Config, policies: Policies, seed: int = 0
) -> dict[Entry, Request]:
    """The entries of a bank in ``settings``, each with the request that records its episodes."""
    found: dict[Entry, Request] = {}
    for setting in settings:
        for entry, policy, noise in _members(str(setting), config, policies):
            found[entry] = record.request(
                env,
                setting,
                config.evaluation,
                policy,
                agent="policy" if policy is not None else entry.kind,  # type: ignore[arg-type]
                noise=noise,
                seed=seed,
                policy_label=entry.policy,
            )
    return found


def _members(
    setting: str, config: Config, policies: Policies
) -> Iterator[tuple[Entry, Source | From | None, float]]:
    """Each entry in ``setting``, its policy (None for an agent without one), and the noise of its actions."""

    def entry(name: str, kind: str) -> Entry:
        return Entry(policy=name, kind=kind, setting=setting)

    yield entry("idle", "idle"), None, 0.0
    yield entry("random", "random"), None, 0.0
    if policies.clone is not None:
        for noise in dict.fromkeys(config.assessment.noise):
            yield entry(f"clone, noise {noise}", "clone"), policies.clone, noise
    if policies.student is not None:
        yield entry("student", "student"), policies.student, 0.0
    for trained, expert in policies.reused.items():
        # If one expert demonstrates in every setting, reusing it would repeat the setting's own.
        if trained != setting and expert != policies.experts.get(setting):
            yield entry(f"expert of {trained}", "reused"), expert, 0.0
    if setting in policies.experts:
        yield entry(f"expert of {setting}", "expert"), policies.experts[setting], 0.0
    for retrained, policy in policies.retrained.items():
        if retrained.setting == setting:
            yield retrained, policy, 0.0


class Finder:
    """Looks for the policies of a bank in a store.

    Args:
        store: the store.
        lookup: of the store and of those to copy from.
        config: under which experts are looked up.
    """

    def __init__(self, store: Store, lookup: Lookup, config: Config):
        self._store = store
        self._index = store.index()
        self._lookup = lookup
        self._config = config

    def demonstrations(self, reward: Source) -> Source | None:
        """What ``reward`` was learned from, if it is in the store."""
        maker = self._maker(reward)
        sha = "" if maker is None else maker.manifest.record.inputs.get("demonstrations", "")
        holders = self._index.holders(sha)
        return source_in(holders[0], None) if holders else None

    def policies(
        self,
        reward: Source,
        origin: Reward,
        settings: Sequence[Setting],
        demos: Source | None,
        cloned: Sequence[str],
        seed: int,
    ) -> Policies:
        """The policies that exist for a bank in ``settings``, and a clone that can be made.

        Args:
            reward: a ``reward.pt``.
            origin: its description.
            settings: of the bank.
            demos: demonstrations for the clone; None for no clone.
            cloned: their settings that the clone imitates.
            seed: of the clone.
        """
        env, imitation = origin.env, None
        if demos is not None:
            imitated = [parse_setting(env, text) for text in cloned]
            request = clone.request(demos, env, imitated, self._config, seed)
            imitation = From(request, "policy.pt")
        demonstrated = self.demonstrations(reward)
        experts, substitutes = {}, []
        for text in dict.fromkeys([*origin.settings, *map(str, settings)]):
            recorded = _recorded(demonstrated, text)
            expert = self._expert(env, text, recorded)
            if expert is not None:
                experts[text] = expert
                if recorded is not None and self._sha(expert) != recorded:
                    substitutes.append(text)
        return Policies(
            clone=imitation,
            student=self._student(reward, origin),
            reused={text: experts[text] for text in origin.settings if text in experts},
            experts=experts,
            retrained=self._retrained(reward),
            substitutes=substitutes,
        )

    def _maker(self, reward: Source) -> Artefact | None:
        """The stored artefact of ``reward``, also of a copy outside the store."""
        makers = [reward.artefact] if reward.artefact else self._index.holders(reward.sha256)
        found = (a for a in makers if a.manifest.record.stage == "train-airl")
        return next(found, None)

    def _expert(self, env: str, text: str, recorded: str | None) -> Source | From | None:
        """The expert with the digest ``recorded``, or else the one that the config asks for."""
        holders = [] if recorded is None else self._index.holders(recorded)
        if holders:
            return source_in(holders[0], "policy.pt")
        request = train_expert.demonstrator(env, parse_setting(env, text), self._config)
        step = self._lookup(request)
        if step.artefact is None:
            return None
        # A HIT is equal to the same expert behind the demonstrations.
        hit = step.status == "HIT"
        return source_in(step.artefact, "policy.pt") if hit else From(request, "policy.pt")

    def _sha(self, expert: Source | From) -> str:
        if isinstance(expert, Source):
            return expert.sha256
        artefact = self._lookup(expert.request).artefact
        assert artefact is not None
        return artefact.output("policy.pt").sha256

    def _student(self, reward: Source, origin: Reward) -> Source | None:
        maker = self._maker(reward)
        if maker is not None:
            return source_in(maker, "policy.pt")
        try:
            return student_beside(self._store, reward, origin)
        except NotFound:
            return None

    def _retrained(self, reward: Source) -> dict[Entry, Source]:
        found = {}
        for artefact in self._index.artefacts.values():
            made = artefact.manifest.record
            trained, setting = made.parameters.get("transfer"), made.parameters.get("setting")
            if (
                made.stage == "transfer"
                and made.inputs.get("reward") == reward.sha256
                and isinstance(trained, dict)
                and isinstance(setting, str)
                and any(output.path == "policy.pt" for output in artefact.manifest.outputs)
            ):
                entry = Entry(
                    policy=f"retrained {artefact.id[:8]} {labels.retrained_as(made)}".strip(),
                    kind="from-student" if "start" in made.inputs else "retrained",
                    setting=setting,
                    ceiling=trained.get("ceiling"),
                    gamma=_gamma(trained),
                )
                found[entry] = source_in(artefact, "policy.pt")
        return dict(sorted(found.items(), key=lambda item: item[0].policy))


def _recorded(demos: Source | None, setting: str) -> str | None:
    """The digest of the expert behind the demonstrations of ``setting``; None if they record none."""
    if demos is None or demos.artefact is None:
        return None
    return demos.artefact.manifest.record.inputs.get(f"expert {setting}")


def _gamma(transfer: Mapping[str, Any]) -> float | None:
    """The discount in the recorded parameters of a transfer; None where they have none."""
    learner = transfer.get("sac" if transfer.get("algorithm") == "sac" else "ppo")
    gamma = learner.get("gamma") if isinstance(learner, dict) else None
    return gamma if isinstance(gamma, int | float) else None

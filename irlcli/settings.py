"""Validated settings: TOML files, profiles, ``--set``.

One file per environment in ``settings/``. Precedence, weakest first: the defaults below, the
environment's file, its profile, ``--settings FILE``, ``--set``, flags. Environment variables
never enter: equal settings give equal artefacts wherever they run.
"""

import stat
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from irlcli.errors import UsageError, suggest
from irlcli.interventions import Setting, environment, knob_of, overlap, parse_settings

PROFILES = ("smoke", "standard", "paper")

# A deep dotted key takes tomllib the square of its length: 12 s for 32 KB.
_MAX_TOML_BYTES = 64 << 10
_MAX_TOML_LINE = 2000
# Bounded, so that every count fits 64 bits and no key holds an infinity or NaN.
_MOST = 2**53
_LARGE = 1e300
Count = Annotated[int, Meta(ge=1, le=_MOST)]
NonNegativeCount = Annotated[int, Meta(ge=0, le=_MOST)]
Positive = Annotated[float, Meta(gt=0, le=_LARGE)]
NonNegative = Annotated[float, Meta(ge=0, le=_LARGE)]
Finite = Annotated[float, Meta(ge=-_LARGE, le=_LARGE)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
# gamma = 1 would make the value of an absorbing state infinite.
Discount = Annotated[float, Meta(ge=0, lt=1)]
# Bounded, so that no description can ask for a network that does not fit memory.
Widths = Annotated[tuple[Annotated[int, Meta(ge=1, le=1024)], ...], Meta(max_length=6)]
Schedule = Literal["constant", "linear"]
Activation = Literal["tanh", "relu"]
Method = Literal["erm", "erm-balanced", "irm"]
# ``irm-shuffled`` is the control: the penalty over groups that mean nothing.
AdversarialMethod = Literal["erm", "erm-balanced", "irm", "irm-shuffled"]
PENALISED = ("irm", "irm-shuffled")


class PPOSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """PPO (paper App. C names the values of rl-baselines3-zoo). ``linear`` falls to zero."""

    # Bounded, so that no file can ask for more worlds or steps than memory holds.
    n_envs: Annotated[int, Meta(ge=1, le=1024)] = 16
    n_steps: Annotated[int, Meta(ge=1, le=65536)] = 1024
    rollouts_per_round: Count = 1
    batch_size: Annotated[int, Meta(ge=2, le=_MOST)] = 512
    n_epochs: Count = 4
    learning_rate: Positive = 1e-3
    learning_rate_schedule: Schedule = "constant"
    clip_range: Positive = 0.2
    clip_range_schedule: Schedule = "constant"
    gamma: Discount = 0.999
    gae_lambda: Fraction = 0.98
    ent_coef: NonNegative = 0.01
    ent_coef_schedule: Schedule = "constant"
    vf_coef: NonNegative = 0.5
    max_grad_norm: Positive = 0.5
    net_arch: Widths = (64, 64)
    activation: Activation = "tanh"
    ortho_init: bool = True
    # For continuous actions. Unset is off (or SB3's default) and not part of an artefact's key:
    # what was made before these settings existed is still found. Where actions beyond the bounds
    # are clipped, ``log_std_max`` bounds an entropy that would cost the policy nothing.
    log_std_init: Finite | UnsetType = UNSET
    log_std_max: Finite | UnsetType = UNSET
    normalise_observations: bool | UnsetType = UNSET
    normalise_rewards: bool | UnsetType = UNSET
    use_sde: bool | UnsetType = UNSET
    sde_sample_freq: Count | UnsetType = UNSET


class InterventionSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Paper Table 2: the values trained on and the held-out ones.

    ``episodes`` are the demonstrations of each value trained on, where they differ. In a file,
    ``expert_ppo`` holds what this knob's experts need different from ``expert.ppo``; once loaded,
    all of their PPO.
    """

    id: tuple[str, ...]
    ood: tuple[str, ...]
    episodes: tuple[Count, ...] = ()
    expert_ppo: PPOSettings | UnsetType = UNSET


_INTERVENTIONS = dict[str, InterventionSettings]


class ExpertSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A policy trained on the true reward. ``bar`` is the mean true return that it must reach."""

    total_steps: Count = 1_000_000
    bar: Finite | None = None
    ppo: PPOSettings = PPOSettings()


class DemonstrationSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Episodes per setting, sampled from the stochastic expert unless ``deterministic``."""

    episodes: Count = 10
    deterministic: bool = False


class AIRLSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Adversarial IRL (paper Sec. 4.3, Algorithm 1, App. C)."""

    method: AdversarialMethod = "erm"
    total_steps: Count = 1_000_000
    state_only: bool = False
    hidden: Widths = (32, 32)
    activation: Activation = "tanh"
    learning_rate: Positive = 3e-4
    weight_decay: NonNegative = 1e-4
    max_grad_norm: Positive = 1.0
    updates_per_round: Count = 10
    batch_size: Annotated[int, Meta(ge=2, le=_MOST, multiple_of=2)] = 256
    replay_share: Fraction = 0.5
    replay_per_round: Count = 1000
    replay_capacity: Count = 50_000
    penalty_weight: NonNegative = 10.0
    penalty_warmup_rounds: NonNegativeCount = 10
    penalty_ramp_rounds: NonNegativeCount = 10
    penalty_scaling: Literal["logit", "reward"] = "logit"
    penalty_estimate: Literal["unbiased", "square"] = "unbiased"
    pairing: Literal["matched", "pooled"] = "matched"
    policy_reward: Literal["f-log-pi", "f", "g"] = "f-log-pi"
    fixed_horizon: bool = True
    # What g and log pi see of continuous actions: the policy's samples, as where unset, or what
    # the environment clips them to.
    actions: Literal["sampled", "executed"] | UnsetType = UNSET
    # Epochs of behavioural cloning with which the student begins: none, as where unset, if 0.
    bc_epochs: NonNegativeCount | UnsetType = UNSET
    # Which round is kept: the ``last``, as where unset, or the best on ``episodes`` held out of
    # every setting's demonstrations, or in one setting of these (``leg-length=1x``), which is
    # left out of training. Scored every so many rounds, a setting over so many episodes.
    select: str | UnsetType = UNSET
    select_every: Count | UnsetType = UNSET
    select_episodes: Count | UnsetType = UNSET
    ppo: PPOSettings = PPOSettings()


class TransferSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A new policy on a frozen reward (paper Sec. 5.3)."""

    total_steps: Count = 1_000_000
    ppo: PPOSettings = PPOSettings()


class EvaluationSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """True return of a policy over whole episodes."""

    episodes: Count = 20
    deterministic: bool = False


class GridworldSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The gridworld of paper Sec. 5.1. Part of a dataset's identity, and recorded with it.

    ``horizon`` [steps] is that of experts and learner. At the goal an episode ends
    (``terminal``) or stays to the horizon (``absorbing``).
    """

    size: Annotated[int, Meta(ge=5, le=1024)] = 8
    horizon: Count = 32
    goal: Literal["terminal", "absorbing"] = "absorbing"
    p_slip: Annotated[float, Meta(ge=0, lt=1)] = 0.2


class MaxEntSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Tractable maximum-entropy IRL (paper Sec. 4.2, 5.1, App. A, C).

    The reward is an MLP's scalar output (``features = learned``) or linear in the ``inputs`` of
    a state. ``held_out`` episodes of each setting's expert measure the likelihood.
    """

    method: Method = "erm"
    penalty: Literal["irmv1", "closed-form"] = "irmv1"
    penalty_weight: NonNegative = 0.05
    l2: NonNegative = 0.0
    features: Literal["learned", "linear"] = "learned"
    inputs: Literal["one-hot", "coordinates"] = "one-hot"
    hidden: Count = 32
    iterations: Count = 1000
    learning_rate: Positive = 1e-3
    held_out: Count = 200


class Figure2Settings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Paper Fig. 2 as numbers: ``seeds`` datasets, the lambdas of IRM, the L2 weights of ERM.

    The datasets' seeds begin at 1000: smaller ones are for trying things out.
    """

    seeds: Annotated[int, Meta(ge=2)] = 20
    first_seed: NonNegativeCount = 1000
    episodes: tuple[Count, ...] = (400, 25, 3)
    penalty_weights: tuple[NonNegative, ...] = (0.01, 0.05, 0.2, 1.0)
    l2s: tuple[NonNegative, ...] = (1e-3, 1e-2, 1e-1, 1.0)


class Settings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that can be set for one environment."""

    interventions: _INTERVENTIONS = {}
    expert: ExpertSettings = ExpertSettings()
    demonstrations: DemonstrationSettings = DemonstrationSettings()
    airl: AIRLSettings = AIRLSettings()
    transfer: TransferSettings = TransferSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    gridworld: GridworldSettings = GridworldSettings()
    maxent: MaxEntSettings = MaxEntSettings()
    figure2: Figure2Settings = Figure2Settings()

    def expert_of(self, setting: Setting) -> ExpertSettings:
        """The settings of the expert of ``setting``, those of its knob included."""
        listed = self.interventions.get(setting.knob or "")
        if listed is None or listed.expert_ppo is UNSET:
            return self.expert
        return msgspec.structs.replace(self.expert, ppo=listed.expert_ppo)


def check_profile(profile: str) -> None:
    """Refuse what is no profile.

    Raises:
        UsageError: not one of :data:`PROFILES`.
    """
    if profile not in PROFILES:
        raise UsageError(f"unknown profile {profile!r}", suggest(profile, PROFILES))


def load_settings(
    env: str,
    profile: str = "standard",
    file: Path | None = None,
    overrides: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
) -> Settings:
    """The settings of ``env``.

    Args:
        env: environment whose file in ``settings/`` is read.
        profile: ``smoke``, ``standard`` or ``paper``.
        file: a TOML file of the same form (without profiles) laid over it.
        overrides: ``airl.penalty_weight=30``, each typed by its field.
        flags: dotted field to value; those that are None are left out.

    Raises:
        UsageError: unknown environment, profile, field or value; malformed TOML.
        OSError: ``file`` cannot be read.
    """
    environment(env)
    check_profile(profile)
    own = _settings_directory() / f"{env}.toml"
    tree = _read_toml(own)
    profiles = tree.pop("profiles", {})
    layers = [(str(own), tree), (f"{own}, profile {profile}", profiles.get(profile, {}))]
    if file is not None:
        layers.append((str(file), _read_toml(file)))
    layers += [(f"--set {item!r}", _override(item)) for item in overrides]
    layers += [
        (f"--{dotted.rpartition('.')[2].replace('_', '-')}", _nest(dotted.split("."), value))
        for dotted, value in (flags or {}).items()
        if value is not None
    ]
    return _stack(env, layers)


def _stack(env: str, layers: Sequence[tuple[str, Mapping[str, Any]]]) -> Settings:
    """The settings that ``layers`` of (source, values) lead to, later ones winning."""
    tree: dict[str, Any] = {}
    for source, values in layers:
        if tree and not values:
            # The standard profile, usually: every command comes through here.
            continue
        tree = _merge(tree, values)
        try:
            settings = _convert(env, tree)
        except UsageError as error:
            raise UsageError(f"{source}: {error.message}", error.hint) from None
    interventions = {
        knob: msgspec.structs.replace(listed, expert_ppo=_expert_ppo(knob, layers))
        for knob, listed in settings.interventions.items()
        if listed.expert_ppo is not UNSET
    }
    return msgspec.structs.replace(settings, interventions=settings.interventions | interventions)


def _expert_ppo(knob: str, layers: Sequence[tuple[str, Mapping[str, Any]]]) -> PPOSettings:
    """In every layer, what is said of the knob wins over ``expert.ppo``, but no later layer."""
    tree: dict[str, Any] = {}
    for _, values in layers:
        tree = _merge(tree, values.get("expert", {}).get("ppo", {}))
        tree = _merge(tree, values.get("interventions", {}).get(knob, {}).get("expert_ppo", {}))
    return msgspec.convert(tree, PPOSettings)


def _settings_directory() -> Path:
    """``settings/`` of the checkout, or its copy inside an installed package."""
    packaged = Path(__file__).parent / "settings_files"
    return packaged if packaged.is_dir() else Path(__file__).parent.parent / "settings"


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        information = path.stat()
        if not stat.S_ISREG(information.st_mode) and not stat.S_ISDIR(information.st_mode):
            # Opening a named pipe would wait for a writer that never comes.
            raise UsageError(f"{path} is not a plain file", "name a TOML file with --settings")
        if information.st_size > _MAX_TOML_BYTES:
            raise ValueError(f"it is larger than {_MAX_TOML_BYTES >> 10} KiB")
        return _parse_toml(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        raise UsageError(
            f"{path} is not valid TOML: {error}", "see settings/ for examples"
        ) from None
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read: {error.strerror}", "name a TOML file with --settings"
        ) from None


def _parse_toml(text: str) -> dict[str, Any]:
    if max(map(len, text.splitlines()), default=0) > _MAX_TOML_LINE:
        raise ValueError(f"a line is longer than {_MAX_TOML_LINE} characters")
    return tomllib.loads(text)


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for name, value in over.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(name), Mapping)
        merged[name] = _merge(merged[name], value) if both else value
    return merged


def _nest(path: Sequence[str], value: Any) -> dict[str, Any]:
    for name in reversed(path):
        value = {name: value}
    return value


def _convert(env: str, tree: Mapping[str, Any]) -> Settings:
    _check_names(tree, Settings, ())
    for knob in tree.get("interventions", {}):
        knob_of(env, knob)
    try:
        settings = msgspec.convert(tree, Settings)
    except msgspec.ValidationError as error:
        message, _, where = str(error).partition(" - at ")
        field = where.strip("`").removeprefix("$.")
        if field.startswith("interventions[...]"):
            knob = next(k for k, v in tree["interventions"].items() if not _is_listed(v))
            field = f"interventions.{knob}{field.removeprefix('interventions[...]')}"
        raise UsageError(f"{field}: {message}", _field_hint(field)) from None
    for knob, values in settings.interventions.items():
        trained, unseen = (
            parse_settings(env, f"{knob}={','.join(part)}") if part else ()
            for part in (values.id, values.ood)
        )
        if len(values.episodes) not in (0, 1, len(trained)):
            raise UsageError(
                f"interventions.{knob}.episodes: {len(values.episodes)} episode counts for "
                f"{len(trained)} settings",
                "write one count for all, or one for each value of id",
            )
        if both := [str(s) for s in unseen if any(overlap(s, other) for other in trained)]:
            raise UsageError(
                f"interventions.{knob}: {', '.join(both)} is both trained in (id) and held out (ood)",
                "hold out what nothing is trained in",
            )
    return settings


def _is_listed(values: Any) -> bool:
    try:
        msgspec.convert(values, InterventionSettings)
    except msgspec.ValidationError:
        return False
    return True


def _check_names(tree: Any, kind: Any, path: tuple[str, ...]) -> None:
    """Refuse unknown names, and values that are no tables: msgspec says too little of either."""
    if kind == _INTERVENTIONS:
        fields = dict.fromkeys(tree, InterventionSettings) if isinstance(tree, Mapping) else {}
        inside = "[interventions.KNOB] with id and ood"
    else:
        fields = {f.name: f.type for f in msgspec.structs.fields(kind)}
        inside = f"[{'.'.join(path)}] with some of: {', '.join(fields)}"
    if not isinstance(tree, Mapping):
        raise UsageError(f"{'.'.join(path)}: a table is needed, not {tree!r}", f"write {inside}")
    for name, value in tree.items():
        if name not in fields:
            where = ".".join((*path, str(name)))
            raise UsageError(f"no setting {where!r}", suggest(str(name), fields))
        for inner in (fields[name], *get_args(fields[name])):
            if inner == _INTERVENTIONS or (isinstance(inner, type) and issubclass(inner, Struct)):
                _check_names(value, inner, (*path, name))
                break


def _override(item: str) -> dict[str, Any]:
    dotted, equals, text = item.partition("=")
    path = dotted.strip().split(".")
    if not equals:
        raise UsageError(f"--set {item!r} has no '='", "write --set airl.penalty_weight=30")
    kind: Any = Settings
    for i, name in enumerate(path):
        if not (isinstance(kind, type) and issubclass(kind, Struct)):
            parent = ".".join(path[:i])
            raise UsageError(
                f"--set {item!r}: {parent} has no fields", f"write --set {parent}=VALUE"
            )
        fields = {f.name: f.type for f in msgspec.structs.fields(kind)}
        if name not in fields:
            homes = [f"{home}.{name}" for home in _homes(name)] if len(path) == 1 else []
            hint = f"did you mean {' or '.join(homes)}?" if homes else suggest(name, fields)
            raise UsageError(f"--set {item!r}: no setting {dotted.strip()!r}", hint)
        kind = fields[name]
        if kind == _INTERVENTIONS:
            raise UsageError(
                f"--set {item!r}: interventions are not set this way", "use --intervention or --ood"
            )
    if isinstance(kind, type) and issubclass(kind, Struct):
        names = ", ".join(f"{dotted.strip()}.{f.name}" for f in msgspec.structs.fields(kind))
        raise UsageError(f"--set {item!r} names a group of settings", f"one of: {names}")
    return _nest(path, _typed(text.strip(), kind, dotted.strip()))


def _homes(name: str) -> list[str]:
    """The groups of settings that have a field ``name``."""
    return [
        f.name
        for f in msgspec.structs.fields(Settings)
        if isinstance(f.type, type) and issubclass(f.type, Struct)
        if name in f.type.__struct_fields__
    ]


def _typed(text: str, kind: Any, field: str) -> Any:
    try:
        value = _parse_toml(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text
    try:
        return msgspec.to_builtins(msgspec.convert(value, kind))
    except (msgspec.ValidationError, UnicodeEncodeError) as error:
        # Arguments may hold bytes that are no text.
        raise UsageError(
            f"--set {field}={text}: {str(error).partition(' - at ')[0]}", _field_hint(field)
        ) from None


def _field_hint(field: str) -> str:
    """What a field takes: its choices if it has some, else a value that it could have."""
    value, kind = Settings(), Settings
    for name in field.split("."):
        name = name.partition("[")[0]
        if not isinstance(value, Struct) or not hasattr(value, name):
            return "see settings/ for examples"
        (kind,) = (f.type for f in msgspec.structs.fields(value) if f.name == name)
        value = getattr(value, name)
    for member in (kind, *get_args(kind)):
        if get_origin(member) is Literal:
            return f"one of: {', '.join(get_args(member))}"
    if value is UNSET:
        return "it is unset by default"
    return f"for example {msgspec.json.encode(value).decode()}"

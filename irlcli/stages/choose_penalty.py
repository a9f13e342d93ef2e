"""lambda by leaving one training setting out (method: model selection that touches no OOD data)."""

from collections.abc import Sequence

import msgspec

from irlcli.configs import PENALISED, AIRLConfig
from irlcli.errors import IntegrityError, UsageError
from irlcli.interventions import Setting
from irlcli.stages import train_airl
from irlcli.stages.base import From, Job, Request, Source, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the choice depends on, besides the rewards learned for it."""

    env: str
    settings: tuple[str, ...]
    weights: tuple[float, ...]
    seed: int


class Choice(msgspec.Struct, frozen=True, kw_only=True):
    """``choice.json``: the mean true return in each setting left out, and what follows."""

    env: str
    weights: tuple[float, ...]
    scores: tuple[dict[str, float], ...]  # of each weight: left-out setting to true return
    chosen: float


def request(
    demos: Source | From,
    env: str,
    settings_: Sequence[Setting],
    airl: AIRLConfig,
    weights: Sequence[float],
    seed: int = 0,
) -> Request:
    """The one of ``weights`` whose students do best in the settings left out, on average.

    For each weight and setting, ``airl`` is trained on the other settings and scored by its best
    round's true return in the one left out. Outputs ``choice.json``.

    Raises:
        UsageError: fewer than two settings or weights, a method without penalty.
    """
    texts = tuple(str(s) for s in settings_)
    candidates = tuple(sorted(set(weights)))
    if len(texts) < 2:
        raise UsageError(
            f"{texts[0]} is the only setting: none can be left out", "set lambda by hand"
        )
    if len(candidates) < 2:
        raise UsageError("one lambda is no choice", "name at least two: --choose-penalty 0.1,1,10")
    if airl.method not in PENALISED:
        raise UsageError(
            f"method {airl.method!r} has no penalty", f"one of: {', '.join(PENALISED)}"
        )
    inputs = {}
    for weight in candidates:
        for text in texts:
            config = msgspec.structs.replace(airl, penalty_weight=weight, select=text)
            learned = train_airl.request(demos, env, settings_, config, seed)
            inputs[_role(weight, text)] = From(learned, "reward.json")
    parameters = Parameters(env=env, settings=texts, weights=candidates, seed=seed)
    label = f"choose-penalty {airl.method} {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, inputs, label)


def _role(weight: float, setting: str) -> str:
    return f"lambda {weight!r} without {setting}"


def run(job: Job) -> None:
    """Read the scores; of weights that tie, the smallest is chosen."""
    import json

    from irlcli.data import descriptions
    from irlcli.data.outputs import write_json

    p: Parameters = job.parameters
    scores = []
    for weight in p.weights:
        row = {}
        for text in p.settings:
            path = job.inputs[_role(weight, text)]
            learned = descriptions.parse(json.loads(path.read_text()), descriptions.Reward, path)
            if learned.selected is None:
                raise IntegrityError(f"{path} says of no round that it was selected")
            row[text] = learned.selected.score
        scores.append(row)
    means = [sum(row.values()) / len(row) for row in scores]
    chosen = p.weights[means.index(max(means))]
    choice = Choice(env=p.env, weights=p.weights, scores=tuple(scores), chosen=chosen)
    write_json(job.output / "choice.json", msgspec.to_builtins(choice))


STAGE = Stage("choose-penalty", 1, run)

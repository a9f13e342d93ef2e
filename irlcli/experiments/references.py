"""What a reference given to ``--demos``, ``--reward`` or ``--policy`` names.

Planning needs the environment and the settings behind it. An artefact has them in a JSON output,
which is read without a tensor library. A foreign file has to be loaded.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Literal, overload

from irlcli.data import descriptions
from irlcli.errors import IntegrityError, NotFound, UsageError
from irlcli.experiments.inputs import foreign_source, source_in
from irlcli.experiments.introduce import introduce
from irlcli.interventions import Setting, check_observed, cue_in, parse_setting, without_cue
from irlcli.stages import evaluate
from irlcli.stages.base import Source
from irlcli.store import Artefact, Store, read_json


@overload
def tensor_file(
    store: Store, ref: str, kind: Literal["reward"]
) -> tuple[Source, descriptions.Reward]: ...
@overload
def tensor_file(
    store: Store, ref: str, kind: Literal["policy"]
) -> tuple[Source, descriptions.Policy]: ...
def tensor_file(
    store: Store, ref: str, kind: Literal["reward", "policy"]
) -> tuple[Source, descriptions.Reward | descriptions.Policy]:
    """The ``reward`` or ``policy`` that ``ref`` names, and its description.

    A reference to a whole artefact means its file of that kind.

    Raises:
        NotFound: ``ref`` names nothing.
        UsageError: an artefact without such a file, or a tensor file of the other kind.
        IntegrityError: damaged, foreign or hostile.
    """
    resolved = store.resolve(ref)
    artefact = resolved.artefact
    if artefact is None:
        from irlcli.data.tensors import load

        path = resolved.path / f"{kind}.pt" if resolved.path.is_dir() else resolved.path
        if not path.exists():
            raise NotFound(
                f"{ref!r} is neither an artefact nor a directory with {kind}.pt",
                f"name an artefact or a {kind} file; {store.listing}",
            )
        description, _ = load(path, kind)
        return foreign_source(path), description
    introduce(artefact)
    if artefact.manifest.record.stage == "train-maxent":
        raise UsageError(
            f"{ref!r} is a reward of MaxEnt IRL, a table over the cells of a gridworld",
            f"name a {kind} of `irl train-airl`; the quality.json of this one rates it",
        )
    if artefact.manifest.record.stage == "clone" and kind == "reward":
        raise UsageError(
            f"{ref!r} is a behavioural clone, which learned no reward",
            f"`{shlex.join(['irl', 'evaluate', '--policy', ref, *store.option])}` measures its policy",
        )
    output = resolved.output or _required(artefact, f"{kind}.pt")
    if output != f"{kind}.pt":
        holds = any(o.path == f"{kind}.pt" for o in artefact.manifest.outputs)
        raise UsageError(
            f"{ref!r} is {output}, not a {kind}",
            f"name {artefact.id}/{kind}.pt or the artefact"
            if holds
            else f"its artefact holds no {kind}; {store.listing}",
        )
    source = source_in(artefact, output)
    path = store.open(artefact, _required(artefact, f"{kind}.json"))
    if kind == "reward":
        return source, descriptions.parse(read_json(path), descriptions.Reward, path)
    return source, descriptions.parse(read_json(path), descriptions.Policy, path)


def expert(store: Store, env: str, setting: Setting, ref: str) -> Source:
    """The expert of ``setting`` that the user names. It is not loaded.

    It is a ``.zip`` of stable-baselines3 or a policy of irl.

    Raises:
        NotFound: ``ref`` names nothing.
        UsageError: not a policy, one of another environment, or one of other observations.
        IntegrityError: a damaged policy.
    """
    if ref.endswith(".zip"):
        path = Path(ref)
        if not path.is_file():
            raise NotFound(f"there is no file {ref}", "name a file that model.save() wrote")
        return foreign_source(path)
    source, about = tensor_file(store, ref, "policy")
    if about.env != env:
        raise UsageError(
            f"{ref!r} is a policy of {about.env}, not of {env}",
            "name an expert of this environment",
        )
    # Experts act without the cue, students that were trained with it take it.
    takes_cue = any(cue_in(env, parse_setting(env, text)) for text in about.settings)
    check_observed(env, about.settings, [setting if takes_cue else without_cue(env, setting)])
    return source


def normaliser(name: str) -> Source:
    """The statistics of an expert that was trained under VecNormalize. They are not loaded.

    Raises:
        NotFound: no such file.
    """
    if not Path(name).is_file():
        raise NotFound(f"there is no file {name}", "name a file that VecNormalize.save wrote")
    return foreign_source(Path(name))


def student_beside(store: Store, reward: Source, origin: descriptions.Reward) -> Source:
    """The ``policy.pt`` of the student that was trained while ``reward`` was learned.

    Raises:
        NotFound: there is none beside the reward's file, or that of another reward.
        UsageError: the reward's artefact has none.
    """
    if reward.artefact is not None:
        return source_in(reward.artefact, _required(reward.artefact, "policy.pt"))
    student = reward.path.parent / "policy.pt"
    if not student.is_file():
        raise NotFound(
            f"there is no student beside {reward.path}", f"--start student needs {student}"
        )
    source, about = tensor_file(store, str(student), "policy")
    own = about.agent, about.env, about.method, about.seed, about.settings
    if own != ("student", origin.env, origin.method, origin.seed, origin.settings):
        raise NotFound(
            f"{student} is not the student of the reward beside it",
            "put the policy.pt of the same irl train-airl there",
        )
    return source


def reward_behind(store: Store, policy: Source) -> tuple[Source, descriptions.Reward] | None:
    """The reward that a stored ``policy`` was trained on, and its description.

    None for an expert, for a policy outside the store, and where the store does not hold it.
    """
    if policy.artefact is None:
        return None
    record = policy.artefact.manifest.record
    if record.stage == "train-airl":
        maker = policy.artefact
    else:
        makers = store.index().holders(record.inputs.get("reward", ""))
        if not makers:
            return None
        maker = makers[0]
    if "reward.pt" not in [output.path for output in maker.manifest.outputs]:
        return None
    return tensor_file(store, str(maker.directory / "reward.pt"), "reward")


def demonstrations(store: Store, ref: str) -> tuple[Source, str, list[str]]:
    """The dataset that ``ref`` names, its environment and its settings.

    Raises:
        NotFound: ``ref`` names nothing.
        UsageError: anything other than demonstrations.
        IntegrityError: damaged or foreign.
    """
    resolved = store.resolve(ref)
    artefact = resolved.artefact
    if artefact is None:
        from irlcli.data.demonstrations import EPISODES, STEPS, read_demonstrations

        if not any((Path(ref) / name).exists() for name in (EPISODES, STEPS)):
            hint = f"name an artefact, or a directory of demonstrations; {store.listing}"
            if Path(ref).is_file():
                words = ["irl", "import", ref, "--env", "ENV", "--intervention", "KNOB=VALUE"]
                line = shlex.join([*words, *store.option])
                hint = f"`{line}` turns a recording into demonstrations"
            raise NotFound(f"{ref!r} is neither an artefact nor a directory with {EPISODES}", hint)
        demos = read_demonstrations(Path(ref))
        return foreign_source(resolved.path), demos.env, list(demos.trajectories)
    introduce(artefact)
    record = artefact.manifest.record
    if record.stage not in ("collect-experts", "import") or resolved.output is not None:
        what = resolved.output or f"an artefact of {record.stage}"
        raise UsageError(
            f"{ref!r} is {what}, not a dataset of demonstrations",
            "name an artefact of `irl collect-experts` or `irl import`",
        )
    about = descriptions.parse(record.parameters, descriptions.Dataset, artefact.directory)
    return source_in(artefact, None), about.env, list(about.settings)


def evaluation(store: Store, ref: str) -> tuple[Artefact, descriptions.Evaluation]:
    """The evaluation that ``ref`` names, and its summary.

    Raises:
        NotFound: ``ref`` names nothing.
        UsageError: not an evaluation.
        IntegrityError: damaged.
    """
    artefact = store.resolve(ref).artefact
    if artefact is None or artefact.manifest.record.stage != "evaluate":
        found = (
            "a path outside the store"
            if artefact is None
            else f"an artefact of {artefact.manifest.record.stage}"
        )
        raise UsageError(
            f"{ref!r} is not an evaluation: it is {found}",
            "name the id that `irl evaluate` printed, or the name that `irl evaluate --name` gave",
        )
    return artefact, summary(store, artefact)


def summary(store: Store, artefact: Artefact) -> descriptions.Evaluation:
    """The summary of an evaluation.

    Raises:
        UsageError: an artefact without a summary, or of an older version of the stage.
        IntegrityError: damaged, or of a newer version.
    """
    introduce(artefact)
    version, known = artefact.manifest.record.stage_version, evaluate.STAGE.version
    # Older ones averaged over episodes that an error had stopped, and did not say so.
    if version != known:
        message = (
            f"evaluation {artefact.id} was made by version {version} of the stage evaluate, and this "
            f"irlcli reads version {known}"
        )
        if version > known:
            raise IntegrityError(message, "a newer irlcli wrote it: upgrade irlcli to read it")
        show = shlex.join(["irl", "show", artefact.id, *store.option])
        raise UsageError(message, f"run its command again: `{show}` prints it")
    path = store.open(artefact, _required(artefact, "summary.json"))
    return descriptions.parse(read_json(path), descriptions.Evaluation, path)


def output(
    store: Store, artefact: Artefact, name: str, form: type[descriptions.AnyForm]
) -> descriptions.AnyForm:
    """The JSON output ``name`` of ``artefact`` as a ``form``.

    Raises:
        UsageError: the artefact has no such output.
        IntegrityError: damaged, or not a ``form``.
    """
    path = store.open(artefact, _required(artefact, name))
    return descriptions.convert(read_json(path), form, path)


def _required(artefact: Artefact, name: str) -> str:
    names = [o.path for o in artefact.manifest.outputs]
    if name not in names:
        makers = {
            "reward.pt": "`irl train-airl`",
            "policy.pt": "`irl train-airl` or `irl transfer`, or an expert",
        }
        wanted = f"name an artefact of {makers[name]}; " if name in makers else ""
        raise UsageError(
            f"artefact {artefact.id} ({artefact.manifest.record.stage}) holds no {name}",
            f"{wanted}this one holds: {', '.join(names)}",
        )
    return name

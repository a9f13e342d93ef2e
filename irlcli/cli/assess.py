"""``irl assess``."""

from typing import Annotated, Any

import typer

from irlcli.cli import console as out
from irlcli.cli.options import EachSetting, Env, Name, Seed, stage_command
from irlcli.cli.session import StageSession
from irlcli.data.descriptions import Assessed, Assessment, Interval, Measured, RegretSplit
from irlcli.experiments import references
from irlcli.requests import assess as requested
from irlcli.store import Artefact


@stage_command
def assess(
    session: StageSession,
    reward: Annotated[str, typer.Argument(help="Learned reward: reward.pt or its artefact.")],
    ood: Annotated[
        str | None,
        typer.Option(help="Settings: VALUE,... of the reward's knob, KNOB=VALUE,... or KNOB."),
    ] = None,
    intervention: Annotated[
        str | None,
        typer.Option(
            help="Settings: KNOB=VALUE,..., or KNOB (training values). Default: those in which the "
            "reward was learned."
        ),
    ] = None,
    setting: EachSetting = [],  # noqa: B006
    demos: Annotated[
        str | None,
        typer.Option(
            help="Demonstrations to clone for the noisy policies. Default: the reward's own."
        ),
    ] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes of each policy.")] = None,
    env: Env = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Measure how well a learned reward ranks policies of mixed quality."""
    request, retrain = requested.assess(
        session,
        reward=reward,
        ood=ood,
        intervention=intervention,
        setting=setting,
        demos=demos,
        episodes=episodes,
        env=env,
        seed=seed,
    )

    def found(artefact: Artefact) -> Assessment:
        return references.output(session.store, artefact, "assessment.json", Assessment)

    import msgspec

    artefacts = session.deliver(
        [request], name, lambda artefact: {"assessment": msgspec.to_builtins(found(artefact))}
    )
    if artefacts and not session.as_json:
        print_assessment(found(artefacts[0]))
        if retrain is not None:
            places = ", ".join(dict.fromkeys(entry.setting for entry in request.parameters.bank))
            out.print_note(
                f"No policy was retrained on this reward in {places}: `{retrain}` does it"
            )


def print_assessment(assessment: Assessment) -> None:
    """The bank, the correlations and the regret splits, as tables on stderr."""
    rows = [
        [e.setting, e.policy, _measured(e.true), out.number(e.progress), _measured(e.learned)]
        for s in assessment.settings
        for e in sorted(assessment.bank, key=lambda e: e.true.mean)
        if e.setting == s.setting
    ]
    columns = ["setting", "policy", "true return", "progress", "learned return"]
    out.print_table(columns, rows, stderr=True, optional=("progress",))
    out.print_note(
        "±: standard error over episodes; [low, high]: 95 % interval"
        + ("; learned returns above are without the ceiling" if _bounded(assessment) else "")
        + ("; in all settings a policy counts once for each" if assessment.pooled else "")
    )
    if assessment.left_out:
        out.print_note(
            f"{assessment.left_out} episodes of each policy are left out: an error stopped them for one of "
            "the policies"
        )
    ranked = ["policies", "Spearman", "Pearson"]
    columns = ["setting", *ranked, *(f"{name}, lower half" for name in ranked)]
    columns += ["expert - idle", "return distance", "EPIC"]
    every = [*assessment.settings, *([assessment.pooled] if assessment.pooled else [])]
    out.print_table(columns, [_ranked(s) for s in every], stderr=True)
    if assessment.epic_missing:
        out.print_note(f"no EPIC distance: {assessment.epic_missing}")
    for setting, agent in assessment.weak_experts:
        consequence = ", so there is no verdict" if agent == "random" else ""
        out.print_note(f"{setting}: the expert earns no more than the {agent} agent{consequence}")
    splits: list[list[Any]] = [
        [
            s.setting,
            r.policy,
            _measured(r.true_regret),
            _measured(r.learned_gap),
            "-" if r.discounted_gap is None else _measured(r.discounted_gap),
            _verdict(r),
            "-" if r.ceiling is None else f"{r.ceiling:g}",
        ]
        for s in assessment.settings
        for r in s.retrained
    ]
    if splits:
        columns = [
            "setting",
            "retrained policy",
            "true regret",
            "learned gap",
            "discounted gap",
            "verdict",
            "ceiling",
        ]
        out.print_table(columns, splits, stderr=True)


def _bounded(assessment: Assessment) -> bool:
    return any(r.ceiling is not None for s in assessment.settings for r in s.retrained)


def _verdict(of: RegretSplit) -> str:
    if of.verdict is None:
        return "-"
    return of.verdict if of.clear else f"{of.verdict}, uncertain"


def _ranked(found: Assessed) -> list[str]:
    cells = [found.setting or "all"]
    for part in (found.overall, found.lower_half):
        cells += [str(part.policies), _interval(part.spearman), _interval(part.pearson)]
    gap = found.expert_minus_idle
    cells.append("-" if gap is None else _measured(gap, 3))
    return [*cells, out.number(found.return_distance, 2), out.number(found.epic, 2)]


def _interval(found: Interval | None) -> str:
    if found is None:
        return "-"
    if found.low is None or found.high is None:
        return f"{found.value:.2f}"
    return f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]"


def _measured(found: Measured, digits: int = 1) -> str:
    error = "" if found.error is None else f" ± {found.error:.{digits}f}"
    return f"{found.mean:.{digits}f}{error}"

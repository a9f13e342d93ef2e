"""Returns of policies trained on the frozen rewards: by training setting, and from the student.

Points are those of :mod:`irlcli.report.compute`.
"""

from __future__ import annotations

import pandas as pd

from irlcli.report.compute import points_of, whole_sample, whole_seeds
from irlcli.report.parameters import Parameters
from irlcli.report.statistics import paired_p, summarise


def by_training_setting(p: Parameters, points: pd.DataFrame) -> pd.DataFrame:
    """Policies retrained in each training setting, a row per row, setting and method.

    Columns: ``row``, ``setting``, ``agent``, ``seeds``; ``mean`` and ``deviation`` (n - 1) of the
    true return over seeds that have all their retrainings there, each the mean of them;
    ``progress``, its mean; ``expert``, the return of that setting's own expert; ``of_expert``, the
    mean over it, None unless the expert's is positive.
    """
    columns = ["row", "setting", "agent", "seeds", "mean", "deviation", "progress"]
    columns += ["expert", "of_expert"]
    found = []
    whole = whole_seeds(p, points)
    for row in p.rows if "transfer-id" in p.measures else ():
        experts = points_of(points, row.name, "expert", "id").set_index("setting")["true_return"]
        for setting in row.trained:
            expert = experts.get(setting)
            for method in p.methods:
                of = points_of(whole, row.name, method, "transfer-id")
                by_seed = of[of["setting"] == setting].groupby("seed")
                means = by_seed[["true_return", "progress"]].mean()
                if means.empty:
                    continue
                s = summarise(means["true_return"].tolist())
                progress = means["progress"].mean()
                share = s.mean / expert if expert is not None and expert > 0 else None
                found.append(
                    (row.name, setting, method, s.n, s.mean, s.deviation, progress, expert, share)
                )
    return pd.DataFrame(found, columns=columns)


def against_zero_shot(p: Parameters, points: pd.DataFrame) -> pd.DataFrame:
    """Whether retraining from the student improves on it, a row per row and method.

    Columns: ``row``, ``agent``; ``pairs``, seeds that have both returns; ``zero_shot`` and
    ``from_student``, their mean true returns; ``difference``; ``better``, seeds in which
    retraining earned more; ``p_paired``, two-sided p of the paired t-test.
    """
    columns = ["row", "agent", "pairs", "zero_shot", "from_student", "difference", "better"]
    columns += ["p_paired"]
    found = []
    for row in p.rows if {"from-student", "zero-shot"} <= set(p.measures) else ():
        for method in p.methods:
            before, after = (
                whole_sample(p, points, row.name, method, measure)["true_return"]
                for measure in ("zero-shot", "from-student")
            )
            common = before.index.intersection(after.index)
            if not len(common):
                continue
            gain = after[common] - before[common]
            paired = paired_p(after[common].tolist(), before[common].tolist())
            means = float(before[common].mean()), float(after[common].mean()), float(gain.mean())
            found.append((row.name, method, len(common), *means, int((gain > 0).sum()), paired))
    return pd.DataFrame(found, columns=columns)


def paired_errors(policy: pd.DataFrame, expert: pd.DataFrame) -> dict[tuple[str, str], float]:
    """Standard errors of a retrained policy's mean differences to the expert, by setting and return.

    The differences are of episodes from the same start state. Where an error stopped one, the means
    are of other episodes than the pairs: such a setting has no standard error.

    Args:
        policy, expert: ``episodes.parquet`` of an evaluation each.
    """
    frames = [frame.set_index(["setting", "episode", "seed"]) for frame in (policy, expert)]
    errors = pd.concat([frame["error"] for frame in frames])
    stopped = errors[errors != ""].index.unique("setting")
    kinds = [
        kind for kind in ("true_return", "learned_return") if all(kind in frame for frame in frames)
    ]
    of_policy, of_expert = (frame[kinds].drop(stopped, level="setting") for frame in frames)
    # An episode that only one of them has is undefined, and sem() omits it.
    return (of_expert - of_policy).groupby("setting").sem().stack().to_dict()

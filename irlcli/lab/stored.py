"""What the methods of :class:`irlcli.Lab` return."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from irlcli import labels
from irlcli.data.descriptions import Assessment
from irlcli.envs import registry
from irlcli.errors import UsageError
from irlcli.experiments import references
from irlcli.report.returns import as_json
from irlcli.requests.evaluate import measured
from irlcli.requests.session import Session
from irlcli.store import Artefact, read_json

if TYPE_CHECKING:
    import pandas as pd


# Where a stage has several, the first is what it is run for.
_TABLES = ("quality.json", "summary.json", "metrics.parquet")


class Stored:
    """An artefact. Every method of :class:`irlcli.Lab` takes it where the command line takes a reference.

    Attributes:
        id: its id.
        path: its directory, with the outputs of its stage.
        stage: the stage that made it.
    """

    def __init__(self, session: Session, artefact: Artefact):
        self._session = session
        self._artefact = artefact
        self.id: str = artefact.id
        self.path: Path = artefact.directory
        self.stage: str = artefact.manifest.record.stage

    def __fspath__(self) -> str:
        return str(self.path)

    def __repr__(self) -> str:
        return f"<{self.stage} {self.path}: {labels.describe(self._artefact.manifest.record)}>"

    @property
    def parameters(self) -> dict[str, Any]:
        """The resolved parameters of its stage, all that its key holds besides its inputs."""
        return dict(self._artefact.manifest.record.parameters)

    def output(self, name: str) -> Path:
        """The path of an output, after its bytes were checked.

        Raises:
            NotFound: there is no such output.
            IntegrityError: it is damaged.
        """
        return self._session.store.open(self._artefact, name)

    def to_pandas(self, output: str | None = None) -> pd.DataFrame:
        """The table that the stage leaves, or another one of its ``.parquet`` outputs.

        A row per setting of demonstrations or of a recording (``summary.json``) and of a MaxEnt reward
        (``quality.json``), per agent and setting of an evaluation (``seed`` is that of the reward
        learning), per policy and setting of an assessment, and per round and setting of any other
        training (``metrics.parquet``).

        Raises:
            UsageError: it leaves none, or ``output`` is not in Parquet.
            NotFound: there is no such output.
            IntegrityError: it is damaged.
        """
        with registry.apart():
            return self._table(output)

    def _table(self, output: str | None) -> pd.DataFrame:
        import pandas as pd

        store, artefact = self._session.store, self._artefact
        if output is None and self.stage == "evaluate":
            run = measured(self._session, artefact)
            policy = run[0].policy
            return pd.DataFrame(as_json([run])).assign(
                method=policy.method, seed=policy.learning_seed
            )
        if output is None and self.stage == "assess":
            found = references.output(store, artefact, "assessment.json", Assessment)
            return pd.DataFrame(_bank(found))
        names = [output.path for output in artefact.manifest.outputs]
        if output is None:
            output = next((name for name in _TABLES if name in names), "")
        if output.endswith(".parquet"):
            return pd.read_parquet(self.output(output))
        if output in _TABLES:
            document = read_json(self.output(output))
            # A recording is of one setting.
            rows = pd.DataFrame(document.get("settings", [document]))
            return rows[["setting", *rows.columns.drop("setting")]]
        raise UsageError(
            f"{self.id} ({self.stage}) has no table {output}".rstrip(),
            f"its outputs: {', '.join(names)}; .output(NAME) is the path of one",
        )


def _bank(assessment: Assessment) -> list[dict[str, Any]]:
    """Mean returns of each policy in each setting, with standard errors, and the verdict on it.

    ``clear`` is False for a verdict that is uncertain.
    """
    splits = {(s.setting, r.policy): r for s in assessment.settings for r in s.retrained}
    rows = []
    for entry in assessment.bank:
        split = splits.get((entry.setting, entry.policy))
        rows.append(
            {
                "setting": entry.setting,
                "policy": entry.policy,
                "kind": entry.kind,
                "true": entry.true.mean,
                "true_error": entry.true.error,
                "learned": entry.learned.mean,
                "learned_error": entry.learned.error,
                "progress": entry.progress,
                "verdict": split and split.verdict,
                "clear": split.clear if split and split.verdict else None,
            }
        )
    return rows


class Evaluations(Sequence[Stored]):
    """Evaluations of one agent, or of the expert of each setting."""

    def __init__(self, evaluations: Sequence[Stored]):
        self._evaluations = list(evaluations)

    def __len__(self) -> int:
        return len(self._evaluations)

    def __getitem__(self, index: Any) -> Any:
        return self._evaluations[index]

    def __repr__(self) -> str:
        return "\n".join(map(repr, self._evaluations))

    @property
    def id(self) -> str:
        """The id of the only one."""
        return self._only().id

    @property
    def path(self) -> Path:
        """The directory of the only one."""
        return self._only().path

    def to_pandas(self) -> pd.DataFrame:
        """A row for each agent and setting: true returns over seeds, and the learned return."""
        import pandas as pd

        return pd.concat([one.to_pandas() for one in self._evaluations], ignore_index=True)

    def _only(self) -> Stored:
        if len(self) != 1:
            raise UsageError(
                f"these are {len(self)} evaluations, one for each expert", "choose one: [0]"
            )
        return self._evaluations[0]


class PlannedTable:
    """The steps of a table, and what the store holds of each.

    Attributes:
        table: its name.
        counts: how many steps have each status: HIT, FOUND, RUN, RESUME or BLOCKED.
        steps: for each step its name, key, status, request, why, needs and other_versions, as
            ``irl plan --json`` prints them.
    """

    def __init__(self, table: str, steps: Sequence[dict[str, Any]]):
        self.table = table
        self.steps = list(steps)
        self.counts = dict(Counter(step["status"] for step in self.steps))

    def __repr__(self) -> str:
        parts = [f"{count} {status}" for status, count in self.counts.items()]
        return f"<{self.table}, {len(self.steps)} steps: {', '.join(parts)}>"

    def to_pandas(self) -> pd.DataFrame:
        """A row for each step."""
        import pandas as pd

        return pd.DataFrame(self.steps)

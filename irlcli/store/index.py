"""Which artefacts were made from which, from all manifests read once."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from irlcli.store.artefact import Artefact


class Index:
    """The artefacts of a store at one moment, by id.

    Args:
        artefacts: artefacts with sound manifests, by id.
        newer: manifests of a newer schema, as bytes, by id.
        damaged: ids of artefacts whose manifests are damaged, in a store that is only read.
    """

    def __init__(
        self,
        artefacts: Mapping[str, Artefact],
        newer: Mapping[str, bytes],
        damaged: Sequence[str] = (),
    ):
        self.artefacts = dict(artefacts)
        self.newer = dict(newer)
        self.damaged = tuple(damaged)

    @cached_property
    def _holders(self) -> dict[str, list[str]]:
        """The ids of the artefacts with an output, or all outputs together, of each content."""
        found: dict[str, list[str]] = {}
        for artefact in self.artefacts.values():
            contents = {o.sha256 for o in artefact.manifest.outputs} | {artefact.manifest.content}
            for sha in contents:
                found.setdefault(sha, []).append(artefact.id)
        return found

    def parents(self, artefact: Artefact) -> dict[str, list[Artefact]]:
        """For each input role of ``artefact``, the artefacts with that content."""
        return {role: self.holders(sha) for role, sha in artefact.manifest.record.inputs.items()}

    def orphaned(self, artefact: Artefact) -> list[str]:
        """The input roles of ``artefact`` whose content no artefact has."""
        return [role for role, holders in self.parents(artefact).items() if not holders]

    def holders(self, sha: str) -> list[Artefact]:
        """The artefacts with an output, or all outputs together, of the content ``sha``."""
        return [self.artefacts[id16] for id16 in self._holders.get(sha, [])]

    def reached_from(self, ids: Iterable[str]) -> set[str]:
        """The ids of all that must be kept with ``ids``.

        Those of ``ids`` that exist, what the manifests of a newer schema mention, and all their
        ancestors.
        """
        reached: set[str] = set()
        pending = [id16 for id16 in ids if id16 in self.artefacts]
        for manifest in self.newer.values():
            # The schema is unknown, but content is named by sha256: keep whatever is mentioned.
            for sha in re.findall(rb"[0-9a-f]{64}", manifest):
                pending += self._holders.get(sha.decode(), [])
        while pending:
            id16 = pending.pop()
            if id16 not in reached:
                reached.add(id16)
                for sha in self.artefacts[id16].manifest.record.inputs.values():
                    pending += self._holders.get(sha, [])
        return reached

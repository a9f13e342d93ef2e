"""``irl ls``, ``show``, ``lineage``, ``name`` and ``unname``: what is stored."""

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from irlcli import labels
from irlcli.cli import console as out
from irlcli.cli.options import Ref, store_command
from irlcli.cli.session import Session
from irlcli.errors import IntegrityError, suggest
from irlcli.store import Artefact, Index, Store
from irlcli.store.artefact import stored_inputs

if TYPE_CHECKING:
    from irlcli.store.remote import Remote


@store_command
def ls(
    session: Session,
    stage: Annotated[str | None, typer.Option(help="Only artefacts of this stage.")] = None,
    source: Annotated[
        str | None,
        typer.Option("--from", help="List those of another store: a directory or a URL."),
    ] = None,
) -> None:
    """List the artefacts."""
    store: Store | Remote = session.store
    if source is None:
        session.check_exists()
    else:
        from irlcli.store.sources import open_sources

        (store,) = open_sources([source], session.console.warn)
    names: dict[str, list[str]] = {}
    for name, id16 in store.names().items():
        names.setdefault(id16, []).append(name)
    damage: list[IntegrityError] = []
    if isinstance(store, Store):
        for name in store.damaged_names():
            session.console.warn(f"the name {name!r} is damaged; `irl verify` says how to mend it")
        index = store.index(damage.append)
    else:
        index = store.index()
    for error in damage[:-1]:
        session.console.warn(f"{error.message}; {error.hint}")
    if damage and session.as_json:
        raise damage[-1]
    if source is None:
        ids = {*index.artefacts, *index.newer}
        lost = [name for id16 in names.keys() - ids for name in names[id16]]
        if lost:
            session.console.warn(
                f"names of missing artefacts: {', '.join(sorted(lost))}; `irl verify` says more"
            )
    stored = list(index.artefacts.values())
    makers = labels.makers(artefact.manifest for artefact in stored)
    found: list[dict[str, Any]] = [
        {
            "id": artefact.id,
            "stage": record.stage,
            "names": names.get(artefact.id, []),
            "about": labels.describe(record) + labels.origin(record, makers),
            "budget": labels.budget(record.parameters),
            "bytes": artefact.manifest.size,
        }
        for artefact in stored
        if stage in (None, (record := artefact.manifest.record).stage)
    ]
    found.sort(key=lambda item: (item["stage"], item["about"], item["id"]))
    if stage is not None and not found:
        known = {artefact.manifest.record.stage for artefact in stored}
        there = suggest(stage, known) if known else f"{store.root} holds none"
        session.console.warn(f"no artefact is of stage {stage!r}; {there}")
    if session.as_json:
        out.print_json("artefacts", {"artefacts": found, "newer": sorted(index.newer)})
        return
    rows = [[f["id"], f["stage"], f["about"], f["budget"], ", ".join(f["names"])] for f in found]
    if rows:
        out.print_table(["id", "stage", "about", "budget", "names"], rows)
    if damage:
        raise damage[-1]


@store_command
def show(session: Session, ref: Ref) -> None:
    """Show an artefact: its stage, parameters, inputs and outputs."""
    from irlcli.experiments import provenance

    artefact = session.artefact(ref)
    record, origin = artefact.manifest.record, artefact.provenance()
    value = {
        "id": artefact.id,
        "path": str(artefact.directory),
        "key": record.key,
        **record.as_json(),
        "outputs": {
            output.path: {"size": output.size, "sha256": output.sha256}
            for output in artefact.manifest.outputs
        },
        "provenance": origin,
        "other_versions": provenance.other_versions(origin),
    }
    if session.as_json:
        out.print_json("shown", value)
    else:
        out.print_data(json.dumps(value, indent=2))


@store_command
def lineage(session: Session, ref: Ref) -> None:
    """Show every artefact that an artefact was made from."""
    artefact = session.artefact(ref)
    tree = _tree(session.store.index(), artefact, ())
    if session.as_json:
        out.print_json("lineage", tree)
        return
    for line in _lines(tree, ""):
        out.print_data(line)


def _tree(index: Index, artefact: Artefact, descendants: tuple[str, ...]) -> dict[str, Any]:
    record = artefact.manifest.record
    descendants = (*descendants, artefact.id)
    inputs = []
    provenance = artefact.provenance()
    for role, sources in index.parents(artefact).items():
        # Inputs are known by content. Several artefacts may hold it: the recorded one comes first, and
        # a descendant is no ancestor.
        recorded = stored_inputs(provenance, [role])
        others = [source for source in sources if source.id not in descendants]
        source = min(others, key=lambda s: s.id not in recorded, default=None)
        origin = _tree(index, source, descendants) if source is not None else None
        lost = next(iter(recorded), None) if origin is None else None
        found = {"role": role, "sha256": record.inputs[role], "missing": lost, "from": origin}
        inputs.append(found)
    return {
        "id": artefact.id,
        "stage": record.stage,
        "about": labels.describe(record),
        "budget": labels.budget(record.parameters),
        "inputs": inputs,
    }


def _lines(node: dict[str, Any], indent: str) -> list[str]:
    text = "  ".join(node[field] for field in ("id", "stage", "about", "budget") if node[field])
    lines = [f"{indent}{text}"]
    for item in node["inputs"]:
        if item["missing"] is not None:
            lines.append(f"{indent}  {item['missing']}  not in this store; `irl verify` says more")
        elif item["from"] is None:
            sha = item["sha256"][:16]
            lines.append(f"{indent}  a file that is not in this store, sha256 {sha}...")
        else:
            lines += _lines(item["from"], indent + "  ")
    return lines


@store_command
def name(
    session: Session,
    ref: Ref,
    name: Annotated[str, typer.Argument(help="The name.")],
) -> None:
    """Name an artefact, which also protects it from gc."""
    artefact = session.artefact(ref)
    session.store.set_name(name, artefact)
    if session.as_json:
        out.print_json("name", {"name": name, "id": artefact.id})
    else:
        out.print_data(str(artefact.directory))


@store_command
def unname(
    session: Session,
    names: Annotated[list[str], typer.Argument(help="Names, or patterns: 'trial.*'.")],
) -> None:
    """Remove names, so that gc may remove what they protected."""
    session.check_exists()
    removed = session.store.remove_names(names)
    if session.as_json:
        out.print_json("unname", {"names": removed})
        return
    for name in removed:
        out.print_data(name)

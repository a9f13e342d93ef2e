"""A published artefact: its directory, its manifest, and checks that change nothing."""

import os
import shlex
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from irlcli.errors import IntegrityError, NotFound, suggest
from irlcli.store.digest import file_digest
from irlcli.store.layout import ID_DIGITS, Layout, is_id
from irlcli.store.manifest import (
    MANIFEST,
    PROVENANCE,
    Manifest,
    Output,
    read_json,
    read_manifest,
    read_provenance,
)


class Artefact(NamedTuple):
    """A published artefact: its directory and its manifest."""

    directory: Path
    manifest: Manifest

    @property
    def id(self) -> str:
        """The first 16 hexadecimal digits of the id, which name the directory."""
        return self.directory.name

    def output(self, path: str) -> Output:
        """The output at ``path``.

        Raises:
            NotFound: the artefact has no such output.
        """
        for output in self.manifest.outputs:
            if output.path == path:
                return output
        names = [o.path for o in self.manifest.outputs]
        raise NotFound(f"artefact {self.id} has no output {path!r}", suggest(path, names))

    def provenance(self) -> dict[str, Any]:
        """How it was made: command line, versions, timings.

        Raises:
            IntegrityError: altered or unreadable.
        """
        try:
            return read_provenance(self.directory, self.manifest.id)
        except IntegrityError as error:
            line = shlex.join(["irl", "verify", self.id, "--store", str(self.directory.parent)])
            hint = f"its outputs may be sound; `{line}` moves it to quarantine; then "
            again = repair_hint(self.directory, Layout(self.directory.parent))
            raise IntegrityError(error.message, hint + again) from None


class Published(NamedTuple):
    """A published artefact; ``diverged`` is the different one that holds its key, if any."""

    artefact: Artefact
    diverged: Artefact | None = None


def read_artefact(directory: Path) -> Artefact:
    """The artefact in ``directory``, its manifest checked against the directory's name.

    Raises:
        IntegrityError: the manifest is missing or damaged, or belongs to another artefact.
        NewerFormat: the manifest has a newer schema.
    """
    manifest = read_manifest(directory)
    if manifest.id[:ID_DIGITS] != directory.name:
        raise IntegrityError(f"{directory / MANIFEST} does not match its directory's name")
    return Artefact(directory, manifest)


def output_problem(directory: Path, output: Output, quick: bool = False) -> str | None:
    """Why a file is not the published output; None if it is. ``quick`` compares sizes only."""
    path = f"{directory}/{output.path}"
    try:
        information = os.lstat(path)
        if not stat.S_ISREG(information.st_mode):
            return f"{path} is not a plain file"
        way = path
        while way != str(directory):
            way = way.rpartition("/")[0]
            if os.path.islink(way):
                return f"{path} is reached through a symbolic link"
        if information.st_size != output.size:
            return f"{path} has {information.st_size} bytes instead of {output.size}"
        if not quick and file_digest(path) != output.sha256:
            return f"{path} is not the file that was stored: its sha256 differs"
    except OSError as error:
        return f"{path} cannot be read ({error.strerror})"
    return None


def entries(directory: Path | str) -> Iterator[str]:
    """All paths below ``directory`` except plain directories.

    Raises:
        OSError: a directory cannot be listed.
    """
    # No recursion: a hostile artefact may nest deeper than Python's stack.
    directories = [os.fspath(directory)]
    while directories:
        with os.scandir(directories.pop()) as listed:
            for entry in listed:
                if entry.is_dir(follow_symlinks=False):
                    directories.append(entry.path)
                else:
                    yield entry.path


def stored_inputs(provenance: Mapping[str, Any], roles: Iterable[str]) -> list[str]:
    """The ids that the inputs ``roles`` were read from; files outside the store are left out."""
    places = provenance.get("inputs") or {}
    texts = [places.get(role, "").partition("/") for role in roles]
    return [id16 for id16, slash, _ in texts if slash and is_id(id16)]


def repair_hint(directory: Path, layout: Layout) -> str:
    """How to make a damaged artefact again, in the store ``layout``."""
    command = recorded_command(directory, layout)
    if not command:
        return "run the command that made it again; the record of this command is lost"
    return f"compute it again: {command}"


def recorded_command(directory: Path, layout: Layout) -> str:
    """The command line that made an artefact, to be repeated in the store ``layout``.

    Without ``--out``: its files lie beside the store, and may be another store's by now. Empty if
    the provenance, which may be damaged, cannot be read.
    """
    kept = []
    try:
        words = iter(read_json(directory / PROVENANCE)["record"]["command"])
        for word in words:
            if word in ("--store", "--out"):
                next(words, None)
            elif not word.startswith(("--store=", "--out=")):
                kept.append(word)
    except (IntegrityError, AttributeError, KeyError, TypeError):
        return ""
    return shlex.join([*kept, *layout.option])

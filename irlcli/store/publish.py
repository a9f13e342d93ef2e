"""Publishing: an artefact appears whole, by one rename, or not at all.

Correctness does not depend on locks. The first result of a key holds it; a second, different
result is kept beside it and reported.
"""

import errno
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

from irlcli.errors import IntegrityError, NewerFormat
from irlcli.store.artefact import Artefact, Published, entries, read_artefact
from irlcli.store.durable import fsync_directory, fsync_file, temporary_file, write_durably
from irlcli.store.integrity import problems, repairing, set_aside
from irlcli.store.layout import ID_DIGITS, Layout, pointer_to
from irlcli.store.manifest import (
    MANIFEST,
    PROVENANCE,
    KeyRecord,
    Manifest,
    directory_outputs,
    encode_provenance,
)
from irlcli.store.read import find, held_by
from irlcli.store.scratch import Scratch


def publish(
    layout: Layout, record: KeyRecord, output: Path, provenance: dict[str, Any]
) -> Published:
    """Turn the directory ``output`` (under ``.work``) into the artefact of ``record``.

    Afterwards ``output`` is gone, and so is the checkpoint of the key.

    Raises:
        OSError: the disk is full or not writable; nothing was published.
        ValueError: the outputs include something other than plain files.
    """
    manifest = Manifest(record, directory_outputs(output))
    published = place_and_claim(
        layout, output, manifest, encode_provenance(manifest.id, provenance)
    )
    Scratch(layout.work / record.key).clear()
    return published


def place_and_claim(
    layout: Layout, output: Path, manifest: Manifest, provenance: bytes
) -> Published:
    """Publish ``output``, whose files are those of ``manifest``.

    The files are made durable and read-only, the manifest is written last, the directory is
    renamed to its id, and the key is claimed by a hard link.
    """
    for item in manifest.outputs:
        fsync_file(output / item.path)
        (output / item.path).chmod(0o444)
    for name, data in ((PROVENANCE, provenance), (MANIFEST, manifest.encode())):
        write_durably(output / name, data)
        (output / name).chmod(0o444)
    for directory in {os.path.dirname(path) for path in entries(output)}:
        fsync_directory(directory)
    artefact = _place(layout, output, manifest)
    holder = claim(layout, artefact)
    return Published(artefact, None if holder.id == artefact.id else holder)


def _place(layout: Layout, output: Path, manifest: Manifest) -> Artefact:
    target = layout.root / manifest.id[:ID_DIGITS]
    while True:
        try:
            output.rename(target)
            target.chmod(0o555)
            break
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        # The same bytes were published before, perhaps by a process killed before its claim.
        if not problems(layout, target.name):
            shutil.rmtree(output)
            break
        with suppress(FileNotFoundError):
            set_aside(layout, target)
    fsync_directory(layout.root)
    return Artefact(target, manifest)


def claim(layout: Layout, artefact: Artefact) -> Artefact:
    """The artefact that holds its key in the end: this one, or an earlier one."""
    key = artefact.manifest.record.key
    pointer = layout.keys / key
    with temporary_file(pointer, pointer_to(artefact.id)) as temporary:
        while True:
            try:
                os.link(temporary, pointer)
                fsync_directory(layout.keys)
                return artefact
            except FileExistsError:
                holder = _holder(layout, key)
                if holder is not None:
                    return holder


def _holder(layout: Layout, key: str) -> Artefact | None:
    """The artefact that holds ``key``; None after removing a claim that points nowhere.

    Raises:
        IntegrityError: the holder is damaged and cannot be moved to quarantine.
    """
    pointer = layout.keys / key
    try:
        holder = find(layout, key)
    except NewerFormat:
        raise
    except IntegrityError:
        # Quarantine removes the claim of a damaged holder.
        if os.path.lexists(pointer):
            raise
        return None
    if holder is not None:
        return holder
    with repairing(layout):
        # Checked again under the lock: another process may have made a valid claim meanwhile, or
        # removed this one, so that a third is making a valid claim now, which needs no lock.
        if os.path.lexists(pointer):
            id16 = held_by(layout, key)
            if id16 is None or read_artefact(layout.root / id16).manifest.record.key != key:
                pointer.unlink(missing_ok=True)
    return None

"""Content-addressed artefacts: digests, manifests, publishing, references, collection."""

from irlcli.store.artefact import Artefact, Published
from irlcli.store.digest import canonical_json, digest, file_digest
from irlcli.store.index import Index
from irlcli.store.layout import DEFAULT_ROOT, store_around
from irlcli.store.manifest import (
    KeyRecord,
    Manifest,
    Output,
    content_digest,
    directory_outputs,
    read_json,
)
from irlcli.store.read import Peek
from irlcli.store.references import Resolved
from irlcli.store.scratch import Scratch
from irlcli.store.store import Store

__all__ = [
    "DEFAULT_ROOT",
    "Artefact",
    "Index",
    "KeyRecord",
    "Manifest",
    "Output",
    "Peek",
    "Published",
    "Resolved",
    "Scratch",
    "Store",
    "canonical_json",
    "content_digest",
    "digest",
    "directory_outputs",
    "file_digest",
    "read_json",
    "store_around",
]

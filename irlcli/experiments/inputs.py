"""An artefact's output, or a foreign file, as a stage's input: known by its digest."""

from pathlib import Path

from irlcli.errors import IntegrityError, UsageError
from irlcli.stages.base import Source
from irlcli.store import Artefact, Store, content_digest, directory_outputs, file_digest


def source_in(artefact: Artefact, output: str | None) -> Source:
    """An output of ``artefact`` as a stage's input; without ``output``, all of it.

    Raises:
        NotFound: the artefact has no such output.
    """
    if output is None:
        return Source(artefact.directory, artefact.manifest.content, artefact)
    return Source(artefact.directory / output, artefact.output(output).sha256, artefact)


def checked(store: Store, source: Source) -> Path:
    """Where ``source`` lies, after its bytes were compared with the digests that a key holds.

    Raises:
        IntegrityError: the bytes differ.
    """
    artefact = source.artefact
    if artefact is None:
        # It was hashed when the run was planned, which may be hours ago.
        if foreign_source(source.path).sha256 != source.sha256:
            raise IntegrityError(
                f"{source.path} changed after this run was planned", "run the same command again"
            )
        return source.path
    if source.path != artefact.directory:
        return store.open(artefact, source.path.relative_to(artefact.directory).as_posix())
    for output in artefact.manifest.outputs:
        store.open(artefact, output.path)
    return source.path


def foreign_source(path: Path) -> Source:
    """A file or a directory outside the store as a stage's input.

    Raises:
        UsageError: a directory without files, or a path that cannot be read.
        IntegrityError: a directory that holds links, pipes or names that no output can have.
    """
    try:
        if path.is_file():
            return Source(path, file_digest(path))
        outputs = directory_outputs(path)
        if not outputs:
            raise UsageError(f"{path} holds no files", "name a file or an artefact")
        return Source(path, content_digest(outputs))
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read ({error.strerror})", "name a file or an artefact"
        ) from None
    except ValueError as error:
        raise IntegrityError(
            f"{path}: {error}", "name a directory of plain files, or an artefact"
        ) from None

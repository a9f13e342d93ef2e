"""The working directory of a running stage, from which a killed run resumes."""

import hashlib
import stat
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from irlcli.store.durable import remove, remove_leftovers, unique_name, write_durably

CHECKPOINT = "checkpoint"
# Beside it: the contents of the run's inputs, which gc keeps as long as the run can be resumed.
INPUTS = "inputs"
# Most have some tens of MB, but SAC's replay may have 4 million transitions of 3 KB.
_MAX_BYTES = 16 << 30


class Scratch:
    """The working directory of one key: a checkpoint, and one output directory per attempt.

    The directory is created on first use.

    Attributes:
        directory: its path.
        inputs: the sha256 of each input of the run.
    """

    def __init__(self, directory: Path):
        self.directory = directory
        self.inputs: Sequence[str] = ()

    def save(self, data: bytes) -> None:
        """Replace the checkpoint with ``data``."""
        self.directory.mkdir(exist_ok=True)
        if self.inputs and not (self.directory / INPUTS).exists():
            write_durably(self.directory / INPUTS, "\n".join(self.inputs).encode())
        # In two parts: one would be a copy of the data in memory.
        write_durably(self.directory / CHECKPOINT, hashlib.sha256(data).digest(), data)

    def load(self) -> bytes | None:
        """The data of the checkpoint; None without one.

        Raises:
            ValueError: the checkpoint is damaged, or not a file of a plausible size.
        """
        path = self.directory / CHECKPOINT
        try:
            information = path.lstat()
        except FileNotFoundError:
            return None
        if not stat.S_ISREG(information.st_mode) or information.st_size > _MAX_BYTES:
            raise ValueError(f"{path} is not a checkpoint")
        # Unbuffered: the buffer would be joined with the rest, which copies it.
        with open(path, "rb", buffering=0) as file:
            digest, data = file.read(32), file.read()
        if hashlib.sha256(data).digest() != digest:
            raise ValueError(f"{path} is damaged")
        return data

    def discard_checkpoint(self) -> None:
        """Remove the checkpoint, so that the stage starts over."""
        remove(self.directory / CHECKPOINT)
        remove(self.directory / INPUTS)

    def new_output(self) -> Path:
        """A new, empty output directory; those of dead processes are removed."""
        self.directory.mkdir(exist_ok=True)
        remove_leftovers(self.directory)
        path = self.directory / unique_name("out")
        path.mkdir()
        return path

    def discard_output(self, output: Path) -> None:
        """Remove the output of an attempt that failed, as far as the file system allows it."""
        with suppress(OSError):
            remove(output)
        self.remove_if_empty()

    def clear(self) -> None:
        """Remove the checkpoint, and the directory unless another process uses it."""
        self.discard_checkpoint()
        self.remove_if_empty()

    def remove_if_empty(self) -> None:
        """Remove the directory unless it holds a checkpoint or another attempt's output."""
        with suppress(OSError):
            self.directory.rmdir()

"""Checkpoints of a stage at work: saved at intervals, and when a signal asks it to stop."""

import time
from collections.abc import Callable

from irlcli.errors import Interrupted
from irlcli.experiments import provenance
from irlcli.stages.base import Console
from irlcli.store import Scratch


class StageCheckpoints:
    """The checkpoints of one attempt at a stage.

    A checkpoint that this program cannot resume is discarded with a warning.

    Args:
        scratch: where the checkpoint lies.
        console: receives warnings.
        seconds: least time from the end of one checkpoint to the start of the next [s].
    """

    def __init__(self, scratch: Scratch, console: Console, seconds: float):
        self._libraries = provenance.libraries()
        self._clock = provenance.Clock()
        self._earlier: tuple[provenance.Attempt, ...] = ()
        self._scratch = scratch
        self._console = console
        self._seconds = seconds
        self._last = time.monotonic()
        self.stop_requested = False
        self._state: bytes | None = None
        try:
            stored = scratch.load()
            if stored is not None:
                header, self._state = provenance.decode(stored)
                self._earlier = header.attempts
        except ValueError as error:
            self.discard(str(error))

    def load(self) -> bytes | None:
        """The state to resume from; None without a usable checkpoint."""
        return self._state

    def discard(self, reason: str) -> None:
        """Start over, with a warning. The attempts so far no longer count: nothing of them is left."""
        self._console.warn(f"the checkpoint cannot be used ({reason}): starting over")
        self._scratch.discard_checkpoint()
        self._state, self._earlier = None, ()

    def attempts(self) -> tuple[provenance.Attempt, ...]:
        """All attempts at this artefact so far, the present one last."""
        return (*self._earlier, self._clock.attempt())

    def offer(self, state: Callable[[], bytes]) -> None:
        """Save ``state()`` if a checkpoint is due or a stop was requested.

        Raises:
            Interrupted: a stop was requested; the state has been saved.
        """
        if self.stop_requested or time.monotonic() - self._last >= self._seconds:
            header = provenance.Header(
                schema=provenance.SCHEMA,
                libraries=self._libraries,
                attempts=self.attempts(),
            )
            self._scratch.save(header.encode(state()))
            # After it: saving a large state can take longer than the interval.
            self._last = time.monotonic()
        if self.stop_requested:
            raise Interrupted(
                "stopped; a checkpoint was written", "run the same command again to resume"
            )

    def request_stop(self) -> None:
        """Stop at the end of the round; a second request stops at once."""
        if self.stop_requested:
            raise KeyboardInterrupt
        self.stop_requested = True
        self._console.warn(
            "stopping at the end of this round or stage (a second signal stops at once)"
        )

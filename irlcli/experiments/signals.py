"""What a request to stop does while work is under way."""

import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR2)
_INSISTING = (signal.SIGINT, signal.SIGTERM)
_stop = threading.Event()


def stop_requested() -> bool:
    """Whether a signal has asked to stop since :func:`stop_requests` was last entered."""
    return _stop.is_set()


@contextmanager
def stop_requests(handle: Callable[[], None]) -> Iterator[None]:
    """Call ``handle`` at the first SIGINT, SIGTERM, SIGHUP or SIGUSR2.

    It is called again at each SIGINT or SIGTERM that follows another of these two.

    A cluster's warning before a time limit or a preemption arrives as SIGUSR2, as SIGTERM or as
    both, and from the job as well as from the process that passes it on. It counts once.
    SIGHUP says that the terminal has closed: what was printed there is printed nowhere.

    Outside the main thread, where Python sets no handlers, signals do what they did before.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    _stop.clear()

    def receive(number: int, _: object) -> None:
        _stop.set()
        if number == signal.SIGHUP:
            _leave_terminal()
        first = not asked
        again = number in _INSISTING and any(n in _INSISTING for n in asked)
        asked.append(number)
        if first or again:
            handle()

    # A shell lets a command in the background ignore SIGINT, and nohup lets it ignore SIGHUP.
    previous = {
        number: signal.signal(number, receive)
        for number in STOPPING
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _leave_terminal() -> None:
    """Print no more to a terminal that has closed. Each write would fail."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):
            os.dup2(nowhere, stream)
    os.close(nowhere)

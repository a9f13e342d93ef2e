"""What a request to stop does while work is under way."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_stop = threading.Event()


def stop_requested() -> bool:
    """Whether a signal has asked to stop since :func:`stop_requests` was last entered."""
    return _stop.is_set()


@contextmanager
def stop_requests(handle: Callable[[], None]) -> Iterator[None]:
    """Call ``handle`` at the first SIGINT, SIGTERM or SIGUSR2.

    It is called again at each SIGINT or SIGTERM that follows another of these two.

    A cluster's warning before a time limit or a preemption arrives as SIGUSR2, as SIGTERM or as
    both, and from the job as well as from the process that passes it on. It counts once.

    Outside the main thread, where Python sets no handlers, signals do what they did before.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    _stop.clear()

    def receive(number: int, _: object) -> None:
        _stop.set()
        first = not asked
        again = number != signal.SIGUSR2 and any(n != signal.SIGUSR2 for n in asked)
        asked.append(number)
        if first or again:
            handle()

    # A shell lets a command in the background ignore SIGINT.
    previous = {
        number: signal.signal(number, receive)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)

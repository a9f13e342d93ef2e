"""The entry point ``irl``: exit codes and one-line errors."""

import atexit
import gc
import re
import signal
import sys
from typing import Any

from irlcli.cli import console
from irlcli.errors import (
    RETRY,
    Interrupted,
    IrlError,
    StageFailed,
    UsageError,
    described,
    file_failure,
    own_line,
)


def main() -> None:
    """Run the command line ``sys.argv`` and exit.

    Exit codes: 0 done, 1 a stage failed, 2 usage, 3 missing or ambiguous reference, 4 integrity,
    75 busy, 130 interrupted. Errors are one line on stderr and a hint; with ``--json`` also a
    document on stdout; with ``--debug`` also a traceback.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    try:
        _main()
    except KeyboardInterrupt:
        # A second Ctrl-C, while the first one was being handled.
        _fail(_interrupted())


def _interrupt(_number: int, _frame: Any) -> None:
    # A key that is held down must not interrupt the error message, nor what handles the interrupt.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise KeyboardInterrupt


def _main() -> None:
    # A light command mostly imports, which leaves no garbage. The runner enables the collector
    # again before it runs a stage. Frozen, what was imported is not searched for garbage at exit.
    gc.disable()
    atexit.register(gc.freeze)
    console.prepare_streams()
    try:
        import typer

        from irlcli.cli.app import app

        # Without arguments print the help. Typer would call that an error.
        arguments = sys.argv[1:] or ["--help"]
        command = typer.main.get_command(app)
        code = command.main(arguments, prog_name="irl", standalone_mode=False)
        # Typer catches a KeyboardInterrupt itself and returns its exit code.
        if code == Interrupted.exit_code:
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        _fail(_interrupted())
    except IrlError as error:
        _fail(error)
    except MemoryError:
        _fail(StageFailed("out of memory", RETRY))
    except BrokenPipeError:
        console.hang_up()
    except OSError as error:
        _fail(file_failure(error))
    except ModuleNotFoundError as error:
        _fail(StageFailed(str(error), "install its package, or name its folder in PYTHONPATH"))
    except Exception as error:
        if hasattr(error, "format_message"):
            _fail(_usage(error))
        place = own_line(error)
        if place:
            _fail(
                StageFailed(
                    f"{place}, raised {described(error)}",
                    "this is code of your own: --debug shows the traceback",
                )
            )
        own = _registered()
        first = f"check the interface of {', '.join(own)}; if it is right, " if own else ""
        _fail(
            StageFailed(
                f"unexpected {described(error)}",
                f"{first}this is a defect of irl: run again with --debug and report the traceback",
            )
        )


def _registered() -> list[str]:
    """Where the penalties, learners and algorithms are that are not part of this package."""
    from irlcli.learners import LEARNERS
    from irlcli.penalties import PENALTIES
    from irlcli.rl import ALGORITHMS

    places = (
        *(penalty.module for penalty in PENALTIES.values()),
        *(learner.place for learner in LEARNERS.values()),
        *ALGORITHMS.values(),
    )
    return sorted(place for place in places if not place.startswith("irlcli."))


def _interrupted() -> Interrupted:
    return Interrupted(
        "interrupted",
        "run the same command again: it resumes at the last checkpoint, if there is one",
    )


def _usage(error: Any) -> UsageError:
    """An error of typer's argument parser as a :class:`UsageError`."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "irl"
    message = error.format_message().replace("\n", " ").rstrip(".")
    message = re.sub("a valid int(eger)?( range)?$", "a whole number", message)
    message = re.sub("a valid float( range)?$", "a number", message)
    extra = re.match(r"^Got unexpected extra argument.*? \((.*)\)$", message)
    hint = f"`{path} --help` lists {'the commands' if path == 'irl' else 'what it accepts'}"
    given = {word.partition("=")[0] for word in sys.argv}
    if extra:
        message = f"Unexpected argument: {extra[1]}"
        if {"--rows", "--seeds", "--methods"} & given:
            hint = f"write a list with commas and without spaces, as in --seeds 0,1; {hint}"
    missing = re.match("^Missing argument '(TABLE|REPORT)'", message)
    if missing and "--experiments" not in given:
        from irlcli.cli import complete

        known = complete.tables() if missing[1] == "TABLE" else complete.reports()
        hint = f"known: {', '.join(name for name, _ in known)}"
    return UsageError(message[0].lower() + message[1:], hint)


def _fail(error: IrlError) -> None:
    # The program ends here, so a further Ctrl-C must not interrupt the error message.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if "--debug" in sys.argv:
        import traceback

        traceback.print_exc()
    try:
        # Not a parsed option: the error may come before the options are parsed.
        console.print_error(error, as_json="--json" in sys.argv)
    finally:
        # The exit code must be right even if nobody reads the message.
        sys.exit(error.exit_code)

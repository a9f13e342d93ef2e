"""A Python that has imported everything: each program runs in a fork of one warm process.

A script of many short commands spends most of its time on imports. ``warm_python.py serve SOCKET``
serves the clients ``warm_python.py run SOCKET -m irlcli ls`` and ``... run SOCKET script.py``, which
behave like Python with these arguments.
"""

import json
import os
import signal
import socket
import sys
from importlib import import_module

HEAVY = (
    *("matplotlib.pyplot", "stable_baselines3", "irlcli.cli.main", "irlcli.experiments.runner"),
    *("irlcli.data.exchange.minari", "irlcli.data.exchange.transitions", "irlcli.data.outputs"),
    *("irlcli.learners.airl", "irlcli.report.build", "irlcli.rl.loop"),
)


def serve(path):
    """Print a line when ready, and serve until killed."""
    # A forked process must not wait for threads that only its parent has.
    os.environ["OMP_NUM_THREADS"] = "1"
    for module in HEAVY:
        import_module(module)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen(64)
    print("ready", flush=True)
    while True:
        connection, _ = listener.accept()
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            code = _run(connection)
            connection.send(bytes([code]))
            os._exit(0)
        connection.close()


def _run(connection):
    message, files, _, _ = socket.recv_fds(connection, 1 << 20, 3)
    words, directory, environment, python = json.loads(message)
    for number, file in enumerate(files):
        os.dup2(file, number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
    os.chdir(directory)
    os.environ.clear()
    os.environ.update(environment)
    # Processes that the program starts are warm, too.
    sys.executable = python
    code = 0
    try:
        if "irlcli" in words[:3]:
            sys.argv = ["irl", *words[words.index("irlcli") + 1 :]]
            from irlcli.cli.main import main

            main()
        else:
            import runpy

            sys.argv = words
            sys.path.insert(0, os.path.dirname(os.path.abspath(words[0])))
            runpy.run_path(words[0], run_name="__main__")
    except SystemExit as stop:
        code = stop.code or 0
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return code


def run(path, words):
    """Have a fork run ``words``; its exit code."""
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(path)
    about = json.dumps([words, os.getcwd(), dict(os.environ), os.environ["WARM_PYTHON"]])
    socket.send_fds(connection, [about.encode()], [0, 1, 2])
    code = connection.recv(1)
    return code[0] if code else 1


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2])
    sys.exit(run(sys.argv[2], sys.argv[3:]))

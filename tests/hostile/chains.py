"""Command lines that make a chain of artefacts, and checks of what a refused command prints."""

import json
import subprocess
import sys

SMOKE = ["--profile", "smoke"]
LANDER = ["--env", "lunar-lander", "--intervention"]
# As tests/conftest.py makes it.
CHAIN = [
    ["collect-experts", *LANDER, "engine-power=1x,1.25x", "--name", "demos"],
    ["train-airl", "--demos", "demos", "--method", "irm", "--name", "airl"],
    ["transfer", "--reward", "airl/reward.pt", "--ood", "1.5x", "--name", "moved"],
    ["evaluate", "--policy", "moved", "--ood", "1.5x", "--name", "score"],
]
MAZES = ["--env", "gridworld", "--intervention", "path-group=1,2"]
GRIDWORLD = [
    ["collect-experts", *MAZES, "--name", "mazes"],
    ["train-maxent", "--demos", "mazes", "--method", "irm", "--name", "maxent"],
]
# Runs command lines, given as JSON, one after another in one process. Prints the exit code, stdout
# and stderr of each, and the peak memory of the process [KiB].
MANY = """
import contextlib, io, json, re, sys
from irlcli.cli.main import main
results = []
for line in json.loads(sys.argv[1]):
    out, err, code = io.StringIO(), io.StringIO(), 0
    sys.argv = ["irl", *line]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as stop:
        code = stop.code or 0
    results.append([code, out.getvalue(), err.getvalue()])
peak = int(re.search(r"VmHWM:\\s*(\\d+) kB", open("/proc/self/status").read())[1])
print(json.dumps({"results": results, "peak": peak}))
"""


def run_many(lines, **options):
    """Run command lines in one new process: [(code, stdout, stderr)] and its peak memory [KiB]."""
    done = subprocess.run(
        [sys.executable, "-c", MANY, json.dumps([[str(w) for w in line] for line in lines])],
        capture_output=True,
        text=True,
        timeout=600,
        **options,
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    return answer["results"], answer["peak"]


def assert_refused(result, code: int, named: str) -> None:
    """``result`` is ``code``, nothing on stdout, one error line that names ``named``, a hint."""
    status, out, err = result
    assert (status, out) == (code, ""), err
    assert "Traceback" not in err and "this is a defect" not in err, err
    lines = err.splitlines()
    (message,) = (line for line in lines if line.startswith("error: "))
    assert named in message and len(message) < 1200, err
    assert lines[-1].startswith("hint: "), err
    assert err.replace("\n", "").isprintable()

"""Python imports this at the start of every process whose PYTHONPATH begins with this directory.

It logs the process, and replaces what the stages compute by rounds of a hash chain: real command
lines, processes, locks and checkpoints, without the cost of training. Environment variables:
IRL_TEST_LOG is the log, a JSON document per line; IRL_TEST_FAIL is the agent or method that fails;
IRL_TEST_ROUND is how long a round takes [s]; IRL_TEST_AHEAD is a node of Slurm and how far its clock
is ahead [s].
"""

import atexit
import hashlib
import json
import os
import sys
import time

ROUNDS = 6


def log(**facts):
    with open(os.environ["IRL_TEST_LOG"], "a") as file:
        file.write(json.dumps({"pid": os.getpid(), **facts}) + "\n")


def compute(job):
    """Outputs that depend on every round, on the parameters and on the inputs."""
    import msgspec

    from irlcli.errors import StageFailed

    parameters = msgspec.to_builtins(job.parameters)
    kind = type(job.parameters).__module__.rpartition(".")[2]
    grouping = parameters.get("airl", {}).get("grouping")
    what = f"{kind} {grouping or parameters.get('agent') or parameters.get('setting')}"
    inputs = sorted(path.read_bytes() for path in job.inputs.values() if path.is_file())
    content = hashlib.sha256(b"".join(inputs)).hexdigest()
    log(computes=what, parameters=parameters, inputs=content)
    if os.environ.get("IRL_TEST_FAIL") == what:
        raise StageFailed("it was asked to fail", "do not ask for it")
    state = job.checkpoints.load() or b"0 " + repr((kind, parameters, inputs)).encode()
    for done in range(int(state.split()[0]) + 1, ROUNDS + 1):
        time.sleep(float(os.environ.get("IRL_TEST_ROUND", "0.02")))
        state = b"%d " % done + hashlib.sha256(state).hexdigest().encode()
        job.console.progress(done, ROUNDS, "rounds", {})
        job.checkpoints.offer(lambda state=state: state)
    for name in ("policy.pt", "reward.pt", "summary.json", "metrics.parquet"):
        (job.output / name).write_bytes(name.encode() + state)


def install():
    from irlcli.experiments import checkpoints
    from irlcli.stages import collect_experts, evaluate, train_airl, train_expert, transfer

    for stage in (collect_experts, evaluate, train_airl, train_expert, transfer):
        stage.STAGE = stage.STAGE._replace(run=compute)
    original = checkpoints.StageCheckpoints.__init__
    checkpoints.StageCheckpoints.__init__ = lambda self, scratch, console, seconds: original(
        self, scratch, console, 0.0
    )


def shift_clock(node, seconds):
    if os.environ.get("SLURMD_NODENAME") == node:
        true_time = time.time
        time.time = lambda: true_time() + float(seconds)


if "IRL_TEST_AHEAD" in os.environ:
    shift_clock(*os.environ["IRL_TEST_AHEAD"].split())
if "IRL_TEST_LOG" in os.environ and "irlcli" in sys.orig_argv:
    log(argv=sys.orig_argv)
    atexit.register(log, exits=True)  # a killed process does not
    install()

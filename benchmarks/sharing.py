"""``irl push`` and ``irl pull`` of the store zoo/, against bare copies, and listing N artefacts.

Each line is a process of its own: wall seconds, CPU seconds and peak memory, start-up included. The S3
server (moto) runs on this machine and answers one request in some milliseconds; a real one takes
longer for each but serves many at a time.
Run with ``python -m benchmarks.sharing``; by ``make bench``.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import time

import fsspec

from irlcli.store import KeyRecord, Manifest, Output
from irlcli.store.manifest import encode_provenance

SERVER = "from moto.server import main; main(['-H', '127.0.0.1', '-p', '{port}'])"
COPY = (
    "import fsspec, sys; fsspec.filesystem('s3').{verb}(sys.argv[1], sys.argv[2], recursive=True)"
)
PORT = 5678
IRL = [sys.executable, "-m", "irlcli"]
BIG = 256 << 20


def main() -> None:
    """Print a line for each command."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    os.environ |= {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{PORT}",
        "AWS_ACCESS_KEY_ID": "x",
        "AWS_SECRET_ACCESS_KEY": "x",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER.format(port=PORT)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        with tempfile.TemporaryDirectory() as directory:
            bucket = create_bucket(server)
            print(f"{'':34}{'wall s':>8}{'CPU s':>8}{'MiB':>6}")
            zoo(directory, bucket)
            listing(directory, bucket)
            large(directory, bucket)
    finally:
        server.terminate()


def zoo(directory: str, bucket: str) -> None:
    """Push and pull zoo/, and copy its files without irl."""
    at = {"directory": f"{directory}/shared", "S3": f"{bucket}/shared"}
    report("cp -r zoo/", ["cp", "-r", "zoo", f"{directory}/plain"])
    report("s3fs put zoo/", bare("put", "zoo/", f"{bucket}/plain"))
    report("s3fs get zoo/", bare("get", f"{bucket}/plain/", f"{directory}/back"))
    for name, place in at.items():
        pulled = ["pull", "--all", "--from", place, "--store", f"{directory}/{name}"]
        pushed = ["push", "--all", "--to", place, "--store", "zoo"]
        report(f"push, {name}", [*IRL, *pushed])
        report(f"push again, {name}", [*IRL, *pushed])
        report(f"pull, {name}", [*IRL, *pulled])
        report(f"pull again, {name}", [*IRL, *pulled])


def listing(directory: str, bucket: str) -> None:
    """List and look for one artefact where there are many."""
    for count in (100, 1000):
        for name, place in (("directory", f"{directory}/{count}"), ("S3", f"{bucket}/{count}")):
            last = plant(place, count)
            report(f"ls, {count:,} artefacts, {name}", [*IRL, "ls", "--from", place])
            pull = ["pull", last, "--from", place, "--store", f"{directory}/of-{name}-{count}"]
            report(f"pull one of {count:,}, {name}", [*IRL, *pull])


def large(directory: str, bucket: str) -> None:
    """Push and pull an artefact of one large file."""
    only = plant(f"{directory}/large", 1, bytes(BIG))
    for name, place in (("directory", f"{directory}/there"), ("S3", f"{bucket}/there")):
        push = ["push", only, "--to", place, "--store", f"{directory}/large"]
        report(f"push {BIG >> 20} MiB, {name}", [*IRL, *push])
        pull = ["pull", only, "--from", place, "--store", f"{directory}/large-{name}"]
        report(f"pull {BIG >> 20} MiB, {name}", [*IRL, *pull])


def plant(place: str, count: int, data: bytes = b"content") -> str:
    """Write a store of ``count`` artefacts, without irl; returns the id of the last one."""
    fs, root = fsspec.core.url_to_fs(place)
    files = {"STORE": b'{"format": 1}'}
    output = Output("f", len(data), hashlib.sha256(data).hexdigest())
    for seed in range(count):
        manifest = Manifest(KeyRecord("train-airl", 1, {"seed": seed}, {}), (output,))
        id16 = manifest.id[:16]
        files[f"{id16}/f"] = data
        files[f"{id16}/provenance.json"] = encode_provenance(manifest.id, {})
        files[f"{id16}/manifest.json"] = manifest.encode()
        files[f".keys/{manifest.record.key}"] = id16.encode()
    for directory in {name.rpartition("/")[0] for name in files}:
        fs.makedirs(f"{root}/{directory}", exist_ok=True)
    fs.pipe({f"{root}/{name}": value for name, value in files.items()})
    return id16


def bare(verb: str, source: str, target: str) -> list[str]:
    return [sys.executable, "-c", COPY.format(verb=verb), source, target]


def create_bucket(server: subprocess.Popen) -> str:
    """The URL of a new bucket, as soon as the server answers."""
    while server.poll() is None:
        try:
            fsspec.filesystem("s3").mkdir("bench")
            return "s3://bench"
        except OSError:
            time.sleep(0.5)
    raise SystemExit(f"the S3 server ended: is moto installed, and port {PORT} free?")


def report(label: str, command: list[str]) -> None:
    """Run ``command`` and print what it took."""
    start, peak = time.monotonic(), 0.0
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
        # Not of wait4: that begins with the memory of this process.
        peak = max(peak, peak_of(process.pid))
        time.sleep(0.005)
    _, status, usage = ended
    if status:
        raise SystemExit(f"failed: {' '.join(command)}")
    wall, cpu = time.monotonic() - start, usage.ru_utime + usage.ru_stime
    print(f"{label:34}{wall:8.2f}{cpu:8.2f}{peak:6.0f}", flush=True)


def peak_of(pid: int) -> float:
    """Peak memory of a running process [MiB]."""
    with open(f"/proc/{pid}/status") as file:
        lines = [line.split() for line in file if line.startswith("VmHWM")]
    return int(lines[0][1]) / 1024 if lines else 0.0


if __name__ == "__main__":
    main()

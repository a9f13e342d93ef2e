"""A chain of artefacts to share, and the places to share it by."""

from __future__ import annotations

from collections.abc import Iterator

import fsspec
import pytest

from irlcli.store import Artefact, Store

FILES = {"nested/g": b"PAR1" * 64, "empty": b""}


@pytest.fixture
def store(empty_store) -> Store:
    return empty_store


@pytest.fixture
def chain(store, publish) -> dict[str, Artefact]:
    """``demos`` was made from ``expert``, and ``airl`` from ``demos``; the last two have names."""
    made: dict[str, Artefact] = {}
    parent = None
    for name in ("expert", "demos", "airl"):
        inputs = {"input": parent.output("f").sha256} if parent else {}
        places = {"input": f"{parent.id}/f"} if parent else {}
        parent = publish(
            store,
            {**FILES, "f": name.encode()},
            parameters={"of": name},
            inputs=inputs,
            places=places,
        ).artefact
        made[name] = parent
    store.set_name("demos", made["demos"])
    store.set_name("irm-0", made["airl"])
    return made


@pytest.fixture
def url(tmp_path) -> Iterator[str]:
    """A place in memory."""
    yield f"memory://{tmp_path.name}/lab"
    fsspec.filesystem("memory").rm(f"/{tmp_path.name}", recursive=True)


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """The address of an S3 server."""
    server = pytest.importorskip("moto.server", reason="moto is not installed")
    pytest.importorskip("s3fs")
    import logging

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    running = server.ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    yield f"http://{host}:{port}"
    running.stop()


@pytest.fixture
def bucket(s3_server, monkeypatch, tmp_path) -> str:
    """The URL of a new bucket."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_server)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "somebody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    name = tmp_path.name.replace("_", "-")[-40:].strip("-")
    fsspec.filesystem("s3", skip_instance_cache=True).mkdir(name)
    return f"s3://{name}"


@pytest.fixture(params=["directory", "folders", "memory", "s3"])
def place(request, tmp_path) -> str:
    """A place to push to; ``folders`` have to be made before a file is written, as by sftp."""
    if request.param == "directory":
        return str(tmp_path / "there")
    if request.param == "folders":
        return f"local://{tmp_path}/there"
    if request.param == "memory":
        return request.getfixturevalue("url")
    return request.getfixturevalue("bucket") + "/lab"

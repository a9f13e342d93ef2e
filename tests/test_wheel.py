"""The wheel works outside the checkout, with the settings it needs."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import irlcli

CHECKOUT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("hatchling") is None:
        pytest.skip("hatchling, which builds the wheel, is not installed")
    directory = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel"]
    done = subprocess.run(
        [*build, "--directory", str(directory)], cwd=CHECKOUT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (built,) = directory.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory that holds what is in the wheel, as an installation would."""
    directory = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(directory)
    return directory


def test_the_wheel_holds_every_settings_file_and_the_type_marker(installed: Path) -> None:
    settings = CHECKOUT / "settings"
    for source in settings.rglob("*.toml"):
        copy = installed / "irlcli" / "settings_files" / source.relative_to(settings)
        assert copy.read_bytes() == source.read_bytes()
    assert (installed / "irlcli" / "py.typed").is_file()


def test_the_wheel_has_the_version_of_the_package(wheel: Path) -> None:
    assert wheel.name == f"irlcli-{irlcli.__version__}-py3-none-any.whl"


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        (["--version"], irlcli.__version__),
        (["report", "table2"], "engine-power"),
        (["plan", "table1", "--rows", "lunar-lander"], "lunar-lander.bounce.erm.0"),
    ],
)
def test_the_installed_command_runs_outside_the_checkout(
    installed: Path, tmp_path: Path, arguments: list[str], shown: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import irlcli; print(irlcli.__file__)"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
    )
    assert Path(done.stdout.strip()).is_relative_to(installed)

    done = subprocess.run(
        [sys.executable, "-m", "irlcli", *arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert shown in done.stdout

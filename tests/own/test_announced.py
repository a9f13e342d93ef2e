"""Environments that installed packages announce, and which of their code is in a key."""

from __future__ import annotations

import json
import sys
from importlib.machinery import EXTENSION_SUFFIXES

import pytest

from irlcli.envs.code import code_of
from irlcli.errors import IrlError, UsageError
from irlcli.store import Store

IDLE = ("evaluate", "--idle", "--env", "cart", "--intervention", "mass=2x", "--profile", "smoke")


@pytest.fixture
def installed(bench, monkeypatch):
    """``installed(value)``: the example as a package ``lab`` 1.0, which announces ``cart``."""
    site = bench.directory.parent / "site-packages"
    package = site / "lab"
    package.mkdir(parents=True)
    bench.module.rename(package / "__init__.py")
    toml = bench.toml.read_text().replace("cart:Cart-v0", "lab:Cart-v0")
    bench.toml.unlink()
    (package / "cart.toml").write_text(toml)
    monkeypatch.syspath_prepend(site)

    def announce(value="lab", distribution="lab", version="1.0"):
        about = site / f"{distribution}-{version}.dist-info"
        about.mkdir(exist_ok=True)
        (about / "METADATA").write_text(f"Name: {distribution}\nVersion: {version}\n")
        (about / "entry_points.txt").write_text(f"[irlcli.environments]\ncart = {value}\n")
        return about

    yield announce
    sys.modules.pop("lab", None)


def test_an_announced_environment_is_known_by_its_name(bench, installed):
    installed()
    listed = bench.irl("envs", "list")
    assert listed.code == 0
    assert listed.out.splitlines()[-1].split()[:2] == ["cart", "lab"]
    done = bench.irl(*IDLE, "--name", "idle", "--quiet")
    assert done.code == 0, done.err
    own = Store("runs").resolve("idle").artefact.manifest.record.parameters["environment"]["own"]
    assert own["distribution"] == "lab" and own["version"] == "1.0" and "sha256" not in own
    assert bench.irl("report", "returns", "idle").code == 0


def test_another_version_is_no_hit(bench, installed):
    about = installed()
    assert bench.irl(*IDLE).code == 0
    assert bench.irl(*IDLE, "--dry-run").out.startswith("HIT")
    for file in about.iterdir():
        file.unlink()
    about.rmdir()
    installed(version="1.1")
    assert bench.irl(*IDLE, "--dry-run").out.startswith("RUN")


@pytest.mark.parametrize("value", ["lab.inner", "gone"])
def test_an_announcement_without_a_file(bench, installed, value):
    installed(value)
    done = bench.irl("envs", "show", "cart")
    assert done.code == 3 and "holds no cart.toml" in done.err
    assert bench.irl("envs", "list").code == 0


def test_two_announcements_of_one_name(bench, installed):
    installed()
    installed("other", "zoo")
    done = bench.irl("envs", "show", "cart")
    assert done.code == 2 and "lab and zoo both announce" in done.err


def test_a_name_in_a_file_of_others_is_no_path(bench, publish):
    """Only what the user types can name a TOML file, and with it code."""
    place = {"name": str(bench.toml), "physics": 1, "max_episode_steps": 50}
    parameters = {"environment": place, "settings": ["mass=1x"]}
    made = publish(Store("runs"), stage="collect-experts", parameters=parameters).artefact
    done = bench.irl("train-airl", "--demos", made.id)
    assert done.code == 4 and "unknown environment" in done.err
    assert "cart" not in sys.modules


# The code of a module


@pytest.fixture
def lab(fresh, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab_env.py").write_text("import lab_physics\nimport json\n")
    (tmp_path / "lab_physics.py").write_text("from lab_parts import arm\n")
    (tmp_path / "lab_parts").mkdir()
    (tmp_path / "lab_parts" / "arm.py").write_text("LENGTH = 1.0\n")
    (tmp_path / "lab_other.py").write_text("")
    (tmp_path / "model.xml").write_text("<arm/>")
    return tmp_path


def digest(directory, module="lab_env", files=()):
    return code_of(module, files, directory, "lab.toml").sha256


@pytest.mark.parametrize(
    ("file", "counts"),
    [
        ("lab_env.py", True),
        ("lab_physics.py", True),
        ("lab_parts/arm.py", True),
        ("lab_other.py", False),
        ("model.xml", False),
    ],
)
def test_the_modules_beside_it_that_a_module_imports_are_its_code(lab, file, counts):
    before, listed = digest(lab), digest(lab, files=["*.xml"])
    (lab / file).write_text((lab / file).read_text() + "\n")
    assert (digest(lab) != before) == counts
    assert (digest(lab, files=["*.xml"]) != listed) == (counts or file == "model.xml")


def test_every_python_file_of_a_package_is_its_code(lab):
    (lab / "lab_parts" / "__init__.py").write_text("")
    before = digest(lab, "lab_parts")
    assert digest(lab, "lab_parts.arm") == before
    (lab / "lab_parts" / "unused.py").write_text("")
    assert digest(lab, "lab_parts") != before


@pytest.mark.parametrize("name", ["lab_env", "lab_physics", "lab_parts/arm"])
def test_compiled_modules_are_code(lab, name):
    """As the module itself, beside it, or in a package."""
    compiled = lab / f"{name}{EXTENSION_SUFFIXES[0]}"
    (lab / f"{name}.py").rename(compiled)
    before = digest(lab)
    assert before is not None
    compiled.write_bytes(b"built again")
    assert digest(lab) != before


@pytest.mark.parametrize("name", ["lab_env", "lab_physics"])
def test_a_module_precedes_a_folder_of_its_name_as_in_python(lab, name):
    (lab / name).mkdir()
    (lab / name / "data.py").write_text("")
    before = digest(lab)
    (lab / name / "data.py").write_text("ignored = 1\n")
    assert digest(lab) == before
    (lab / f"{name}.py").write_text("edited = 1\n")
    assert digest(lab) != before
    (lab / name / "__init__.py").write_text("")
    package = digest(lab)
    (lab / f"{name}.py").write_text("ignored = 1\n")
    assert digest(lab) == package


@pytest.mark.parametrize("module", ["nothing", "lab_env.inner", "lab_parts.leg", "os.nothing"])
def test_a_module_that_does_not_exist(lab, module):
    with pytest.raises(IrlError, match=f"no module '{module}'") as caught:
        digest(lab, module)
    assert caught.value.exit_code == 3


def test_a_module_that_is_not_python_names_its_line(lab):
    (lab / "lab_physics.py").write_text("x = 1\nx = = 2\n")
    with pytest.raises(UsageError, match="line 2 is not Python"):
        digest(lab)


def test_two_modules_of_one_name_are_refused(lab):
    (lab / "json.py").write_text("")
    with pytest.raises(UsageError, match="two modules are called 'json'"):
        digest(lab, "json")


def test_a_helper_that_python_imports_from_elsewhere_is_refused(lab, monkeypatch):
    """The key would hold the one beside the module, and the other one would run."""
    (lab / "other").mkdir()
    (lab / "other" / "lab_physics.py").write_text("")
    before = digest(lab)
    monkeypatch.syspath_prepend(lab / "other")
    with pytest.raises(UsageError, match="two modules are called 'lab_physics'"):
        digest(lab)
    (lab / "other" / "lab_physics.py").unlink()
    assert digest(lab) == before
    # Python's own library precedes the directory, which is last on its path,
    for module in ("json", "this"):
        (lab / "lab_env.py").write_text(f"import lab_physics\nimport {module}\n")
        before = digest(lab)
        (lab / f"{module}.py").write_text("")
        assert digest(lab) == before
    # but not one that is named first.
    monkeypatch.syspath_prepend(lab)
    assert digest(lab) != before
    # An installed package precedes a folder of data.
    (lab / "lab_env.py").write_text("import numpy\n")
    before = digest(lab)
    (lab / "numpy").mkdir()
    (lab / "numpy" / "saved.py").write_text("")
    assert digest(lab) == before


# The code of installed modules


@pytest.fixture
def site(fresh, tmp_path, monkeypatch):
    """A folder of installed packages; ``site(name, module, origin)`` installs a module of one line."""
    directory = tmp_path / "site-packages"
    directory.mkdir()
    monkeypatch.syspath_prepend(directory)
    monkeypatch.chdir(tmp_path)

    def install(distribution, module, origin=None, at=directory):
        at.mkdir(exist_ok=True)
        (at / f"{module}.py").write_text("import lab_beside\nGRAVITY = 9.8\n")
        if distribution is not None:
            about = directory / f"{distribution.replace('-', '_')}-1.0.dist-info"
            about.mkdir()
            (about / "METADATA").write_text(f"Name: {distribution}\nVersion: 1.0\n")
            (about / "top_level.txt").write_text(f"{module}\n")
            if origin is not None:
                (about / "direct_url.json").write_text(json.dumps({"url": origin.as_uri()}))
        return at / f"{module}.py"

    return install


@pytest.mark.parametrize(
    ("distribution", "local"),
    [("lab_arm", False), ("lab-arm", False), ("robots", False), ("robots", True), (None, False)],
)
def test_only_the_version_of_a_package_from_an_index_stands_for_its_content(
    site, tmp_path, distribution, local
):
    file = site(distribution, "lab_arm", tmp_path if local else None)
    before = code_of("lab_arm", (), None, "lab.toml")
    assert before[1:] == (distribution, None if distribution is None else "1.0")
    file.write_text("GRAVITY = 1.6\n")
    released = distribution is not None and not local
    assert (before.sha256 is None) == released
    assert (code_of("lab_arm", (), None, "lab.toml") == before) == released


@pytest.mark.parametrize(("owner", "counts"), [(None, True), ("lab", True), ("other", False)])
def test_the_dependencies_of_an_installed_module_are_not_its_code(site, tmp_path, owner, counts):
    site("lab", "lab_arm", tmp_path)
    beside = site(owner if owner != "lab" else None, "lab_beside")
    if owner == "lab":
        (beside.parent / "lab-1.0.dist-info" / "top_level.txt").write_text("lab_arm\nlab_beside\n")
    before = code_of("lab_arm", (), None, "lab.toml")
    beside.write_text("GRAVITY = 1.6\n")
    assert (code_of("lab_arm", (), None, "lab.toml") != before) == counts


@pytest.mark.parametrize("folder", ["lab", "elsewhere"])
def test_an_editable_package_is_known_by_version_and_content(site, tmp_path, monkeypatch, folder):
    monkeypatch.syspath_prepend(tmp_path / "lab")
    file = site("lab_arm", "lab_arm", tmp_path / folder, at=tmp_path / "lab")
    before = code_of("lab_arm", (), None, "lab.toml")
    assert before[1:] == (("lab_arm", "1.0") if folder == "lab" else (None, None))
    file.write_text("GRAVITY = 1.6\n")
    assert code_of("lab_arm", (), None, "lab.toml").sha256 != before.sha256

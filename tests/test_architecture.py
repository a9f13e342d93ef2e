"""The import rules of the design, read off the source, and what light commands leave unloaded."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "irlcli"
HEAVY = {
    *("torch", "stable_baselines3", "gymnasium", "pybullet", "pandas", "pyarrow", "Box2D"),
    *("scipy", "matplotlib"),
}
OURS = {
    "store",
    "stages",
    "irl",
    "envs",
    "rl",
    "cli",
    "console",
    "runner",
    "references",
    "dataset",
    "checkpoints",
    "report",
}

# Module or package -> what it may never import, at any depth of its own code.
NEVER = {
    "errors": HEAVY | OURS | {"numpy", "msgspec", "settings"},
    "settings": HEAVY | OURS | {"numpy"},
    "seeds": HEAVY | OURS | {"settings", "pathlib"},
    "interventions": HEAVY | OURS | {"numpy", "settings"},
    "trajectories": HEAVY | OURS | {"settings", "pathlib"},
    "play": {"store", "irl", "stages", "cli", "console", "runner", "stable_baselines3"},
    "tabular": (HEAVY - {"scipy"}) | OURS | {"settings", "pathlib"},
    "store": HEAVY | (OURS - {"store"}) | {"numpy", "msgspec", "settings", "trajectories"},
    "envs": {"torch", "stable_baselines3", "pandas", "pyarrow"} | (OURS - {"envs"}),
    "irl": {"stable_baselines3", "gymnasium", "pandas", "pyarrow", "logging", "pathlib"}
    | (OURS - {"irl"}),
    "rl": {"store", "irl", "stages", "cli", "console", "runner", "dataset", "checkpoints"},
    "dataset": {"torch", "stable_baselines3", "store", "irl", "stages", "cli", "rl"},
    "report": {"torch", "stable_baselines3", "cli", "stages", "runner"},
    "stages": {"cli", "console", "runner", "stable_baselines3"},
    "runner": {"cli", "console"} | HEAVY,
    "experiments": {"cli", "console", "report"} | HEAVY,
    "provenance": HEAVY | OURS | {"numpy", "settings"},
}
# Modules that planning and hits load: nothing heavy at their top level.
LIGHT = [
    "cli",
    "__main__",
    "console",
    "errors",
    "settings",
    "interventions",
    "runner",
    "provenance",
    "references",
    "experiments",
    "report/returns",
    "report/tables",
    "stages/__init__",
    "stages/train_expert",
    "stages/collect_experts",
    "stages/train_airl",
    "stages/choose_penalty",
    "stages/train_maxent",
    "stages/sweep_maxent",
    "stages/figure2",
    "stages/results",
    "stages/transfer",
    "stages/evaluate",
]


def imported(path, top_level_only=False):
    """Names of modules imported by a file; of our own, the part after ``irlcli.``."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else ast.walk(tree)
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found = [node.module]
            if node.module == "irlcli":
                found = [f"irlcli.{alias.name}" for alias in node.names]
        else:
            continue
        for name in found:
            parts = name.split(".")
            names.add(parts[1] if parts[0] == "irlcli" and len(parts) > 1 else parts[0])
    return names


@pytest.mark.parametrize("module", sorted(NEVER))
def test_import_rules(module):
    path = PACKAGE / module
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    assert files
    for file in files:
        assert not imported(file) & NEVER[module], file


def test_only_rl_knows_stable_baselines():
    users = {f.name for f in PACKAGE.rglob("*.py") if "stable_baselines3" in imported(f)}
    assert users == {"rl.py"}


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_import_nothing_heavy_at_their_top(module):
    names = imported(PACKAGE / f"{module}.py", top_level_only=True)
    assert not names & (HEAVY | {"numpy", "rl", "irl", "envs", "play", "dataset", "checkpoints"})


def loaded_by(*arguments):
    """Heavy modules loaded after a command line ran in a fresh interpreter."""
    code = (
        "import sys\n"
        f"sys.argv = ['irl', *{list(arguments)!r}]\n"
        "from irlcli.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code, stop.code\n"
        f"print('LOADED', sorted({HEAVY | {'numpy'}!r} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_help_loads_nothing_heavy():
    assert loaded_by("--help") == "LOADED []"


def test_a_hit_loads_nothing_heavy(tmp_path):
    command = ["evaluate", "--idle", "--env", "lunar-lander", "--intervention", "bounce=0.9"]
    command += ["--profile", "smoke", "--store", str(tmp_path / "runs")]
    assert "torch" in loaded_by(*command)
    assert loaded_by(*command) == "LOADED []"
    assert loaded_by("ls", "--store", str(tmp_path / "runs")) == "LOADED []"
    assert loaded_by("verify", "--store", str(tmp_path / "runs")) == "LOADED []"


def test_nothing_is_unfinished():
    words = ("TODO", "FIXME", "XXX", "NotImplementedError")
    for file in PACKAGE.rglob("*.py"):
        assert not any(word in file.read_text() for word in words), file

"""The import rules of the design, read from the source, and what light commands leave unloaded."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "irlcli"
HEAVY = {
    *("torch", "stable_baselines3", "gymnasium", "pybullet", "pybullet_data", "mujoco"),
    *("pandas", "pyarrow", "Box2D", "scipy", "matplotlib", "PIL"),
}
FILES = {
    *("irlcli.data.tensors", "irlcli.data.parquet", "irlcli.data.demonstrations"),
    *("irlcli.data.outputs", "pathlib"),
}

# Layers, lowest first: a package imports only from its own layer's list or from below.
LAYERS = [
    ["errors", "seeds"],
    ["envs.spec", "envs.registry"],
    ["interventions", "methods", "trajectories", "symmetries", "tabular", "networks"],
    ["penalties", "learners.__init__", "rl.__init__"],
    ["configs"],
    ["store", "labels", "data.descriptions"],
    ["envs", "learners"],
    ["controls"],
    ["rl"],
    ["data"],
    ["report"],
    ["stages"],
    ["experiments"],
    # Options as requests: below both front ends, the command line and the notebook facade.
    ["requests"],
    ["rewards"],
    ["cli"],
    # Another front end, which outside a notebook prints with the command line's console.
    ["lab"],
]

# Package or module -> what it may never import, at any depth of its own code.
NEVER = {
    "errors": HEAVY | {"numpy", "msgspec", "irlcli"},
    "configs": HEAVY | {"numpy"},
    "interventions": HEAVY | {"numpy", "msgspec", "pathlib"},
    "trajectories": (HEAVY | {"msgspec", "pathlib", "irlcli"}),
    "symmetries": HEAVY | {"msgspec", "pathlib", "irlcli"},
    "tabular": (HEAVY - {"scipy"}) | {"pathlib", "irlcli"},
    "store": HEAVY | {"numpy", "msgspec"},
    "envs": {"torch", "stable_baselines3", "pandas", "pyarrow", "irlcli.store", "irlcli.learners"},
    "learners": FILES
    | {"stable_baselines3", "gymnasium", "pandas", "pyarrow", "logging"}
    | {"irlcli.store", "irlcli.rl", "irlcli.envs"},
    "controls": FILES
    | {"stable_baselines3", "gymnasium", "pandas", "pyarrow", "logging"}
    | {"irlcli.store", "irlcli.rl", "irlcli.envs"},
    "penalties": FILES | HEAVY - {"torch"} | {"logging", "irlcli.store", "irlcli.rl"},
    "rl": FILES | {"irlcli.store", "irlcli.learners", "pandas", "pyarrow"},
    "report": {"torch", "stable_baselines3", "irlcli.stages", "irlcli.rl", "irlcli.learners"},
    "stages": {"stable_baselines3"},
    "experiments": HEAVY | {"numpy"},
    "requests": HEAVY | {"numpy", "typer", "rich"},
    "lab": (HEAVY - {"pandas"}) | {"numpy", "typer"},
}
EXCEPTIONS = {
    # GIFs of a policy at work.
    "report/animation.py": {"irlcli.rl"},
}


def modules():
    """Path by dotted name below irlcli."""
    return {
        path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", "."): path
        for path in sorted(PACKAGE.rglob("*.py"))
    }


KNOWN = {name.removesuffix(".__init__") for name in modules()}


def imported(path, top_level_only=False):
    """Dotted names that a file imports, those only for type checkers left out."""
    tree = ast.parse(path.read_text())
    names = set()

    def visit(node):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            return
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                # The imported name may be a module itself.
                inner = f"{node.module}.{alias.name}"
                is_module = inner.removeprefix("irlcli.") in KNOWN
                names.update([inner] if is_module else [node.module, inner])
        inside_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        if not (top_level_only and inside_function):
            for child in ast.iter_child_nodes(node):
                visit(child)

    visit(tree)
    return names


def within(name, prefixes):
    return any(name == prefix or name.startswith(prefix + ".") for prefix in prefixes)


@pytest.mark.parametrize("package", sorted(NEVER))
def test_import_rules(package):
    path = PACKAGE / package
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    assert files
    for file in files:
        allowed = EXCEPTIONS.get(file.relative_to(PACKAGE).as_posix(), set())
        forbidden = NEVER[package] - allowed
        found = {name for name in imported(file) if within(name, forbidden)}
        assert not found, f"{file} imports {', '.join(sorted(found))}"


def layer(module):
    """The layer of a module: of its longest prefix that has one."""
    if module.startswith("envs.") and module.endswith((".spec", ".knobs")):
        module = "errors"
    best = max(
        (
            (len(name), number)
            for number, names in enumerate(LAYERS)
            for name in names
            if within(module, [name])
        ),
        default=None,
    )
    return None if best is None else best[1]


def arrows():
    """(importing module, imported module) of our own, at the top level."""
    known = modules()
    packages = {name.removesuffix(".__init__") for name in known if name.endswith("__init__")}
    for name, path in known.items():
        for target in imported(path, top_level_only=True):
            if not target.startswith("irlcli."):
                continue
            target = target.removeprefix("irlcli.")
            if target in packages:
                target += ".__init__"
            if target in known and target != name:
                yield name, target


def test_every_module_has_a_place():
    for name in modules():
        assert name in ("__init__", "__main__") or layer(name) is not None, name


def test_no_arrow_points_upward():
    upward = [
        f"{source} -> {target}"
        for source, target in arrows()
        if source not in ("__main__",) and layer(source) < layer(target)
    ]
    assert not upward, upward


def test_the_house_has_no_circle():
    graph = {}
    for source, target in arrows():
        graph.setdefault(source, set()).add(target)
    done, path = set(), []

    def visit(node):
        if node in path:
            raise AssertionError(" -> ".join([*path[path.index(node) :], node]))
        if node in done:
            return
        path.append(node)
        for target in sorted(graph.get(node, ())):
            visit(target)
        done.add(path.pop())

    for node in sorted(graph):
        visit(node)


def test_only_rl_knows_stable_baselines():
    users = {
        name.split(".")[0]
        for name, path in modules().items()
        if any(within(n, ["stable_baselines3"]) for n in imported(path))
    }
    assert users == {"rl"}


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in modules()
        if name.split(".")[0]
        in ("cli", "lab", "requests", "stages", "experiments", "store", "configs", "methods")
        or name in ("errors", "interventions", "envs.registry", "__main__")
        or name in ("learners.__init__", "rl.__init__", "penalties.__init__", "envs.__init__")
        or name.endswith(".spec")
    ],
)
def test_light_modules_import_nothing_heavy_at_their_top(name):
    """Planning and hits load these."""
    found = imported(modules()[name], top_level_only=True)
    heavy = HEAVY | {
        "numpy",
        "irlcli.networks",
        "irlcli.data.tensors",
        "irlcli.data.demonstrations",
    }
    assert not {n for n in found if within(n, heavy)}


def loaded_by(*arguments, among=HEAVY | {"numpy"}):
    """Those of the modules ``among`` that a command line loads in a fresh interpreter."""
    code = (
        "import sys\n"
        f"sys.argv = ['irl', *{list(arguments)!r}]\n"
        "from irlcli.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code, stop.code\n"
        f"print('LOADED', sorted({set(among)!r} & set(sys.modules)))\n"
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
    # What only reads the store loads no configs.
    light = loaded_by("ls", "--store", str(tmp_path / "runs"), among={"msgspec", "tomllib"})
    assert light == "LOADED []"
    assert loaded_by("verify", "--store", str(tmp_path / "runs")) == "LOADED []"


def test_an_evaluation_loads_no_compiler(smoke_store, tmp_path):
    """Importing PyTorch's takes longer than the episodes of a short evaluation."""
    store = str(shutil.copytree(smoke_store.path, tmp_path / "runs", symlinks=True))
    command = ["evaluate", "--policy", "moved", "--episodes", "1", "--store", store]
    modules = {"torch", "torch._dynamo"}
    assert loaded_by(*command, "--profile", "smoke", among=modules) == "LOADED ['torch']"


def test_nothing_is_unfinished():
    words = ("TODO", "FIXME", "XXX", "NotImplementedError")
    for file in PACKAGE.rglob("*.py"):
        assert not any(word in file.read_text() for word in words), file

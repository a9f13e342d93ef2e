"""Which code defines an environment: its files, their digest and its version; nothing is imported.

A package installed from an index is known by its distribution's version. Anything else is known by
its content, so that an edit changes every key.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.machinery
import importlib.metadata
import importlib.util
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote, urlparse

from irlcli.envs.spec import Code
from irlcli.errors import NotFound, UsageError

_INSTALLED = ("site-packages", "dist-packages")
_ENDINGS = (*importlib.machinery.EXTENSION_SUFFIXES, *importlib.machinery.SOURCE_SUFFIXES)
# Written for an installation from a directory, a file or a repository, not from an index (PEP 610).
_ORIGIN = "direct_url.json"


def join_path(directory: Path | None) -> None:
    """Let modules in ``directory`` and in the current one be imported, after all others."""
    for place in (directory, Path.cwd()):
        if place is not None and str(place) not in sys.path:
            sys.path.append(str(place))


def code_of(module: str, files: Sequence[str], directory: Path | None, where: str) -> Code:
    """The code of ``module`` as it is now; it is not imported.

    The content of a single file includes that of the modules beside it that it imports, and that of
    a package all its Python files. Compiled modules count as well, but not what they import.

    Args:
        module: dotted name of a module.
        files: patterns of further files that the environment reads, beside the top-level module.
        directory: of the file that names the module; searched after Python's path.
        where: who asks, for messages.

    Raises:
        NotFound: no such module, or a pattern that no file matches.
        UsageError: two modules of this name, a file that is not Python, or a pattern that is malformed
            or leads out.
    """
    join_path(directory)
    origin = _origin(module, directory, where)
    top = module.partition(".")[0]
    root = _root(origin, module)
    found = {path.relative_to(root).as_posix(): path for path in _further(files, root, where)}
    distribution = _distribution(top, root)
    if distribution is None or distribution.read_text(_ORIGIN):
        sources = [origin, *_sources(root, top, where)]
        found |= {path.relative_to(root).as_posix(): path for path in sources}
    name, version = (distribution.name, distribution.version) if distribution else (None, None)
    return Code(_digest(found) if found else None, name, version)


def _origin(module: str, directory: Path | None, where: str) -> Path:
    """The file of ``module``."""
    importlib.invalidate_caches()
    top, *inner = module.split(".")
    hint = "install it, or add its directory to PYTHONPATH"
    if directory is None:
        hint += ". Or name the TOML file that lies beside it, with --env"
    else:
        hint += f", or put {top}.py beside the TOML file"
    try:
        spec = importlib.util.find_spec(top)
        for depth in range(len(inner)):
            name = ".".join([top, *inner[: depth + 1]])
            parents = list((spec and spec.submodule_search_locations) or ())
            spec = importlib.machinery.PathFinder.find_spec(name, parents)
    except (ImportError, ValueError):
        spec = None
    if spec is None or not spec.origin or not Path(spec.origin).is_file():
        raise NotFound(f"{where}: no module {module!r} can be imported", hint)
    origin = Path(spec.origin).resolve()
    if directory is not None:
        for beside in (directory / f"{top}.py", directory / top / "__init__.py"):
            if beside.is_file() and directory.resolve() not in origin.parents:
                raise UsageError(
                    f"{where}: two modules are called {top!r}: {beside} and {origin}",
                    "rename the one beside the file",
                )
    return origin


def _root(origin: Path, module: str) -> Path:
    """The directory that holds the top-level module."""
    depth = module.count(".") + (origin.stem == "__init__")
    return origin.parents[depth]


def _further(files: Sequence[str], root: Path, where: str) -> Iterator[Path]:
    for pattern in files:
        if Path(pattern).is_absolute() or ".." in Path(pattern).parts or not pattern:
            raise UsageError(
                f"{where}: env.files: {pattern!r} leads out of the module's directory",
                f"name files below {root}",
            )
        try:
            matching = sorted(path for path in root.glob(pattern) if path.is_file())
        except (ValueError, IndexError):
            raise UsageError(
                f"{where}: env.files: {pattern!r} is not a pattern of files",
                "write for example assets/*.xml, or **/*.xml for any depth",
            ) from None
        if not matching:
            raise NotFound(
                f"{where}: env.files: no file matches {pattern!r}", f"paths are relative to {root}"
            )
        yield from matching


def _sources(root: Path, module: str, where: str) -> list[Path]:
    """The files of the top-level ``module``, and of those beside it that it imports.

    Beside an installed module are its dependencies. They are other distributions, and left out.
    """
    own = _distribution(module, root)
    found: list[Path] = []
    seen: set[str] = set()
    pending = [module]
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        files = _files(root, name)
        if name != module and files and not _is_taken(root, name, files, where):
            continue
        other = _distribution(name, root) if files else None
        if other is None or (own and other.name == own.name):
            found += files
            written = [path for path in files if path.suffix == ".py"]
            pending += [imported for path in written for imported in _imported(path, where)]
    return found


def _is_taken(root: Path, name: str, files: Sequence[Path], where: str) -> bool:
    """Whether Python imports ``name`` from its ``files`` in ``root``.

    It does not if its own library comes first on its path, or an installed package has the name of a
    mere folder.

    Raises:
        UsageError: it imports another module of that name.
    """
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        spec = None
    places = [] if spec is None else [spec.origin, *(spec.submodule_search_locations or ())]
    taken = [Path(place).resolve() for place in places if place is not None]
    here = {(root / name).resolve(), *(file.resolve() for file in files)}
    if not taken or not here.isdisjoint(taken):
        return True
    is_folder = not any(file.parent == root or file.stem == "__init__" for file in files)
    if is_folder or name in sys.stdlib_module_names:
        return False
    raise UsageError(
        f"{where}: two modules are called {name!r}: {files[0]} and {taken[0]}",
        f"rename the one in {root}",
    )


def _files(root: Path, name: str) -> list[Path]:
    """The files of ``name`` in ``root``: a module precedes a folder without __init__.py."""
    folder = root / name
    modules = [path for ending in _ENDINGS if (path := root / f"{name}{ending}").is_file()]
    if modules and not (folder / "__init__.py").is_file():
        return modules
    return sorted(path for path in folder.rglob("*") if path.name.endswith(_ENDINGS))


def _imported(path: Path, where: str) -> list[str]:
    """The top-level names that a Python file imports."""
    try:
        tree = ast.parse(path.read_bytes(), str(path))
    except (SyntaxError, ValueError) as error:
        line = getattr(error, "lineno", None)
        raise UsageError(
            f"{where}: {path}{f', line {line}' if line else ''} is not Python: "
            f"{getattr(error, 'msg', error)}",
            "fix the file",
        ) from None
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.append(node.module)
    # The versions of stages stand for this package's own code.
    return [top for name in names if (top := name.partition(".")[0]) != "irlcli"]


def _digest(files: dict[str, Path]) -> str:
    contents = {name: hashlib.sha256(p.read_bytes()).hexdigest() for name, p in files.items()}
    return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()


def _distribution(top: str, root: Path) -> importlib.metadata.Distribution | None:
    """The distribution that ``top`` in ``root`` belongs to; None for a loose file."""
    installed = not set(_INSTALLED).isdisjoint(root.parts)
    for name in (top, top.replace("_", "-")):
        try:
            found = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        if installed or _editable_at(found, root):
            return found
    names = importlib.metadata.packages_distributions().get(top, ()) if installed else ()
    return importlib.metadata.distribution(names[0]) if names else None


def _editable_at(found: importlib.metadata.Distribution, root: Path) -> bool:
    """Whether a distribution is an editable installation of a directory that holds ``root``."""
    text = found.read_text(_ORIGIN)
    if not text:
        return False
    place = unquote(urlparse(json.loads(text).get("url", "")).path)
    return bool(place) and Path(os.path.realpath(place)) in (root, *root.parents)

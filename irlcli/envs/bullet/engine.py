"""PyBullet, imported without its banner.

PyBullet's C code writes its build time to stderr on import. Without this module every command and
every worker that imports it would print that line.
"""

import importlib
import os
import tempfile

_BANNER = b"pybullet build time:"


def _import_without_banner() -> None:
    """Import pybullet, and forward what it writes to stderr, except for the banner."""
    try:
        stderr = os.dup(2)
    except OSError:  # stderr is closed, so the banner goes nowhere
        importlib.import_module("pybullet")
        return
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            importlib.import_module("pybullet")
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            caught.seek(0)
            with os.fdopen(os.dup(2), "wb") as out:
                out.writelines(line for line in caught if not line.startswith(_BANNER))


_import_without_banner()

import pybullet  # noqa: E402, F401

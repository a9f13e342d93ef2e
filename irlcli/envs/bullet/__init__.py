"""The PyBullet robots of the paper's Sec. 5.2, with the interventions of Table 2.

Each robot comes as two models: ``"merged"``, built from data with every fixed joint merged
away, and ``"original"``, the MJCF file of ``pybullet_data``. Lengths are metres, angles
radians, masses kilograms, forces newtons and torques newton metres unless said otherwise.
"""

import importlib
import os
import tempfile

_BANNER = b"pybullet build time:"


def _import_without_banner() -> None:
    """Import PyBullet, whose C code writes when it was built to stderr; pass on all else.

    A line there would spoil what reads ``--json`` with stderr merged into stdout.
    """
    try:
        stderr = os.dup(2)
    except OSError:  # closed: nothing can be written to it
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

"""Reports are drawn in the caller's process, which may be a notebook with a backend of its own."""

import subprocess
import sys


def test_a_report_leaves_pyplot_and_its_backend_alone():
    code = (
        "import sys\n"
        "from irlcli.report import ablation, control, experts, figure2, plots, scatter\n"
        "print('matplotlib.figure' in sys.modules, 'matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]

"""What a node sees of the store: run there before anything is submitted.

``python -m irlcli.experiments.cluster.probe JOBS TOKEN DIRECTORY`` prints a JSON document.
"""

import json
import os
import shutil
import sys
import time
from pathlib import Path


def look(jobs: Path, token: str, directory: Path) -> dict[str, object]:
    """The facts about the node that can make jobs fail, or give other results.

    ``jobs`` is the store's directory of submissions, which holds a file ``token``.
    """
    seen = (jobs / token).exists()
    facts: dict[str, object] = {"host": os.uname().nodename, "time": time.time(), "seen": seen}
    facts["directory"] = directory.is_dir()
    if seen:
        own = jobs / f"{token}.node"
        try:
            own.write_text(os.uname().nodename)
            own.unlink()
        except OSError as error:
            facts["problem"] = error.strerror
        facts["free"] = shutil.disk_usage(jobs).free
    return facts


if __name__ == "__main__":
    print(json.dumps(look(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))))

"""``python -m irlcli`` is ``irl``."""

from irlcli.cli import main

main()

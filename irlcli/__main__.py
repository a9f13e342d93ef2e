"""``python -m irlcli`` is ``irl``."""

from irlcli.cli.main import main

main()

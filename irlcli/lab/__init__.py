"""The notebook facade: :class:`irlcli.Lab` runs the stages that the command line runs."""

"""Errors about options, as errors about arguments."""

import re


def in_python(text: str) -> str:
    """``--penalty-weight`` as ``penalty_weight``, except in command lines between backticks."""
    text = text.replace("the same command again", "the same call again")
    text = text.replace("with --store or IRL_STORE", 'with store="DIRECTORY"')
    text = text.replace(" or IRL_STORE", "").replace("--from and IRL_FROM take", "--from takes")
    return re.sub(
        r"`[^`]*`|(?<![\w/.-])--([a-z][a-z-]*)",
        lambda found: argument(found[1]) if found[1] else found[0],
        text,
    )


def argument(option: str) -> str:
    """``penalty_weight`` for ``penalty-weight``."""
    name = option.replace("-", "_")
    return "from_" if name == "from" else name

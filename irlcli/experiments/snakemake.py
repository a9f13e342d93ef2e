"""A plan as a Snakefile, for the workflow engines that Snakemake drives."""

import json
import re
import shlex
from collections.abc import Callable, Mapping, Sequence

_HEAD = """\
# Made by `{made_by}`. One rule per step; each runs the step's own command.
#
# A rule leaves an empty file in done/, so that Snakemake knows what it has run. Whether an artefact
# exists is known to the store alone: a step that exists already ends at once.
# `snakemake --forceall` asks the store about every step.

rule all:
    input:
{everything}
"""
_RULE = """\

rule {rule}:
{inputs}    output: touch({output})
    shell: {command}
"""


def snakefile(
    needs: Mapping[str, Sequence[str]], command: Callable[[str], Sequence[str]], made_by: str
) -> str:
    """The text of a Snakefile.

    Args:
        needs: for each step, the steps that must be made first.
        command: the command line that makes the step of that name.
        made_by: the command line to mention in the first line.
    """
    rules: dict[str, str] = {}
    for name in needs:
        rule = re.sub(r"\W", "_", name)
        # Two names that differ only in signs.
        while rule in rules:
            rule += "_"
        rules[rule] = name
    everything = ",\n".join(f"        {_done(name)}" for name in needs)
    text = _HEAD.format(made_by=made_by.replace("\n", " "), everything=everything)
    for rule, name in rules.items():
        inputs = ", ".join(_done(source) for source in needs[name])
        text += _RULE.format(
            rule=rule,
            inputs=f"    input: {inputs}\n" if inputs else "",
            output=_done(name),
            # Snakemake replaces what stands in braces.
            command=_text(shlex.join(command(name)).replace("{", "{{").replace("}", "}}")),
        )
    return text


def _done(name: str) -> str:
    return _text(f"done/{name}")


def _text(text: str) -> str:
    """``text`` as a Python string. JSON's escapes of characters beyond 16 bits are not Python's."""
    return json.dumps(text, ensure_ascii=False)

"""The table of commands. Only the module of the command that is called is imported.

To add a command, write a function in a module of this package, decorated with
:func:`irlcli.cli.options.stage_command` or :func:`~irlcli.cli.options.store_command`, and add a
line here.
"""

from importlib import import_module
from keyword import iskeyword
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from irlcli import __version__
from irlcli.cli.console import print_data
from irlcli.errors import UsageError

# Command -> (module of this package, one-line help). The function has the command's name, with
# underscores; its docstring is the help of the command itself.
COMMANDS = {
    "collect-experts": ("collect", "Train an expert per setting and record its demonstrations."),
    "import": (
        "import_",
        "Turn demonstrations recorded elsewhere into an artefact like that of collect-experts.",
    ),
    "export": (
        "export",
        "Write demonstrations or a learned reward in a form that other tools read.",
    ),
    "train-airl": ("train", "Learn a reward and a student policy from demonstrations."),
    "train-maxent": ("train", "Learn a reward from demonstrations in a gridworld, exactly."),
    "transfer": ("transfer", "Train a new policy on a frozen reward in one setting."),
    "evaluate": ("evaluate", "Measure the return of a policy, an expert or a baseline."),
    "assess": ("assess", "Measure how well a learned reward ranks policies of mixed quality."),
    "play": ("play", "Draw a policy as a GIF or MP4, several settings side by side."),
    "plan": ("experiments", "Show which steps of a table exist or are missing, and why."),
    "run": ("experiments", "Compute the missing steps of a table, then its report."),
    "report": ("report", "Print or write a table or figure from stored results."),
    "envs": ("envs", "List the environments, show one, or check one."),
    "ls": ("artefacts", "List the artefacts."),
    "show": ("artefacts", "Show an artefact: its stage, parameters, inputs and outputs."),
    "lineage": ("artefacts", "Show every artefact that an artefact was made from."),
    "name": ("artefacts", "Name an artefact, which also protects it from gc."),
    "unname": ("artefacts", "Remove names, so that gc may remove what they protected."),
    "push": ("share", "Copy artefacts and all they were made from to a directory or URL."),
    "pull": ("share", "Copy artefacts and all they were made from out of a directory or URL."),
    "verify": ("integrity", "Check stored bytes against their digests."),
    "gc": ("integrity", "List or delete artefacts that no name depends on, and old job logs."),
}


class Commands(TyperGroup):
    """A group that lists :data:`COMMANDS` by their one-line help and loads one when it is called.

    Importing and inspecting all commands would take longer than a cache hit.
    """

    def __init__(self, **attributes: Any):
        super().__init__(**attributes)
        self.commands = {
            name: TyperCommand(name, short_help=help_) for name, (_, help_) in COMMANDS.items()
        }

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[Any, Any, list[str]]:
        name, _, rest = super().resolve_command(ctx, args)
        command = None if name is None else _load(name)
        # The shell completes a line that may be wrong.
        if command is not None and not ctx.resilient_parsing:
            _refuse_repeated(command, rest)
        return name, command, rest


def _refuse_repeated(command: Any, args: list[str]) -> None:
    """Refuse an option of one value that is given twice: only its last value would count.

    Raises:
        UsageError: naming the option.
    """
    given = [arg.partition("=")[0] for arg in args]
    for option in command.params:
        if option.param_type_name != "option" or option.multiple or option.is_flag:
            continue
        if sum(given.count(flag) for flag in option.opts) > 1:
            hint = f"give {option.opts[0]} once"
            if option.opts[0] == "--intervention":
                hint += "; combine knobs in a setting: --setting KNOB=VALUE,KNOB=VALUE"
            raise UsageError(f"{option.opts[0]} is given twice", hint)


def _load(name: str) -> Any:
    module, _ = COMMANDS[name]
    function_name = name.replace("-", "_") + ("_" if iskeyword(name) else "")
    function = getattr(import_module(f"irlcli.cli.{module}"), function_name)
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    single.command(name)(function)
    return typer.main.get_command(single)


app = typer.Typer(
    name="irl",
    cls=Commands,
    help="Invariant reward learning: experts, adversarial IRL, transfer, evaluation.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _print_version(asked: bool) -> None:
    if asked:
        print_data(f"irlcli {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    pass

"""README.md and docs/: links lead somewhere, commands exist, examples run."""

from __future__ import annotations

import fnmatch
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from irlcli.cli.app import app

CHECKOUT = Path(__file__).parent.parent
PAGES = [CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").glob("*.md"))]
IDS = [page.name for page in PAGES]

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str = "") -> list[str]:
    return [text for kind, text in BLOCK.findall(page.read_text("utf-8")) if kind == language]


def anchors(page: Path) -> set[str]:
    """What the headings of ``page`` are called in links, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in headings}


@pytest.mark.parametrize("page", [*PAGES, CHECKOUT / "CHANGELOG.md"], ids=[*IDS, "CHANGELOG.md"])
def test_every_relative_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", BLOCK.sub("", page.read_text("utf-8"))):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def test_the_readme_is_short() -> None:
    assert len((CHECKOUT / "README.md").read_text("utf-8").splitlines()) <= 200


def test_the_readme_leads_to_every_page() -> None:
    readme = (CHECKOUT / "README.md").read_text("utf-8")
    for page in sorted((CHECKOUT / "docs").glob("*.md")):
        assert f"(docs/{page.name})" in readme, f"no link to docs/{page.name}"


def shown_lines(page: Path) -> list[str]:
    """Every line of the code blocks and every text between backticks, without comments."""
    lines = [line.removeprefix("$ ") for text in blocks(page) for line in text.splitlines()]
    prose = re.sub(r"\s*\n\s*", " ", BLOCK.sub("", page.read_text("utf-8")))
    lines += re.findall(r"`([^`]+)`", prose)
    # In a list of commands two spaces separate a command from its description.
    return [re.split(r"\s{2,}|\s\|\s", line)[0] for line in lines if re.match(r"(irl|make) ", line)]


def shown_commands(page: Path) -> list[str]:
    """Every ``irl ...`` that names a command or an option."""
    return [text for text in shown_lines(page) if re.match(r"irl -?-?[a-z]", text)]


def check_command(text: str) -> None:
    """Fails if there is no such command or option, or results lack the names of their own they need."""
    group = typer.main.get_command(app)
    words = shlex.split(text.replace("[", "").replace("]", ""), comments=True)[1:]
    words = [word for word in words if word not in ("...", "\\")]
    context = group.make_context("irl", ["ls"])
    if words[0].startswith("--"):
        known = {option for parameter in group.get_params(context) for option in parameter.opts}
        assert words[0] in known, text
        return
    assert words[0] in group.list_commands(context), text
    _, command, rest = group.resolve_command(context, words)
    own = command.make_context(words[0], [], resilient_parsing=True)
    parameters = command.get_params(own)
    known = {o for parameter in parameters for o in (*parameter.opts, *parameter.secondary_opts)}
    given = {word.partition("=")[0] for word in rest if word.startswith("--")}
    assert given <= known, text
    if words[0] in ("plan", "run") and given & {"--set", "--settings", "--choose-penalty"}:
        assert "--tag" in given, text


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_every_command_shown_has_its_options(page: Path) -> None:
    for text in shown_commands(page):
        check_command(text)


def test_the_commands_of_published_results_have_their_options() -> None:
    for page in sorted((CHECKOUT / "docs" / "results").rglob("README.md")):
        for text in shown_commands(page):
            check_command(text)


@pytest.mark.parametrize(
    "text",
    [
        "irl train-aril --demos x",
        "irl transfer --rewards x",
        "irl --versio",
        "irl run figure2 --set maxent.inputs=coordinates",
    ],
)
def test_a_command_that_fails_is_noticed(text: str) -> None:
    with pytest.raises(AssertionError):
        check_command(text)


def make_targets() -> list[str]:
    """The Makefile's targets as patterns, ``%`` as ``*``."""
    heads = re.findall(
        r"^([a-z%][^:=\n]*):(?!=)", (CHECKOUT / "Makefile").read_text(), re.MULTILINE
    )
    return [word.replace("%", "*") for head in heads for word in head.split()]


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_every_make_target_shown_exists(page: Path) -> None:
    targets = make_targets()
    for text in shown_lines(page):
        words = [word for word in shlex.split(text, comments=True) if "=" not in word]
        for word in words[1:] if words[:1] == ["make"] else []:
            assert any(fnmatch.fnmatch(word, target) for target in targets), text


def test_make_help_names_every_target_and_variable() -> None:
    done = subprocess.run(["make", "help"], cwd=CHECKOUT, capture_output=True, text=True)
    words = set(re.findall(r"[\w-]+", done.stdout))
    assert {target for target in make_targets() if "*" not in target} <= words
    assert {"PROFILE", "CLUSTER", "RESULTS"} <= words


def test_every_table_has_a_make_target_and_is_in_the_docs() -> None:
    tables = tomllib.loads((CHECKOUT / "settings" / "experiments.toml").read_text())
    names = tables.keys() - {"defaults"}
    assert names <= set(make_targets())
    page = (CHECKOUT / "docs" / "command-line.md").read_text()
    assert [name for name in names if f"`{name}`" not in page] == []


@pytest.mark.parametrize("name", ["python-api.md", "environments.md"])
def test_the_python_of_a_page_runs(name: str, tmp_path: Path, store_copy: object) -> None:
    """In the directory of a store that holds some of what the page makes."""
    code = "\n".join(blocks(CHECKOUT / "docs" / name, "python"))
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr

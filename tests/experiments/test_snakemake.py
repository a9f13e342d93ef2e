"""``irl plan TABLE --to snakemake``: a Snakefile with one rule per step."""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import subprocess
import sys

import pytest

from irlcli.experiments.snakemake import snakefile

TABLES = """
[tiny]
rows = ["lunar-lander.engine-power"]
methods = ["erm"]
seeds = [0]
measures = ["zero-shot"]
"""


@pytest.fixture
def planned(irl, tmp_path):
    """What ``irl plan`` prints of a small table with these options."""
    tables = tmp_path / "tables.toml"
    tables.write_text(TABLES)
    words = ["plan", "tiny", "--experiments", tables, "--profile", "smoke"]

    def run(*more):
        done = irl(*words, "--store", tmp_path / "runs", *more)
        assert done.code == 0, done.err
        return done.out

    return run


def test_each_step_is_a_rule_that_runs_its_command_after_what_it_needs(planned):
    steps = json.loads(planned("--json"))["steps"]
    text = planned("--to", "snakemake")
    rules = dict(re.findall(r"^rule (\w+):\n((?:    .*\n?)+)", text, re.MULTILINE))
    assert len(rules) == len(steps) + 1
    for step in steps:
        assert f'"done/{step["name"]}"' in rules["all"]
        (rule,) = (r for r in rules.values() if f'touch("done/{step["name"]}")' in r)
        command = json.loads(re.search(r"shell: (.*)", rule)[1])
        assert shlex.split(command) == step["command"]
        inputs = re.search(r"input: (.*)", rule)
        needs = re.findall(r'"done/([^"]+)"', inputs[1]) if inputs else []
        assert needs == step["needs"]


def test_braces_in_a_command_are_no_wildcards():
    text = snakefile({"a": ()}, lambda name: ["irl", "--set", "x={y}"], "irl plan")
    assert "x={{y}}" in text


def test_a_path_is_written_as_it_is():
    text = snakefile({"a": ()}, lambda name: ["irl", "--store", "st 🚀"], "irl plan")
    (command,) = re.findall(r"shell: (.*)", text)
    assert ast.literal_eval(command) == "irl --store 'st 🚀'"


def test_names_that_differ_in_signs_only_have_rules_of_their_own():
    text = snakefile({"a.b": (), "a-b": ()}, lambda name: ["irl", name], "irl plan")
    assert len(set(re.findall(r"^rule (\w+):", text, re.MULTILINE))) == 3


@pytest.mark.skipif(shutil.which("snakemake") is None, reason="snakemake is not installed")
def test_snakemake_runs_it_as_it_is(planned, tmp_path):
    (tmp_path / "Snakefile").write_text(planned("--until", "experts", "--to", "snakemake"))
    (tmp_path / "irl").write_text(f'#!/bin/sh\nexec {sys.executable} -m irlcli "$@"\n')
    (tmp_path / "irl").chmod(0o755)
    line = f"PATH={tmp_path}:$PATH snakemake --cores 1 --directory {tmp_path}"
    subprocess.run(["bash", "-c", line], cwd=tmp_path, check=True)
    steps = json.loads(planned("--until", "experts", "--json"))["steps"]
    assert {step["status"] for step in steps} == {"HIT"}


def test_an_unknown_engine_is_refused(irl):
    done = irl("plan", "table1", "--to", "airflow")
    assert done.code == 2 and "snakemake" in done.err

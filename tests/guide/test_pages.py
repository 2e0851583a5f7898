"""The guide and the README: commands and options exist, links lead somewhere, lists are lists."""

import itertools
import re
import shlex
from pathlib import Path

import pytest
import typer

from rig.bridge.mode_supervisor import Event
from rig.cli.main import app
from rig.guide.reference import generated_blocks
from rig.guide.site import GENERATED, PAGES, fill_page
from tests.guide.generated import blocks

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *sorted(PAGES.rglob("*.md"))]
README_WORDS = 1500

COMMANDS = typer.main.get_command(app)
"""The command line, as click has it."""


def name_of(path):
    return str(path.relative_to(ROOT))


def code_lines(text):
    """Indented lines of code, and code within sentences."""
    for line in text.splitlines():
        if line.startswith("    "):
            yield line.strip()
        else:
            yield from re.findall(r"`([^`]+)`", line)


def calls(text):
    """Words of each call of rig in a text."""
    for code in code_lines(text):
        line = re.sub(r"\s#.*", "", code)
        if re.match(r"rig [a-z]", line) and "YAML" not in line:
            yield line, shlex.split(line)[1:]


def command_of(words):
    """The command that is called, with its words."""
    command, rest = COMMANDS, list(words)
    while hasattr(command, "commands") and rest and rest[0] in command.commands:
        command = command.commands[rest.pop(0)]
    return command, rest


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_every_command_and_option_exists(path):
    for line, words in calls(path.read_text("utf-8")):
        command, rest = command_of(words)
        if hasattr(command, "commands"):
            # A group is meant, or a sentence begins with the program's name.
            assert words[0] in COMMANDS.commands, line
            continue
        options = {name for parameter in command.params for name in parameter.opts}
        options |= {name for parameter in command.params for name in parameter.secondary_opts}
        used = {word.partition("=")[0] for word in rest if word.startswith("--")}
        assert used <= {*options, "--help"}, line


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_lists_are_lists(path):
    """A list that follows a paragraph without an empty line is one paragraph."""
    lines = path.read_text("utf-8").splitlines()
    for before, line in itertools.pairwise(lines):
        if re.match(r"(-|\d+\.) ", line):
            assert not before or re.match(r"(-|\d+\.) |  ", before), f"{name_of(path)}: {line}"
        if line.startswith("|") and not before.startswith("|"):
            assert not before, f"{name_of(path)}: {line}"


def test_the_readme_can_be_read_in_six_minutes():
    assert len((ROOT / "README.md").read_text("utf-8").split()) <= README_WORDS


def test_links_of_the_readme_lead_somewhere():
    text = (ROOT / "README.md").read_text("utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if not link.startswith("http")]
    assert len(links) > 5
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_each_generated_part_stands_in_a_page():
    named = {name for path in TEXTS for name in GENERATED.findall(path.read_text("utf-8"))}
    assert named == set(generated_blocks(str, {}))


@pytest.mark.parametrize(
    "path", [it for it in TEXTS if GENERATED.search(it.read_text("utf-8"))], ids=name_of
)
def test_generated_parts_are_those_of_the_code(path):
    """`python -m tests.guide` writes them again."""
    assert path.read_text("utf-8") == fill_page(path, blocks(), None)


def test_each_cause_of_a_mode_is_explained():
    text = (PAGES / "reference" / "run-folder.md").read_text("utf-8")
    assert [event.value for event in Event if f"`{event.value}`" not in text] == []

"""The pages: every command in them is one that its script takes, and every link leads somewhere."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *ROOT.glob("docs/*.md"), *ROOT.glob("trained_agents/**/*.md")])
CODE = re.compile(r"^ *```[^\n]*\n(.*?)^ *```|`([^`\n]+)`", re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"^    (\S.*)", re.MULTILINE)
COMMAND = re.compile(r"^(?:\$ )?(?:[\w./]*python )?zoo/(\w+)\.py\b(.*)", re.MULTILINE)
STANDS_FOR = {"S": "1", "$seed": "1"}
LINK = re.compile(r"\]\(([^)\s]+)\)")


def of_pages(find):
    found = [(page, own) for page in PAGES for own in find(page.read_text())]
    return [pytest.param(page, own, id=f"{page.relative_to(ROOT)} {own}") for page, own in dict.fromkeys(found)]


def commands(text):
    """The command lines of a page: name of the script and what follows."""
    text = text.replace("\\\n", " ")
    blocks = [block for block, _ in CODE.findall(text)] + INDENTED.findall(text)
    return [match for block in blocks for match in COMMAND.findall(re.sub(r"^ +", "", block, flags=re.MULTILINE))]


def flags(text):
    """The flags that the prose of a page names: name of the script and each."""
    spans = [match for _, span in CODE.findall(text) for match in COMMAND.findall(span)]
    return [(script, flag) for script, line in spans for flag in re.findall(r"(?<= )--?[a-z][\w-]*", line)]


def headings(page):
    """The anchors that the headings of a page get."""
    lines = re.findall(r"^#+ (.+)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line).strip().lower().replace(" ", "-") for line in lines}


def parser_of(script):
    return import_module(f"zoo.{script}").make_parser()


@pytest.mark.parametrize(("page", "command"), of_pages(commands))
def test_commands(page, command):
    script, line = command
    parser_of(script).parse_all([STANDS_FOR.get(word, word) for word in shlex.split(line, comments=True)])


@pytest.mark.parametrize(("page", "flag"), of_pages(flags))
def test_flags(page, flag):
    script, name = flag
    assert name in parser_of(script)._option_string_actions


@pytest.mark.parametrize(("page", "target"), of_pages(LINK.findall))
def test_links(page, target):
    if re.match(r"[a-z]+:", target):
        return
    path, _, anchor = target.partition("#")
    file = (page.parent / path) if path else page
    assert file.exists()
    assert not anchor or anchor in headings(file) or f"::: {anchor}" in file.read_text()


def test_they_are_found():
    text = "`python zoo/plot.py -o a`\n\n```\n$ zoo/train.py -n 3 \\\n  --seed 1\n```\n\n    zoo/match.py b"
    assert commands(text) == [("train", " -n 3    --seed 1"), ("match", " b")]
    assert flags(text) == [("plot", "-o")]
    assert len(of_pages(commands)) > 60 and len(of_pages(flags)) > 10 and len(of_pages(LINK.findall)) > 80

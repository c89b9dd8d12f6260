"""The page "bring your own environment": every line of its code is run, in order, as its reader would."""

import re
import runpy
import shlex
from pathlib import Path

import pytest

from zoo import train

PAGE = Path(__file__).parents[1] / "docs" / "own_environment.md"
COMMAND = [".venv/bin/python", "zoo/train.py"]


@pytest.mark.filterwarnings("ignore:the state of .* cannot be read")
def test_every_line_of_the_page_runs(tmp_path, monkeypatch, capsys):
    pytest.importorskip("supersuit")
    pytest.importorskip("mpe2")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert {language for language, _ in blocks} == {"python", "yaml", ""}
    names = {"__name__": "page"}
    commands = 0
    for language, text in blocks:
        file = re.match(r"# (\w+\.\w+)\n", text)
        if file:
            (tmp_path / file[1]).write_text(text)
        if language == "":
            for line in text.splitlines():
                words = shlex.split(line)
                assert words[:2] == COMMAND
                assert train.main(words[2:]) == 0
                commands += 1
        elif language == "python" and "__main__" in text:
            runpy.run_path(str(tmp_path / file[1]), run_name="__main__")
        elif language == "python" and not file:
            exec(compile(text, str(PAGE), "exec"), names)
    assert commands == 2
    assert names["step"].shape == (1,)
    assert "return_walker" in capsys.readouterr().out
    assert set(names["episodes"]) == {"reward", "length", "return_guide", "return_walker"}

"""Apply the recipes of CONTRIBUTING.md to a copy of the sources."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from exhaustive import exhaustive

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PLACE = r"In `(?P<path>[^`]+)`, (?P<how>at the end of|at the end|before|anew)(?: `(?P<anchor>[^\n]*)`)?"
STEP = re.compile(
    rf"^ *(?:\d\. )?(?:(?P<then>Then)|{PLACE}):\n\n(?P<indent> *)```python\n(?P<code>.*?)\n(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
RECIPES = re.findall(r"^### (.*)$", TEXT, re.MULTILINE)


def steps_until(recipe: str) -> list[re.Match[str]]:
    """Return the steps of all recipes up to this one, because a recipe may continue an earlier one."""
    end = TEXT.find("\n### ", TEXT.index(f"### {recipe}") + 1)
    return list(STEP.finditer(TEXT[: None if end < 0 else end]))


def apply(step: re.Match[str], sources: Path) -> None:
    file = sources / step["path"].removeprefix("src/")
    body = "\n".join(line[len(step["indent"]) :] for line in step["code"].split("\n"))
    if step["how"] == "anew":
        file.write_text(textwrap.dedent(body) + "\n")
        return
    text = file.read_text(encoding="utf-8")
    if step["how"] == "at the end":
        text = f"{text}\n\n{body}\n"
    elif step["how"] == "at the end of":
        begin = text.index(step["anchor"])
        end = re.search(r"\n\n\n|\Z", text[begin:])
        assert end is not None
        at = begin + end.start()
        text = f"{text[:at].rstrip()}\n{body}\n{text[at:]}"
    else:
        assert text.count(step["anchor"]) >= 1, step["anchor"]
        text = text.replace(step["anchor"], f"{body}\n{step['anchor']}", 1)
    file.write_text(text, encoding="utf-8")


@pytest.mark.parametrize("recipe", [*map(exhaustive, RECIPES[:-1]), RECIPES[-1]])
def test_recipe_works(recipe: str, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "src" / "aerokit", tmp_path / "aerokit", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "tests" / "helpers", tmp_path / "tests" / "helpers")
    steps = steps_until(recipe)
    for step in steps:
        if not step["then"]:
            apply(step, tmp_path)
    check = textwrap.dedent(steps[-1]["code"])
    assert steps[-1]["then"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tmp_path, tmp_path / "tests" / "helpers")))}
    done = subprocess.run(
        [sys.executable, "-c", check],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_four_recipes_have_all_their_steps() -> None:
    assert len(RECIPES) == 4
    counts = [len(steps_until(recipe)) for recipe in RECIPES]
    assert counts == [3, 6, 10, 12], (
        "a step begins with 'In `path`, before|at the end of|anew …:' or 'Then:' (see STEP)"
    )

"""The pages of docs/ keep pace with the scripts: options, curves, equations' places, excerpts and links."""

import ast
import importlib
import json
import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

import envs
from envs.run import RunArgs

ROOT = Path(envs.__file__).parents[1]
METHODS = ROOT / "docs" / "methods"
SCRIPTS = sorted(path.stem for path in (ROOT / "algos").glob("*.py"))
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PARTS = [
    "Equations",
    "Options",
    "Curves",
    "Beside the paper and the original code",
    "What was found here",
    "Known deviations",
]


def part(page, heading):
    """The text under a heading of the second level, up to the next."""
    return re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL).group(1)


def options(text):
    """{option: what its table says of the default}"""
    return dict(re.findall(r"^\| `(--[a-z-]+)` \| (.*?) \|", text, re.MULTILINE))


def recorded_curves(source):
    """The names of the curves that a script's `run.record` is given, by keyword or as `**figures`."""
    tree, names = ast.parse(source), set()
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    (record,) = [call for call in calls if ast.unparse(call.func) == "run.record"]
    dicts = {
        node.targets[0].id: node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    for keyword in record.keywords:
        given = [keyword] if keyword.arg else dicts[keyword.value.id].keywords
        names |= {"losses/policy_loss" if word.arg == "policy_loss" else f"charts/{word.arg}" for word in given}
    return names


def test_every_script_has_a_page_and_the_index_lists_it():
    assert sorted(path.stem for path in METHODS.glob("*.md")) == sorted([*SCRIPTS, "README"])
    assert set(re.findall(r"^\| \[(\w+)\]\(\1\.md\)", (METHODS / "README.md").read_text(), re.MULTILINE)) == set(SCRIPTS)


def test_the_options_of_all_runs_are_explained_once():
    explained = options(part((METHODS / "README.md").read_text(), "Options of all runs"))
    assert list(explained) == [f"--{field.name.replace('_', '-')}" for field in fields(RunArgs)]


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_page_has_its_parts_in_order(script):
    page = (METHODS / f"{script}.md").read_text()
    assert re.match(r"# .+\n\n\S", page)
    assert re.findall(r"^##? (.+)$", page, re.MULTILINE)[1:] == PARTS


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_page_has_every_option_with_its_default(script):
    explained = options(part((METHODS / f"{script}.md").read_text(), "Options"))
    own = {field.name: field.default for field in fields(importlib.import_module(f"algos.{script}").Args)}
    for field in fields(RunArgs):
        del own[field.name]
    assert list(explained) == [f"--{name.replace('_', '-')}" for name in own]
    for said, default in zip(explained.values(), own.values(), strict=True):
        if default is None:
            assert re.search("tuned|Table 1", said, re.IGNORECASE)
        elif isinstance(default, tuple):
            assert said == " ".join(map(str, default))
        else:
            assert said == (default if isinstance(default, str) else f"{default:g}")


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_page_explains_every_curve_of_its_script(script):
    names = recorded_curves((ROOT / "algos" / f"{script}.py").read_text())
    curves = part((METHODS / f"{script}.md").read_text(), "Curves")
    assert names <= set(re.findall(r"^\| `([\w/]+)` \|", curves, re.MULTILINE))


@pytest.mark.parametrize("path", sorted(METHODS.glob("*.md")), ids=lambda path: path.stem)
def test_equations_name_functions_and_classes_that_are_there(path):
    for name, script in re.findall(r"\[`([\w.]+)`\]\(\.\./\.\./(algos/\w+\.py)\)", path.read_text()):
        for word in name.split("."):
            assert re.search(rf"^ *(def|class) {word}\b", (ROOT / script).read_text(), re.MULTILINE), (name, script)


def test_excerpts_in_the_tutorial_stand_in_the_scripts():
    tutorial = (ROOT / "docs" / "tutorial.md").read_text()
    excerpts = re.findall(r"From\s\[[\w/.]+\]\(\.\./(algos/\w+\.py)\),\s`[\w.]+`:\n\n```python\n(.*?)```", tutorial, re.DOTALL)
    assert len(excerpts) == tutorial.count("```python")
    for script, excerpt in excerpts:
        assert excerpt in (ROOT / script).read_text(), (script, excerpt)


def test_relative_links_lead_to_files():
    missing = set()
    for text in TEXTS:
        words = re.sub(r"^```.*?^```", "", text.read_text(), flags=re.MULTILINE | re.DOTALL)
        links = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", words)
        missing |= {path for link in links if not (path := (text.parent / link).resolve()).exists()}
    assert not missing


# --- the notebook ---


def test_the_notebook_runs(tmp_path):
    for name in ("algos", "envs"):
        (tmp_path / name).symlink_to(ROOT / name)
    cells = json.loads((ROOT / "docs" / "look_inside.ipynb").read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    code = code.replace("num_episodes=1500", "num_episodes=200")
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.search(r"meeting +10 episodes, steps \[", done.stdout)

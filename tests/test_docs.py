"""The pages of docs/ keep pace with scripts and worlds: options, curves, equations' places, excerpts, optima and links."""

import ast
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
import textwrap
from dataclasses import fields
from pathlib import Path

import pytest

import envs
from envs.run import RunArgs
from tests.helpers import SCRIPTS

ROOT = Path(envs.__file__).parents[1]
METHODS = ROOT / "docs" / "methods"
WORLDS = list(envs.WORLDS)
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PARTS = [
    "Equations",
    "Options",
    "Curves",
    "Beside the paper and the original code",
    "What was found here",
    "Known deviations",
]
WORLD_PARTS = ["Map", "Rules", "Options", "Exact optimum", "What is hard about it", "Source and differences"]


def part(page, heading):
    """The text under a heading of the second level, up to the next."""
    return re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL).group(1)


def world_page(name):
    return (ROOT / "docs" / "worlds" / f"{name}.md").read_text(encoding="utf-8")


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
            assert re.search("tuned|Table 1|^None: .* in (Climbing|MoveBox), .* elsewhere", said, re.IGNORECASE)
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


def test_the_site_leads_to_every_page():
    """Told from mkdocs.yml as text: the tests need no mkdocs. README.md is its first page, as index.md."""
    listed = re.findall(r"^ +- (?:[^:\n]+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted(["index.md", *pages])


# --- the worlds ---


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_has_a_page_in_the_common_shape(name):
    page = world_page(name)
    opening = rf"# (\w+)\n\n!\[optimal play of {name}\]\(\.\./optimal-{name}\.gif\)\n\n(.*?)\n\n## "
    title, about = re.match(opening, page, re.DOTALL).groups()
    assert title == envs.WORLDS[name].__name__
    assert len(re.findall(r"\.(?=\s|$)", about)) == 3  # sentences
    words = re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL)  # walls look like headings
    assert re.findall(r"^##? (.+)$", words, re.MULTILINE)[1:] == WORLD_PARTS
    assert re.findall(r"^- \*\*(\w+)\.\*\*", part(page, "Rules"), re.MULTILINE) == ["Actions", "Observation", "Rewards", "Ends"]
    index = (ROOT / "docs" / "worlds.md").read_text(encoding="utf-8")
    assert re.search(rf"^\| \[`{name}`\]\(worlds/{name}\.md\) \|", index, re.MULTILINE)


def test_there_is_no_page_without_a_world():
    assert sorted(path.stem for path in (ROOT / "docs" / "worlds").glob("*.md")) == sorted(WORLDS)


@pytest.mark.parametrize("name", WORLDS)
def test_a_worlds_map_and_actions_are_those_of_its_file(name):
    page, world = world_page(name), envs.WORLDS[name]
    (drawn,) = re.findall(r"```\n(.*?)```", part(page, "Map"), re.DOTALL)
    assert textwrap.indent(drawn, "    ") in sys.modules[world.__module__].__doc__
    actions = ", ".join(f"{k} {action}" for k, action in enumerate(world.action_names))
    assert f"- **Actions.** {actions}." in part(page, "Rules")


@pytest.mark.parametrize("name", WORLDS)
def test_a_page_has_every_option_of_its_world_with_its_default(name):
    told = re.findall(r"^\| `(\w+)` \| (.*?) \| \S", part(world_page(name), "Options"), re.MULTILINE)
    defaults = [(option, each.default) for option, each in inspect.signature(envs.WORLDS[name]).parameters.items()]
    assert told == [(option, f"{value:g}" if isinstance(value, float) else str(value)) for option, value in defaults]


@pytest.mark.parametrize("name", WORLDS)
def test_the_optimum_on_a_worlds_page_is_what_the_search_gives(name):
    told = part(world_page(name), "Exact optimum")
    assert re.findall(r"```\n(.*?)\n```", told, re.DOTALL) == [str(envs.optimum(name))]
    assert f"python -c \"import envs; print(envs.optimum('{name}'))\"" in told


@pytest.mark.parametrize("name", WORLDS)
def test_random_play_is_as_the_pages_say(name, capsys):
    """The program in docs/worlds.md, which takes a second or two, with this world in the place of pushbox."""
    index = (ROOT / "docs" / "worlds.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(import numpy as np, envs\n.*?)```", index, re.DOTALL)
    exec(program.replace("pushbox", name), {})
    per_step, mean, *ends = map(float, re.findall(r"-?\d+\.?\d*(?:e-\d+)?", capsys.readouterr().out))
    assert re.search(rf"^\| \[`{name}`\].* \| {per_step:.3f} \|$", index, re.MULTILINE)
    (told,) = re.findall(r"- \*\*Random play\*\* ((?:.+\n)+)", part(world_page(name), "What is hard about it"))
    numbers = re.findall(r"-?\d+(?:\.\d+)?", told.replace("10 000", ""))
    if name == "cleaner":
        assert numbers == [f"{mean:.1f}", "71"]
    else:
        counts = [f"{count:g}" for count in ends if count]
        assert sorted(numbers) == sorted(counts + ([f"{mean:.0f}"] if name == "gotogether" else []))


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

"""Take in finished cells of the comparison; redraw docs/, rewrite the README's tables and make report.html.

    python benchmark/report.py                           # at any time, also half-way

report.html holds everything in one file: figures, tables, GIFs of trained teams, settings, versions. Of two results of a cell
that differ in length only, the longer counts.
"""

import base64
import html
import io
import sys
import tempfile
from datetime import datetime
from pathlib import Path

import numpy as np
import tyro
from matplotlib import pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark import figures, results, statistics
from benchmark.cells import METHODS, OPTIMIZERS, ROOT, RUNS, WORLDS, name_of, script, select

README, DOCS = ROOT / "README.md", ROOT / "docs"
HEAD = """<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>The comparison</title>"""
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 1300px; margin: 0 auto; padding: 1rem; }
h1 { line-height: 1.2; } h2 { margin-top: 2.5rem; border-bottom: 1px solid #ddd; }
img { max-width: 100%; height: auto; } .wide { overflow-x: auto; } .wide img { min-width: 40rem; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
td, th { padding: 0.2rem 0.6rem; border-bottom: 1px solid #e4e4e4; text-align: left; white-space: nowrap; }
.teams { display: flex; flex-wrap: wrap; gap: 1rem; } figure { margin: 0; } figcaption { font-size: 0.85rem; }
"""


def score_table(found):
    """Reward per step over the last 5 % of the episodes of everything that is kept."""
    rows = [["world", "method", "episodes"]]
    for optimizer in OPTIMIZERS:
        rows[0] += [f"{optimizer}: reward per step", "worst trial", "at best end"]
    worlds, methods = results.named_in(found)
    for world in worlds:
        for method in methods:
            pair = [found.get((world, method, optimizer)) for optimizer in OPTIMIZERS]
            if any(pair):
                lengths = ", ".join(sorted({str(result.num_episodes) for result in pair if result}))
                words = [word for result in pair for word in scores(world, result)]
                rows.append([Path(world).stem, name_of(method), lengths, *words])
        if rows[-1][0] == Path(world).stem and np.isfinite(statistics.optimum(world)):
            best = f"*{statistics.optimum(world):.2f}*"
            rows.append([Path(world).stem, "*exact optimum*", "", best, "", "", best, "", ""])
    return rows


def scores(world, result):
    """The three columns of one result."""
    if result is None:
        return ["", "", ""]
    mean, error = statistics.mean_and_error(result.last)
    best = envs.make_world(world)
    count = f"{np.sum(result.usual == best.best_outcome)} of {len(result.usual)}" if best.outcome_names else "-"
    return [f"{mean:.2f} ± {error:.2f}", f"{result.last.min():.2f}", count]


def difference_table(found, one="decespg", other="spg"):
    """What one method adds to another: mean difference and 95 % interval."""
    rows = [["world", *OPTIMIZERS]]
    for world in WORLDS:
        pairs = [[found.get((world, method, optimizer)) for method in (one, other)] for optimizer in OPTIMIZERS]
        if any(all(pair) for pair in pairs):
            words = ["{:+.2f} [{:+.2f}, {:+.2f}]".format(*statistics.difference(*pair)) if all(pair) else "" for pair in pairs]
            rows.append([world, *words])
    return rows


def cell_table(found):
    """The cells that are there: how long they took, and from which commit they are."""
    rows = [["world", "method", "optimiser", "episodes", "minutes", "commit"]]
    for (world, method, optimizer), result in found.items():
        minutes = "" if np.isnan(result.seconds) else f"{result.seconds / 60:.1f}"
        who, commit = [Path(world).stem, name_of(method), optimizer], result.about.get("commit", "")[:10]
        rows.append([*who, str(result.num_episodes), minutes, commit])
    return rows


def settings_table():
    """What the tuning rule has chosen: the method's numbers in each world, under each optimiser."""
    rows = [["method", "world", *OPTIMIZERS]]
    for method in METHODS:
        tuned = script(method).TUNED
        for world in WORLDS:
            chosen = [tuned.get((world, optimizer), {}) for optimizer in OPTIMIZERS]
            rows.append([name_of(method), world, *(", ".join(f"{k} {v:g}" for k, v in numbers.items()) for numbers in chosen)])
    return rows


def versions(found):
    """The versions with which the results were made."""
    packages = ("python", "torch", "numpy", "numba", "gymnasium")
    seen = {name: sorted({result.about[name] for result in found.values()}) for name in packages}
    return ", ".join(f"{name} {' and '.join(numbers)}" for name, numbers in seen.items())


def whole_comparison_hours(found, cores=2):
    """Hours that all cells take at Table 1's episodes on some cores, by the kept times."""
    pace = results.seconds_per_episode(found)
    cells = select(METHODS, WORLDS, OPTIMIZERS)
    return sum(pace[cell.method, cell.world] * cell.settings["num_episodes"] for cell in cells) / 3600 / cores


def all_figures(found):
    """{name: figure} of what can be drawn from the results."""
    drawn = {}
    others = results.named_in(found)[1][len(METHODS) :]
    for name, methods in figures.FIGURES.items():
        methods = (*methods, *others)
        own = [method for method in methods if method not in ("pg", "espg", "decespg")]
        if any(method in own for _, method, _ in found):
            drawn[name] = figures.learning_curves(found, methods)
            drawn[f"{name}-best"] = figures.share_at_best(found, methods)
    if any(len(result.actions) for result in found.values()):
        drawn["figure5"] = figures.trajectories(found)
    worlds = ("findtreasure", "pushbox")  # where every method has all its episodes
    shares = {optimizer: statistics.scores_over_worlds(found, optimizer, worlds) for optimizer in OPTIMIZERS}
    if all("decespg" in methods and len(methods) > 1 for methods in shares.values()):
        means = {optimizer: statistics.interquartile_means(scores) for optimizer, scores in shares.items()}
        drawn["iqm"] = figures.intervals(means, "interquartile mean of reward per step / optimum")
        better = {optimizer: statistics.improvements(scores) for optimizer, scores in shares.items()}
        drawn["improvement"] = figures.intervals(better, "probability that DecESPG's trial is better")
    return drawn


def markdown(rows):
    """A table, its first row the head."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [rows[0], ["---"] * len(rows[0]), *rows[1:]])


def html_table(rows):
    """The same for a page; words between stars are slanted."""

    def cells(row, tag):
        words = [f"<i>{html.escape(word.strip('*'))}</i>" if word.startswith("*") else html.escape(word) for word in row]
        return "<tr>" + "".join(f"<{tag}>{word}</{tag}>" for word in words) + "</tr>"

    body = "".join(cells(row, "td") for row in rows[1:])
    return f'<div class="wide"><table>{cells(rows[0], "th")}{body}</table></div>'


def embedded(kind, data, about):
    """An image inside the page."""
    return f'<img alt="{html.escape(about)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}">'


def svg(figure, about):
    """A figure inside the page, crisp at any size."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return f'<div class="wide">{embedded("svg+xml", file.getvalue(), about)}</div>'


def team_films(found, methods=("pg", "decespg"), optimizer="sign", longest=200):
    """GIFs of the first trial's trained teams, one episode each, of its first `longest` steps."""
    films = []
    for world_name in WORLDS:
        for method in methods:
            result = found.get((world_name, method, optimizer))
            if result is None or not len(result.actions):
                continue
            world = envs.make_world(world_name)
            states = figures.episode_states(world, result.actions[:longest])
            frames = [envs.draw(world, state, cell=32, caption=f"step {t}") for t, state in enumerate(states)]
            words = f"{name_of(method)} in {world_name}, {len(result.actions)} steps"
            with tempfile.TemporaryDirectory() as folder:
                envs.save_gif(film := Path(folder) / "team.gif", frames)
                films.append(f"<figure>{embedded('gif', film.read_bytes(), words)}<figcaption>{words}</figcaption></figure>")
    return f'<div class="teams">{"".join(films)}</div>'


CAPTIONS = {
    "figure3": "Figure 3: the baselines. Mean and standard error over 20 trials.",
    "figure4": "Figure 4: the ablation, what bonus and memory do by themselves.",
    "figure6": "Figure 6: single components exchanged.",
    "figure5": "Figure 5: ways of trained teams (first trial, sign), from the rings on.",
    "iqm": "Interquartile mean over FindTreasure and PushBox, 95 % stratified bootstrap intervals (rliable).",
    "improvement": "Probability that a trial of DecESPG ends better than one of the method, over both worlds (0.5: none).",
}


def page(found, drawn):
    """report.html."""
    parts = ["<h1>Cooperative multi-agent exploration: the comparison</h1>"]
    cells, hours = select(METHODS, WORLDS, OPTIMIZERS), whole_comparison_hours(found)
    there = f"{len(found)} of {len(cells)} cells of 20 trials are there"
    parts.append(f"<p>{datetime.now():%Y-%m-%d}: {there}, made with {versions(found)}. ")
    parts.append(f"All of them at Table 1's episodes take about {hours:.0f} hours on two cores.</p>")
    parts += ["<h2>Reward per step, last 5 % of the episodes</h2>", html_table(score_table(found))]
    parts += ["<h3>DecESPG minus SPG: what the bonus adds to the memory</h3>", html_table(difference_table(found))]
    for name, figure in drawn.items():
        caption = CAPTIONS.get(name, "Share of the trials that end most of 100 episodes in the best outcome.")
        parts += [f"<h2>{caption}</h2>" if name in CAPTIONS else f"<p>{caption}</p>", svg(figure, caption)]
    parts += ["<h2>Trained teams</h2>", team_films(found)]
    parts += ["<h2>Cells</h2>", html_table(cell_table(found)), "<h2>Settings</h2>", html_table(settings_table())]
    return f"<!doctype html><html lang=en><head>{HEAD}<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"


def rewrite(readme, name, text):
    """Put a table between the marks <!-- name --> and <!-- end name --> of the README."""
    marks = f"<!-- {name} -->", f"<!-- end {name} -->"
    before, _, rest = readme.partition(marks[0])
    _, _, after = rest.partition(marks[1])
    return f"{before}{marks[0]}\n{text}\n{marks[1]}{after}"


def main(runs: Path = RUNS, output: Path = Path("report.html"), scripts: tuple[Path, ...] = ()):
    """Take in new runs, redraw, rewrite.

    Args:
        runs: where the cells have worked
        output: the page
        scripts: files of your own methods, if they are not in algos/
    """
    results.take_in(runs, tuple(map(str, scripts)))
    found = results.kept()
    if not found:
        print("report.py: there is no result yet; ./benchmark.sh makes some.", file=sys.stderr)
        sys.exit(2)
    drawn = all_figures(found)
    for name, figure in drawn.items():
        figure.savefig(DOCS / f"{name}.png", dpi=130)
    with envs.complete_file(output) as file:
        file.write(page(found, drawn).encode())
    plt.close("all")
    readme = rewrite(README.read_text(), "scores", markdown(score_table(found)))
    README.write_text(rewrite(readme, "differences", markdown(difference_table(found))))
    print(markdown(score_table(found)), markdown(difference_table(found)), sep="\n\n")
    print(f"\nAll cells at Table 1's episodes: about {whole_comparison_hours(found):.1f} hours on two cores. See {output}.")


if __name__ == "__main__":
    tyro.cli(main)

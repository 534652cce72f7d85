"""Tables and figures of the comparison: report.html, and with --publish docs/, the README's table and what is kept.

    python benchmark/report.py                           # at any time, also half-way; writes into runs/report/
    python benchmark/report.py --episodes 50             # of a smoke run, ./benchmark.sh --episodes 50

What is finished under runs/ stands beside what is kept in benchmark/results/, which it replaces. Results of different numbers
of episodes never stand together. report.html holds everything in one file: figures, tables, GIFs of trained teams, settings.
"""

import base64
import html
import io
import sys
import tempfile
from dataclasses import dataclass
from datetime import datetime
from itertools import product
from pathlib import Path

import numpy as np
import tyro
from matplotlib import pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark import figures, measures, results
from benchmark.cells import BEYOND, BEYOND_WORLDS, METHODS, OPTIMIZERS, ROOT, RUNS, WORLDS, name_of, script, seeds_of, select
from envs.command import command_line

README, DOCS = ROOT / "README.md", ROOT / "docs"
HEAD = """<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>The comparison</title>"""
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 1300px; margin: 0 auto; padding: 1rem; }
h1 { line-height: 1.2; } h2 { margin-top: 2.5rem; border-bottom: 1px solid #ddd; }
img { max-width: 100%; height: auto; } .wide img { min-width: 40rem; }
.wide { overflow-x: auto; background-repeat: no-repeat; background-size: 3rem 100%, 3rem 100%, 1rem 100%, 1rem 100%;
  background-image: linear-gradient(90deg, #fff 40%, #fff0), linear-gradient(270deg, #fff 40%, #fff0),
    linear-gradient(90deg, #0004, #0000), linear-gradient(270deg, #0004, #0000);
  background-position: left, right, left, right; background-attachment: local, local, scroll, scroll; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
td, th { padding: 0.2rem 0.6rem; border-bottom: 1px solid #e4e4e4; text-align: left; white-space: nowrap; }
.teams { display: flex; flex-wrap: wrap; gap: 1rem; } figure { margin: 0; } figcaption { font-size: 0.85rem; }
"""


@dataclass
class Args:
    runs: Path = RUNS
    """where the cells have worked"""
    output_dir: Path | None = None
    """where figures and report.html go (None: runs/report, beside the cells)"""
    seeds: str = "1-20"
    """first and last seed"""
    episodes: int | None = None
    """training episodes of each trial (None: Table 1)"""
    publish: bool = False
    """keep the results in benchmark/results/ and show them in docs/ and in the README"""
    scripts: tuple[Path, ...] = ()
    """files of your own methods, if they are not in algos/"""


def score_table(found, world):
    """A world's results: reward per step over the last 5 % of the episodes and, if it has outcomes, where the trials end."""
    columns = ["reward per step", "worst trial"]
    columns += ["at best end", "the others"] if envs.make_world(world).best_outcome else []
    rows = [["method", *(f"{optimizer}: {column}" for optimizer in OPTIMIZERS for column in columns)]]
    for method in results.named_in(found)[1]:
        pair = [found.get((world, method, optimizer)) for optimizer in OPTIMIZERS]
        if any(pair):
            words = [[*scores(world, result), the_others(world, result)][: len(columns)] for result in pair]
            rows.append([name_of(method), *words[0], *words[1]])
    if np.isfinite(measures.optimum(world)):
        optimum = [f"*{measures.in_words(world, measures.optimum(world))}*", *[""] * (len(columns) - 1)]
        rows.append(["*exact optimum*", *optimum, *optimum])
    return rows


def score_tables(found):
    """{world: table} of all worlds of which there are results."""
    return {world: score_table(found, world) for world in results.named_in(found)[0] if any(world == w for w, *_ in found)}


def scores(world, result):
    """The mean and error of one result, its worst trial, and how many trials end most often in the best outcome."""
    if result is None:
        return ["", "", ""]
    numbers = *measures.mean_and_error(result.last), result.last.min()
    mean, error, worst = (measures.in_words(world, number) for number in numbers)
    best, trials = envs.make_world(world).best_outcome, len(result.usual)
    return [f"{mean} ± {error}" if trials > 1 else mean, worst, f"{np.sum(result.usual == best)} of {trials}" if best else "-"]


def the_others(name, result):
    """Where the trials that are not at the best outcome end, and how many of them have met it, and how often."""
    world = envs.make_world(name)
    if result is None or not world.best_outcome:
        return ""
    others = result.usual != world.best_outcome
    if not others.any():
        return ""
    names = dict(enumerate(("time limit", *world.outcome_names)))  # a result may know outcomes that its world has no longer
    ends = [f"{names.get(k, f'outcome {k}')}: {count}" for k, count in enumerate(np.bincount(result.usual[others])) if count]
    times = np.rint(result.at_best[others].sum(1) * results.block_of(result.num_episodes)).astype(int)
    often = "once" if times.max() == 1 else f"up to {times.max()} times"
    met = "all" if times.all() else np.sum(times > 0) or "none"
    return f"{', '.join(ends)}; {met} met it" + (f", {often}" if times.any() else "")


def best_table(found):
    """For each world and optimiser the exact optimum, who ends best, who is level with that method, and DecESPG and PG.

    A method is level with the best if the 95 % interval of their difference (`measures.difference`) has 0 in it.
    """
    rows = [["world", "exact optimum", "optimiser", "best", "level with it", "DecESPG", "PG"]]

    def words(world, method, optimizer):
        score, _, count = scores(world, found.get((world, method, optimizer)))
        return f"{score} ({count})" if count.strip("-") else score

    for world, optimizer in product(WORLDS, OPTIMIZERS):
        there = {m: result for (w, m, o), result in found.items() if (w, o) == (world, optimizer)}
        if len(there) > 2:
            best = max(there, key=lambda method: there[method].last.mean())
            above = {m: measures.difference(there[best], there[m])[1] > 0 for m in there if m != best}  # False of one trial
            level = [method for method, is_above in above.items() if not is_above]
            three = [words(world, method, optimizer) for method in (best, "decespg", "pg")]
            place = [world, measures.in_words(world, measures.optimum(world)), optimizer, f"{name_of(best)} {three[0]}"]
            rows.append([*place, ", ".join(map(name_of, level)) or "-", *three[1:]])
    return rows


def leaderboard(found):
    """Episodes, and environment steps of a trial, until 95 % of the trials are at the best outcome, and near the optimum.

    In each world first who needs the fewest steps to come near the optimum, then who needs the fewest to the best outcome.
    """
    rows, worlds = [], results.named_in(found)[0]
    for (world, method, optimizer), result in found.items():
        goods = measures.at_best_outcome(result), measures.near_optimum(result, world)
        points = [measures.reached(result, good) for good in goods]
        if any(points):
            place = worlds.index(world), *(point[1] if point else np.inf for point in reversed(points))
            words = [word for point in points for word in ([str(point[0]), f"{point[1]:,.0f}"] if point else ["-", "-"])]
            at_end = [str(good[:, -1].sum()) for good in goods]
            rows.append((place, [Path(world).stem, name_of(method), optimizer, *words[:2], at_end[0], *words[2:], at_end[1]]))
    head = ["world", "method", "optimiser", "best outcome: episodes", "steps", "trials in the end"]
    head += ["within 5 % of the optimum: episodes", "steps", "trials in the end"]
    return [head, *(row for _, row in sorted(rows))]


def difference_table(found, one="decespg", other="spg"):
    """What one method adds to another: mean difference and 95 % interval."""
    rows = [["world", *OPTIMIZERS]]
    for world in WORLDS:
        pairs = [[found.get((world, method, optimizer)) for method in (one, other)] for optimizer in OPTIMIZERS]
        if any(all(pair) for pair in pairs):
            differences = [measures.difference(*pair) if all(pair) else None for pair in pairs]
            rows.append([world, *(measures.interval_in_words(world, *each) if each else "" for each in differences)])
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
    for method, world in product(METHODS | BEYOND, (*WORLDS, *BEYOND_WORLDS)):
        chosen = [script(method).TUNED.get((world, optimizer), {}) for optimizer in OPTIMIZERS]
        if any(chosen):
            rows.append([name_of(method), world, *(", ".join(f"{k} {v:g}" for k, v in numbers.items()) for numbers in chosen)])
    return rows


def versions(found):
    """The versions with which the results were made."""
    packages = ("python", "torch", "numpy", "numba", "gymnasium")
    seen = {name: sorted({result.about.get(name, "unknown") for result in found.values()}) for name in packages}
    return ", ".join(f"{name} {' and '.join(numbers)}" for name, numbers in seen.items())


def time_needed(found, cores=2):
    """How long all cells take at Table 1's episodes, by the kept times; only of the paper's worlds in which there are some."""
    cells = select(METHODS, WORLDS, OPTIMIZERS)
    whole = {(cell.world, cell.method): (cell.num_trials, cell.settings["num_episodes"]) for cell in cells}
    timed = {
        (world, method, optimizer): result
        for (world, method, optimizer), result in found.items()
        if result.seconds > 0 and whole.get((world, method)) == (len(result.last), result.num_episodes)
    }  # short runs mostly start and compile
    worlds = [world for world in WORLDS if any(world == w for w, *_ in timed)]
    if not worlds:
        return ""
    pace = results.seconds_per_episode(timed)
    cells = [cell for cell in cells if cell.world in worlds]
    hours = sum(pace[cell.method, cell.world] * cell.settings["num_episodes"] for cell in cells) / 3600 / cores
    return f"All cells of {', '.join(worlds)} at Table 1's episodes take about {hours:.1f} hours on {cores} cores."


def all_figures(found):
    """{name: figure} of what can be drawn from the results."""
    drawn, beyond, found = {}, results.beyond_the_paper(found), results.of_the_paper(found)
    others = results.named_in(found)[1][len(METHODS) :]
    for name, methods in figures.FIGURES.items():
        part, methods = (beyond, methods) if name == "beyond" else (found, (*methods, *others))
        own = [method for method in methods if method not in ("pg", "espg", "decespg")]
        if any(method in own for _, method, _ in part):
            drawn[name] = figures.learning_curves(part, methods)
            drawn[f"{name}-steps"] = figures.curves_over_steps(part, methods)
            drawn[f"{name}-best"] = figures.share_at_best(part, methods)
    if any(all((r := found.get((world, m, "sign"))) and len(r.actions) for m in ("pg", "decespg")) for world in WORLDS):
        drawn["figure5"] = figures.trajectories(found)
    if worlds := worlds_of_all(found):
        scores = {optimizer: measures.scores_over_worlds(found, optimizer, worlds) for optimizer in OPTIMIZERS}
        means = {optimizer: measures.interquartile_means(values) for optimizer, values in scores.items()}
        drawn["iqm"] = figures.intervals(means, "interquartile mean of reward per step / optimum")
        better = {optimizer: measures.improvements(values) for optimizer, values in scores.items()}
        drawn["improvement"] = figures.intervals(better, "probability that DecESPG's trial is better")
        shares = np.linspace(0, 1, 101)
        profiles = {optimizer: measures.profiles(values, shares) for optimizer, values in scores.items()}
        drawn["profiles"] = figures.performance_profiles(profiles, shares)
    return drawn


def worlds_of_all(found):
    """The worlds in which every method of the paper has a result under both optimisers."""
    cells = {world: select(METHODS, [world], OPTIMIZERS) for world in WORLDS}
    return [world for world in WORLDS if all((world, cell.method, cell.optimizer) in found for cell in cells[world])]


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
    "figure3": "Figure 3: the baselines. Mean and standard error over the trials",
    "figure4": "Figure 4: the ablation, what bonus and memory do by themselves",
    "figure6": "Figure 6: single components exchanged",
    "beyond": "Beyond the paper: other methods and other worlds",
    "figure5": "Figure 5: ways of trained teams (first trial, sign), from the rings on",
    "iqm": "Interquartile mean, 95 % stratified bootstrap intervals (rliable)",
    "improvement": "Probability that a trial of DecESPG ends better than one of the method (0.5: no difference)",
    "profiles": "Performance profiles: the share of the trials that reach a share of the optimum",
}
MORE = {
    "-steps": "The same over environment steps.",
    "-best": "The share of the trials that end most of 100 episodes in the best outcome.",
}


def page(found, drawn):
    """report.html."""
    parts = ["<h1>Cooperative multi-agent exploration: the comparison</h1>"]
    paper = results.of_the_paper(found)
    there = f"{len(paper)} of {len(select(METHODS, WORLDS, OPTIMIZERS))} cells of the paper's are there"
    parts.append(f"<p>{datetime.now():%Y-%m-%d}: {there}, made with {versions(found)}. {time_needed(found)}</p>")
    parts.append("<h2>Reward per step, last 5 % of the episodes</h2>")
    parts += [f"<h3>{Path(world).stem}</h3>{html_table(table)}" for world, table in score_tables(found).items()]
    parts += ["<h2>DecESPG minus SPG: what the bonus adds to the memory</h2>", html_table(difference_table(found))]
    parts += ["<h2>Sample efficiency: until 95 % of the trials are there</h2>", html_table(leaderboard(found))]
    for name, figure in drawn.items():
        base, dash, more = name.partition("-")
        caption = MORE[dash + more] if more else CAPTIONS[base]
        parts += [f"<p>{caption}</p>" if more else f"<h2>{caption}</h2>", svg(figure, caption)]
    parts += ["<h2>Trained teams</h2>", team_films(found)]
    parts += ["<h2>Cells</h2>", html_table(cell_table(found)), "<h2>Settings</h2>", html_table(settings_table())]
    return f"<!doctype html><html lang=en><head>{HEAD}<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"


def rewrite(text, name, table):
    """Put a table between the marks <!-- name --> and <!-- end name --> of a text; UsageError if it has not one of each."""
    first, last = f"<!-- {name} -->", f"<!-- end {name} -->"
    if (text.count(first), text.count(last)) != (1, 1):
        raise envs.UsageError(f"the place of a table must be marked by one {first} and one {last}.")
    before, rest = text.split(first)
    return f"{before}{first}\n{table}\n{last}{rest.split(last)[1]}"


def published_tables(found):
    """{page: {mark: table}} of all that docs/ and the README show."""
    paper, beyond = results.of_the_paper(found), results.beyond_the_paper(found)
    return {
        README: {"best": best_table(paper)},
        DOCS / "results.md": {**score_tables(paper), "differences": difference_table(paper), "leaderboard": leaderboard(paper)},
        DOCS / "beyond.md": {**score_tables(beyond), "leaderboard": leaderboard(beyond)},
    }


def published_texts(found):
    """{page: its text with the tables of today}."""
    pages = published_tables(found)
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    for page, tables in pages.items():
        for mark, table in tables.items():
            texts[page] = rewrite(texts[page], mark, markdown(table))
    return texts


def publish(texts, drawn):
    """Show results in docs/ and in the README."""
    for page, text in texts.items():
        page.write_text(text, encoding="utf-8")
    for name, figure in drawn.items():
        figure.savefig(DOCS / f"{name}.png", dpi=130)


def main(args: Args):
    """Read what is finished, draw, write."""
    seeds = seeds_of(args.seeds)
    if args.episodes is not None:
        envs.check_whole("--episodes", args.episodes, minimum=1)
    for path in args.scripts:
        script(str(path))
    ours = seeds == (1, 20) and args.episodes is None
    if args.publish and not ours:
        raise envs.UsageError("only results of seeds 1-20 and all of Table 1's episodes are published.")
    fresh = results.finished(args.runs, seeds, args.episodes, tuple(map(str, args.scripts)))
    fresh = results.shipped(fresh) if args.publish else fresh
    found = results.in_order({**results.kept(), **fresh} if ours else fresh)
    if not found:
        raise envs.UsageError(f"there is no finished cell under {args.runs}; ./benchmark.sh makes some.")
    texts = published_texts(found) if args.publish else {}  # before anything is written, for it may be refused
    drawn = all_figures(found)
    output_dir = args.output_dir or args.runs.parent / "report"
    output_dir.mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        figure.savefig(output_dir / f"{name}.png", dpi=130)
    with envs.complete_file(output_dir / "report.html") as file:
        file.write(page(found, drawn).encode())
    if args.publish:
        results.keep(fresh)
        publish(texts, drawn)
    plt.close("all")
    tables = [f"{Path(world).stem}\n\n{markdown(table)}" for world, table in score_tables(found).items()]
    print(*tables, markdown(difference_table(found)), markdown(leaderboard(found)), sep="\n\n")
    print("", f"{time_needed(found)} See {output_dir}.".strip(), sep="\n")


if __name__ == "__main__":
    with command_line("report.py"):
        main(tyro.cli(Args, description=__doc__))

"""The paper's claims and this repository's own sentences, judged by the kept results.

    python benchmark/claims.py                           # every claim and sentence, its figures, its verdict
    python benchmark/claims.py --publish                 # writes docs/claims.md and the README's sentences

A claim is a sentence of the paper's Sections 4.3 to 4.5, judged in each world that it speaks of and under each optimiser. Our
own sentences stand here once, with names where their figures are to stand.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
from benchmark import measures, results
from benchmark.cells import OPTIMIZERS, WORLDS, name_of
from benchmark.figures import FIGURES
from benchmark.report import DOCS, README, markdown, rewrite
from envs.command import command_line

YES, PARTLY, UNDECIDED, NO, OPEN = "yes", "partly", "undecided", "no", "open"
BASELINES = ("pg", "ac", "coma", "acer", "dqn", "edti")
POLICY_GRADIENT = ("pg", "ac", "coma", "acer", "edti")
OURS = ("espg", "decespg")


class Cells:
    """The results of one world under one optimiser. Methods that have none there raise KeyError, which leaves a claim open."""

    def __init__(self, found, world, optimizer):
        self.found, self.world, self.optimizer = found, world, optimizer
        self.optimum = measures.optimum(world)

    def __getitem__(self, method):
        return self.found[self.world, method, self.optimizer]

    def that_are(self, methods):
        """Those of `methods` that there can be: Q-learning has no policies, and so no optimiser of theirs but Adam."""
        return [method for method in methods if self.optimizer == "adam" or method != "dqn"]

    def at_best(self, method):
        """How many trials end most often in the best outcome."""
        return int(np.sum(self[method].usual == envs.make_world(self.world).best_outcome))

    def mean(self, method):
        """Reward per step over the last 5 % of the episodes."""
        return float(self[method].last.mean())

    def trials(self, methods):
        """How many trials of each method are at the best outcome, in words."""
        return ", ".join(f"{name_of(method)} {self.at_best(method)}" for method in methods) + " of 20 trials"

    def means(self, methods):
        """The reward per step of each method, in words."""
        return ", ".join(f"{name_of(method)} {self.mean(method):.2f}" for method in methods)

    def minus(self, one, other):
        """What one method has more than another: words, and YES, NO, or UNDECIDED where the interval has 0 in it."""
        mean, low, high = measures.difference(self[one], self[other])
        words = f"{name_of(one)} - {name_of(other)} = {mean:+.2f} [{low:+.2f}, {high:+.2f}]"
        return words, YES if low > 0 else NO if high < 0 else UNDECIDED

    def minus_best_of(self, one, others):
        """The same against whichever of the others ends best."""
        return self.minus(one, max(self.that_are(others), key=self.mean))


def all_of(verdicts):
    """The verdict that all have; PARTLY if they differ."""
    return verdicts[0] if len(set(verdicts)) == 1 else PARTLY


def best_in_figure3(cells):
    return cells.minus_best_of("decespg", [m for m in FIGURES["figure3"] if m not in OURS])


def espg_follows(cells):
    words, than_baselines = cells.minus_best_of("espg", BASELINES)
    more, than_decespg = cells.minus("espg", "decespg")
    return f"{words}; {more}", all_of([than_baselines, YES if than_decespg != NO else NO])


def worse_with_training(cells):
    words, verdicts = [], []
    for method in ("pg", "coma"):
        first, last = cells[method].score[:, 0], cells[method].last
        change = last - first
        error = measures.mean_and_error(change)[1]
        words.append(f"{name_of(method)} {first.mean():.2f} in the first 100 episodes, {last.mean():.2f} in the end")
        verdicts.append(YES if change.mean() < -2 * error else NO if change.mean() > 2 * error else UNDECIDED)
    return "; ".join(words), all_of(verdicts)


def off_policy_is_suboptimal(cells):
    methods = cells.that_are(("dqn", "acer"))
    return cells.means(methods), all_of([YES if cells.mean(m) < 0.95 * cells.optimum else NO for m in methods])


def policy_gradients_stay(cells):
    away = [method for method in POLICY_GRADIENT if cells.at_best(method) < 10]
    return cells.trials(POLICY_GRADIENT), YES if len(away) > len(POLICY_GRADIENT) / 2 else PARTLY if away else NO


def ours_find_the_optimum(cells):
    words = f"{cells.trials(OURS)}; {cells.means(OURS)} of {cells.optimum:.2f}"
    return words, all_of([YES if cells.at_best(method) >= 19 else NO for method in OURS])


def baselines_push_small_boxes(cells):
    methods = cells.that_are(BASELINES)
    return f"{cells.trials(methods)}; {cells.means(methods)}", all_of([NO if cells.at_best(m) >= 2 else YES for m in methods])


def bonus_helps(cells):
    pairs = [cells.minus("epg", "pg"), cells.minus("espg", "spg")]
    return "; ".join(words for words, _ in pairs), all_of([verdict for _, verdict in pairs])


def memory_helps(cells):
    pairs = [cells.minus("spg", "pg"), cells.minus("espg", "epg")]
    return "; ".join(words for words, _ in pairs), all_of([verdict for _, verdict in pairs])


def bonus_hurts(cells):
    words, verdict = cells.minus("pg", "epg")
    return words, verdict


def memory_is_essential(cells):
    without, with_it = ("pg", "epg"), ("spg", "espg", "decespg")
    stays = all_of([YES if cells.at_best(method) < 10 else NO for method in without])
    leaves = all_of([YES if cells.at_best(method) >= 19 else NO for method in with_it])
    return cells.trials((*without, *with_it)), all_of([stays, leaves])


def best_in_figure6(cells):
    return cells.minus_best_of("decespg", [m for m in FIGURES["figure6"] if m not in OURS])


def better_than_gasil(cells):
    return cells.minus("decespg", "gasil")


def gasil_stays(cells):
    words = f"{cells.trials(['gasil'])}; {cells.means(['gasil'])} of {cells.optimum:.2f}"
    return words, YES if cells.at_best("gasil") < 10 else PARTLY if cells.at_best("gasil") < 19 else NO


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper."""

    section: str
    quote: str
    criterion: str  # when it counts as true
    worlds: tuple[str, ...]
    judge: Callable  # Cells -> (the figures in words, the verdict)
    note: str = ""


WITH_LOCAL_OPTIMUM = ("findtreasure", "movebox", "pushbox")
INTERVAL = "the 95 % interval of the difference over the trials of the same seeds lies above 0 (undecided: has 0 in it)"
CLAIMS = (
    Claim(
        "4.3",
        "DecESPG reached the best performance in the most domains",
        f"beside the best baseline of Figure 3, {INTERVAL}",
        WORLDS,
        best_in_figure3,
    ),
    Claim(
        "4.3",
        "followed closely by ESPG",
        "the same for ESPG, and its difference to DecESPG does not lie below 0",
        WORLDS,
        espg_follows,
    ),
    Claim(
        "4.3",
        "In Cleaner, policy gradient methods (PG and COMA) got worse with training",
        "the last 5 % of the episodes lie more than two standard errors below the first 100",
        ("cleaner",),
        worse_with_training,
    ),
    Claim(
        "4.3",
        "Off-policy methods (DQN and ACER) converged to some sub-optimal paths",
        "below 95 % of the optimum",
        ("cleaner",),
        off_policy_is_suboptimal,
    ),
    Claim(
        "4.3",
        "most policy gradient methods converged to a sub-optimum",
        "more than half of PG, AC, COMA, ACER and EDTI have fewer than 10 of 20 trials at the best outcome",
        ("findtreasure", "movebox"),
        policy_gradients_stay,
    ),
    Claim(
        "4.3",
        "our methods (ESPG, DecESPG) converge to the global optimum",
        "at least 19 of 20 trials of both end at the best outcome",
        WITH_LOCAL_OPTIMUM,
        ours_find_the_optimum,
    ),
    Claim(
        "4.3",
        "in PushBox, all baselines learn pushing small boxes",
        "no baseline has more than one trial at the large box",
        ("pushbox",),
        baselines_push_small_boxes,
        "The paper's 0.94 to 1.88 per step lie below what the best memoryless policies make of small boxes (2.00 for one, 4.00 "
        "for both), so its teams take longer ways.",
    ),
    Claim(
        "4.4",
        "both mechanisms improved the performance: the exploration bonus",
        f"EPG over PG and ESPG over SPG: {INTERVAL}",
        ("cleaner", "pushbox"),
        bonus_helps,
    ),
    Claim(
        "4.4",
        "both mechanisms improved the performance: the selective memory",
        f"SPG over PG and ESPG over EPG: {INTERVAL}",
        ("cleaner", "pushbox"),
        memory_helps,
    ),
    Claim("4.4", "we observe the deteriorated performance of EPG", f"PG over EPG: {INTERVAL}", ("gotogether",), bonus_hurts),
    Claim(
        "4.4",
        "selective memory is essential in escaping local optima",
        "fewer than 10 of 20 trials at the best outcome without it (PG, EPG) and at least 19 with it (SPG, ESPG, DecESPG)",
        WITH_LOCAL_OPTIMUM,
        memory_is_essential,
    ),
    Claim(
        "4.5",
        "DecESPG reached the best performance",
        f"beside the best of EX2, ICM, EMI and GASIL, {INTERVAL}",
        WORLDS,
        best_in_figure6,
    ),
    Claim("4.5", "DecESPG outperforms GASIL in all domains", INTERVAL, WORLDS, better_than_gasil),
    Claim(
        "4.5",
        "GASIL, which converges to local optimum",
        "fewer than 10 of 20 trials at the best outcome (partly: fewer than 19)",
        WITH_LOCAL_OPTIMUM,
        gasil_stays,
    ),
)


def judge(claim, found):
    """(world, optimiser, figures, verdict) of a claim wherever it can be judged, and where it is open."""
    rows = []
    for world, optimizer in product(claim.worlds, OPTIMIZERS):
        try:
            rows.append((world, optimizer, *claim.judge(Cells(found, world, optimizer))))
        except KeyError:
            rows.append((world, optimizer, "", OPEN))
    return rows


def overall(rows):
    """The verdict on a whole claim."""
    verdicts = {optimizer: {verdict for _, o, _, verdict in rows if o == optimizer} - {OPEN} for optimizer in OPTIMIZERS}
    seen, still_open = set.union(*verdicts.values()), sum(verdict == OPEN for *_, verdict in rows)
    only = [optimizer for optimizer in OPTIMIZERS if verdicts[optimizer] == {YES}]
    alike = {YES: "reproduced", NO: "not reproduced", UNDECIDED: "undecided"}
    word = "open" if not seen else alike.get(*seen) if len(seen) == 1 else ""
    word = word or (f"only under {only[0]}" if len(only) == 1 and YES not in verdicts[other(only[0])] else "partly")
    return word + (f" ({still_open} of {len(rows)} cases open)" if still_open and seen else "")


def other(optimizer):
    return OPTIMIZERS[1 - OPTIMIZERS.index(optimizer)]


def claims_text(found):
    """What docs/claims.md says of the claims: one table of all, and one for each."""
    judged = [(claim, judge(claim, found)) for claim in CLAIMS]
    rows = [["section", "the paper says", "verdict"]]
    rows += [
        [claim.section, f"[{claim.quote}](#{number})", overall(found_rows)]
        for number, (claim, found_rows) in enumerate(judged, 1)
    ]
    parts = [markdown(rows)]
    for number, (claim, found_rows) in enumerate(judged, 1):
        parts.append(f'<a id="{number}"></a>\n\n### "{claim.quote}" (Section {claim.section})')
        parts.append(f"Counts as true if: {claim.criterion}. " + claim.note)
        parts.append(markdown([["world", "optimiser", "measured", "holds"], *map(list, found_rows)]))
    return "\n\n".join(part.strip() for part in parts)


@dataclass(frozen=True)
class Sentence:
    """A sentence of the README's results, with names in braces where its figures stand."""

    words: str
    figures: Callable  # results -> {name: figure}
    holds: Callable = lambda figures: True  # whether what is said besides the figures is true of them

    def with_figures(self, found):
        """The sentence as it has to stand there."""
        return self.words.format(**self.figures(found))


def cells_of(found, world):
    """The results of a world under both optimisers."""
    return [Cells(found, world, optimizer) for optimizer in OPTIMIZERS]


def coma_in_pushbox(found):
    cells = cells_of(found, "pushbox")
    figures = {f"{m}_{c.optimizer}": c.mean(m) for c in cells for m in ("coma", "decespg")}
    figures |= {f"{m}_{c.optimizer}_best": c.at_best(m) for c in cells for m in ("coma", "decespg")}
    for c in cells:
        words, figures[f"{c.optimizer}_verdict"] = c.minus("decespg", "coma")
        figures[c.optimizer] = words.partition(" = ")[2]
    return figures


def other_baselines_in_pushbox(found):
    sign, adam = cells_of(found, "pushbox")
    others = max(c.at_best(m) for c in (sign, adam) for m in c.that_are(("pg", "acer", "dqn", "edti")))
    return dict(ac_sign=sign.at_best("ac"), ac_adam=adam.at_best("ac"), others=others)


def memories_in_findtreasure(found):
    cells = cells_of(found, "findtreasure")
    methods = ("spg", "espg", "decespg", "decespg_ex2", "espg_icm", "espg_emi", "gasil")
    means = [c.mean(m) for c in cells for m in methods]
    return dict(
        low=min(means), high=max(means), fewest=min(c.at_best(m) for c in cells for m in methods), optimum=cells[0].optimum
    )


def baselines_in_findtreasure(found):
    sign, adam = cells_of(found, "findtreasure")
    others = ("ac", "coma", "acer", "dqn", "edti")
    means = [c.mean(m) for c in (sign, adam) for m in c.that_are(others)]
    at_best = [c.at_best(m) for c in (sign, adam) for m in c.that_are(others)]
    return dict(low=min(means), high=max(means), fewest=min(at_best), pg=sign.mean("pg"), pg_best=sign.at_best("pg"))


def memory_alone(found):
    treasure, push = (Cells(found, world, "sign") for world in ("findtreasure", "pushbox"))
    figures = dict(spg_t=treasure.at_best("spg"), spg_p=push.at_best("spg"))
    return figures | dict(epg_t=treasure.at_best("epg"), epg_p=push.at_best("epg"))


def two_differences(one, other):
    """{world_optimiser: "mean [low, high]"} of one method minus another in FindTreasure and PushBox, and their verdicts."""

    def figures(found):
        pairs = {
            f"{c.world}_{c.optimizer}": c.minus(one, other) for w in ("findtreasure", "pushbox") for c in cells_of(found, w)
        }
        verdicts = {f"{key}_verdict": verdict for key, (_, verdict) in pairs.items()}
        return {key: words.partition(" = ")[2] for key, (words, _) in pairs.items()} | verdicts

    return figures


def verdicts_of(figures):
    return [value for name, value in figures.items() if name.endswith("_verdict")]


def learnt_novelty(found):
    sign, adam = cells_of(found, "pushbox")
    methods = ("decespg", "espg", "decespg_ex2", "espg_icm", "espg_emi")
    return {f"{m}_{c.optimizer}": c.at_best(m) for c in (sign, adam) for m in methods}


def gasil_in_pushbox(found):
    return {c.optimizer: c.at_best("gasil") for c in cells_of(found, "pushbox")}


def pg_under_both(found):
    sign, adam = cells_of(found, "findtreasure")
    return dict(sign=sign.mean("pg"), adam=adam.mean("pg"), best=adam.at_best("pg"))


SENTENCES = (
    Sentence(
        "**In PushBox COMA beats DecESPG** under sign descent, now that its critics see the global state: {coma_sign_best} of "
        "20 trials end at the large box, at {coma_sign:.2f} per step (DecESPG {decespg_sign:.2f}). Under Adam {coma_adam_best} "
        "do (DecESPG {decespg_adam_best}), and DecESPG minus COMA is {adam}.",
        coma_in_pushbox,
        lambda f: (f["sign_verdict"], f["adam_verdict"]) == (NO, UNDECIDED),
    ),
    Sentence(
        "AC ends there in {ac_sign} (sign) and {ac_adam} (Adam) trials, PG, ACER, DQN and EDTI in at most {others}.",
        other_baselines_in_pushbox,
        lambda f: f["others"] <= 1,
    ),
    Sentence(
        "In FindTreasure all methods with a memory, and GASIL, end at the treasure in all 20 trials, at {low:.2f} to "
        "{high:.2f} of {optimum:.2f} per step.",
        memories_in_findtreasure,
        lambda f: f["fewest"] == 20,
    ),
    Sentence(
        "The baselines that learn values end at {low:.2f} to {high:.2f}, at the treasure in at least {fewest} trials; PG under "
        "sign descent stays at the meeting ({pg:.2f}, {pg_best} trials at the treasure).",
        baselines_in_findtreasure,
        lambda f: f["pg_best"] == 0 and f["fewest"] > 10,
    ),
    Sentence(
        "What leaves the local optima under sign descent is the memory: SPG, which has only that, ends at the best outcome in "
        "{spg_t} (FindTreasure) and {spg_p} (PushBox) trials, EPG, which has only the bonus, in {epg_t} and {epg_p}.",
        memory_alone,
        lambda f: min(f["spg_t"], f["spg_p"]) >= 19 and max(f["epg_t"], f["epg_p"]) <= 1,
    ),
    Sentence(
        "What the bonus adds to it cannot be told from nothing here: DecESPG minus SPG is {findtreasure_sign} (FindTreasure) "
        "and {pushbox_sign} (PushBox) under sign descent, {findtreasure_adam} and {pushbox_adam} under Adam.",
        two_differences("decespg", "spg"),
        lambda f: set(verdicts_of(f)) == {UNDECIDED},
    ),
    Sentence(
        "Learnt novelty does as well in FindTreasure; in PushBox under Adam it keeps the large box in {decespg_ex2_adam} "
        "(EX2), {espg_icm_adam} (ICM) and {espg_emi_adam} (EMI) trials, the Gaussian process in {decespg_adam} (DecESPG) and "
        "{espg_adam} (ESPG).",
        learnt_novelty,
        lambda f: max(f["decespg_ex2_adam"], f["espg_icm_adam"], f["espg_emi_adam"]) < min(f["decespg_adam"], f["espg_adam"]),
    ),
    Sentence("GASIL keeps the large box in {sign} (sign) and {adam} (Adam) trials.", gasil_in_pushbox),
    Sentence(
        "The optimiser decides as much as the method: PG goes from {sign:.2f} to {adam:.2f} in FindTreasure, all {best} trials "
        "at the treasure.",
        pg_under_both,
        lambda f: f["best"] == 20,
    ),
)


def main(publish: bool = False):
    """Print what is claimed, what was measured and the verdict.

    Args:
        publish: write the paper's claims into docs/claims.md, and our sentences into the README
    """
    found = results.kept()
    for claim in CLAIMS:
        rows = judge(claim, found)
        print(f'\nSection {claim.section}: "{claim.quote}": {overall(rows)}')
        for world, optimizer, words, verdict in rows:
            print(f"    {world}, {optimizer}: {verdict}{': ' * bool(words)}{words}")
    for sentence in SENTENCES:
        holds = "true" if sentence.holds(sentence.figures(found)) else "NOT TRUE"
        print(f"\n{holds}: {sentence.with_figures(found)}")
    if publish:
        sentences = "\n".join(f"- {sentence.with_figures(found)}" for sentence in SENTENCES)
        for path, name, text in ((DOCS / "claims.md", "claims", claims_text(found)), (README, "sentences", sentences)):
            path.write_text(rewrite(path.read_text(encoding="utf-8"), name, text), encoding="utf-8")


if __name__ == "__main__":
    with command_line("claims.py"):
        tyro.cli(main)

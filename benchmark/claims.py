"""The paper's claims and this repository's own sentences, judged by the kept results.

    python benchmark/claims.py                           # every claim and sentence, its figures, its verdict
    python benchmark/claims.py --publish                 # writes docs/claims.md

A claim is a sentence of the paper's Sections 4.3 to 4.5, judged in each world that it speaks of and under each optimiser. A
sentence is one of README.md or docs/, with its figures left out; `tests/test_claims.py` holds that it stands there with these.
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
from benchmark.report import DOCS, markdown, rewrite

YES, PARTLY, NO, OPEN = "yes", "partly", "no", "open"
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
        """What one method has more than another: words, and YES, NO, or PARTLY where the interval has 0 in it."""
        mean, low, high = measures.difference(self[one], self[other])
        words = f"{name_of(one)} - {name_of(other)} = {mean:+.2f} [{low:+.2f}, {high:+.2f}]"
        return words, YES if low > 0 else NO if high < 0 else PARTLY

    def minus_best_of(self, one, others):
        """The same against whichever of the others ends best."""
        return self.minus(one, max(self.that_are(others), key=self.mean))


def all_of(verdicts):
    """YES if all are, NO if none is even partly."""
    return YES if set(verdicts) == {YES} else NO if set(verdicts) == {NO} else PARTLY


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
        verdicts.append(YES if change.mean() < -2 * error else NO if change.mean() > 2 * error else PARTLY)
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
INTERVAL = "the 95 % interval of the difference over the trials of the same seeds lies above 0 (partly: has 0 in it)"
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
    word = {frozenset(): "open", frozenset({YES}): "reproduced", frozenset({NO}): "not reproduced"}.get(frozenset(seen))
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
    """A sentence of this repository's texts, with names in braces where its figures stand."""

    path: str
    words: str
    figures: Callable  # results -> {name: figure}
    holds: Callable = lambda figures: True  # whether what is said besides the figures is true of them

    def with_figures(self, found):
        """The sentence as it has to stand there."""
        return self.words.format(**self.figures(found))


SENTENCES = ()


def main(publish: bool = False):
    """Print what is claimed, what was measured and the verdict.

    Args:
        publish: write the paper's claims into docs/claims.md
    """
    found = results.kept()
    for claim in CLAIMS:
        rows = judge(claim, found)
        print(f'\nSection {claim.section}: "{claim.quote}": {overall(rows)}')
        for world, optimizer, words, verdict in rows:
            print(f"    {world}, {optimizer}: {verdict}{': ' * bool(words)}{words}")
    if publish:
        page = DOCS / "claims.md"
        page.write_text(rewrite(page.read_text(encoding="utf-8"), "claims", claims_text(found)), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)

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
        return ", ".join(f"{name_of(method)} {measures.in_words(self.world, self.mean(method))}" for method in methods)

    def minus(self, one, other):
        """What one method has more than another: words, and YES, NO, or UNDECIDED where the interval has 0 in it."""
        _, low, high = interval = measures.difference(self[one], self[other])
        words = f"{name_of(one)} - {name_of(other)} = {measures.interval_in_words(self.world, *interval)}"
        return words, YES if low > 0 else NO if high < 0 else UNDECIDED

    def minus_each_of(self, one, others):
        """The same against all others: words on whichever ends best, and YES if it is above all, NO if it is below one."""
        others = self.that_are(others)
        verdicts = {self.minus(one, other)[1] for other in others}
        words, _ = self.minus(one, max(others, key=self.mean))
        return words, NO if NO in verdicts else YES if verdicts == {YES} else UNDECIDED

    def usual_ends(self, method):
        """How many trials end most often in the best outcome, in another, and at the time limit."""
        usual, best = self[method].usual, envs.make_world(self.world).best_outcome
        return int(np.sum(usual == best)), int(np.sum((usual != best) & (usual > 0))), int(np.sum(usual == 0))


def all_of(verdicts):
    """The verdict on several things at once: YES or UNDECIDED if all are, PARTLY if some hold and others do not, else NO."""
    seen = set(verdicts)
    return verdicts[0] if len(seen) == 1 else PARTLY if seen & {YES, PARTLY} else NO


def best_in_figure3(cells):
    return cells.minus_each_of("decespg", [m for m in FIGURES["figure3"] if m not in OURS])


def espg_follows(cells):
    words, than_baselines = cells.minus_each_of("espg", BASELINES)
    more, _ = cells.minus("espg", "decespg")
    close = abs(cells.mean("espg") - cells.mean("decespg")) < 0.05 * cells.optimum
    return f"{words}; {more}", all_of([than_baselines, YES if close else NO])


def worse_with_training(cells):
    words, verdicts = [], []
    for method in ("pg", "coma"):
        first, last = cells[method].score[:, 0], cells[method].last
        change = last - first
        error = measures.mean_and_error(change)[1]
        start, end = (measures.in_words(cells.world, values.mean()) for values in (first, last))
        words.append(f"{name_of(method)} {start} in the first 100 episodes, {end} in the end")
        verdicts.append(YES if change.mean() < -2 * error else NO if change.mean() > 2 * error else UNDECIDED)
    return "; ".join(words), all_of(verdicts)


def off_policy_is_suboptimal(cells):
    methods = cells.that_are(("dqn", "acer"))
    return cells.means(methods), all_of([YES if cells.mean(m) < 0.95 * cells.optimum else NO for m in methods])


def policy_gradients_stay(cells):
    away = [method for method in POLICY_GRADIENT if cells.at_best(method) < 10]
    return cells.trials(POLICY_GRADIENT), YES if len(away) > len(POLICY_GRADIENT) / 2 else NO


def ours_find_the_optimum(cells):
    words = f"{cells.trials(OURS)}; {cells.means(OURS)} of {cells.optimum:.2f}"
    ends = [cells.at_best(method) >= 19 for method in OURS]
    near = [cells.mean(method) >= 0.95 * cells.optimum for method in OURS]
    return words, YES if all(ends) and all(near) else PARTLY if all(ends) else NO


def ours_reach_the_far_goal(cells):
    words = f"{cells.trials(OURS)}; {cells.means(OURS)} of {cells.optimum:.2f}"
    fewest = min(cells.at_best(method) for method in OURS)
    return words, YES if fewest >= 19 else PARTLY if fewest else NO


def ours_push_the_large_box(cells):
    words = f"{cells.trials(OURS)}; {cells.means(OURS)} of {cells.optimum:.2f}"
    ends = all(cells.at_best(method) >= 19 for method in OURS)
    near = all(cells.mean(method) >= 0.9 * cells.optimum for method in OURS)
    return words, YES if ends and near else PARTLY if ends else NO


def baselines_push_small_boxes(cells):
    methods = cells.that_are(BASELINES)
    small = ", ".join(f"{name_of(method)} {cells.usual_ends(method)[1]}" for method in methods)
    verdicts = [YES if cells.usual_ends(method)[1] >= 19 else NO for method in methods]
    return f"small boxes: {small} of 20 trials; large box: {cells.trials(methods)}", all_of(verdicts)


def bonus_helps(cells):
    pairs = [cells.minus("epg", "pg"), cells.minus("espg", "spg")]
    return "; ".join(words for words, _ in pairs), all_of([verdict for _, verdict in pairs])


def memory_helps(cells):
    pairs = [cells.minus("spg", "pg"), cells.minus("espg", "epg")]
    return "; ".join(words for words, _ in pairs), all_of([verdict for _, verdict in pairs])


def bonus_hurts(cells):
    return cells.minus("pg", "epg")


def memory_is_essential(cells):
    without, with_it = ("pg", "epg"), ("spg", "espg", "decespg")
    stays = all_of([YES if cells.at_best(method) < 10 else NO for method in without])
    leaves = all_of([YES if cells.at_best(method) >= 19 else NO for method in with_it])
    return cells.trials((*without, *with_it)), all_of([stays, leaves])


def best_in_figure6(cells):
    return cells.minus_each_of("decespg", [m for m in FIGURES["figure6"] if m not in OURS])


def better_than_gasil(cells):
    return cells.minus("decespg", "gasil")


def gasil_stays(cells):
    best, another, limit = cells.usual_ends("gasil")
    words = f"{best} trials at the best outcome, {another} at another, {limit} at the time limit"
    return words, YES if another >= 10 else PARTLY if another >= 2 else NO


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper."""

    section: str
    quote: str
    criterion: str  # when it counts as true
    worlds: tuple[str, ...]
    judge: Callable  # Cells -> (the figures in words, the verdict)
    note: str = ""
    about: str = ""  # what the quoted words speak of, if they do not say it
    scope: str = "each"  # or "most", "all": of how many worlds it speaks


WITH_LOCAL_OPTIMUM = ("findtreasure", "movebox", "pushbox")
INTERVAL = "the 95 % interval of the difference over the trials of the same seeds lies above 0 (undecided: has 0 in it)"
CLEANERS_RATE = "learning rate under sign descent is MoveBox's, by the tuning rule, and too high for Cleaner"
STAY = "more than half of PG, AC, COMA, ACER and EDTI have fewer than 10 of 20 trials at the best outcome"
CLAIMS = (
    Claim(
        "4.3",
        "DecESPG reached the best performance in the most domains",
        f"in most worlds: beside every baseline of Figure 3, {INTERVAL}",
        WORLDS,
        best_in_figure3,
        scope="most",
    ),
    Claim(
        "4.3",
        "followed closely by ESPG",
        "in most worlds: the same for ESPG, and it ends within 5 % of the optimum from DecESPG",
        WORLDS,
        espg_follows,
        scope="most",
    ),
    Claim(
        "4.3",
        "In Cleaner, policy gradient methods (PG and COMA) got worse with training",
        "the last 5 % of the episodes lie more than two standard errors below the first 100",
        ("cleaner",),
        worse_with_training,
        f"PG's {CLEANERS_RATE}.",
    ),
    Claim(
        "4.3",
        "Off-policy methods (DQN and ACER) converged to some sub-optimal paths",
        "below 95 % of the optimum; under sign descent that is said of ACER alone, as DQN has no policy",
        ("cleaner",),
        off_policy_is_suboptimal,
    ),
    Claim("4.3", "most policy gradient methods converged to a sub-optimum", STAY, ("findtreasure",), policy_gradients_stay),
    Claim(
        "4.3",
        "our methods (ESPG, DecESPG) converge to the global optimum",
        "at least 19 of 20 trials of both end at the best outcome (partly), and both reach 95 % of the optimum per step (yes)",
        ("findtreasure",),
        ours_find_the_optimum,
    ),
    Claim("4.3", "Policy gradient methods usually could not exceed it", STAY, ("movebox",), policy_gradients_stay),
    Claim(
        "4.3",
        "our methods escape from the local optimum (pushing box to far goal)",
        "at least 19 of 20 trials of both end at the far goal (partly: at least one of each)",
        ("movebox",),
        ours_reach_the_far_goal,
    ),
    Claim(
        "4.3",
        "all baselines learn pushing small boxes with return 0.94-1.88",
        "at least 19 of 20 trials of every baseline end at small boxes",
        ("pushbox",),
        baselines_push_small_boxes,
        "0.94 to 1.88 per step lie below what the best memoryless policies make of small boxes (2.00 for one, 4.00 for both), "
        "so the paper's teams take longer ways.",
    ),
    Claim(
        "4.3",
        "our methods learned to jointly push the large box, approaching global optimum at 33.3",
        "at least 19 of 20 trials of both end at the large box (partly), at 90 % of the optimum or more (yes)",
        ("pushbox",),
        ours_push_the_large_box,
    ),
    Claim(
        "4.4",
        "both mechanisms improved the performance",
        f"EPG over PG and ESPG over SPG: {INTERVAL}",
        ("cleaner", "pushbox"),
        bonus_helps,
        f"In Cleaner PG's {CLEANERS_RATE}, so it says little that EPG ends above it.",
        about="the exploration bonus",
    ),
    Claim(
        "4.4",
        "both mechanisms improved the performance",
        f"SPG over PG and ESPG over EPG: {INTERVAL}",
        ("cleaner", "pushbox"),
        memory_helps,
        f"In Cleaner PG's {CLEANERS_RATE}, so it says little how far SPG ends above it.",
        about="the selective memory",
    ),
    Claim("4.4", "we observe the deteriorated performance of EPG", f"PG over EPG: {INTERVAL}", ("gotogether",), bonus_hurts),
    Claim(
        "4.4",
        "selective memory is essential in escaping local optima",
        "fewer than 10 of 20 trials at the best outcome without it (PG, EPG) and at least 19 with it (SPG, ESPG, DecESPG)",
        WITH_LOCAL_OPTIMUM,
        memory_is_essential,
        "Partly: some trials leave without it, or not enough leave with it. That is among the ablation's five methods; what "
        "critics do without a memory is in the tables of results.",
    ),
    Claim(
        "4.5",
        "DecESPG reached the best performance",
        f"beside each of EX2, ICM, EMI and GASIL, {INTERVAL}",
        WORLDS,
        best_in_figure6,
    ),
    Claim("4.5", "DecESPG outperforms GASIL in all domains", INTERVAL, WORLDS, better_than_gasil, scope="all"),
    Claim(
        "4.5",
        "which converges to local optimum",
        "at least 10 of 20 trials end at an outcome other than the best (partly: at least 2); the time limit is none",
        WITH_LOCAL_OPTIMUM,
        gasil_stays,
        about="GASIL",
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


def overall(claim, rows):
    """The verdict on a whole claim: under each optimiser over the worlds, then over the optimisers."""
    verdicts = {o: over_worlds(claim.scope, [verdict for _, of, _, verdict in rows if of == o]) for o in OPTIMIZERS}
    still_open = sum(verdict == OPEN for *_, verdict in rows)
    seen = set(verdicts.values()) - {OPEN}
    alike = {YES: "reproduced", NO: "not reproduced", UNDECIDED: "undecided", PARTLY: "partly"}
    if len(seen) == 1:
        decided = [optimizer for optimizer in OPTIMIZERS if verdicts[optimizer] != OPEN]
        word = alike[seen.pop()] + (f" under {decided[0]}" if len(decided) == 1 else "")
    elif YES in seen and PARTLY not in seen:
        word = f"only under {next(o for o in OPTIMIZERS if verdicts[o] == YES)}"
    else:
        word = OPEN if not seen else PARTLY if PARTLY in seen else "not reproduced"
    return word + (f" ({still_open} of {len(rows)} cases open)" if still_open and word != OPEN else "")


def over_worlds(scope, verdicts):
    """The verdict over the worlds of one optimiser; "most" and "all" stay open while the open ones may decide."""
    known, still_open = [verdict for verdict in verdicts if verdict != OPEN], verdicts.count(OPEN)
    if scope == "most" and verdicts.count(YES) <= len(verdicts) / 2:
        return OPEN if verdicts.count(YES) + still_open > len(verdicts) / 2 else NO
    if scope == "all" and (NO in known or still_open):
        return NO if NO in known else OPEN
    return YES if scope == "most" else all_of(known) if known else OPEN


def claims_text(found):
    """What docs/claims.md says of the claims: one table of all, and one for each."""
    judged = [(claim, judge(claim, found)) for claim in CLAIMS]
    rows = [["section", "the paper says", "verdict"]]
    for number, (claim, cases) in enumerate(judged, 1):
        about = f" ({claim.about})" if claim.about else ""
        rows.append([claim.section, f'["{claim.quote}"](#{number}){about}', overall(claim, cases)])
    parts = [markdown(rows)]
    for number, (claim, cases) in enumerate(judged, 1):
        about = f"{claim.about}; " if claim.about else ""
        parts.append(f'<a id="{number}"></a>\n\n### "{claim.quote}" ({about}Section {claim.section})')
        parts.append(f"Counts as true if: {claim.criterion}. " + claim.note)
        parts.append(markdown([["world", "optimiser", "measured", "holds"], *map(list, cases)]))
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


def who_wins_pushbox(found):
    cells = cells_of(found, "pushbox")
    methods = ("coma", "gasil", "decespg")
    figures = {f"{m}_{c.optimizer}": c.mean(m) for c in cells for m in methods}
    figures |= {f"{m}_{c.optimizer}_best": c.at_best(m) for c in cells for m in methods}
    verdicts = [[c.minus("decespg", m)[1] for m in ("coma", "gasil")] for c in cells]
    return figures | dict(adam=cells[1].minus("decespg", "coma")[0].partition(" = ")[2], verdicts=verdicts)


def who_finds_the_treasure(found):
    cells = cells_of(found, "findtreasure")
    memories = [(c, m) for c in cells for m in ("spg", "espg", "decespg", "decespg_ex2", "espg_icm", "espg_emi", "gasil")]
    baselines = [(c, m) for c in cells for m in c.that_are(("ac", "coma", "acer", "dqn", "edti"))]
    figures = dict(optimum=cells[0].optimum)
    for ending, pairs in (("", memories), ("_baseline", baselines)):
        means = [c.mean(m) for c, m in pairs]
        best = [c.at_best(m) for c, m in pairs]
        figures |= {f"low{ending}": min(means), f"high{ending}": max(means), f"fewest{ending}": min(best)}
    return figures


def memory_alone(found):
    treasure, push = (Cells(found, world, "sign") for world in ("findtreasure", "pushbox"))
    figures = dict(spg_t=treasure.at_best("spg"), spg_p=push.at_best("spg"))
    return figures | dict(epg_t=treasure.at_best("epg"), epg_p=push.at_best("epg"))


def what_the_bonus_adds(found):
    """{world_optimiser: "mean [low, high]"} of DecESPG minus SPG, and the verdicts on them in the same order."""
    places = list(product(("gotogether", "movebox", "findtreasure", "pushbox", "cleaner"), OPTIMIZERS))
    pairs = {f"{world}_{optimizer}": Cells(found, world, optimizer).minus("decespg", "spg") for world, optimizer in places}
    verdicts = [verdict for _, verdict in pairs.values()]
    return {key: words.partition(" = ")[2] for key, (words, _) in pairs.items()} | dict(verdicts=verdicts)


def goals_in_gotogether(found):
    methods = ("decespg", "spg", "pg")
    return {f"{m}_{c.optimizer}": c.at_best(m) for c in cells_of(found, "gotogether") for m in methods}


def learnt_novelty(found):
    places = list(product(("findtreasure", "gotogether", "movebox", "pushbox", "cleaner"), OPTIMIZERS))
    pairs = {
        f"{world}_{optimizer}": Cells(found, world, optimizer).minus("decespg", "decespg_ex2") for world, optimizer in places
    }
    figures = {key: words.partition(" = ")[2] for key, (words, _) in pairs.items()}
    kept = {f"{m}_{c.optimizer}": c.at_best(m) for c in cells_of(found, "pushbox") for m in ("espg_icm", "espg_emi")}
    return figures | kept | dict(verdicts=[verdict for _, verdict in pairs.values()])


def pg_under_both(found):
    sign, adam = cells_of(found, "findtreasure")
    return {c.optimizer: c.mean("pg") for c in (sign, adam)} | {f"{c.optimizer}_best": c.at_best("pg") for c in (sign, adam)}


SENTENCES = (
    Sentence(
        "**In PushBox under sign descent COMA and GASIL beat DecESPG**: all 20 trials of each end at the large box, COMA's and "
        "GASIL's by the shortest way ({coma_sign:.2f} per step), DecESPG's at {decespg_sign:.2f}, as its memory replays small "
        "boxes, too. Under Adam {coma_adam_best} (COMA), {gasil_adam_best} (GASIL) and {decespg_adam_best} (DecESPG) end "
        "there; DecESPG minus COMA is {adam}. COMA's number hangs on [what its critics see](docs/results.md#pushbox).",
        who_wins_pushbox,
        lambda f: (
            f["coma_sign_best"] == f["gasil_sign_best"] == f["decespg_sign_best"] == 20
            and f"{f['coma_sign']:.2f}" == f"{f['gasil_sign']:.2f}" == "33.33"
            and f["verdicts"] == [[NO, NO], [UNDECIDED, YES]]
        ),
    ),
    Sentence(
        "In FindTreasure all methods with a memory, and GASIL, end at the treasure in all 20 trials, at {low:.2f} to "
        "{high:.2f} of {optimum:.2f} per step; AC, COMA, ACER, DQN and EDTI in at least {fewest_baseline}, at "
        "{low_baseline:.2f} to {high_baseline:.2f}.",
        who_finds_the_treasure,
        lambda f: f["fewest"] == 20 and f["fewest_baseline"] > 10,
    ),
    Sentence(
        "There the optimiser decides for PG: under sign descent all its trials stay at the meeting ({sign:.2f}), under Adam "
        "all end at the treasure ({adam:.2f}).",
        pg_under_both,
        lambda f: (f["sign_best"], f["adam_best"]) == (0, 20) and f"{f['sign']:.2f}" == "1.00",
    ),
    Sentence(
        "In FindTreasure and PushBox under sign descent SPG, with the memory and no bonus, ends at the best outcome in {spg_t} "
        "and {spg_p} trials, EPG, with the bonus and no memory, in {epg_t} and {epg_p}.",
        memory_alone,
        lambda f: min(f["spg_t"], f["spg_p"]) >= 19 and max(f["epg_t"], f["epg_p"]) <= 1,
    ),
    Sentence(
        "What the bonus adds to the memory, DecESPG minus SPG under sign descent and Adam: **much in GoTogether**, "
        "{gotogether_sign} and {gotogether_adam}; perhaps something in MoveBox, {movebox_sign} and {movebox_adam}, which rests "
        "on [a few trials](docs/results.md#movebox); nothing that could be told from chance in FindTreasure, "
        "{findtreasure_sign} and {findtreasure_adam}, PushBox, {pushbox_sign} and {pushbox_adam}, and Cleaner, {cleaner_sign} "
        "and {cleaner_adam}.",
        what_the_bonus_adds,
        lambda f: f["verdicts"] == [YES, YES, YES, *[UNDECIDED] * 7],
    ),
    Sentence(
        "In GoTogether all trials of DecESPG end at the goal under either optimiser, of SPG's {spg_sign} and {spg_adam}, of "
        "PG's {pg_sign} and {pg_adam}.",
        goals_in_gotogether,
        lambda f: f["decespg_sign"] == f["decespg_adam"] == 20,
    ),
    Sentence(
        "**EX2, learnt novelty, cannot be told from the Gaussian process** in FindTreasure, GoTogether and MoveBox (DecESPG "
        "minus EX2 is {movebox_sign} and {movebox_adam} under sign descent and Adam), in PushBox under sign descent and in "
        "Cleaner under Adam ({cleaner_adam}). It is better in Cleaner under sign descent ({cleaner_sign}) and in PushBox "
        "under Adam ({pushbox_adam}); ICM and EMI keep the large box there in only {espg_icm_adam} and {espg_emi_adam} trials, "
        "under sign descent in {espg_icm_sign} and {espg_emi_sign}.",
        learnt_novelty,
        lambda f: (
            f["verdicts"] == [*[UNDECIDED] * 7, NO, NO, UNDECIDED]
            and all(f[f"{method}_adam"] < f[f"{method}_sign"] for method in ("espg_icm", "espg_emi"))
        ),
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
        print(f'\nSection {claim.section}: "{claim.quote}": {overall(claim, rows)}')
        for world, optimizer, words, verdict in rows:
            print(f"    {world}, {optimizer}: {verdict}{': ' * bool(words)}{words}")
    try:
        wrong = [sentence for sentence in SENTENCES if not sentence.holds(sentence.figures(found))]
    except KeyError as error:
        raise envs.UsageError(
            f"the README's sentences need {'/'.join(error.args[0])}, which is not in {results.STORE}."
        ) from error
    for sentence in SENTENCES:
        holds = "NOT TRUE" if sentence in wrong else "true"
        print(f"\n{holds}: {sentence.with_figures(found)}")
    if publish and wrong:
        raise envs.UsageError(f"{len(wrong)} of the README's sentences are no longer true; nothing is published.")
    if publish:
        sentences = "\n".join(f"- {sentence.with_figures(found)}" for sentence in SENTENCES)
        for path, name, text in ((DOCS / "claims.md", "claims", claims_text(found)), (README, "sentences", sentences)):
            path.write_text(rewrite(path.read_text(encoding="utf-8"), name, text), encoding="utf-8")


if __name__ == "__main__":
    with command_line("claims.py"):
        tyro.cli(main, description=__doc__)

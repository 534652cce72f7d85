"""benchmark/claims.py: the verdicts, and that README and docs/ quote the kept results."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest

from benchmark import claims, results
from benchmark.report import DOCS, README
from tests.helpers import assert_refused
from tests.test_results import some_result


@pytest.fixture(scope="module")
def kept():
    return results.kept()


def test_the_page_is_that_of_the_kept_results(kept):
    assert claims.claims_text(kept) in (DOCS / "claims.md").read_text()


@pytest.mark.parametrize("sentence", claims.SENTENCES, ids=lambda sentence: sentence.words[:40])
def test_every_sentence_of_the_readme_has_the_figures_of_the_data_and_holds(sentence, kept):
    assert f"- {sentence.with_figures(kept)}\n" in README.read_text()
    assert sentence.holds(sentence.figures(kept))


def end(mean, best=20, world="pushbox"):
    """A result of 20 trials, `best` of them at the best outcome (4 of pushbox)."""
    usual = np.array([4] * best + [1] * (20 - best))
    return some_result(mean + np.linspace(-0.1, 0.1, 20), usual=usual, score=np.full((20, 2), mean))


def pushbox(optimizer="sign", **ends):
    return {("pushbox", method, optimizer): end(*value) for method, value in ends.items()}


def judged(quote, found, optimizer="sign"):
    (claim,) = [claim for claim in claims.CLAIMS if claim.quote.startswith(quote)]
    return {(world, o): verdict for world, o, _, verdict in claims.judge(claim, found)}["pushbox", optimizer]


def test_a_difference_is_judged_by_its_interval():
    cells = claims.Cells(pushbox(decespg=(31.0,), spg=(30.0,), espg=(31.0,)), "pushbox", "sign")
    assert cells.minus("decespg", "spg") == ("DecESPG - SPG = +1.00 [+1.00, +1.00]", "yes")
    assert cells.minus("spg", "decespg")[1] == "no"
    cells.found["pushbox", "espg", "sign"] = dataclasses.replace(cells["espg"], last=cells["espg"].last[::-1].copy())
    assert cells.minus("decespg", "espg")[1] == "undecided"


def test_claims_about_where_trials_end():
    baselines = dict.fromkeys(("pg", "ac", "coma", "acer", "edti"), (3.0, 0))
    quote = "all baselines learn pushing"
    assert judged(quote, pushbox(**baselines)) == "yes"
    assert judged(quote, pushbox(**{**baselines, "coma": (33.0, 18)})) == "partly"
    assert judged(quote, pushbox(**{**baselines, "coma": (4.0, 1)})) == "yes"
    stands = {("pushbox", "coma", "sign"): some_result(np.zeros(20), usual=np.zeros(20))}  # until the time limit
    assert judged(quote, pushbox(**baselines) | stands) == "partly"
    assert judged(quote, pushbox("adam", **baselines), "adam") == "open"  # DQN is missing
    assert judged(quote, pushbox("adam", **baselines, dqn=(2.0, 0)), "adam") == "yes"
    quote, memory = "selective memory is essential", dict.fromkeys(("spg", "espg", "decespg"), (31.0, 19))
    assert judged(quote, pushbox(pg=(3.0, 0), epg=(4.0, 9), **memory)) == "yes"
    assert judged(quote, pushbox(pg=(3.0, 10), epg=(4.0, 11), **memory)) == "partly"
    assert judged("which converges to local", pushbox(gasil=(20.0, 14))) == "partly"
    assert judged("which converges to local", pushbox(gasil=(20.0, 10))) == "yes"
    assert judged("which converges to local", pushbox(gasil=(20.0, 19))) == "no"
    collapsed = {("pushbox", "gasil", "sign"): some_result(np.zeros(20), usual=np.array([4] * 8 + [0] * 12))}
    assert judged("which converges to local", collapsed) == "no"
    quote = "our methods learned to jointly"
    assert [judged(quote, pushbox(espg=(mean,), decespg=(31.0, best))) for mean, best in ((31, 20), (29, 20), (31, 18))] == [
        "yes",
        "partly",
        "no",
    ]


def test_the_best_of_the_others_is_who_counts():
    found = pushbox(decespg=(31.0,), pg=(3.0,), ac=(4.0,), coma=(33.0,), acer=(3.0,), edti=(2.0,))
    assert judged("DecESPG reached the best performance in", found) == "no"
    found.update(pushbox(coma=(30.0,)))
    assert judged("DecESPG reached the best performance in", found) == "yes"


@pytest.mark.parametrize(
    ("scope", "verdicts", "word"),
    [
        ("each", "yes yes yes yes", "reproduced"),
        ("each", "no no no no", "not reproduced"),
        ("each", "open open open open", "open"),
        ("each", "yes no yes no", "only under sign"),
        ("each", "undecided yes no yes", "only under adam"),
        ("each", "yes no yes yes", "partly"),
        ("each", "partly partly partly partly", "partly"),
        ("each", "undecided undecided undecided open", "undecided (1 of 4 cases open)"),
        ("each", "undecided no no undecided", "not reproduced"),
        ("each", "yes open yes open", "reproduced under sign (2 of 4 cases open)"),
        ("most", "yes yes yes open no open", "reproduced under sign (2 of 6 cases open)"),
        ("each", "yes yes open open", "reproduced (2 of 4 cases open)"),
        ("most", "yes yes no no yes yes", "reproduced"),
        ("most", "yes yes no no open open", "open"),
        ("most", "no yes no no open open", "not reproduced under sign (2 of 6 cases open)"),
        ("all", "yes yes no yes", "only under adam"),
        ("all", "yes yes undecided yes", "partly"),
        ("all", "no yes no open", "not reproduced under sign (1 of 4 cases open)"),
        ("all", "no yes open open", "not reproduced under sign (2 of 4 cases open)"),
        ("all", "yes yes open open", "open"),
    ],
)
def test_the_verdict_on_a_whole_claim(scope, verdicts, word):
    verdicts = verdicts.split()
    rows = [(f"world {n // 2}", ("sign", "adam")[n % 2], "", verdict) for n, verdict in enumerate(verdicts)]
    assert claims.overall(SimpleNamespace(scope=scope), rows) == word


def test_worse_with_training_is_a_matter_of_standard_errors():
    noise = np.random.default_rng(0).normal(scale=0.01, size=20)
    found = {("cleaner", method, "sign"): some_result(0.05 + noise, score=np.full((20, 3), 0.11)) for method in ("pg", "coma")}
    words, verdict = claims.worse_with_training(claims.Cells(found, "cleaner", "sign"))
    assert verdict == "yes"
    assert re.match(r"PG 0.110 in the first 100 episodes, 0.0\d\d in the end; COMA 0.110 ", words)
    found["cleaner", "coma", "sign"] = some_result(0.2 + noise, score=np.full((20, 3), 0.11))
    assert claims.worse_with_training(claims.Cells(found, "cleaner", "sign"))[1] == "partly"


def test_a_result_that_is_missing_is_named(kept, monkeypatch):
    monkeypatch.setattr(claims.results, "kept", lambda: {key: kept[key] for key in kept if key != ("pushbox", "coma", "sign")})
    assert_refused("the README's sentences need pushbox/coma/sign", claims.main)

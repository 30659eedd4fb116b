"""The orderings that the paper claims, and whether they hold in our measurements."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.evaluation.statistics import Interval, probability_of_improvement
from modgnn_rl.reporting.table import Table
from modgnn_rl.reproduction.measurements import VALIDATION, Results
from modgnn_rl.reproduction.paper_tables import NAMES, format_interval, mean, mean_and_std, metric_title, published
from modgnn_rl.reproduction.studies import HOPS, ModelVariant

__all__ = ["CLAIMS", "Claim", "Operand", "check_claim", "claim_tables"]

WITH_PRE, WITHOUT_PRE, BASELINES = ("modgnn_mlp", "no_mid"), ("no_pre", "gcn_final"), ("gcn", "gcn_final")
OTHERS = ("no_mid", "no_pre", "gcn", "gcn_final")
CLAIMED = ("error", "leader_distance", "cohesion", "separation_spread")  # metrics in which ModGNN-MLP is best


@dataclass(frozen=True)
class Operand:
    """One side of a comparison: a metric of a model in one environment, averaged over its hops if there are several."""

    model: str
    hops: tuple[int, ...]
    setting: str = VALIDATION
    metric: str = "error"

    def __str__(self) -> str:
        hops = (
            "" if self.model == "central" else f", K = {' to '.join(map(str, sorted({self.hops[0], self.hops[-1]})))}"
        )
        agents = f", N = {self.setting[1:]}" if self.setting != VALIDATION else ""
        return f"{NAMES[self.model]}{hops}{agents}"

    def values(self, results: Results) -> NDArray[np.float64] | None:
        """The metric of all rollouts [S, F]; None if a job failed or was not run."""
        hops = (1,) if self.model == "central" else self.hops
        found = [results.values(ModelVariant(self.model, hop), self.setting, self.metric) for hop in hops]
        known = [values for values in found if values is not None]
        same = len(known) == len(found) and len({values.shape for values in known}) == 1
        return np.mean(known, axis=0) if same else None


@dataclass(frozen=True)
class Claim:
    """An ordering, as comparisons of which each first side should have the lower value."""

    text: str
    comparisons: tuple[tuple[Operand, Operand], ...]


def _levels() -> Claim:
    levels = (WITH_PRE, WITHOUT_PRE, ("gcn",), ("central",))
    pairs = [pair for low, high in itertools.pairwise(levels) for pair in itertools.product(low, high)]
    # The paper leaves out its GCN with K = 3 here, as an outlier.
    sides = {model: Operand(model, HOPS[:2] if model == "gcn" else HOPS) for pair in pairs for model in pair}
    text = "Validation error has four levels: models with f_pre; with networks elsewhere; GCN (K = 1, 2); Central"
    return Claim(text, tuple((sides[better], sides[worse]) for better, worse in pairs))


def _best(text: str, metric: str, setting: str, others: Sequence[str], hops: Sequence[int] = HOPS) -> Claim:
    pairs = [
        (Operand("modgnn_mlp", (hop,), setting, metric), Operand(other, (hop,), setting, metric))
        for hop in hops
        for other in others
    ]
    return Claim(text, tuple(pairs))


def _more_hops() -> Claim:
    pairs = [
        (Operand("modgnn_mlp", (more,), "N32"), Operand("modgnn_mlp", (fewer,), "N32"))
        for fewer, more in itertools.pairwise(HOPS)
    ]
    return Claim("ModGNN-MLP gains with K in closed loop", tuple(pairs))


def _no_gain() -> Claim:
    pairs = [(Operand(model, (2,), "N32"), Operand(model, (3,), "N32")) for model in BASELINES]
    return Claim("The baselines do not gain with K: K = 3 is worse than K = 2 in closed loop", tuple(pairs))


def _other_sizes() -> Claim:
    pairs = [
        (Operand("modgnn_mlp", (hop,), setting), Operand(model, (hop,), "N32"))
        for hop in HOPS
        for setting in ("N16", "N64")
        for model in BASELINES
    ]
    return Claim("ModGNN-MLP errs less with 16 or 64 agents than the baselines do with 32", tuple(pairs))


def _submodule(text: str, better: str, worse: str, setting: str) -> Claim:
    return Claim(text, tuple((Operand(better, (hop,), setting), Operand(worse, (hop,), setting)) for hop in HOPS))


CLAIMS = (
    _levels(),
    _best("ModGNN-MLP has the lowest validation error at every K", "error", VALIDATION, (*OTHERS, "central")),
    *(
        _best(
            f"ModGNN-MLP is best in closed loop at every K: {metric_title(metric)}",
            metric,
            "N32",
            (*OTHERS, "central"),
        )
        for metric in CLAIMED
    ),
    _more_hops(),
    _no_gain(),
    _best("ModGNN-MLP errs least with 64 agents", "error", "N64", OTHERS),
    _best("ModGNN-MLP errs least with 16 agents at K = 2 and 3", "error", "N16", OTHERS, (2, 3)),
    Claim(
        "At K = 1 with 16 agents ModGNN-MLP [-f_mid] beats ModGNN-MLP",
        ((Operand("no_mid", (1,), "N16"), Operand("modgnn_mlp", (1,), "N16")),),
    ),
    _other_sizes(),
    _submodule("f_pre matters more than f_mid: validation error", "no_mid", "no_pre", VALIDATION),
    _submodule("f_pre matters more than f_mid: closed-loop error", "no_mid", "no_pre", "N32"),
)


@dataclass(frozen=True)
class Verdict:
    """The result of one comparison; ``chance`` is None if it was not measured."""

    better: Operand
    worse: Operand
    chance: Interval | None
    means: tuple[float, float] | None

    @property
    def word(self) -> str:
        """``holds`` or ``reversed`` if the interval is on one side of one half, else ``undecided``."""
        if self.chance is None:
            return "not measured"
        return "holds" if self.chance.low > 0.5 else "reversed" if self.chance.high < 0.5 else "undecided"


def check_claim(claim: Claim, results: Results) -> tuple[str, list[Verdict]]:
    """Whether a claim holds: all of its comparisons must; it does not as soon as one is reversed."""
    verdicts = [_compare(better, worse, results) for better, worse in claim.comparisons]
    words = {verdict.word for verdict in verdicts}
    for word, verdict in (("reversed", "does not hold"), ("not measured", "not measured"), ("undecided", "undecided")):
        if word in words:
            return verdict, verdicts
    return "holds", verdicts


def _compare(better: Operand, worse: Operand, results: Results) -> Verdict:
    first, second = better.values(results), worse.values(results)
    if first is None or second is None:
        return Verdict(better, worse, None, None)
    rng, paired = np.random.default_rng(0), better.setting == worse.setting
    chance = probability_of_improvement(first, second, rng=rng, paired=paired, resamples=1000)
    return Verdict(better, worse, chance, (float(first.mean()), float(second.mean())))


def claim_tables(results: Results) -> dict[str, Table]:
    """What holds of the claims, and every comparison."""
    rows: list[list[str | float]] = []
    details: list[list[str | float]] = []
    for number, claim in enumerate(CLAIMS, start=1):
        word, verdicts = check_claim(claim, results)
        held, reversed_ = (sum(verdict.word == kind for verdict in verdicts) for kind in ("holds", "reversed"))
        known = [verdict.chance for verdict in verdicts if verdict.chance is not None]
        weakest = format_interval(min(known, key=lambda chance: chance.value), 2) if known else "-"
        rows.append([f"{number}. {claim.text}", word, f"{held} of {len(verdicts)}", reversed_, weakest])
        for verdict in verdicts:
            means = [f"{mean:.3f}" for mean in verdict.means] if verdict.means else ["-", "-"]
            chance = "-" if verdict.chance is None else format_interval(verdict.chance, 2)
            details.append([str(number), f"{verdict.better} < {verdict.worse}", *means, chance, verdict.word])
    caption = (
        "A comparison holds where the 95 % interval of the probability of improvement lies above one half, and is "
        "reversed where it lies below. A claim holds where all its comparisons do, and does not where one is reversed; "
        "else it is undecided at this size. Weakest: the lowest probability of improvement among them."
    )
    if results.config.seeds == 1:
        caption += " With one training of each model this tells of these trainings, not of the architectures."
    about = (
        "Probability that the first has the lower value in an episode, over all pairs of seeds (Agarwal et al. 2021), "
        "with its 95 % bootstrap interval over seeds and rollouts, and both means."
    )
    header = ["the paper says", "here", "comparisons that hold", "reversed", "weakest [95 %]"]
    every = ["claim", "comparison", "first", "second", "probability [95 %]", "here"]
    return {
        "claims": Table("The paper's orderings", header, rows, caption),
        "margins": _margins(results),
        "comparisons": Table("Every comparison", every, details, about),
    }


def _margins(results: Results) -> Table:
    """By how much ModGNN-MLP is better than the better of the two baselines, there and here."""
    paper = published()["model_evaluation"]
    body = []
    for hop in HOPS:
        models = ("modgnn_mlp", *BASELINES)
        there, here = [paper[model][hop] for model in models], [ModelVariant(model, hop) for model in models]
        errors = [entry["error"] for entry in there], [mean(results, row, "N32", "error") for row in here]
        spreads = (
            [entry["separation"][1] for entry in there],
            [mean_and_std(results, row, "separation")[1] for row in here],
        )
        body.append([str(hop), *map(_less, (*errors, *spreads))])
    caption = (
        "Error on own rollouts, and standard deviation of the separation over time, agents and rollouts (Table 2): how "
        "far that of ModGNN-MLP lies below the lower one of GCN and GCN [+f_final]."
    )
    header = ["K", "error, paper", "error", "std of separation, paper", "std of separation"]
    return Table("By how much ModGNN-MLP is better than the best baseline", header, body, caption)


def _less(figures: Sequence[float]) -> str:
    """How much lower the first metric is than the lowest of the others."""
    own, *others = figures
    share = 1 - own / min(others)
    return "not measured" if np.isnan(share) else f"{abs(share):.0%} {'lower' if share >= 0 else 'higher'}"

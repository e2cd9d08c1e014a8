"""What a report says at its head in plain words: what was learnt, and how sure it is."""

from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.report.contents import Evidence
from bayespbrl.preferences import Answer
from bayespbrl.settings import WITHOUT_POSTERIOR

ENOUGH_PREDICTIONS = 10  # to judge calibration by


def learnt(
    evidence: Evidence, iterations: xr.Dataset, answers: xr.Dataset, scores: xr.Dataset, ranking: xr.Dataset
) -> list[str]:
    """Plain sentences with figures, for the head of the report."""
    number = iterations.sizes["iteration"]
    if number == 0:
        given = count(len(evidence.answers), "answer has", "answers have")
        return [f"Nothing has been learnt yet: no iteration is completed, {given} been given."]
    sentences = [_reached(evidence, iterations), _trust(evidence)]
    quality = getattr(evidence.estimate, "quality", None)
    if quality is not None and quality.pairs:
        satisfied = f"{quality.pairs_satisfied} of {count(quality.pairs, 'preference')}"
        sentences.append(f"It agrees with {satisfied} that follow from the answers.")
    sentences += _sureness(evidence, ranking)
    before = answers["before"].values[answers["iteration"].values > 1]  # the first ones meet the prior: a coin's chance
    before = before[np.isfinite(before)]
    if before.size:
        with np.errstate(divide="ignore"):
            mean = np.exp(np.mean(np.log(before)))
        sentences.append(
            f"Since the first iteration it gave the answers that came {percent(mean)} probability beforehand "
            f"(geometric mean), and more than half to {percent(np.mean(before > 0.5))} of them. {_calibrated(scores)}"
        )
    return sentences + _undominated(evidence)


def iterations_that_asked_nothing(evidence: Evidence, iterations: xr.Dataset) -> int:
    """How many iterations put no question; one that was skipped was put."""
    without_answer = iterations["iteration"].values[1:][np.diff(iterations["answers"].values) == 0]
    return len(set(without_answer.tolist()) - {record.iteration for record in evidence.answers})


def _reached(evidence: Evidence, iterations: xr.Dataset) -> str:
    value, answers = iterations["value"].values, iterations["answers"].values
    so_far = f"{count(int(np.nan_to_num(answers[-1])), 'answer')} and {count(len(value), 'iteration')}"
    if unasked := iterations_that_asked_nothing(evidence, iterations):
        so_far += f", {unasked} of which asked nothing,"
    if np.isnan(value).any():
        return f"After {so_far} the value of the policy is not known for every iteration."
    episodes = count(evidence.settings.evaluation_episodes, "fresh episode")
    text = f"After {so_far} the policy's value, the mean return of {episodes}, is {figure(value[-1])}"
    optimum = getattr(evidence.dynamics, "optimal_return", None)
    if optimum is not None:
        text += f", {percent(value[-1] / optimum, 1)} of the optimum {figure(optimum)}"
    best = int(np.argmax(value))
    known = not np.isnan(answers[best])
    when = f"after {count(int(answers[best]), 'answer')}" if known else f"in iteration {best + 1}"
    when += f" and {count(best + 1, 'iteration')}" if known and unasked else ""
    text += f". After the first iteration it was {figure(value[0])}; "
    if best == len(value) - 1:
        return f"{text}it has never been better."
    same = figure(value[best]) == figure(value[-1])
    return text + (f"it was as good {when} already." if same else f"the best was {figure(value[best])} {when}.")


def figure(number: float) -> str:
    """Four digits, whole numbers as such, and a minus sign that is one."""
    whole = number == int(number) and abs(number) < 1e6 if np.isfinite(number) else False
    return (f"{number:.0f}" if whole else f"{number:.4g}").replace("-", "−")


def percent(share: float, digits: int = 0) -> str:
    """A share as a percentage."""
    return f"{100 * share:.{digits}f} %"


def count(number: int, one: str, many: str | None = None) -> str:
    """A number with its noun, in the plural where it is not one."""
    return f"{number} {one if number == 1 else (many or one + 's')}"


def cell(value: Any) -> str:
    """A text or a number as it stands in a table; a dash for what is not known."""
    if isinstance(value, str):
        return value
    number = float(value)
    return "–" if np.isnan(number) else figure(number)


def no_posterior(evidence: Evidence) -> str:
    """Why there is none."""
    kind = evidence.settings.utility
    if evidence.estimate is None and kind not in WITHOUT_POSTERIOR:
        return "No posterior yet." if not evidence.iterations else "No posterior can be read."
    return f"This run's utility is {kind}, which has no posterior: there is no uncertainty to show."


def _trust(evidence: Evidence) -> str:
    quality = getattr(evidence.estimate, "quality", None)
    if quality is None:
        return "No utility estimate can be read."
    if evidence.estimate_iteration < len(evidence.iterations):
        return (
            f"The newest utility estimate that can be read is that of iteration {evidence.estimate_iteration}; "
            "what follows about the utility is as of then."
        )
    if evidence.posterior is None:
        return (
            "The utility is the hidden reward itself: a ceiling for comparison, in which nothing is uncertain."
            if evidence.settings.utility == "known-reward"
            else "The utility is a point estimate (linear program) without a posterior, so nothing here can say how "
            "sure it is: only how well it fits the answers."
        )
    draws = evidence.posterior["posterior"].sizes
    verdict = "has converged" if quality.converged else "has NOT converged"
    return (
        f"The last posterior {verdict}: largest R̂ {quality.rhat_max:.3f}; of {draws['chain'] * draws['draw']} draws at "
        f"least {quality.effective_sample_size_min:.0f} are effective."
    )


def _sureness(evidence: Evidence, ranking: xr.Dataset) -> list[str]:
    """How sure the posterior is of the order of the newest trajectories, and that the undominated one is the best."""
    number = ranking.sizes["trajectory"]
    if number < 2:
        return []
    better = ranking["better_probability"].values[np.triu_indices(number, k=1)]
    sure = float(np.mean(np.maximum(better, 1 - better)))
    sentences = [
        f"Taking two at a time of {number} trajectories, the newest and the undominated one, it is {percent(sure)} "
        "sure, on average, which of them is better (50 % is knowing nothing)."
    ]
    for best in set(evidence.preferences.undominated[-1:]) & set(ranking["trajectory"].values.tolist()):
        wins = percent(float(ranking["best_probability"].sel(trajectory=best)))
        sentences.append(f"With probability {wins} trajectory {best}, undominated so far, is the best of these.")
    return sentences


def _undominated(evidence: Evidence) -> list[str]:
    """Which are the best so far, and for how long nothing better has come."""
    best = evidence.preferences.undominated
    if not best:
        return []
    size = evidence.settings.trajectories_per_iteration
    named = ", ".join(f"{n} (of iteration {n // size + 1})" for n in best)
    text = f"Undominated among all trajectories that were compared: number {named}."
    compared = [record for record in evidence.answers if record.answer is not Answer.SKIP]
    since = max(0, sum(best[-1] in (record.first, record.second) for record in compared) - 1)  # the first set it there
    return [text + (f" {count(since, 'comparison')} since then brought nothing better." if since else "")]


def _calibrated(scores: xr.Dataset) -> str:
    score, expected, sd = (float(scores[name]) for name in ("log_score", "log_score_expected", "log_score_sd"))
    text = f"The log score is {figure(score)} nats, where {figure(expected)} ± {figure(sd)} was to be expected: "
    if scores.sizes["prediction"] < ENOUGH_PREDICTIONS:
        return text + "too few to judge by."
    if score < expected - 2 * sd:
        return text + "it was surer than it should have been."
    return text + ("it could have been surer." if score > expected + 2 * sd else "no sign of false confidence.")

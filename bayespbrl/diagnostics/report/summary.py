"""The summary of a report: sentences on the value reached, the posterior's convergence and the predictions."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.report.contents import RunContents
from bayespbrl.diagnostics.report.formatting import count, number, percent
from bayespbrl.diagnostics.report.tables import iterations_without_question
from bayespbrl.preferences import Answer

ENOUGH_PREDICTIONS = 10  # to judge calibration by


def summary(
    contents: RunContents, iterations: xr.Dataset, answers: xr.Dataset, scores: xr.Dataset, ranking: xr.Dataset
) -> list[str]:
    """The sentences, from the contents and their tables."""
    if not iterations.sizes["iteration"]:
        given = count(contents.preferences.answers, "answer has", "answers have")
        return [f"Nothing has been learnt yet: no iteration is completed, {given} been given."]
    sentences = [_value(contents, iterations), *_restart(contents), _convergence(contents)]
    quality = None if contents.estimate is None else contents.estimate.quality
    if quality is not None and quality.pairs:
        satisfied = f"{quality.pairs_satisfied} of {count(quality.pairs, 'preference')}"
        sentences.append(f"The estimate satisfies {satisfied} that follow from the answers.")
    return [*sentences, *_ranking(contents, ranking), *_predictions(answers, scores), *_undominated(contents)]


def _value(contents: RunContents, iterations: xr.Dataset) -> str:
    value, answers = iterations["value"].values, iterations["answers"].values
    so_far = f"{count(int(np.nan_to_num(answers[-1])), 'answer')} and {count(len(value), 'iteration')}"
    if unasked := iterations_without_question(contents, iterations):
        so_far += f", {unasked} of them without a question,"
    if np.isnan(value).any():
        return f"After {so_far} the value of the policy is unknown for some iterations."
    episodes = count(contents.settings.rollouts.evaluation_episodes, "fresh episode")
    text = f"After {so_far} the policy's value, the mean return of {episodes}, is {number(value[-1])}"
    optimum = contents.optimum
    if optimum is not None and optimum > 0:
        text += f", {percent(value[-1] / optimum, 1)} of the optimum {number(optimum)}"
    elif optimum is not None:
        text += f"; the optimum is {number(optimum)}"
    if not np.ptp(value) and not value[0]:
        return f"{text}: the environment may give no reward."
    best = int(np.argmax(value))
    known = not np.isnan(answers[best])
    when = f"after {count(int(answers[best]), 'answer')}" if known else f"in iteration {best + 1}"
    when += f" and {count(best + 1, 'iteration')}" if known and unasked else ""
    text += f". After the first iteration it was {number(value[0])}; "
    if best == len(value) - 1:
        return f"{text}it has never been better."
    same = number(value[best]) == number(value[-1])
    return text + (f"it was already as good {when}." if same else f"the best was {number(value[best])} {when}.")


def _restart(contents: RunContents) -> Iterator[str]:
    """When the policy was restarted, and which policy the run keeps."""
    kept = contents.iterations[-1].get("kept")
    if contents.started and isinstance(kept, int):
        of = "the one" if kept > contents.started else "the earlier one"
        yield (
            f"After iteration {contents.started} the policy was restarted with the posterior by then; the run keeps "
            f"{of} of iteration {kept}."
        )


def _convergence(contents: RunContents) -> str:
    if contents.estimate is None:
        return "No utility estimate can be read."
    quality = contents.estimate.quality
    if contents.estimate_iteration < len(contents.iterations):
        return (
            f"The newest utility estimate that can be read is that of iteration {contents.estimate_iteration}; what "
            "follows about the utility describes that iteration."
        )
    if contents.posterior is None:
        return (
            "The utility is the hidden reward itself: a reference run, without uncertainty."
            if contents.settings.estimation.utility == "known-reward"
            else "The utility is a point estimate (linear program) without a posterior: its fit to the answers is "
            "known, its uncertainty is not."
        )
    draws = contents.posterior["posterior"].sizes
    verdict = "has converged" if quality.converged else "has NOT converged"
    return (
        f"The last posterior {verdict}: largest R̂ {quality.rhat_max:.3f}, smallest effective sample size "
        f"{quality.effective_sample_size_min:.0f} of {draws['chain'] * draws['draw']} draws."
    )


def _ranking(contents: RunContents, ranking: xr.Dataset) -> Iterator[str]:
    """How certain the order of the newest trajectories is, and that the undominated one is the best."""
    total = ranking.sizes["trajectory"]
    if total < 2:
        return
    better = ranking["better_probability"].values[np.triu_indices(total, k=1)]
    certainty = float(np.mean(np.maximum(better, 1 - better)))
    yield (
        f"Of two among {total} trajectories, the newest and the newest undominated one, the better one is known with "
        f"probability {percent(certainty)} on average (50 % is chance)."
    )
    for best in set(contents.preferences.undominated[-1:]) & set(ranking["trajectory"].values.tolist()):
        wins = percent(float(ranking["best_probability"].sel(trajectory=best)))
        others = len(contents.preferences.undominated) - 1
        of = f" ({count(others, 'other is', 'others are')} undominated too)" if others else ""
        yield f"With probability {wins} the newest undominated trajectory, number {best}{of}, is the best of these."


def _predictions(answers: xr.Dataset, scores: xr.Dataset) -> Iterator[str]:
    """How probable the answers were before they were given; those of the first iteration meet the prior, at ½ each."""
    before = answers["before"].values[answers["iteration"].values > 1]
    before = before[np.isfinite(before)]
    if before.size:
        with np.errstate(divide="ignore"):
            mean = np.exp(np.mean(np.log(before)))
        tied = bool((answers["said"] == str(Answer.TIE)).any())
        yield (
            f"The answers since the first iteration had a probability of {percent(mean)} before they were given "
            f"(geometric mean); {percent(np.mean(before > 0.5))} of them had more than one half. "
            + _calibration(scores, "Of those that say which is better, the" if tied else "The")
        )


def _calibration(scores: xr.Dataset, the: str) -> str:
    if not scores.sizes["prediction"]:
        return "None of them says which is better."
    score, expected, sd = (float(scores[name]) for name in ("log_score", "log_score_expected", "log_score_sd"))
    text = f"{the} log score is {number(score)} nats; {number(expected)} ± {number(sd)} is expected if calibrated: "
    if scores.sizes["prediction"] < ENOUGH_PREDICTIONS:
        return text + "too few answers to judge."
    if score < expected - 2 * sd:
        return text + "overconfident."
    return text + ("underconfident." if score > expected + 2 * sd else "no sign of overconfidence.")


def _undominated(contents: RunContents) -> Iterator[str]:
    """The best so far, and for how many comparisons it has been so."""
    best, pairs = contents.preferences.undominated, contents.preferences.pairs
    lost = {dominated for _, dominated in pairs}
    compared = [answer for answer in contents.answers if answer.answer is not Answer.SKIP]
    if not best or not compared:
        return
    size = contents.settings.rollouts.trajectories_per_iteration
    named = ", ".join(f"{n} (of iteration {n // size + 1})" for n in best)
    with_it = ({answer.first, answer.second} for answer in compared if best[-1] in (answer.first, answer.second))
    since = max(0, len(set().union(*with_it)) - 2)  # itself, and the one that made it the best
    unbeaten = (
        f" {count(since, 'comparison')} since then found nothing better." if since and best[-1] not in lost else ""
    )
    # neither says which trajectory later ones are compared with
    whole = {preferred for preferred, _ in pairs} - lost <= set(best) and not lost & set(best)
    apart = "" if whole else ", leaving out repeated questions and comparisons of two policies"
    yield f"Undominated among all compared trajectories{apart}: number {named}.{unbeaten}"

"""The warnings of a report, each with its remedy."""

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from gymnasium.spaces import Discrete

from bayespbrl.diagnostics.report.contents import RunContents
from bayespbrl.diagnostics.report.document import ReportWarning
from bayespbrl.diagnostics.report.formatting import count, number
from bayespbrl.diagnostics.report.people import has_people, people_warnings
from bayespbrl.diagnostics.report.summary import ENOUGH_PREDICTIONS
from bayespbrl.diagnostics.report.tables import contradicted
from bayespbrl.preferences import Answer

# Entropy has collapsed below a tenth of that of a uniform choice, or of the first policy. A continuous policy has lost
# three nats a dimension when its standard deviation is a twentieth of the first.
ENTROPY_LEFT, ENTROPY_LOST = 0.1, 3.0
SURPRISING = 0.1
FIT_NOISE = 0.03  # nats by which a refit moves a policy, however small the bound
# The confidence of the default schedule sets its own bounds.
SMALLER = "smaller updates (--schedule constant with a small --kl-bound)"


def find_warnings(
    contents: RunContents, iterations: xr.Dataset, answers: xr.Dataset, scores: xr.Dataset
) -> list[ReportWarning]:
    """All warnings, most serious first."""
    found = list(contents.damage)
    if contents.features_missing:
        what = (
            f"The run's state features are a function of your own, and {contents.features_missing}. The utility of "
            "states and the probability of each answer before it was given are missing here."
        )
        remedy = "Call bayespbrl.load(directory, features=...).report() with the function of the run."
        found.append(ReportWarning(what, remedy))
    if iterations.sizes["iteration"]:
        found += [*_of_fits(contents, iterations), *_of_updates(iterations), *_of_fitted_policy(iterations)]
        found += [*_of_entropy(contents, iterations), *_of_value(iterations)]
    found += people_warnings(contents) if has_people(contents) else []
    return [*found, *_of_answers(contents, answers), *_of_predictions(scores)]


def _of_fits(contents: RunContents, table: xr.Dataset) -> Iterator[ReportWarning]:
    failed = table["iteration"].values[table["utility_converged"].values == 0]
    if failed.size and contents.settings.estimation.utility == "linear-program":
        yield ReportWarning(f"The linear program failed in {_which(failed)}.", "Its status is in summary.json.")
    elif failed.size:
        last = "The last fit is among them. " if failed[-1] == table.sizes["iteration"] else ""
        yield ReportWarning(
            f"The posterior did not converge in {_which(failed)}. {last}Uncertainties there are unreliable, and so are "
            "the policy updates that followed.",
            "One chain of so many draws does not suffice: take more (--plain-draws), or leave that option out."
            if contents.settings.estimation.plain_draws is not None
            else "Look at the rank plots. "
            + (
                "The usual reason is answers that contradict each other, under the lapse rate that was set. Let it be "
                "inferred."
                if contents.model.lapse_rate is not None
                else "Where they are level, it is the hyperparameters or the length scales that mix slowly."
            ),
        )


def _of_updates(table: xr.Dataset) -> Iterator[ReportWarning]:
    iteration, failed = table["iteration"].values, table["reps_converged"].values == 0
    if failed.any():
        yield ReportWarning(
            f"REPS did not converge in {_which(iteration[failed])}: the last update there changed nothing.",
            f"Fewer centres (--centres), where states are continuous, or {SMALLER} make the dual easier to solve.",
        )
    if (idle := iteration[(table["bound_active"].values == 0) & ~failed]).size:
        yield ReportWarning(
            f"The KL bound was inactive in {_which(idle)}: no admissible policy was as far away as allowed.",
            "Harmless once the policy is good and has no more to gain. If the value is poor, the utility no longer "
            "distinguishes the actions: ask more questions, or use a policy with more entropy.",
        )


def _of_fitted_policy(table: xr.Dataset) -> Iterator[ReportWarning]:
    """Whether the policy could be fitted, and the KL of the fitted policy against the KL that REPS reached."""
    iteration = table["iteration"].values
    if (failed := iteration[table["policy_fit_converged"].values == 0]).size:
        yield ReportWarning(
            f"The fit of the policy did not converge in {_which(failed)}: the policy may not follow the weights of "
            "REPS there.",
            "Compare the fitted policy's KL with the KL that REPS reached. Harmless where they agree. Otherwise try "
            f"{SMALLER} or another kind of policy (--policy).",
        )
    # of several updates the policy's KL is that of all together, and REPS' own that of the last alone
    several = table["updates"].values > 1
    fitted, reached = table["kl_fitted_policy"].values, np.where(several, table["kl_bound"], table["kl"])
    if (far := iteration[fitted > 3 * np.maximum(reached, FIT_NOISE)]).size:
        yield ReportWarning(
            f"The fitted policy moved more than three times as far as REPS asked for in {_which(far)}.",
            "The bound does not hold there. Try another kind of policy (--policy), or more trajectories an iteration.",
        )
    active = table["bound_active"].values != 0  # else REPS itself did not go as far as the bound
    if (near := iteration[active & (fitted < reached / 3) & (reached > 0.02)]).size > 0.2 * len(iteration):
        yield ReportWarning(
            f"The fitted policy moved less than a third as far as REPS asked for in {_which(near)}.",
            "The policy smooths the update. Harmless while the value rises. A larger bound (--schedule constant with a "
            "larger --kl-bound) moves it further"
            + (", and so do more updates (--updates-per-iteration 3)." if not several.any() else "."),
        )


def _of_entropy(contents: RunContents, table: xr.Dataset) -> Iterator[ReportWarning]:
    first, last = float(table["entropy"][0]), float(table["entropy"][-1])
    space = None if contents.environment is None else contents.environment.action_space
    if isinstance(space, Discrete):
        collapsed = last < ENTROPY_LEFT * max(first, np.log(float(space.n)))
    else:
        size = 1 if space is None else int(np.prod(space.shape or ()))
        collapsed = first - last > ENTROPY_LOST * size
    if collapsed:
        yield ReportWarning(
            f"The policy's entropy collapsed, from {first:.2f} to {last:.2f} nats: it hardly explores.",
            f"Harmless if the value is good. Otherwise the policy settled too early: {SMALLER} narrow it more slowly. "
            "A run with another --seed shows whether this was chance.",
        )


def _of_value(table: xr.Dataset) -> Iterator[ReportWarning]:
    value = table["value"].values
    if len(value) >= 3 and np.max(value) - value[-1] > 0.15 * np.ptp(value):  # no comparison holds for an unknown one
        best = int(np.argmax(value))
        yield ReportWarning(
            f"The value has fallen from {number(value[best])} (iteration {best + 1}) to {number(value[-1])}.",
            f"Either the evaluation is noisy, an update was too large (look at the KL, and try {SMALLER}), "
            "or no answer covers this policy, and the posterior is wrong about it: more answers help.",
        )


def _of_answers(contents: RunContents, answers: xr.Dataset) -> Iterator[ReportWarning]:
    question = answers["question"].values
    if (against := question[contradicted(answers)]).size:
        mistakes = (
            "nothing is wrong" if contents.without_posterior else "the lapse rate allows for them, unless it is set"
        )
        cause = (
            "the expert wants something else than the reward."
            if contents.settings.estimation.utility == "known-reward"
            else "the features cannot express what matters: use features of your own, or more centres where states are "
            "continuous."
        )
        yield ReportWarning(
            f"The estimate contradicts {count(against.size, 'answer')}: {_list(against)}.",
            f"See the pictures below. If these answers are mistakes, {mistakes}. If they are right, {cause}",
        )
    if (surprising := question[answers["before"].values < SURPRISING]).size:
        yield ReportWarning(
            f"{count(surprising.size, 'answer was', 'answers were')} surprising (probability below {SURPRISING:g} "
            f"beforehand): {_list(surprising)}.",
            "Some surprises are expected: one in ten predictions of 0.9 fails. The pictures show whether these "
            "answers were mistakes.",
        )
    yield from _of_undecided_answers([answer.answer for answer in contents.answers])


def _of_undecided_answers(answers: Sequence[Answer]) -> Iterator[ReportWarning]:
    """Whether many answers were ties or skips."""
    if (skipped := answers.count(Answer.SKIP)) > 0.5 * max(3, len(answers)):
        yield ReportWarning(
            f"{skipped} of {len(answers)} questions were skipped: they taught nothing.",
            "Say what to look for, or show clips in which it can be seen: shorter ones (--clip-steps), or pictures by "
            "your environment's render().",
        )
    given = len(answers) - skipped
    if (ties := answers.count(Answer.TIE)) > 0.3 * max(3, given):
        yield ReportWarning(
            f"{ties} of {given} answers were ties: they say that two are alike, not what is better.",
            "Harmless where the trajectories are good. Otherwise longer ones, or less similar ones, are easier to tell "
            "apart.",
        )


def _of_predictions(scores: xr.Dataset) -> Iterator[ReportWarning]:
    limit = float(scores["log_score_expected"] - 2 * scores["log_score_sd"])
    if scores.sizes["prediction"] >= ENOUGH_PREDICTIONS and float(scores["log_score"]) < limit:
        yield ReportWarning(
            "The predictions may be overconfident: their log score is more than two standard deviations below its "
            "expectation, as in 6 to 9 % of calibrated runs.",
            "Leave length scales, lapse rate and steepness to be inferred (--hyperparameters inferred), if they were "
            "set. Else the features cannot express what matters.",
        )


def _which(iterations: np.ndarray) -> str:
    return f"iteration {_list(iterations)}" if len(iterations) == 1 else f"iterations {_list(iterations)}"


def _list(numbers: Sequence[int] | np.ndarray) -> str:
    """Numbers in words, consecutive ones as a range: 1, 3–5."""
    ranges: list[list[int]] = []
    for n in sorted(int(n) for n in numbers):
        if ranges and n == ranges[-1][1] + 1:
            ranges[-1][1] = n
        else:
            ranges.append([n, n])
    return ", ".join(str(low) if low == high else f"{low}–{high}" for low, high in ranges)

"""The warnings of a report, each with what to do about it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from gymnasium.spaces import Discrete

from bayespbrl.diagnostics.report.contents import Evidence
from bayespbrl.diagnostics.report.summary import ENOUGH_PREDICTIONS, count, figure
from bayespbrl.preferences import Answer

# Below a tenth of what a uniform choice, or the first policy, has left there is nothing more to explore with; a
# continuous policy has lost three nats a dimension when its standard deviation is a twentieth.
ENTROPY_LEFT, ENTROPY_LOST = 0.1, 3.0
SURPRISING = 0.1


@dataclass(frozen=True)
class Caution:
    """Something that is not in order, and the way out.

    Attributes:
      what: one sentence or two.
      do: what to do about it.
    """

    what: str
    do: str


def warnings(evidence: Evidence, iterations: xr.Dataset, answers: xr.Dataset, scores: xr.Dataset) -> list[Caution]:
    """What is not in order, most serious first."""
    found = [Caution(f"Broken: {text}", _mending(text)) for text in evidence.broken]
    if evidence.features_missing:
        found.append(
            Caution(
                f"The run's state features are a function of your own, and {evidence.features_missing}: the utility of "
                "states, and what was expected of each answer beforehand, are missing here.",
                "Call bayespbrl.load(directory, features=...).report() with the function you started the run with.",
            )
        )
    if iterations.sizes["iteration"]:
        found += _of_fits(evidence, iterations) + _of_updates(evidence, iterations) + _of_value(iterations)
    return found + _of_answers(evidence, answers, scores)


def _of_fits(evidence: Evidence, table: xr.Dataset) -> list[Caution]:
    failed = table["iteration"].values[table["utility_converged"].values == 0]
    if not failed.size:
        return []
    last = "The last fit is among them. " if failed[-1] == table.sizes["iteration"] else ""
    if evidence.settings.utility == "linear-program":
        return [Caution(f"The linear program failed in {_which(failed)}.", "Its status is in summary.json.")]
    return [
        Caution(
            f"The posterior did not converge in {_which(failed)}. {last}What is said of uncertainty there is not to be "
            "relied on, nor is the policy update that followed.",
            "Look at the rank plots. A lapse rate above zero (--lapse-rate 0.1) softens answers that contradict each "
            "other, which is the usual reason; a lower --steepness does as well.",
        )
    ]


def _of_updates(evidence: Evidence, table: xr.Dataset) -> list[Caution]:
    found, iteration = [], table["iteration"].values
    if (failed := iteration[table["reps_converged"].values == 0]).size:
        found.append(
            Caution(
                f"REPS did not converge in {_which(failed)}: that update left the policy where it was.",
                "Fewer centres (--centres) or a smaller --kl-bound make the dual easier.",
            )
        )
    solved = table["reps_converged"].values != 0
    if (idle := iteration[(table["bound_active"].values == 0) & solved]).size:
        found.append(
            Caution(
                f"The KL bound was inactive in {_which(idle)}: no admissible policy was as far away as allowed.",
                "Harmless once the policy is good: there is no more to gain. If the value is poor, the utility no "
                "longer tells actions apart: ask more questions, or a policy with more entropy.",
            )
        )
    # of several updates the policy's KL is that of all together, and REPS' own that of the last alone
    several = table["updates"].values > 1
    fitted, reached = table["kl_fitted_policy"].values, np.where(several, table["kl_bound"], table["kl"])
    if (bold := iteration[fitted > 3 * np.maximum(reached, 0.01)]).size:
        found.append(
            Caution(
                f"The fitted policy went more than three times as far as REPS asked for in {_which(bold)}.",
                "The bound does not hold there. Another kind of policy (--policy), or a smaller --kl-bound.",
            )
        )
    if (tame := iteration[(fitted < reached / 3) & (reached > 0.02)]).size > 0.2 * len(iteration):
        found.append(
            Caution(
                f"The fitted policy went less than a third as far as REPS asked for in {_which(tame)}.",
                "The policy smooths the update. Harmless while the value rises; a larger --kl-bound takes it further"
                + (", and so do more updates (--updates-per-iteration 3)." if not several.any() else "."),
            )
        )
    return found + _of_entropy(evidence, table)


def _of_entropy(evidence: Evidence, table: xr.Dataset) -> list[Caution]:
    first, last = float(table["entropy"][0]), float(table["entropy"][-1])
    space = getattr(evidence.environment, "action_space", None)
    if isinstance(space, Discrete):
        collapsed = last < ENTROPY_LEFT * max(first, np.log(float(space.n)))
    else:
        size = 1 if space is None else int(np.prod(space.shape))
        collapsed = first - last > ENTROPY_LOST * size
    if not collapsed:
        return []
    return [
        Caution(
            f"The policy's entropy collapsed, from {first:.2f} to {last:.2f} nats: it hardly explores any more.",
            "Right if the value is good. If not, it settled too early: a smaller --kl-bound narrows it more slowly; "
            "start again with another --seed to see whether it was chance.",
        )
    ]


def _of_value(table: xr.Dataset) -> list[Caution]:
    value = table["value"].values
    if len(value) < 3 or np.isnan(value).any() or np.max(value) - value[-1] <= 0.15 * (np.max(value) - np.min(value)):
        return []
    best = int(np.argmax(value))
    return [
        Caution(
            f"The value has fallen from {figure(value[best])} (iteration {best + 1}) to {figure(value[-1])}.",
            "A noisy evaluation, or an update that was too bold: look at the KL, and try a smaller --kl-bound.",
        )
    ]


def _of_answers(evidence: Evidence, answers: xr.Dataset, scores: xr.Dataset) -> list[Caution]:
    found, question = [], answers["question"].values
    against = question[answers["margin"].values < 0]
    if against.size:
        found.append(
            Caution(
                f"The estimate contradicts {count(against.size, 'answer')}: {_list(against)}.",
                "See the pictures below. Mistaken answers: allow for them with --lapse-rate 0.1 (now "
                f"{evidence.fitted_with('lapse_rate'):g}). Right ones: the features cannot tell what matters; use more "
                "centres or features of your own.",
            )
        )
    surprising = question[answers["before"].values < SURPRISING]
    if surprising.size:
        found.append(
            Caution(
                f"{count(surprising.size, 'answer came', 'answers came')} as a surprise (probability below "
                f"{SURPRISING:g} beforehand): {_list(surprising)}.",
                "Some are to be expected: of predictions of 0.9 one in ten fails. See by the pictures whether they "
                "were slips, or taught something.",
            )
        )
    if scores.sizes["prediction"] >= ENOUGH_PREDICTIONS and float(scores["log_score"]) < float(
        scores["log_score_expected"] - 2 * scores["log_score_sd"]
    ):
        found.append(
            Caution(
                "The predictions were surer than they should have been (log score more than two standard deviations "
                "below what they promise).",
                "A lapse rate, a lower --steepness or smoother features make it less sure.",
            )
        )
    ties = sum(record.answer is Answer.TIE for record in evidence.answers)
    if ties > 0.3 * max(3, len(evidence.answers)):
        found.append(
            Caution(
                f"{ties} of {len(evidence.answers)} answers were ties, which give the posterior nothing.",
                "Longer or more different trajectories are easier to tell apart.",
            )
        )
    return found


def _mending(text: str) -> str:
    if text.startswith("iterations/"):
        return "What this file alone held is missing here. Bring it back from a copy; the run cannot go on without it."
    if "last line is cut off" in text:
        return "If nothing else is broken, nothing to do: bayespbrl resume drops the rest of a line and goes on."
    if text.startswith("events.jsonl holds"):
        return (
            "The figures of summary.json are used. Where an interruption does not explain it, bring the log back from "
            "a copy: without it the run cannot go on."
        )
    if "environment" in text:
        return "Register it first, or call bayespbrl.load(directory, env=...).report() with the object."
    return "What the log says up to there is used. Bring the file back from a copy to go on with the run."


def _which(iterations: np.ndarray) -> str:
    return f"iteration {_list(iterations)}" if len(iterations) == 1 else f"iterations {_list(iterations)}"


def _list(numbers: Sequence[int] | np.ndarray) -> str:
    """Numbers in words, runs drawn together: 1, 3–5."""
    runs: list[list[int]] = []
    for number in sorted(int(n) for n in numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(low) if low == high else f"{low}–{high}" for low, high in runs)

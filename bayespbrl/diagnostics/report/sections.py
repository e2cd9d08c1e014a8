"""The sections of a report, each a function of the evidence: the texts say what to look for in each picture."""

from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.chains import convergence, plot_convergence, plot_ranks
from bayespbrl.diagnostics.power_scaling import plot_sensitivity, sensitivity
from bayespbrl.diagnostics.prequential import plot_calibration
from bayespbrl.diagnostics.report import figures
from bayespbrl.diagnostics.report.contents import Evidence
from bayespbrl.diagnostics.report.document import Section, Table, drawn
from bayespbrl.diagnostics.report.summary import cell, figure, iterations_that_asked_nothing, no_posterior
from bayespbrl.diagnostics.report.tables import progress_table
from bayespbrl.diagnostics.uncertainty import thinned
from bayespbrl.settings import WITHOUT_POSTERIOR

RANKED = 4


def learning(evidence: Evidence, iterations: xr.Dataset) -> Section:
    """The learning curve, by the hidden reward and by the inferred utility."""
    if not iterations.sizes["iteration"]:
        return Section("learning", "Learning curve", ["No iteration is completed yet."])
    optimum = getattr(evidence.dynamics, "optimal_return", None)
    quiet = iterations_that_asked_nothing(evidence, iterations)
    panels = [("Value against answers", partial(figures.plot_value, iterations, optimum=optimum))]
    caption = (
        "Each point is the policy after an update, valued by fresh episodes whose reward the learner never sees. "
        "Look for a rise that levels off, and for falls after it."
        + (" Points above one another are of iterations that asked nothing." if quiet else "")
    )
    first, last = float(iterations["value"][0]), float(iterations["value"][-1])
    alt = f"Learning curve: value from {figure(first)} to {figure(last)} over {int(iterations['answers'][-1])} answers."
    blocks = [drawn("learning", panels, caption, alt, columns=1, size=(7.6, 3.3))]
    if hasattr(evidence.estimate, "weights") and not evidence.features_missing:  # the reward itself has none
        panels = [("By the inferred utility", partial(figures.plot_progress, progress_table(evidence)))]
        caption = (
            "What the last estimate thinks of the trajectories of each iteration, over those of the last; the scale is "
            "free. No reward enters, so this is the learning curve of a run whose answers a person gives. Where the "
            "interval is below zero the policy has become better since, by this utility; where it is level and holds "
            "zero nothing more was gained, and whether what was gained is good is seen in the trajectories."
        )
        alt = "The inferred utility of each iteration's trajectories."
        blocks.append(drawn("progress", panels, caption, alt, columns=1, size=(7.6, 3.0)))
    return Section("learning", "Learning curve", [], blocks)


def fits(evidence: Evidence, iterations: xr.Dataset) -> Section:
    """Convergence of every fit, and ranks of the last."""
    title = "Have the fits converged?"
    if evidence.posterior is None:
        return Section("convergence", title, [no_posterior(evidence)])
    panels = [
        ("Largest R̂", partial(figures.plot_rhat, iterations)),
        ("Effective draws", partial(figures.plot_effective_sample_size, iterations)),
    ]
    every = drawn(
        "convergence",
        panels,
        "Every fit's worst margin. R̂ should be below its limit and the effective draws above theirs; crosses mark fits "
        "that did not converge within their cap of draws.",
        "R̂ and effective sample size by iteration.",
    )
    result = convergence(evidence.posterior)
    if not result.sizes["preference"]:
        return Section("convergence", title, ["The last fit has no preference to converge on."], [every])
    worst = np.argsort(-result["rhat"].values, kind="stable")[:RANKED]
    ranks = [(f"Ranks, preference {k}", partial(plot_ranks, evidence.posterior, preference=int(k))) for k in worst]
    last = drawn(
        "margins",
        [(f"The fit of iteration {evidence.estimate_iteration}", partial(plot_convergence, result))],
        "Effective draws of every margin of the last fit, in the middle of its distribution (bulk) and in its tails.",
        f"Effective sample sizes of {result.sizes['preference']} margins.",
        columns=1,
        size=(7.6, 2.8),
    )
    rank_plots = drawn(
        "ranks",
        ranks,
        "Ranks of each chain's draws among all, for the margins of largest R̂. Chains that agree are level about the "
        "dashed line; one that leans to a side, or a hump, has not mixed.",
        f"Rank plots of {len(ranks)} margins.",
        size=(4.4, 2.6),
    )
    return Section("convergence", title, [], [every, last, rank_plots])


def calibration(evidence: Evidence, scores: xr.Dataset) -> Section:
    """Whether the predicted probabilities can be trusted."""
    title = "Are its probabilities right?"
    if evidence.settings.utility in WITHOUT_POSTERIOR:
        return Section("calibration", title, [no_posterior(evidence)])
    number = scores.sizes["prediction"]
    if not number:
        return Section("calibration", title, ["No answer has been given that could be predicted beforehand."])
    rows = []
    for name, label in (("log_score", "log score (nats, summed)"), ("brier_score", "Brier score (mean)")):
        got, expected, sd = (figure(float(scores[name + end])) for end in ("", "_expected", "_sd"))
        rows.append([label, got, f"{expected} ± {sd}"])
    rows += [[name, figure(float(scores[name])), ""] for name in ("miscalibration", "discrimination", "uncertainty")]
    head = ["", "reached", "expected if every probability were right"]
    caption = "Each answer was predicted by the posterior that the learner had when it asked. 0 is the best score."
    curve = drawn(
        "calibration",
        [("", partial(plot_calibration, scores))],
        "How often the trajectory shown first was preferred, against its predicted probability "
        "(pool-adjacent-violators). Calibrated predictions stay within the band; a curve steeper than the diagonal "
        "means that the model was not sure enough, a flatter one that it was too sure.",
        f"Reliability curve of {number} predictions.",
        columns=1,
        size=(5.6, 4.0),
    )
    few = ["With so few answers the band is wide: little can be said."] if number < 15 else []
    return Section("calibration", title, few, [curve, Table(caption, head, rows)])


def updates(evidence: Evidence, iterations: xr.Dataset) -> Section:
    """The bound, the KL reached, the temperature, the entropy; what the schedule and the evidence chose."""
    title = "The policy updates"
    if not iterations.sizes["iteration"]:
        return Section("updates", title, ["No update has been made yet."])
    panels = [
        ("KL bound and KL", partial(figures.plot_bound, iterations)),
        ("Temperature", partial(figures.plot_temperature, iterations)),
        ("Entropy of the policy", partial(figures.plot_entropy, iterations)),
        ("Effective samples of REPS", partial(figures.plot_column, iterations, "effective_samples")),
    ]
    caption = (
        "Where the KL reached is below the bound, the update had no more to gain. The fitted policy's KL should follow "
        "the one that REPS asked for. An entropy that falls to nothing early is a policy that has stopped exploring."
    )
    if (iterations["updates"] > 1).any():
        caption += (
            " Where an iteration had several updates, the fitted policy's KL is that of all together, and the KL, the "
            "temperature and the effective samples of REPS are those of the last."
        )
    blocks: list[Any] = [drawn("updates", panels, caption, "KL, temperature, entropy and effective samples.")]
    text = []
    for group, label in (("schedule", "the schedule of the KL bound"), ("hyperparameters", "the hyper-parameters")):
        names = [str(name) for name in iterations.data_vars if str(name).startswith(group + " ")]
        if not names:
            continue
        text.append(f"What decided {label} in each iteration is in the table below.")
        numbers = [name for name in names if iterations[name].dtype.kind == "f" and iterations[name].notnull().any()]
        if numbers:
            shown = [
                ("", partial(figures.plot_column, iterations, name, label=name.removeprefix(group + " ")))
                for name in numbers[:4]
            ]
            blocks.append(drawn(group, shown, f"By iteration: {label}.", f"{label} by iteration."))
        rows = [
            [str(int(iterations["iteration"][i])), *(cell(iterations[name].values[i]) for name in names)]
            for i in range(iterations.sizes["iteration"])
        ]
        head = ["iteration", *(name.removeprefix(group + " ") for name in names)]
        blocks.append(Table(label[0].upper() + label[1:], head, rows))
    return Section("updates", title, text, blocks)


def leaning(evidence: Evidence) -> Section:
    """Sensitivity to the prior scale σ and to the likelihood, whose steepness is m."""
    title = "How much leans on σ and m"
    if evidence.posterior is None:
        return Section("sensitivity", title, [no_posterior(evidence)])
    try:
        result = sensitivity(thinned(evidence.estimate, 4000).posterior)
    except ValueError as error:  # ArviZ cannot smooth a tail of equal weights
        few = "That happens while the answers are few and most draws explain them equally well."
        return Section("sensitivity", title, [f"It cannot be estimated ({error}) {few}"])
    number = result.sizes["quantity"]
    if not number:
        return Section("sensitivity", title, ["There is no preference yet that could lean on anything."])
    limit = result.attrs["threshold"]
    above = {part: int((result["sensitivity"].sel(component=part) >= limit).sum()) for part in ("prior", "likelihood")}
    text = [
        f"Of {number} margins, {above['prior']} change noticeably (above {limit:g}) when the prior scale σ = "
        f"{evidence.fitted_with('prior_scale'):g} changes a little, {above['likelihood']} when the answers count "
        f"a little more or less, as they do with another steepness m = {evidence.fitted_with('steepness'):g}.",
        "A margin that leans on the prior is one whose size the answers leave open: they say which is better, seldom "
        "by how much. Its sign, which is what the order of trajectories needs, can be sure all the same.",
    ]
    caption = "Power-scaling sensitivity of each preference's margin; the dashed line is where it begins to matter."
    alt = f"Sensitivity of {number} margins to prior and likelihood."
    panels = [("", partial(plot_sensitivity, result))]
    return Section("sensitivity", title, text, [drawn("sensitivity", panels, caption, alt, columns=1, size=(7.6, 3.0))])


def numbers(iterations: xr.Dataset) -> Section:
    """All iterations as one table."""
    title = "All iterations in figures"
    if not iterations.sizes["iteration"]:
        return Section("numbers", title, ["None yet."])
    columns = {
        "answers": "answers",
        "value": "value",
        "kl_bound": "bound",
        "kl": "KL",
        "kl_fitted_policy": "KL fitted",
        "updates": "updates",
        "temperature": "temperature",
        "entropy": "entropy",
        "rhat_max": "R̂",
        "effective_sample_size_min": "eff. draws",
        "pairs_satisfied": "agree",
        "pairs": "of pairs",
    }
    rows = [
        [str(int(iterations["iteration"][i])), *(cell(float(iterations[name][i])) for name in columns)]
        for i in range(iterations.sizes["iteration"])
    ]
    return Section("numbers", title, [], [Table("One row an iteration.", ["iteration", *columns.values()], rows)])

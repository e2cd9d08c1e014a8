"""The other sections of a report: learning curve, convergence, calibration, policy updates, sensitivity, iterations."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import xarray as xr

from bayespbrl.diagnostics.chains import convergence, plot_convergence, plot_ranks
from bayespbrl.diagnostics.power_scaling import plot_sensitivity, sensitivity
from bayespbrl.diagnostics.predictive_checks import predictive_checks
from bayespbrl.diagnostics.prequential import plot_calibration
from bayespbrl.diagnostics.report import figures
from bayespbrl.diagnostics.report.contents import RunContents
from bayespbrl.diagnostics.report.document import Block, Body, Picture, Table, drawn
from bayespbrl.diagnostics.report.formatting import cell, number
from bayespbrl.diagnostics.report.tables import iterations_without_question, progress_table
from bayespbrl.diagnostics.uncertainty import thinned

RANK_PLOTS = 4  # of the margins with the largest R̂
SENSITIVITY_DRAWS = 4000
FEW_ANSWERS = 15  # with fewer the band of the reliability curve is too wide to conclude from
COLUMNS = {
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
    "pairs_satisfied": "satisfied",
    "pairs": "of pairs",
}


def learning_curve(contents: RunContents, iterations: xr.Dataset) -> Body:
    """The learning curve, by the hidden reward and by the inferred utility."""
    if not iterations.sizes["iteration"]:
        return ["No iteration is completed yet."], []
    optimum = contents.optimum
    panels = [("Value against answers", partial(figures.plot_value, iterations, optimum=optimum))]
    caption = (
        "Each point is the value of the policy that the run keeps after an update: the mean return of fresh episodes, "
        "which the learner never sees. Look for a rise that levels off, and for drops after it."
    )
    newest = iterations["value_newest"].values
    if np.any(np.isfinite(newest) & (newest != iterations["value"].values)):
        caption += " The thin line is the newest policy, where another is kept."
    if iterations_without_question(contents, iterations):
        caption += " Points above one another are iterations without a question."
    first, last = float(iterations["value"][0]), float(iterations["value"][-1])
    alt = f"Learning curve: value from {number(first)} to {number(last)} over {int(iterations['answers'][-1])} answers."
    blocks = [drawn("learning", panels, caption, alt, size=(7.6, 3.3))]
    estimate = contents.estimate
    if estimate is not None and estimate.features is not None and not contents.features_missing:
        curve = [("By the inferred utility", partial(figures.plot_progress, progress_table(contents)))]
        caption = (
            "Mean utility of each iteration's trajectories by the last estimate, relative to the last iteration's; the "
            "scale is arbitrary. No reward enters, so this is the learning curve of a run with a person's answers. "
            "An interval below zero: the policy has improved since, by this utility. A flat curve whose interval "
            "contains zero: no further gain. Only the trajectories show whether the gain is real."
        )
        if contents.started:
            caption += (
                " It begins again where the policy was restarted; the last iteration is of that policy, kept or not."
            )
        alt = "The inferred utility of each iteration's trajectories."
        blocks.append(drawn("progress", curve, caption, alt, size=(7.6, 3.0)))
    return [], blocks


def convergence_of_fits(contents: RunContents, iterations: xr.Dataset) -> Body:
    """Convergence of every fit, and rank plots of the last."""
    if contents.posterior is None:
        return [contents.posterior_missing], []
    panels = [
        ("Largest R̂", partial(figures.plot_rhat, iterations)),
        ("Effective sample size", partial(figures.plot_effective_sample_size, iterations)),
    ]
    caption = (
        "The worst of the margins, hyperparameters and length scales of each fit. R̂ should stay below its limit, and "
        "the effective sample size above its limit. "
        "Crosses mark fits that did not converge within their cap of draws."
    )
    every = drawn("convergence", panels, caption, "R̂ and effective sample size by iteration.")
    result = convergence(contents.posterior)
    if not result.sizes["preference"]:
        return ["The last fit has no preferences, so there is nothing to diagnose."], [every]
    margins = drawn(
        "margins",
        [(f"The fit of iteration {contents.estimate_iteration}", partial(plot_convergence, result))],
        "Effective sample size of every margin of the last fit, in the bulk of its distribution and in its tails.",
        f"Effective sample sizes of {result.sizes['preference']} margins.",
        size=(7.6, 2.8),
    )
    ranks = [_rank_plots(contents.posterior, result)] if contents.posterior["posterior"].sizes["chain"] > 1 else []
    return [], [every, margins, *ranks]  # of one chain alone the ranks are level by construction


def _rank_plots(tree: xr.DataTree, result: xr.Dataset) -> Picture:
    worst = np.argsort(-result["rhat"].values, kind="stable")[:RANK_PLOTS]
    panels = [(f"Ranks, preference {k}", partial(plot_ranks, tree, preference=int(k))) for k in worst]
    caption = (
        "Rank plots of the margins with the largest R̂: ranks of each chain's draws among all draws. Chains that agree "
        "are level at the dashed line; a chain with a slope or a hump has not mixed."
    )
    return drawn("ranks", panels, caption, f"Rank plots of {len(panels)} margins.", size=(4.4, 2.6))


def calibration(contents: RunContents, scores: xr.Dataset) -> Body:
    """Calibration of the predicted probabilities of answers."""
    if contents.without_posterior:
        return [contents.posterior_missing], []
    total = scores.sizes["prediction"]
    blocks = _scores(scores, total) if total else list[Block]()
    if contents.posterior is not None:
        blocks.append(_predictive_checks(contents.posterior))
    if not total:
        return ["No answer that says which is better could be predicted before it was given."], blocks
    few = ["The band is wide with so few answers: little can be concluded."] if total < FEW_ANSWERS else []
    return few, blocks


def _scores(scores: xr.Dataset, total: int) -> list[Block]:
    """The scores of the predictions, beside what is expected of calibrated ones, and the reliability curve."""
    rows = []
    labels = ("log score (nats, summed)", "Brier score (mean)", "expected calibration error")
    for name, label in zip(("log_score", "brier_score", "expected_calibration_error"), labels, strict=True):
        got, expected, sd = (number(float(scores[name + end])) for end in ("", "_expected", "_sd"))
        rows.append([label, got, f"{expected} ± {sd}"])
    rows.append(
        ["log score less its expectation, in standard deviations (z)", cell(float(scores["log_score_z"])), "0 ± 1"]
    )
    rows += [[name, number(float(scores[name])), ""] for name in ("miscalibration", "discrimination", "uncertainty")]
    caption = (
        "Each answer that says which is better was predicted by the last posterior before it, given that one is. 0 is "
        "the best score."
    )
    table = Table(caption, ["", "score", "expected if calibrated"], rows)
    curve = drawn(
        "calibration",
        [("", partial(plot_calibration, scores))],
        "How often the trajectory shown first was preferred, against the predicted probability "
        "(pool-adjacent-violators). Calibrated predictions stay within the band. A curve steeper than the diagonal is "
        "underconfident, a flatter one overconfident.",
        f"Reliability curve of {total} predictions.",
        size=(5.6, 4.0),
    )
    return [curve, table]


def _predictive_checks(tree: xr.DataTree) -> Table:
    """Counts in the answers beside those in answers that the last posterior simulates."""
    result = predictive_checks(tree)
    caption = (
        "Posterior predictive checks: the preferences and ties that follow from the answers, beside those that the "
        "last posterior simulates. Surprises contradict the inferred utility; cycles are triads that no utility can "
        "order. A p-value below 0.01 or above 0.99 says that the model does not explain this count."
    )
    rows = []
    for name in result["check"].values[result["possible"].values > 0]:
        row = {key: float(value) for key, value in result.sel(check=name).data_vars.items()}
        interval = f"{number(row['expected'])} [{number(row['lower'])}, {number(row['upper'])}]"
        rows.append([str(name), number(row["observed"]), f"{int(row['possible'])}", interval, number(row["p_value"])])
    return Table(caption, ["count", "given", "of", "simulated [90 %]", "p"], rows)


def updates(iterations: xr.Dataset) -> Body:
    """Bound, KL, temperature and entropy; what the schedule and the choice of hyperparameters reported."""
    if not iterations.sizes["iteration"]:
        return ["No update has been made yet."], []
    panels = [
        ("KL bound and KL", partial(figures.plot_bound, iterations)),
        ("Temperature", partial(figures.plot_temperature, iterations)),
        ("Entropy of the policy", partial(figures.plot_entropy, iterations)),
        ("Effective samples of REPS", partial(figures.plot_column, iterations, "effective_samples")),
    ]
    caption = (
        "A KL below the bound means that the update had nothing more to gain. The fitted policy's KL should follow the "
        "KL that REPS reached. An entropy that drops to zero early means that the policy has stopped exploring."
    )
    if (iterations["updates"] > 1).any():
        caption += (
            " Where an iteration had several updates, the fitted policy's KL is that of all together; the KL, the "
            "temperature and the effective samples of REPS are those of the last."
        )
    blocks: list[Block] = [drawn("updates", panels, caption, "KL, temperature, entropy and effective samples.")]
    for group, label in (
        ("schedule", "Schedule of the KL bound"),
        ("check", "The newest policy compared with the best before it; the bound is the schedule's times trust"),
        ("hyperparameters", "What was inferred besides the weights"),
    ):
        blocks += _reported(iterations, group, label)
    return [], blocks


def _reported(iterations: xr.Dataset, group: str, label: str) -> list[Block]:
    """The variables of a group, as a table, with figures of the first four that are numbers."""
    names = [str(name) for name in iterations.data_vars if str(name).startswith(group + " ")]
    if not names:
        return []
    short = {name: name.removeprefix(group + " ") for name in names}
    numeric = [name for name in names if iterations[name].dtype.kind == "f" and iterations[name].notnull().any()]
    panels = [("", partial(figures.plot_column, iterations, name, label=short[name])) for name in numeric[:4]]
    caption = f"{label}, by iteration."
    figure = [drawn(group, panels, caption, caption)] if panels else []
    return [*figure, _by_iteration(iterations, short, caption)]


def _by_iteration(iterations: xr.Dataset, columns: Mapping[str, str], caption: str) -> Table:
    """Variables of the iterations, `columns` by their heads, as a table of one row per iteration."""
    values = [iterations[name].values for name in ("iteration", *columns)]
    return Table(
        caption, ["iteration", *columns.values()], [[cell(v) for v in row] for row in zip(*values, strict=True)]
    )


def sensitivity_to_model(contents: RunContents) -> Body:
    """Sensitivity to the prior scale σ and to the likelihood."""
    if contents.posterior is None:
        return [contents.posterior_missing], []
    try:
        result = sensitivity(thinned(contents.posterior, SENSITIVITY_DRAWS))
    except ValueError as error:  # ArviZ cannot smooth a tail of equal weights
        few = "This happens while there are few answers and most draws explain them equally well."
        return [f"The sensitivity cannot be estimated ({error}). {few}"], []
    total = result.sizes["quantity"]
    if not total:
        return ["There is no preference yet whose margin could be sensitive."], []
    limit = result.attrs["threshold"]
    above = {part: int((result["sensitivity"].sel(component=part) >= limit).sum()) for part in ("prior", "likelihood")}
    text = [
        f"Of {total} margins, {above['prior']} are sensitive (at least {limit:g}) to the prior scale σ = "
        f"{contents.model.prior_scale:g}, and {above['likelihood']} to the likelihood.",
        "A margin is sensitive to the prior where the answers leave its size open: they say which trajectory is "
        "better, seldom by how much. Its sign, which fixes the order of the trajectories, can still be certain.",
    ]
    caption = "Power-scaling sensitivity of each preference's margin; the dashed line is the threshold."
    alt = f"Sensitivity of {total} margins to prior and likelihood."
    panels = [("", partial(plot_sensitivity, result))]
    return text, [drawn("sensitivity", panels, caption, alt, size=(7.6, 3.0))]


def all_iterations(iterations: xr.Dataset) -> Body:
    """All iterations as one table."""
    if not iterations.sizes["iteration"]:
        return ["No iteration is completed yet."], []
    return [], [_by_iteration(iterations, COLUMNS, "One row per iteration.")]

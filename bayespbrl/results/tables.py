"""The tables of a study: values with their intervals, settings and convergence of runs, calibration of predictions."""

from collections.abc import Callable

import numpy as np
import pandas as pd

from bayespbrl.diagnostics import score_predictions
from bayespbrl.results.intervals import (
    Interval,
    answers_for_good,
    benjamini_hochberg,
    failed_trials,
    holm,
    median_interval,
    paired_difference,
    sign_test,
)
from bayespbrl.results.study_data import RowData, StudyData
from bayespbrl.studies.declaration import AXES, DeclaredRow
from bayespbrl.utility.inference import WITHOUT_POSTERIOR

REACHED = 0.95  # of the relative value, (value − random policy) / (known reward − random policy)
FAILED_BELOW = 0.5  # of the relative value, where the task declares no `failed_below`
SURE = 0.95
CLOSE = 0.03  # of what the best policy of a run gains over the random one
FAR = 1000.0  # R̂ beyond it is of what some chain never changes; no digit of it tells anything
MISSING = "–"


def values_table(data: StudyData) -> pd.DataFrame:
    """Final value of each row, and its difference from the row that it is compared with (`reference_of`).

    All comparisons are at the same number of answers on both sides, over shared seeds, and their p values are adjusted
    for the number of comparisons in the table (Holm); `false discovery` has Benjamini and Hochberg's.
    """
    lines: list[dict[str, str]] = []
    p: list[tuple[int, float]] = []
    for task in data.tasks:
        scale = data.floor_and_ceiling(task)
        for row in data.of_task(task):
            line = _of_trials(row, scale, data)
            if (declared := data.reference_of(row.declared)) is not None:
                cells, value = _compared(row, data.row_of(declared))
                line |= {"against": _without_task(declared)} | cells if cells else {}
                p.append((len(lines), value))
            lines.append(line)
    table = pd.DataFrame(lines)
    compared = [(place, value) for place, value in p if np.isfinite(value)]
    for name, adjust in (("p (Holm)", holm), ("false discovery", benjamini_hochberg)) if compared else ():
        table[name] = MISSING
        for (place, _), value in zip(compared, adjust([value for _, value in compared]), strict=True):
            table.loc[place, name] = f"{value:.2g}"
    return table.reindex(columns=_present(table)).fillna(MISSING)


def _without_task(declared: DeclaredRow) -> str:
    return " ".join(level for level in declared.levels[1:] if level)


def _present(table: pd.DataFrame) -> list[str]:
    """The columns, without axes that the study does not have."""
    return [name for name in table.columns if name not in AXES or table[name].ne("").any()]


def _of_trials(row: RowData, scale: tuple[float, float] | None, data: StudyData) -> dict[str, str]:
    quartiles, report_at = np.quantile(row.final, [0.25, 0.75]), data.declaration.report_at
    values = [None if row.declared.untrained else row.at(number) for number in report_at]
    finished, wanted = len(row.final), data.description.get("trials")
    line = dict(zip(AXES, row.declared.levels, strict=True)) | {
        "trials": f"{finished} of {wanted}" if isinstance(wanted, int) and finished < wanted else str(finished),
        "answers": f"{np.median(row.used):g}",
        **{
            f"after {number}": MISSING if value is None else median_and_quartile(value)
            for number, value in zip(report_at, values, strict=True)
        },
        "median": f"{np.median(row.final):.4g}",
        "quartiles": f"{quartiles[0]:.4g} … {quartiles[1]:.4g}",
        "interval of the median": _bounds(median_interval(row.final)),
        "relative value": MISSING,
        f"answers to {REACHED} for good": MISSING,
        "failed": MISSING,
        "exact interval": MISSING,
    }
    beyond = data.declaration.seed + (wanted if isinstance(wanted, int) else 0)
    if left_out := sorted(set(range(data.declaration.seed, max(max(row.seeds), beyond))) - set(row.seeds)):
        line["seeds left out"] = ", ".join(map(str, left_out))
    level = row.declared.failed_below
    if scale is not None:
        floor, ceiling = scale
        line["relative value"] = f"{(np.median(row.final) - floor) / (ceiling - floor):.3f}"
        level = floor + FAILED_BELOW * (ceiling - floor) if level is None else level
        if not row.declared.untrained:
            needed = answers_for_good(row.answers, row.values, floor + REACHED * (ceiling - floor))
            line[f"answers to {REACHED} for good"] = _with_bounds(needed, _number)
    if level is not None and not row.declared.untrained:
        failed = int(np.sum(~(row.final >= level)))  # a value that is no number is a failure too
        line["failed"] = f"{failed} of {len(row.final)}"
        line["exact interval"] = _bounds(failed_trials(failed, len(row.final)), "{:.2f}")
    return line


def _compared(row: RowData, reference: RowData | None) -> tuple[dict[str, str], float]:
    """Paired difference to the reference after the answers that both were allowed, as cells of a line; p."""
    shared = [] if reference is None else sorted(set(row.seeds) & set(reference.seeds))
    if reference is None or len(shared) < 2:
        return {}, np.nan
    budget = min(row.allowed, reference.allowed)
    both = row.at(budget), reference.at(budget)
    if both[0] is None or both[1] is None:
        return {}, np.nan
    values, before = (
        part[[side.seeds.index(seed) for seed in shared]] for part, side in ((both[0], row), (both[1], reference))
    )
    difference, p = paired_difference(values, before)
    shown = _with_bounds(difference, lambda number: f"{number:+.3g}")
    return {"pairs": str(len(shared)), "at answers": str(budget), "difference": shown}, p


def pairs_table(data: StudyData) -> pd.DataFrame:
    """Pairs of trials with those of `reference_of`: how often one needed fewer answers, and how often more.

    In all; until its kept policy is first better than the task's `good_above`; and until it is for good. No lines where
    no task declares that.
    """
    lines = []
    for row in data.rows:
        declared, level = data.reference_of(row.declared), row.declared.good_above
        reference = None if declared is None else data.row_of(declared)
        if declared is None or reference is None or level is None:
            continue
        if not (shared := sorted(set(row.seeds) & set(reference.seeds))):
            continue
        places = [[side.seeds.index(seed) for seed in shared] for side in (row, reference)]
        line = dict(zip(AXES, row.declared.levels, strict=True))
        line |= {"against": _without_task(declared), "pairs": str(len(shared))}
        for name, needed in (
            ("in all", [side.used for side in (row, reference)]),
            (f"to {level:g}", [_answers_above(side, level) for side in (row, reference)]),
            (f"to {level:g} for good", [_answers_above(side, level, for_good=True) for side in (row, reference)]),
        ):
            mine, its = (part[place] for part, place in zip(needed, places, strict=True))
            fewer, more = int(np.sum(mine < its)), int(np.sum(mine > its))
            line |= {f"median {name}": f"{_number(np.median(mine))} against {_number(np.median(its))}"}
            line |= {f"fewer {name}": str(fewer), f"more {name}": str(more)}
            line |= {f"p {name}": f"{sign_test(fewer, more):.2g}"}
        lines.append(line)
    table = pd.DataFrame(lines)
    return table.reindex(columns=_present(table)).fillna(MISSING) if len(table) else table


def _answers_above(row: RowData, level: float, *, for_good: bool = False) -> np.ndarray:
    """Answers of each trial by which its kept policy is better than `level`, infinity for never, shape (S,)."""
    found = []
    for _, trial in row.lines.drop_duplicates(["seed", "answers"], keep="last").groupby("seed"):
        better = trial["value"].to_numpy() > level
        if for_good:
            better = np.logical_and.accumulate(better[::-1])[::-1]
        found.append(float(trial["answers"].to_numpy()[better.argmax()]) if better.any() else np.inf)
    return np.array(found)


def _number(value: float) -> str:
    return f"{value:.4g}" if np.isfinite(value) else "never"


def _with_bounds(interval: Interval, shown: Callable[[float], str]) -> str:
    if np.isnan(interval.low):
        return shown(interval.estimate)
    return f"{shown(interval.estimate)} [{shown(interval.low)}, {shown(interval.high)}]"


def _bounds(interval: Interval, form: str = "{:.4g}") -> str:
    if np.isnan(interval.low):
        return MISSING
    return f"[{form.format(interval.low)}, {form.format(interval.high)}]"


def runs_table(data: StudyData) -> pd.DataFrame:
    """Settings and convergence of each row."""
    lines = []
    for row in data.rows:
        if row.declared.untrained or row.declared.baseline is not None:
            continue
        seen = row.lines
        options = " ".join(f"{name}={value}" for name, value in sorted(row.declared.options.items()))
        share, none = seen["kl"] / seen["kl_bound"], row.declared.options.get("utility") in WITHOUT_POSTERIOR
        lines.append(
            dict(zip(AXES, row.declared.levels, strict=True))
            | {
                "settings": options or "the default",
                "fits": MISSING if none else str(len(seen)),
                "not converged": MISSING if none else str(int((seen["converged"].astype(str) != "True").sum())),
                "worst R̂": _of(worst := seen["rhat"].max(), "{:.2g}" if worst > FAR else "{:.3f}"),
                "least ESS": _of(seen["effective_sample_size"].min(), "{:.0f}"),
                "signal": _of(seen["signal"].median(), "{:.2f}"),
                "KL": _of(seen["kl"].median(), "{:.3f}"),
                "most KL/bound": _of(share.max(), "{:.2f}"),
                "minutes a trial": _of(seen.groupby("seed")["seconds"].sum().median() / 60, "{:.2g}"),
            }
        )
    table = pd.DataFrame(lines)
    return table.reindex(columns=_present(table)) if len(table) else table


def kept_table(data: StudyData) -> pd.DataFrame:
    """Values of each row's kept, newest and best policies; no lines where all kept ones are the newest.

    The best is by the hidden value, which only the evaluation knows.
    """
    lines, others = [], 0
    for row in data.rows:
        if row.declared.untrained:
            continue
        trials = [trial["value_newest"].to_numpy() for _, trial in row.lines.groupby("seed")]
        kept, newest = row.final, np.array([trial[-1] for trial in trials])
        best = np.array([trial.max() for trial in trials])
        others += int((kept != newest).sum())
        floor = data.floor(row.declared.levels[0])
        close = None if floor is None else best - kept <= CLOSE * np.maximum(best - floor, 0)
        lines.append(
            dict(zip(AXES, row.declared.levels, strict=True))
            | {"trials": str(len(kept)), "kept": median_and_quartile(kept), "worst": f"{kept.min():.4g}"}
            | {"newest": median_and_quartile(newest), "best of the run": median_and_quartile(best)}
            | {"within 3 % of the best": MISSING if close is None else f"{close.sum()} of {len(kept)}"}
        )
    table = pd.DataFrame(lines if others else [])
    return table.reindex(columns=_present(table)) if len(table) else table


def median_and_quartile(values: np.ndarray) -> str:
    """Median [lower quartile], to four digits."""
    return f"{np.median(values):.4g} [{np.quantile(values, 0.25):.4g}]"


def _of(value: float, form: str) -> str:
    return MISSING if pd.isna(value) else form.format(value)


def calibration_table(data: StudyData) -> pd.DataFrame:
    """Calibration of each row with a posterior: predictions of its answers before they were given.

    `z` is the log score less its expectation under the predictions themselves, in standard deviations: below −2 the
    predictions are overconfident. The first iteration, which has no posterior, is left out.
    """
    lines: list[dict[str, str]] = []
    if data.predicted is None:
        return pd.DataFrame(lines)
    for row in data.rows:
        levels = row.declared.levels
        chosen = np.logical_and.reduce([data.predicted[a] == level for a, level in zip(AXES, levels, strict=True)])
        if chosen.any():
            lines.append(dict(zip(AXES, levels, strict=True)) | _scores(data.predicted[chosen]))
    if len(lines) > 1 and len({tuple(line[axis] for axis in AXES[1:]) for line in lines}) == 1:  # tasks alone differ
        lines.append(lines[0] | {"tasks": "all"} | _scores(data.predicted))
    table = pd.DataFrame(lines)
    return table.reindex(columns=_present(table)) if len(table) else table


def _scores(answers: pd.DataFrame) -> dict[str, str]:
    predicted, observed = answers["predicted"].to_numpy(float), answers["first"].to_numpy(bool)
    return {"runs": str(answers.groupby([*AXES, "seed"], dropna=False).ngroups)} | calibration_line(predicted, observed)


def calibration_line(predicted: np.ndarray, observed: np.ndarray) -> dict[str, str]:
    """How well n probabilities predicted n outcomes, shapes (n,), as the cells of a table."""
    least = 5e-7  # a table has six digits, which make a larger prediction a 1
    predicted = np.clip(predicted, least, 1 - least)
    scores = score_predictions(predicted, observed)
    score, expected, deviation, z = (float(scores[f"log_score{end}"]) for end in ("", "_expected", "_sd", "_z"))
    error, chance, by_chance = (float(scores[f"expected_calibration_error{end}"]) for end in ("", "_expected", "_sd"))
    confidence = np.maximum(predicted, 1 - predicted)
    right = np.where(predicted >= 0.5, observed, ~observed)[confidence >= SURE]
    return {
        "answers predicted": str(len(predicted)),
        "log score": f"{score:.1f}",
        "expected": f"{expected:.1f} ± {deviation:.1f}",
        "z": f"{z:.1f}",
        "ECE": f"{error:.3f}",
        "if calibrated": f"{chance:.3f} ± {by_chance:.3f}",
        f"right of those ≥ {SURE}": f"{right.mean():.2f} (n = {len(right)})" if len(right) else MISSING,
    }


def markdown(table: pd.DataFrame) -> str:
    """A table in Markdown, numbers to the right."""
    text = [name for name in table.columns if name in AXES or name == "settings"]
    rule = "|".join("---" if name in text else "---:" for name in table.columns)
    rows = [" | ".join(str(value) or MISSING for value in row) for row in table.itertuples(index=False)]
    return "\n".join([f"| {' | '.join(table.columns)} |", f"|{rule}|", *(f"| {row} |" for row in rows)])

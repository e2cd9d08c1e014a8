"""Does a run keep the best of its policies? Each is evaluated again; other episodes choose the best than compare it.

    bayespbrl study bicycle --jobs 2 --out runs/bicycle
    python benchmarks/kept_policies.py runs/bicycle/bicycle/default --out FILE.csv [--episodes 500] [--jobs 2]

The tables of a study compare the kept policy with the best value that any policy of its run had in one evaluation. Of
thirty values, each the mean of a hundred episodes, the highest is also the luckiest, so that a run may seem to miss a
policy which is no better. Here every policy of a run, without its noise, has fresh episodes, the same for all of them;
the best of these is then compared with the kept one, and with the first policy, by as many others. The kept policy is
*close* where it misses less than 3 % of what the best gains over the first, in the mean of all runs.

The argument holds the run directories of one row of a study, `seed-…`, or of trials. A row is appended for each run; a
second call does only those that are missing.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pandas as pd
from rows_by_seed import Row, run

import bayespbrl
from bayespbrl import rollouts
from bayespbrl.policies.greedy import greedy
from bayespbrl.policies.policy import Sampler
from bayespbrl.results.intervals import failed_trials
from bayespbrl.results.tables import CLOSE
from bayespbrl.runs.directory import RunDirectory

CHOICE, COMPARISON = 1, 2  # whose episodes: of all runs
COLUMNS = ("seed", "policies", "kept", "best", "value kept", "value best", "value first", "seemed best", "seemed kept")


def evaluated(study: Path, episodes: int, seed: int) -> Row:
    """The figures of the run of a seed, as the columns name them."""
    directory = study / f"seed-{seed}"
    learner = bayespbrl.load(directory).learner
    if not learner.settings.update.checked:
        raise ValueError(f"{directory}: expected a run that keeps the best of its policies, got one of the newest")

    def value(policy: Sampler, whose: int) -> float:
        limit, key = learner.settings.rollouts.max_steps, jax.random.key(whose)
        returns = rollouts.returns(learner.environment, policy, key=key, episodes=episodes, max_steps=limit)
        return float(returns.total.mean())

    entries = [each for each in RunDirectory.open(directory).entries() if each.event["event"] == "improved"]
    policies = {each.event["iteration"]: greedy(each.parts["policy"]) for each in entries}
    seemed = {each.event["iteration"]: each.event["summary"]["value_newest"] for each in entries}
    chosen = {number: value(policy, CHOICE) for number, policy in policies.items()}
    kept, best = entries[-1].event["kept"], max(chosen, key=lambda number: chosen[number])
    return {
        "seed": seed,
        "policies": len(policies),
        "kept": kept,
        "best": best,
        "value kept": value(policies[kept], COMPARISON),
        "value best": value(policies[best], COMPARISON),
        "value first": value(learner.state.first_policy, COMPARISON),
        "seemed best": max(seemed.values()),
        "seemed kept": seemed[kept],
    }


def show(rows: list[Row]) -> None:
    """Print how many runs keep a policy that is close to their best, by these episodes and by those of the run."""
    table = pd.DataFrame(rows)
    first = table["value first"].mean()
    for name, episodes in (("value", "fresh episodes"), ("seemed", "the run's own evaluations")):
        best, kept = (table[f"{name} {which}"].to_numpy() for which in ("best", "kept"))
        close = int((best - kept <= CLOSE * np.maximum(best - first, 0)).sum())
        share, low, high = failed_trials(close, len(table))  # the exact interval of any share
        medians = f"median {np.median(kept):.4g}, of the best {np.median(best):.4g}"
        print(f"{episodes}: close in {close} of {len(table)} ({share:.2f} [{low:.2f}, {high:.2f}]); kept {medians}")
    missed = (table["value best"] - table["value kept"]) / (table["value best"] - first)
    print(f"missed, as a share of the best's gain: median {missed.median():.3f}, at most {missed.max():.3f}")


def main() -> None:
    """Evaluate the policies of the runs that are missing, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="the folder of the run directories of one row of a study")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=500, help="to choose the best by, and as many to compare it by")
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args()
    seeds = [int(each.name.removeprefix("seed-")) for each in sorted(chosen.study.glob("seed-*")) if each.is_dir()]
    if not seeds:
        parser.error(f"{chosen.study}: expected run directories named seed-…, got none")
    one_run = partial(evaluated, chosen.study, chosen.episodes)
    about = {"runs": "/".join(chosen.study.resolve().parts[-2:]), "episodes": str(chosen.episodes)}
    show(run(seeds, chosen.out, COLUMNS, one_run, jobs=chosen.jobs, about=about))


if __name__ == "__main__":
    main()

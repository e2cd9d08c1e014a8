"""Is the default calibrated on the Gridworld where the hidden rewards are a draw from its prior, and where not?

    python benchmarks/gridworld_rewards.py normal --out runs/normal      # standard normal, as the prior
    python benchmarks/gridworld_rewards.py permuted --out runs/permuted  # the domain's own, shuffled in each trial
    python benchmarks/gridworld_rewards.py own --out runs/own            # the domain's own

A trial is a run of at most 12 answers by an expert who prefers the higher sum of rewards, without an error; the
dynamics are the Gridworld's. In the end each answer is predicted, from the ordered pairs before it, by three models:
that of the run; without lapses; and without lapses and with a steepness at which nearly no answer is an error.
`python benchmarks/calibration.py runs/normal` scores what the runs themselves predicted.

Repeated, a command runs the trials that are missing.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

import bayespbrl
from bayespbrl.diagnostics import answer_probabilities
from bayespbrl.envs.gridworld import REWARDS
from bayespbrl.preferences import Answer
from bayespbrl.results.tables import calibration_line, markdown
from bayespbrl.trajectories import Trajectory, trajectory_features
from bayespbrl.utility import PosteriorUtility

KINDS = ("own", "permuted", "normal")
# lapse rate and steepness, None where they are inferred
MODELS = {"as the run": (None, None), "without lapses": (0.0, None), "without errors": (0.0, 100.0)}


def rewards_of(kind: str, seed: int) -> np.ndarray:
    """The reward of each cell in one trial."""
    rng = np.random.default_rng([seed, 7])
    if kind == "normal":
        return rng.normal(size=REWARDS.size)
    return rng.permutation(REWARDS.ravel()) if kind == "permuted" else REWARDS.ravel()


def trial(kind: str, seed: int, directory: Path) -> bayespbrl.Learner:
    """One run, from where it was stopped."""
    rewards = rewards_of(kind, seed)

    def expert(*shown: Trajectory) -> Answer:
        return bayespbrl.ReturnExpert()(*(replace(each, rewards=rewards[each.states[1:]]) for each in shown))

    if directory.exists():
        learner = bayespbrl.resume(directory)
    else:
        learner = bayespbrl.start("gridworld", directory, answers=12, seed=seed)
    return learner.run(expert)


def one_hot(states: np.ndarray) -> np.ndarray:
    """φ of cells, as the learner has it."""
    return np.eye(REWARDS.size)[states]


def predicted(learner: bayespbrl.Learner) -> pd.DataFrame:
    """A row for each ordered answer after the first iteration: how probable each model held what the expert said."""
    sums = trajectory_features(learner.trajectories, one_hot, discount=learner.settings.trajectory_discount)
    pairs = learner.preferences.pairs
    rows = []
    gathered = learner.settings.rollouts.trajectories_per_iteration  # in the first iteration
    for number in range(sum(max(pair) < gathered for pair in pairs), len(pairs)):
        preferred, other = pairs[number]
        row = {}
        for name, (lapse_rate, steepness) in MODELS.items():
            utility = bayespbrl.infer_utility(
                sums, pairs[:number], seed=number, lapse_rate=lapse_rate, steepness=steepness
            )
            assert isinstance(utility, PosteriorUtility)
            assert utility.posterior is not None
            difference = (sums[preferred] - sums[other]) / utility.scales
            either = answer_probabilities(utility.posterior, difference[None])[0, :2]
            row[name] = either[0] / either.sum()
        rows.append(row)
    return pd.DataFrame(rows)


def main() -> None:
    """Run the trials, and print a line when each has ended, and in the end the calibration by each model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rewards", choices=KINDS)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=150, help="of the first trial")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    found = []
    for seed in range(arguments.seed, arguments.seed + arguments.trials):
        found.append(predicted(trial(arguments.rewards, seed, arguments.out / f"seed-{seed}")))
        print(f"{arguments.rewards}: seed {seed} ended", flush=True)
    table = pd.concat(found)
    lines = [
        {"rewards": arguments.rewards, "model": name, "runs": str(len(found))}
        | calibration_line(np.clip(table[name], 0, 1), np.ones(len(table), bool))
        for name in MODELS
    ]
    print(markdown(pd.DataFrame(lines)))


if __name__ == "__main__":
    main()

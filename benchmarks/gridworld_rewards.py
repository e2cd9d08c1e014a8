"""Is the default calibrated on the Gridworld where the hidden rewards are a draw from its prior, and where not?

    python benchmarks/gridworld_rewards.py normal --out runs/normal      # standard normal, as the prior
    python benchmarks/gridworld_rewards.py permuted --out runs/permuted  # the domain's own, shuffled in each trial
    python benchmarks/gridworld_rewards.py own --out runs/own            # the domain's own
    python benchmarks/calibration.py runs/normal runs/permuted runs/own

A trial is a run of at most 12 answers by an expert who prefers the higher sum of rewards; the dynamics are the
Gridworld's. Repeated, a command runs the trials that are missing.
"""

import argparse
from pathlib import Path

import numpy as np

import bayespbrl
from bayespbrl.envs.gridworld import REWARDS
from bayespbrl.trajectories import Trajectory

KINDS = ("own", "permuted", "normal")


def rewards_of(kind: str, seed: int) -> np.ndarray:
    """The reward of each cell in one trial."""
    rng = np.random.default_rng([seed, 7])
    if kind == "normal":
        return rng.normal(size=REWARDS.size)
    return rng.permutation(REWARDS.ravel()) if kind == "permuted" else REWARDS.ravel()


def trial(kind: str, seed: int, directory: Path) -> None:
    """One run, from where it was stopped."""
    rewards = rewards_of(kind, seed)

    def expert(first: Trajectory, second: Trajectory) -> str:
        returns = [rewards[trajectory.states[1:]].sum() for trajectory in (first, second)]
        return "tie" if returns[0] == returns[1] else "first" if returns[0] > returns[1] else "second"

    if directory.exists():
        learner = bayespbrl.resume(directory)
    else:
        learner = bayespbrl.start("gridworld", directory, answers=12, seed=seed)
    learner.run(expert)


def main() -> None:
    """Run the trials, and print a line when each has ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rewards", choices=KINDS)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=150, help="of the first trial")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    for seed in range(arguments.seed, arguments.seed + arguments.trials):
        trial(arguments.rewards, seed, arguments.out / f"seed-{seed}")
        print(f"{arguments.rewards}: seed {seed} ended", flush=True)


if __name__ == "__main__":
    main()

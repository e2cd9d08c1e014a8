"""What PPO reaches on the hidden reward of a task: the peer of the default's values on MuJoCo's.

    make .venv-neighbours/.installed && .venv-neighbours/bayespbrl/bin/pip install 'gymnasium[mujoco]'
    .venv-neighbours/bayespbrl/bin/python benchmarks/ppo.py Reacher-v5 --seed 3723 --trials 5 --out FILE.csv

PPO of stable-baselines3 with its own settings. Value: the mean return of its mode in 100 episodes, whose starts are the
same for all seeds. A row is appended for each seed as it ends; a second call does only those that are missing.
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from neighbours import value
from rows_by_seed import Row, run

STARTS = range(10**6, 10**6 + 100)  # seeds of the episodes that evaluate
COLUMNS = ("seed", "steps", "value")


def trained(task: str, steps: int, seed: int) -> Row:
    """The value of PPO after so many environment steps."""
    from stable_baselines3 import PPO  # no dependency of the project's

    agent = PPO("MlpPolicy", task, seed=seed, device="cpu").learn(steps)
    mode = value(task, STARTS, lambda observations: agent.predict(observations, deterministic=True)[0])
    return {"seed": seed, "steps": steps, "value": mode}


def main() -> None:
    """Train on the seeds that are missing, and print the median."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--seed", type=int, required=True, help="the first of them")
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    seeds = range(chosen.seed, chosen.seed + chosen.trials)
    one_run, same = partial(trained, chosen.task, chosen.steps), {"steps": float(chosen.steps)}
    rows = run(seeds, chosen.out, COLUMNS, one_run, same, chosen.jobs, about={"task": chosen.task})
    print(f"{chosen.task}, {len(rows)} seeds: median {np.median([row['value'] for row in rows]):.4g}")


if __name__ == "__main__":
    main()

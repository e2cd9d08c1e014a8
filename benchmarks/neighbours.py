"""Three ways from answers to a policy, on the same tasks and with the same number of answers.

    make neighbours [OPTIONS="--tasks Pendulum-v1 --answers 16"]
    .venv-neighbours/bayespbrl/bin/python benchmarks/neighbours.py run [--tasks ...] [--answers ...] [--seeds ...]

`bayespbrl` is the default, as of `bayespbrl run TASK --answers N`, and the policy that it keeps. `posterior-ppo` is PPO
on the utility that the same run inferred. `imitation` is the preference comparisons of the package imitation with the
settings of its Pendulum notebook, then PPO on the learned reward. Both PPOs have that notebook's settings, eight copies
of the task and 100 000 steps.

Each library asks in its own way. bayespbrl shows whole episodes and may ask less than it is allowed; imitation compares
random fragments of 100 steps. Neither expert ever errs. imitation cannot go through a round without an answer, so it
has as many rounds as answers, at most the notebook's 60. It also needs episodes of equal length: its CartPole is the
variant of its authors, where the pole may fall; in the other tasks an episode that has ended stays where it is, without
reward, until the time limit.

The value is the mean hidden return of 100 episodes without noise, from starts that all methods share. Steps are those
of the environment that the learner sees, but for the random episodes by which the default chooses options; steps and
CPU seconds of `posterior-ppo` include the run's. The evaluation is left out of both, but bayespbrl's CPU seconds
include its own evaluations of each iteration. A run that was interrupted counts only the CPU seconds since.

Each cell is computed in a process of its own, in one of the two virtual environments that `make neighbours` builds:
imitation needs an older gymnasium and NumPy than bayespbrl. Its row is written as it ends; a second call does only what
is missing. At the end it prints medians and quartiles. They describe few trials and are no test of a difference.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

ROOT = Path(__file__).parents[1]
ENVIRONMENTS, RUNS = ROOT / ".venv-neighbours", ROOT / "runs" / "neighbours"
RESULTS = Path(__file__).parent / "results" / "neighbours.csv"
TASKS = ("CartPole-v1", "Pendulum-v1", "MountainCarContinuous-v0", "Acrobot-v1", "MountainCar-v0")
METHODS = {"bayespbrl": "bayespbrl", "posterior-ppo": "bayespbrl", "imitation": "imitation"}  # and their environments
FIGURES = {"answered": int, "value": float, "steps": int, "cpu_seconds": float}
COLUMNS: dict[str, type] = {"task": str, "answers": int, "seed": int, "method": str, **FIGURES}
EPISODES, COPIES = 100, 8
# of the notebook "Learning a Reward Function using Preference Comparisons" of imitation 1.0.1, by name of the argument
PPO_SETTINGS = {"n_steps": 2048 // COPIES, "batch_size": 64, "n_epochs": 10, "learning_rate": 2e-3}
PPO_SETTINGS |= {"ent_coef": 0.01, "clip_range": 0.1, "gae_lambda": 0.95, "gamma": 0.97}
ROUNDS, FRAGMENT, FIRST_SHARE, STEPS_WITH_ANSWERS, STEPS = 60, 100, 0.1, 5000, 100_000
EQUAL_LENGTH = {"CartPole-v1": "seals:seals/CartPole-v0"}


class Cell(NamedTuple):
    """What one row is about."""

    task: str
    answers: int
    seed: int
    method: str

    @property
    def starts(self) -> range:
        """Reset seeds of the evaluation, the same for all methods."""
        return range(1_000_000 + EPISODES * self.seed, 1_000_000 + EPISODES * (self.seed + 1))


class Counted(gymnasium.Wrapper):
    """Counts the steps of an environment, and of its copies, in `count[0]`."""

    def __init__(self, env: gymnasium.Env, count: list[int]):
        super().__init__(env)
        self.count = count

    def step(self, action: Any) -> Any:
        """As of the environment."""
        self.count[0] += 1
        return self.env.step(action)


def value(task: str, starts: Iterable[int], act: Callable[[np.ndarray], np.ndarray]) -> float:
    """Mean return of the episodes that begin at `starts`; `act` maps observations to actions, one a row."""
    running = [gymnasium.make(task) for _ in starts]
    total, number = 0.0, len(running)
    seen = [env.reset(seed=seed)[0] for env, seed in zip(running, starts, strict=True)]
    while running:
        steps = [env.step(action) for env, action in zip(running, act(np.stack(seen)), strict=True)]
        total += sum(float(reward) for _, reward, *_ in steps)
        alive = [not (terminated or truncated) for _, _, terminated, truncated, _ in steps]
        running = [env for env, goes_on in zip(running, alive, strict=True) if goes_on]
        seen = [step[0] for step, goes_on in zip(steps, alive, strict=True) if goes_on]
    return total / number


def bayespbrl_run(cell: Cell, directory: Path, **options: Any) -> Any:
    """The finished run of a cell, made or continued where it is not finished."""
    import bayespbrl

    if directory.exists():
        learner = bayespbrl.resume(directory)
    else:
        learner = bayespbrl.start(cell.task, directory, answers=cell.answers, seed=cell.seed, **options)
    learner.run(bayespbrl.ReturnExpert())
    return bayespbrl.load(directory)


def steps_of(directory: Path) -> int:
    """Environment steps that the learner of a run saw: its trajectories, and the trials of its policies."""
    from bayespbrl.runs.directory import RunDirectory

    parts = [
        entry.parts["trajectories" if entry.event["event"] == "collected" else "tried"]
        for entry in RunDirectory.open(directory).entries()
        if entry.parts
    ]
    return sum(len(trajectory) for part in parts for trajectory in part)


def bayespbrl_cell(cell: Cell, directory: Path, **options: Any) -> dict[str, float]:
    """The figures of bayespbrl's own policy."""
    import jax

    from bayespbrl import rollouts

    run = bayespbrl_run(cell, directory, **options)
    seconds, learner = time.process_time(), run.learner
    episodes = rollouts.rollout(
        learner.environment,
        learner.policy,
        key=jax.random.key(cell.seed),
        episodes=EPISODES,
        max_steps=run.settings.rollouts.max_steps,
        starts=cell.starts,
    )
    figures = {"answered": run.preferences.answers, "steps": steps_of(directory), "cpu_seconds": seconds}
    return figures | {"value": float(np.mean([episode.total_reward for episode in episodes]))}


def posterior_ppo_cell(cell: Cell, directory: Path) -> dict[str, float]:
    """The figures of PPO on the utility of the run in `directory`, without those of the run."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecNormalize

    torch.set_num_threads(1)
    run, count = bayespbrl_run(cell, directory), [0]

    class Utility(VecEnvWrapper):
        """The reward of `bayespbrl.UtilityReward`, of all copies at once, without the slow deviations."""

        def reset(self) -> Any:
            return self.venv.reset()

        def step_async(self, actions: np.ndarray) -> None:
            self.taken = np.array(actions, float)
            self.venv.step_async(actions)

        def step_wait(self) -> Any:
            observations, _, done, infos = self.venv.step_wait()
            reached = np.array(observations, float)
            for copy in np.flatnonzero(done):
                reached[copy] = infos[copy]["terminal_observation"]
            return observations, run.estimate.utilities(reached, actions=self.taken), done, infos

    began = time.process_time()
    copies = DummyVecEnv([lambda: Counted(gymnasium.make(cell.task), count) for _ in range(COPIES)])
    tasks = VecNormalize(Utility(copies), gamma=PPO_SETTINGS["gamma"])  # the utility has no unit
    agent = PPO("MlpPolicy", tasks, seed=cell.seed, policy_kwargs={"net_arch": [32, 32]}, **PPO_SETTINGS)
    agent.learn(STEPS)
    figures = {"answered": run.preferences.answers, "steps": count[0], "cpu_seconds": time.process_time() - began}

    def act(observations: np.ndarray) -> np.ndarray:
        return agent.predict(tasks.normalize_obs(observations), deterministic=True)[0]

    return figures | {"value": value(cell.task, cell.starts, act)}


def imitation_cell(cell: Cell) -> dict[str, float]:
    """The figures of imitation's preference comparisons and PPO on the reward that they learn."""
    import torch
    from imitation.algorithms import preference_comparisons as comparisons
    from imitation.policies.base import FeedForward32Policy, NormalizeFeaturesExtractor
    from imitation.rewards.reward_nets import BasicRewardNet
    from imitation.rewards.reward_wrapper import RewardVecEnvWrapper
    from imitation.util.networks import RunningNorm
    from stable_baselines3 import PPO

    torch.set_num_threads(1)
    torch.manual_seed(cell.seed)
    rng, count = np.random.default_rng(cell.seed), [0]
    tasks = _of_equal_length(cell.task, rng, count)
    reward = BasicRewardNet(tasks.observation_space, tasks.action_space, normalize_input_layer=RunningNorm)

    def ppo(env: Any) -> PPO:
        normalised = {"features_extractor_kwargs": {"normalize_class": RunningNorm}}
        policy = normalised | {"features_extractor_class": NormalizeFeaturesExtractor}
        return PPO(FeedForward32Policy, env, seed=cell.seed, policy_kwargs=policy, **PPO_SETTINGS)

    first_share = max(FIRST_SHARE, 1 / cell.answers)
    model, loss = comparisons.PreferenceModel(reward), comparisons.CrossEntropyRewardLoss()
    learner = comparisons.PreferenceComparisons(
        comparisons.AgentTrainer(ppo(tasks), reward, tasks, rng, exploration_frac=0.05),
        reward,
        num_iterations=max(1, min(ROUNDS, cell.answers - int(first_share * cell.answers))),
        fragmenter=comparisons.RandomFragmenter(rng, warning_threshold=0),
        preference_gatherer=comparisons.SyntheticGatherer(temperature=0, rng=rng),
        reward_trainer=comparisons.BasicRewardTrainer(model, loss, rng, epochs=3),
        fragment_length=FRAGMENT,
        initial_comparison_frac=first_share,
        initial_epoch_multiplier=4,
    )
    learner.train(total_timesteps=STEPS_WITH_ANSWERS, total_comparisons=cell.answers)
    agent = ppo(RewardVecEnvWrapper(tasks, reward.predict_processed))
    agent.learn(STEPS)
    seconds, answered = time.process_time(), len(learner.dataset)

    def act(observations: np.ndarray) -> np.ndarray:
        return agent.predict(observations, deterministic=True)[0]

    figures = {"answered": answered, "steps": count[0], "cpu_seconds": seconds}
    return figures | {"value": value(cell.task, cell.starts, act)}


def _of_equal_length(task: str, rng: np.random.Generator, count: list[int]) -> Any:
    """Copies of a task whose episodes all last until the time limit, as imitation needs them; steps are counted."""
    from imitation.util.util import make_vec_env
    from seals.util import AbsorbAfterDoneWrapper

    limit = gymnasium.spec(task).max_episode_steps
    assert limit is not None
    ends: list[Any] = [lambda env, _: gymnasium.wrappers.TimeLimit(AbsorbAfterDoneWrapper(env), limit)]
    wrappers = [lambda env, _: Counted(env, count), *([] if task in EQUAL_LENGTH else ends)]
    return make_vec_env(EQUAL_LENGTH.get(task, task), rng=rng, n_envs=COPIES, post_wrappers=wrappers)


def measured(cell: Cell) -> dict[str, Any]:
    """The figures of a cell from a process of its own.

    Raises:
      RuntimeError: it failed; says why in a line.
    """
    interpreter = str(ENVIRONMENTS / METHODS[cell.method] / "bin" / "python")
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [interpreter, __file__, "cell", *map(str, cell)]
    process = subprocess.run(command, capture_output=True, text=True, env=os.environ | limits)
    if process.returncode:
        raise RuntimeError((process.stderr.strip().splitlines() or [f"exit status {process.returncode}"])[-1])
    return json.loads(process.stdout.splitlines()[-1])


def done(file: Path) -> list[dict[str, Any]]:
    """The rows so far; a last one that is cut off is dropped."""
    if not file.exists():
        return []
    whole = [line for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")]
    rows = [row for row in csv.DictReader(whole) if all(row.get(name) not in (None, "") for name in COLUMNS)]
    return [{name: kind(row[name]) for name, kind in COLUMNS.items()} for row in rows]


def run(cells: Sequence[Cell], file: Path, measure: Callable[[Cell], dict[str, Any]] = measured) -> list[Cell]:
    """Add a row for each cell that has none, as soon as it has ended, and return those that failed."""
    have, failed = {_cell(row): row for row in done(file)}, []
    for cell in cells:
        if cell in have:
            continue
        learned = have.get(cell._replace(method="bayespbrl"))
        try:
            if cell.method == "posterior-ppo" and learned is None:
                raise RuntimeError("the run of bayespbrl that it needs has failed")
            figures = measure(cell)
        except RuntimeError as error:
            print(f"failed: {' '.join(map(str, cell))}: {error}", file=sys.stderr, flush=True)
            failed.append(cell)
            continue
        if cell.method == "posterior-ppo" and learned is not None:
            figures = figures | {name: figures[name] + learned[name] for name in ("steps", "cpu_seconds")}
        have[cell] = cell._asdict() | {name: round(figures[name], 2) for name in FIGURES}
        _write(file, list(have.values()))
    return failed


def _cell(row: dict[str, Any]) -> Cell:
    return Cell(*(row[name] for name in Cell._fields))


def _write(file: Path, rows: list[dict[str, Any]]) -> None:
    import pandas as pd

    from bayespbrl.runs.files import written_aside

    file.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(file) as aside:
        pd.DataFrame(rows, columns=list(COLUMNS)).to_csv(aside, index=False, lineterminator="\r\n")


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each task, number of answers and method: median [lower, upper quartile], and medians of the costs."""
    header = "| task | answers | method | trials | value | worst | answered | steps | CPU minutes |"
    lines, order = [header, "|---|---|---|---|---|---|---|---|---|"], list(METHODS)
    keys = {(row["task"], row["answers"], row["method"]) for row in rows}
    for task, answers, method in sorted(keys, key=lambda key: (key[0], key[1], order.index(key[2]))):
        its = [row for row in rows if (row["task"], row["answers"], row["method"]) == (task, answers, method)]
        column = {name: [row[name] for row in its] for name in FIGURES}
        low, middle, high = np.quantile(column["value"], [0.25, 0.5, 0.75])
        answered, steps, seconds = (np.median(column[name]) for name in ("answered", "steps", "cpu_seconds"))
        figures = f"{middle:.1f} [{low:.1f}, {high:.1f}] | {min(column['value']):.1f} | {answered:g} | {steps:.0f}"
        lines.append(f"| {task} | {answers:g} | {method} | {len(its)} | {figures} | {seconds / 60:.1f} |")
    return lines


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    whole, one = commands.add_parser("run", help="what is missing, and the table"), commands.add_parser("cell")
    whole.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, metavar="TASK", help=", ".join(TASKS))
    whole.add_argument("--answers", nargs="+", type=_positive, default=[4, 8, 16, 32])
    whole.add_argument("--seeds", nargs="+", type=int, default=range(3110, 3115))
    whole.add_argument("--out", type=Path, default=RESULTS)
    for name, kind in Cell.__annotations__.items():
        one.add_argument(name, type=kind, choices=METHODS if name == "method" else None)
    chosen = parser.parse_args()
    if chosen.command == "cell":
        print(json.dumps(figures_of(Cell(chosen.task, chosen.answers, chosen.seed, chosen.method))))
        return
    cells = [Cell(*each) for each in product(chosen.tasks, chosen.answers, chosen.seeds, METHODS)]
    missing = set(cells) - set(map(_cell, done(chosen.out)))
    if missing and not all((ENVIRONMENTS / name / "bin" / "python").exists() for name in METHODS.values()):
        parser.error(f"{ENVIRONMENTS}: expected the methods' environments, got none; `make neighbours` builds them")
    failed = run(cells, chosen.out)
    print("\n".join(table([row for row in done(chosen.out) if _cell(row) in cells])))
    sys.exit(bool(failed))


def figures_of(cell: Cell) -> dict[str, float]:
    """The figures of a cell, in this process."""
    if cell.method == "imitation":
        return imitation_cell(cell)
    directory = RUNS / f"{cell.task}-{cell.answers}-{cell.seed}"
    return (bayespbrl_cell if cell.method == "bayespbrl" else posterior_ppo_cell)(cell, directory)


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 up, got {text}")
    return int(text)


if __name__ == "__main__":
    main()

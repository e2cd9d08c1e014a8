"""Toy environments, runs that take a second, and the comparison of two learners bit for bit."""

import sys

import gymnasium
import jax
import numpy as np
from gymnasium.spaces import Box

# The paper's protocol with short episodes, and a run of it that takes a second.
SHORT = {"preset": "paper", "max_steps": 20, "evaluation_episodes": 3}
QUICK = SHORT | {"utility": "linear-program", "iterations": 3, "seed": 7}

# The command line in a process that hears interrupts: where tests run in the background they are ignored.
HEARS_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
INTERRUPTIBLE = [sys.executable, "-c", f"{HEARS_INTERRUPTS}; from bayespbrl.cli.commands import main; main()"]

# Selects the page or the widget while it waits for an answer.
READY = ".bp-box[data-phase=question][data-locked=false]"


class Memory:
    """A log in memory."""

    def __init__(self):
        self.entries = []

    def append(self, entry, state):
        self.entries.append(entry)

    def answers(self):
        return [entry.event for entry in self.entries if entry.event["event"] == "answered"]


class Slope(gymnasium.Env):
    """A point pushed along a line; goes wrong at the n-th step of its life if told so."""

    observation_space = Box(-10.0, 10.0, (2,), dtype=np.float64)
    action_space = Box(-1.0, 1.0, (1,), dtype=np.float64)

    def __init__(self, fault=None, at=None):
        self.fault, self.at, self.life = fault, at, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = self.np_random.normal(0, 0.1, 2)
        return self.position.copy(), {}

    def step(self, action):
        self.life += 1
        fault = self.fault if self.life == self.at else None
        if fault == "raises":
            raise RuntimeError("the motor\nis on fire")
        self.position = self.position + 0.3 * float(action[0]) + self.np_random.normal(0, 0.02, 2)
        seen = np.full(2, np.nan) if fault == "observation" else self.position.copy()
        faulty = {"reward": np.nan, "no reward": None, "rewards": np.ones(1, np.float32)}
        return seen, faulty[fault] if fault in faulty else float(self.position.sum()), False, False, {}


class Odd(gymnasium.Env):
    """A box of two rows observed, and any action space: the learner flattens and shifts them; keeps the last action."""

    def __init__(self, action_space, columns=2):
        self.observation_space = Box(-1.0, 1.0, (2, columns), dtype=np.float32)
        self.action_space, self.received = action_space, None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.received = action
        return self._seen(), float(np.sum(action)), False, False, {}

    def _seen(self):
        return self.np_random.uniform(-1, 1, self.observation_space.shape).astype(np.float32)


class Echo(gymnasium.Env):
    """Observes the last action, as one of many states, and has the same reward in each step."""

    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, states=2, reward=0.0):
        self.observation_space, self.reward = gymnasium.spaces.Discrete(states), reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return int(action), self.reward, False, False, {}


class Push(gymnasium.Env):
    """The return is the sum of the actions; observations are the share of the steps; cut off or ended after them."""

    observation_space, action_space = Box(0, 1, (1,)), Box(-1, 1, (1,))

    def __init__(self, steps, ends=False):
        self.steps, self.ends = steps, ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        over = self.time >= self.steps
        share = np.full(1, self.time / self.steps, np.float32)
        return share, float(action[0]), over and self.ends, over and not self.ends, {}


def fingerprint(learner):
    """Everything of a learner that must come out the same, bit for bit."""
    posterior = None if learner.estimate is None else learner.estimate.posterior
    return {
        "summaries": [{k: v for k, v in s.items() if k != "seconds"} for s in learner.iterations],
        "policy": [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(learner.policy)],
        "trajectories": [
            (t.states.tobytes(), t.actions.tobytes(), t.rewards.tobytes(), t.terminated)
            for t in (*learner.trajectories, *learner.state.newest.tried, *learner.state.best.tried)
        ],
        "preferences": learner.preferences,
        "weights": None if learner.estimate is None else np.asarray(learner.estimate.weights).tobytes(),
        "draws": None if posterior is None else posterior["posterior"]["coordinates"].values.tobytes(),
        "question": None if learner.state.query is None else (learner.state.query.first, learner.state.query.second),
    }

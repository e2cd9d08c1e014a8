"""One trial of commit 49879bc, the last version before the one posterior and the one default; prints its figures.

`earlier_version.py` calls this with a checkout of that commit on PYTHONPATH: what is imported here is that version. The
options are those of the best rows of its README. A trial ends when its answers are given and its policy has followed
from them.
"""

import json
import sys
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

import bayespbrl
from bayespbrl import rollouts

CONFIDENT = {
    "schedule": "confidence",
    "query": "information-when-unsure",
    "updates_per_iteration": 3,
    "unasked_iterations": 4,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "gridworld": {},
    "swing-up": CONFIDENT | {"hyperparameters": "averaged"},
    "bicycle": CONFIDENT,
    "acrobot": {},
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WithoutNoise:
    """The mean of continuous actions, the most probable of discrete ones; `actions` has one entry for each of these."""

    policy: Any
    actions: Any

    def sample(self, key: Any, observation: Any) -> Any:
        """One action, whatever the key."""
        del key
        if len(self.actions) == 0:
            return self.policy.moments(observation)[0]
        return jnp.argmax(jax.vmap(lambda action: self.policy.log_prob(observation, action))(self.actions))


def figures(task: str, seed: int, answers: int) -> dict[str, float]:
    """Values of the newest policy after `answers` answers, means of 100 fresh episodes, and what they took."""
    learner = bayespbrl.Learner(task, seed=seed, **OPTIONS[task])
    expert = bayespbrl.ReturnExpert()
    while (questions := learner.ask()) and learner.preferences.answers < answers:
        learner.tell([expert(*question.trajectories) for question in questions])
    space = learner.environment.action_space
    actions = jnp.arange(getattr(space, "n", 0))
    values: dict[str, float] = {
        "seed": seed,
        "answers": learner.preferences.answers,
        "iterations": len(learner.iterations),
    }
    for name, policy in (("value", WithoutNoise(learner.policy, actions)), ("with_noise", learner.policy)):
        returns = rollouts.returns(learner.environment, policy, key=jax.random.key(seed), episodes=100, max_steps=None)
        values[name] = float(returns.total.mean())
    return values


if __name__ == "__main__":
    print(json.dumps(figures(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))

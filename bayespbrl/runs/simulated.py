"""The simulated expert that a run's settings name, in the units of its task."""

import jax

from bayespbrl import rollouts
from bayespbrl.experts import Expert, NoisyExpert, named_expert
from bayespbrl.learner import Learner

EPISODES = 100  # of the first policy, for the units of the task's return
IN_UNITS_OF_THE_TASK = ("stochastic", "skipping", "equal", "margin")


def expert_of(learner: Learner) -> Expert:
    """The simulated expert of a run, the same for a run that is continued.

    Raises:
      ValueError: an expert that is not simulated; one in units of the return, where all returns are equal.
    """
    settings = learner.settings
    mean, scale = 0.0, 1.0
    if settings.expert in IN_UNITS_OF_THE_TASK:
        returns = rollouts.returns(
            learner.environment,
            learner.first_policy(),
            key=jax.random.key(settings.seed),
            episodes=EPISODES,
            max_steps=settings.rollouts.max_steps,
        ).total
        mean, scale = float(returns.mean()), float(returns.std())
        if scale == 0:
            raise ValueError(
                f"expert: expected returns that differ for {settings.expert}, got {mean:g} in all {EPISODES} episodes"
            )
    expert = named_expert(settings.expert, mean=mean, scale=scale, seed=settings.seed)
    return NoisyExpert(expert, settings.wrong_answers, settings.seed) if settings.wrong_answers else expert

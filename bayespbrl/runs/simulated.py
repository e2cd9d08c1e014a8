"""The simulated expert that a run's settings name, in the units of its task."""

import jax
import numpy as np
from jaxtyping import Float

from bayespbrl import rollouts
from bayespbrl.experts import Expert, NoisyExpert, named_expert
from bayespbrl.learner import Learner
from bayespbrl.trajectories import clips_of

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
        returns = _first_returns(learner)
        mean, scale = float(returns.mean()), float(returns.std())
        if scale == 0:
            raise ValueError(
                f"expert: expected returns that differ for {settings.expert}, got {mean:g} in all {EPISODES} episodes"
            )
    expert = named_expert(settings.expert, mean=mean, scale=scale, seed=settings.seed)
    return NoisyExpert(expert, settings.wrong_answers, settings.seed) if settings.wrong_answers else expert


def _first_returns(learner: Learner) -> Float[np.ndarray, " episode"]:
    """Returns of the first policy, of what the expert is shown: whole trajectories, or clips."""
    settings = learner.settings
    episodes = {
        "key": jax.random.key(settings.seed),
        "episodes": EPISODES,
        "max_steps": settings.rollouts.max_steps,
    }
    if settings.questions.clip_steps is None:
        return rollouts.returns(learner.environment, learner.first_policy(), **episodes).total
    whole = rollouts.rollout(learner.environment, learner.first_policy(), **episodes)
    clips = settings.questions.clips(whole, rng=np.random.default_rng(settings.seed))
    return np.array([clip.total_reward for clip in clips_of(whole, clips)])

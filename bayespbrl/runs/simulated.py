"""The simulated expert that a run's settings name, in the units of its task."""

import jax
import numpy as np
from jaxtyping import Float

from bayespbrl import rollouts
from bayespbrl.experts import TIE_TOLERANCE, Expert, NoisyExpert, named_expert
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
        if scale <= TIE_TOLERANCE * np.abs(returns).max():
            raise ValueError(
                f"expert: expected returns that differ for {settings.expert}, got {mean:g} in all {EPISODES} episodes"
            )
    expert = named_expert(settings.expert, mean=mean, scale=scale, seed=settings.seed)
    return NoisyExpert(expert, settings.wrong_answers, settings.seed) if settings.wrong_answers else expert


def _first_returns(learner: Learner) -> Float[np.ndarray, " episode"]:
    """Returns of the first policy, of what the expert is shown: whole trajectories, or clips."""
    questions, seed = learner.settings.questions, learner.settings.seed
    environment, policy, steps = learner.environment, learner.state.first_policy, learner.settings.rollouts.max_steps
    key = jax.random.key(seed)
    if questions.clip_steps is None:
        return rollouts.returns(environment, policy, key=key, episodes=EPISODES, max_steps=steps).total
    whole = rollouts.rollout(environment, policy, key=key, episodes=EPISODES, max_steps=steps)
    clips = questions.clips(whole, rng=np.random.default_rng(seed))
    return np.array([clip.total_reward for clip in clips_of(whole, clips)])

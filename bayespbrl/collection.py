"""Step 3: new trajectories: whose they are, from which starts, and by which random numbers."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import jax
import numpy as np

from bayespbrl import rollouts
from bayespbrl.envs.stepping import step_limit
from bayespbrl.events import LearnerState
from bayespbrl.policies import Policy, Sampler, greedy
from bayespbrl.policies.policy import has_mode
from bayespbrl.settings import Settings
from bayespbrl.trajectories import Trajectory

# Each random choice has a stream of its own, named by (seed, purpose, count): what is redone comes out the same.
COLLECT, CHOOSE, SHOW, FEATURES, FIT, IMPROVE, EVALUATE, VISITED, STARTS, REPEAT, CLIPS, CHECK, NOISE_FREE = range(13)


@dataclass(frozen=True)
class Collection:
    """How a run collects trajectories.

    Attributes:
      settings: all options.
      environment: opened.
    """

    settings: Settings
    environment: gymnasium.Env

    def _collected(self, state: LearnerState, policy: Policy) -> tuple[Trajectory, ...]:
        """New trajectories, the last of them those `_without_noise`, from one start."""
        options, iteration, silent = self.settings.rollouts, state.iteration, self._without_noise(state)
        number = options.trajectories_per_iteration
        noisy = number - len(silent)
        first = [len(each) for each in state.trajectories[:number]]
        hold = options.hold(first or [step_limit(self.environment, options.max_steps)])
        starts = self._starts(iteration)[:noisy] if self.settings.questions.same_start else None
        collected = self._roll(policy, self._key(COLLECT, iteration), noisy, hold=hold, starts=starts)
        start, key = self.reset_seed(iteration * number + noisy), self._key(NOISE_FREE, iteration)
        for each in silent:
            collected += self._roll(greedy(each), key, 1, starts=[start])
        return collected

    def _without_noise(self, state: LearnerState) -> tuple[Sampler, ...]:
        """The policies shown without noise, the newest last, before it the kept one where they are compared."""
        restarts = state.restarts(self.settings)
        if not self.settings.rollouts.noise_free or not state.iteration:
            return ()
        if self.settings.questions.against_kept:
            if restarts:
                return state.kept.policy, state.first_policy
            return state.to_beat.policy, state.newest.policy
        updated = state.iteration > state.started and not restarts
        return (state.newest.policy,) if updated and has_mode(state.newest.policy) else ()

    def _tried(self, policy: Sampler) -> tuple[Trajectory, ...]:
        """Trajectories without the policy's noise, from starts that are the same for all policies of the run."""
        options = self.settings.update
        return self._roll(greedy(policy), self._key(CHECK, 0), options.check_episodes) if options.checked else ()

    def _roll(self, policy: Sampler, key: jax.Array, episodes: int, **how: Any) -> tuple[Trajectory, ...]:
        limit = self.settings.rollouts.max_steps
        return rollouts.rollout(self.environment, policy, key=key, episodes=episodes, max_steps=limit, **how)

    def evaluated(self, policy: Sampler) -> rollouts.Returns:
        """Fresh episodes, the same for all policies of the run; the learner never sees them."""
        options = self.settings.rollouts
        return rollouts.returns(
            self.environment,
            policy,
            key=self._key(EVALUATE, 0),
            episodes=options.evaluation_episodes,
            max_steps=options.max_steps,
        )

    def _starts(self, iteration: int) -> list[int]:
        """The seeds of the resets, the same in each iteration; in the first each start has two trajectories."""
        number = self.settings.rollouts.trajectories_per_iteration
        first = int(self._rng(STARTS, 0).integers(2**30))
        return [first + (i // 2 if iteration == 0 else i) for i in range(number)]

    def reset_seed(self, number: int) -> int:
        """The seed with which the environment was reset for a trajectory, where it is stepped by its interface."""
        iteration, episode = divmod(number, self.settings.rollouts.trajectories_per_iteration)
        if self.settings.questions.against_kept and iteration:
            episode = min(episode, self.settings.rollouts.trajectories_per_iteration - 2)  # the last two start alike
        if self.settings.questions.same_start:
            return self._starts(iteration)[episode]
        return rollouts.reset_seed(self._key(COLLECT, iteration)) + episode

    def _rng(self, purpose: int, count: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, purpose, count])

    def _key(self, purpose: int, count: int) -> jax.Array:
        return jax.random.key(int(self._rng(purpose, count).integers(2**31)))

"""The options of a run, composed of those of its parts.

Users name an option alone: in keywords, on the command line, in `settings.json`. `OPTIONS` tells which part reads it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, cast

import numpy as np

from bayespbrl import checks
from bayespbrl.experts import SIMULATED
from bayespbrl.features import RadialBasisOptions
from bayespbrl.improvement.problem import PolicyUpdate
from bayespbrl.improvement.q_function import Critic
from bayespbrl.improvement.schedules import SCHEDULES
from bayespbrl.models import PreferenceModel
from bayespbrl.policies.choice import POLICIES
from bayespbrl.queries import BY_SIGNAL, WITHOUT_DRAWS
from bayespbrl.questions import Questions
from bayespbrl.settings import presets
from bayespbrl.settings.presets import preset_options
from bayespbrl.settings.tasks import Task
from bayespbrl.utility.inference import WITHOUT_POSTERIOR, Estimation

LAST_ITERATIONS = 5  # after the last answer: the policy catches up with what is known
INFERRED: dict[str, Any] = {"steepness": None, "lapse_rate": None}  # unless they or all hyperparameters are given
HOLDS = 40  # of exploration, in an episode
MOST_UNASKED = 10  # in a row; then more answers would change little
MOST_STEPS = 10_000_000  # an episode
MOST_TRAJECTORIES = 100_000  # an iteration; of a damaged or foreign run, they are room that is made


@dataclass(frozen=True)
class Features:
    """How the features are drawn.

    Attributes:
      features: φ(s) as `drawn`: one-hot or radial basis functions at observed states; or `other`, a function of the
        user's.
      centres: radial basis functions of each kind of feature; where actions are discrete Q has as many for each, but at
        most 2000 in all, or ten for each.
      bandwidth_factor: multiplies the median rule for the features of Q and V.
      utility_bandwidth_factor: multiplies the median rule for the utility's features.
      normalised_utility: whether the utility's radial basis functions are divided by their sum. Decision: they are, so
        that the utility extends to states far from every compared trajectory, where plain ones fall to zero.
      constant_utility: whether the utility has a constant part, as in `RadialBasisOptions`, where some episodes end
        before the time limit.
      effort_utility: whether the utility has a part for the effort of continuous actions, as in `RadialBasisOptions`;
        inferred is then whether it counts, too.
      diffusion_utility: whether the utility of discrete states is smooth over the steps that were observed, with a
        length scale that is inferred, as in `DiffusionBasis`; else it has an independent value for each state. At most
        1000 states.
      standardised_utility: whether discrete states have the same part in the utility a priori however often
        trajectories visit them, as in `RadialBasisOptions`; else each visit has.
    """

    features: str = "drawn"
    centres: int = 300
    bandwidth_factor: float = 1.0
    utility_bandwidth_factor: float = 1.0
    normalised_utility: bool = True
    constant_utility: bool = False
    effort_utility: bool = False
    diffusion_utility: bool = False
    standardised_utility: bool = False

    def __post_init__(self) -> None:
        checks.one_of("features", self.features, ("drawn", "other"))
        checks.whole("centres", self.centres)
        checks.positive("bandwidth_factor", self.bandwidth_factor)
        checks.positive("utility_bandwidth_factor", self.utility_bandwidth_factor)
        for name in ("normalised", "constant", "effort", "diffusion", "standardised"):
            checks.boolean(f"{name}_utility", getattr(self, f"{name}_utility"))
        if self.diffusion_utility and self.standardised_utility:
            raise ValueError("standardised_utility: expected false with diffusion_utility, got true")

    @property
    def of_critic(self) -> RadialBasisOptions:
        """The features of Q and V."""
        return RadialBasisOptions(self.centres, self.bandwidth_factor)

    @property
    def of_utility(self) -> RadialBasisOptions:
        """The features of the utility."""
        return RadialBasisOptions(
            self.centres,
            self.utility_bandwidth_factor,
            normalised=self.normalised_utility,
            constant=self.constant_utility,
            effort=self.effort_utility,
            diffusion=self.diffusion_utility,
            standardised=self.standardised_utility,
        )


@dataclass(frozen=True)
class Rollouts:
    """How the policy begins, explores and is evaluated.

    Attributes:
      trajectories_per_iteration: N.
      max_steps: steps an episode; None for the environment's own limit. An object of yours keeps its own where less.
      exploration_hold: steps for which the exploring policy's random choice is held, so that the trajectories of an
        iteration differ; the paper's is 1. None: a fortieth of an episode, in the first iteration by the limit of
        steps, then by the mean length of the first trajectories, which may end early. Evaluations never hold it.
      noise_free: whether the last trajectory of each iteration but the first follows the policy without its noise, as
        the run keeps it. Once an answer stated an order, a question is about it wherever the posterior is in doubt
        (`queries.DOUBT`), whatever the rule, also in an iteration that would ask nothing. With `against_kept` the last
        but one is of the policy that is kept, and the two are compared where that matters.
      evaluation_episodes: fresh episodes for the value of an iteration; the learner never sees them.
      policy: the kind of policy. `auto` takes tabular for discrete states, softmax for discrete actions in continuous
        states, gaussian-process otherwise; `other` is a policy of the user's.
      initial_action_scale: standard deviation of the first continuous policy, in ranges of the action space.
    """

    trajectories_per_iteration: int = 10
    max_steps: int | None = None
    exploration_hold: int | None = 1
    noise_free: bool = False
    evaluation_episodes: int = 100
    policy: str = "auto"
    initial_action_scale: float = 0.75

    def __post_init__(self) -> None:
        checks.whole("trajectories_per_iteration", self.trajectories_per_iteration, 2, most=MOST_TRAJECTORIES)
        checks.optional(checks.whole, "max_steps", self.max_steps, most=MOST_STEPS)
        checks.optional(checks.whole, "exploration_hold", self.exploration_hold)
        checks.boolean("noise_free", self.noise_free)
        checks.whole("evaluation_episodes", self.evaluation_episodes)
        checks.one_of("policy", self.policy, ("auto", *POLICIES, "other"))
        checks.positive("initial_action_scale", self.initial_action_scale)

    def hold(self, lengths: Sequence[int]) -> int:
        """For how many steps exploration is held: as set, or a share of episodes of these lengths."""
        if self.exploration_hold is not None:
            return self.exploration_hold
        return max(1, round(float(np.mean(lengths)) / HOLDS))


@dataclass(frozen=True)
class Settings:
    """All options of one run.

    Attributes:
      env: a short name, a gymnasium id, or how an environment object describes itself.
      seed: of every random choice of the run.
      preset: `default`, or `paper`, the paper's protocol; all other options say what it came to.
      iterations: most cycles of the four steps; None: they follow from the budget of answers.
      environment: `named`, which `env` opens again; `object`, which gymnasium makes of `env`; or `other`, an object of
        the user's.
      expert, wrong_answers: who answers, and the share of a simulated expert's answers that are reversed; a stopped run
        finds its expert again by them.
      model, estimation, features, critic, update, rollouts, questions: the options of each part, documented there:
        `PreferenceModel` (models), `Estimation` (utility), `Features` and `Rollouts` (here), `Critic` and
        `PolicyUpdate` (improvement), `Questions` (questions).
    """

    env: str
    preset: str = "default"
    seed: int = 0
    iterations: int | None = 25
    environment: str = "named"
    expert: str = "return"
    wrong_answers: float = 0.0
    model: PreferenceModel = field(default_factory=partial(PreferenceModel, **INFERRED))
    estimation: Estimation = field(default_factory=Estimation)
    features: Features = field(default_factory=Features)
    critic: Critic = field(default_factory=Critic)
    update: PolicyUpdate = field(default_factory=PolicyUpdate)
    rollouts: Rollouts = field(default_factory=Rollouts)
    questions: Questions = field(default_factory=Questions)

    def __post_init__(self) -> None:
        checks.seed(self.seed)
        checks.one_of("preset", self.preset, presets.NAMES)
        if self.iterations is not None:
            checks.whole("iterations", self.iterations)
        elif self.questions.answers is None:
            raise ValueError("iterations: expected a number, because there is no budget of answers, got None")
        checks.one_of("environment", self.environment, ("named", "object", "other"))
        checks.one_of("expert", self.expert, (*SIMULATED, "page", "terminal", "other"))
        checks.share("wrong_answers", self.wrong_answers)
        self._check_together()

    def _check_together(self) -> None:
        """Check options that depend on options of another part."""
        utility, query, schedule = self.estimation.utility, self.questions.query, self.update.schedule
        checks.one_of("schedule", schedule, (*SCHEDULES, "other"))
        if utility in WITHOUT_POSTERIOR and query not in (*WITHOUT_DRAWS, "other"):
            rules = " or ".join(WITHOUT_DRAWS)
            raise ValueError(f"query: expected {rules} with {utility}, which has no posterior, got {query!r}")
        if self.estimation.plain_draws is not None and None in (self.model.steepness, self.model.lapse_rate):
            given = f"{self.model.steepness} and {self.model.lapse_rate}"
            raise ValueError(f"plain_draws: expected numbers as steepness and lapse_rate, got {given}")
        if self.questions.against_kept:
            if not (self.rollouts.noise_free and self.update.checked):
                raise ValueError("against_kept: expected false unless noise_free and checked, got true")
            if (number := self.rollouts.trajectories_per_iteration) < 3:
                raise ValueError(f"trajectories_per_iteration: expected at least 3 with against_kept, got {number}")
            if utility in WITHOUT_POSTERIOR:
                raise ValueError(f"against_kept: expected false with {utility}, which has no posterior, got true")
        if query in BY_SIGNAL and schedule != "confidence":
            raise ValueError(f"schedule: expected confidence with the query rule {query}, got {schedule!r}")
        if self.wrong_answers and self.expert not in SIMULATED:
            raise ValueError(f"wrong_answers: expected 0 with the expert {self.expert}, got {self.wrong_answers}")
        number = self.rollouts.trajectories_per_iteration
        for name, limit in (("queries_per_iteration", number), ("first_queries", number - 1)):
            if (value := getattr(self.questions, name)) > limit:
                raise ValueError(f"{name}: expected at most {limit} with {number} trajectories, got {value}")

    @classmethod
    def from_options(cls, env: str, options: Mapping[str, Any]) -> "Settings":
        """The settings with these options, named alone; the defaults for all others.

        Raises:
          ValueError: an unknown option, or a value that its part does not take.
        """
        unknown = sorted(set(options) - set(OPTIONS))
        if unknown:
            raise ValueError(f"settings: expected options among {', '.join(sorted(OPTIONS))}, got {', '.join(unknown)}")
        parts: dict[str, dict[str, Any]] = {name: {} for name in ("", *PARTS)}
        for name, value in options.items():
            parts[OPTIONS[name]][name] = value.item() if isinstance(value, np.generic) else value
        if parts["estimation"].get("hyperparameters", Estimation.hyperparameters) == "inferred":
            parts["model"] = INFERRED | parts["model"]
        own = parts.pop("")
        return cls(env, **own, **{name: PARTS[name](**chosen) for name, chosen in parts.items()})

    def options(self) -> dict[str, Any]:
        """All options, named alone, with their values."""
        return {name: getattr(getattr(self, part) if part else self, name) for name, part in OPTIONS.items()}

    @property
    def most_iterations(self) -> int:
        """The limit on iterations.

        `iterations`; else three for every two answers, with those of a restarted policy (and `LAST_ITERATIONS` before
        it at least), or `LAST_ITERATIONS` more where none is restarted.
        """
        if self.iterations is not None:
            return self.iterations
        most = 3 * cast(int, self.questions.answers) // 2  # there is one of the two limits
        return max(most, LAST_ITERATIONS) + self._restarted if self._restarted else most + LAST_ITERATIONS

    @property
    def with_confirmations(self) -> int:
        """`most_iterations`, and those that a run may add to ask about its restarted policy."""
        return self.most_iterations + self.confirmations

    @property
    def most_answers(self) -> int:
        """The most answers that a run can use: `answers`, or those of all iterations where they are fewer."""
        asking = self.questions
        return asking.within_budget(asking.first_queries + asking.queries_per_iteration * (self.most_iterations - 1), 0)

    @property
    def _restarted(self) -> int:
        """Number of iterations of the restarted policy."""
        return self.update.restart_iterations if self.update.checked and self.iterations is None else 0

    @property
    def confirmations(self) -> int:
        """Answers that are left for the restarted policy, where policies are compared with what is kept: a tenth."""
        budget = self.questions.answers
        return (budget + 5) // 10 if self.questions.against_kept and self._restarted and budget is not None else 0

    def restarts(self, iteration: int, answers: int, unasked: int) -> bool:
        """Whether to restart the policy: answers or iterations are used up, or no question is worthwhile.

        Decision: at once after the last answer, but for `confirmations`, since nobody is asked about what the first
        policy does then, but not before it had as many iterations as a run without a second policy ends with.
        """
        budget, last = self.questions.answers, self.most_iterations - self._restarted
        if not self._restarted or budget is None or iteration < LAST_ITERATIONS:
            return False
        return answers >= budget - self.confirmations or unasked >= MOST_UNASKED or iteration >= last

    def last_iteration(self, started: int = 0) -> int:
        """The last iteration, unless a nominated policy is still to be asked about; `started` as in `finished`."""
        return min(self.most_iterations, started + self._restarted) if started else self.most_iterations

    def finished(self, iteration: int, answers: int, unasked: int, started: int = 0) -> bool:
        """Whether a run ends.

        Args:
          iteration, answers: completed and given.
          unasked: iterations in a row without a question.
          started: iterations completed when the policy was started anew; 0: it was not.
        """
        if iteration >= self.last_iteration(started):
            return True
        if self._restarted or self.questions.answers is None:
            return False
        return unasked >= (LAST_ITERATIONS if answers >= self.questions.answers else MOST_UNASKED)

    @property
    def own_parts(self) -> tuple[str, ...]:
        """The parts that are objects of the user's and have to be passed again to go on, or the expert."""
        return tuple(name for name, value in self.options().items() if value == "other")

    @property
    def trajectory_discount(self) -> float:
        """γ of ψ(τ), by which answers are explained."""
        given = self.estimation.trajectory_discount
        return self.critic.discount if given is None else given


PARTS: dict[str, type[Any]] = {
    "model": PreferenceModel,
    "estimation": Estimation,
    "features": Features,
    "critic": Critic,
    "update": PolicyUpdate,
    "rollouts": Rollouts,
    "questions": Questions,
}
# The part that reads each option; "" for the run's own. The tie threshold has none: a run infers it.
OPTIONS: dict[str, str] = {f.name: "" for f in fields(Settings) if f.name not in ("env", *PARTS)} | {
    option.name: part for part, kind in PARTS.items() for option in fields(kind) if option.name != "tie_threshold"
}


def settings_for(env: str, *, task: Task | None = None, **changes: Any) -> Settings:
    """The preset for an environment with `changes`.

    An environment object of the user's may have another time limit when the run is continued, so its limit is kept.

    Args:
      env: short name or gymnasium id.
      task: what the default preset derives options from; None: it derives none.
      **changes: options, named alone.

    Raises:
      ValueError: as `Settings.from_options`.
    """
    limit = {} if task is None or changes.get("environment", "named") == "named" else {"max_steps": task.horizon}
    return Settings.from_options(env, preset_options(env, changes, task) | changes | limit)

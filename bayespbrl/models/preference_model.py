"""The model of Bayesian PBIRL (eqs. 7-8): its options, and its form in NumPyro."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array
from jaxtyping import Bool, Float, Integer, Shaped
from numpy.typing import ArrayLike

from bayespbrl import checks
from bayespbrl.models import priors
from bayespbrl.models.likelihoods import LIKELIHOODS, Likelihood, Scalar, likelihood_of, log_prob
from bayespbrl.models.priors import Grid

# Beyond these, squares and densities are no numbers any more. Of a threshold so wide every answer is a tie.
LEAST_SCALE, LARGEST_SCALE = 1e-30, 1e30
TIES = 1e-12, 1e6  # prior standard deviations of the margins that a given threshold may have


@dataclass(frozen=True)
class PreferenceModel:
    """Prior and likelihood (eqs. 7-8): w ~ N(0, σ²I), and the probability of an answer given its margin t = wᵀψ.

    Without ties the answers depend on σ·m alone. What is None is inferred, with the priors of `priors`. By default
    steepness and lapse rate are given, as in eq. 8; `infer_utility` and the learner infer both.

    Attributes:
      prior_scale: σ > 0, standard deviation of each weight, in utility per feature.
      steepness: m > 0, slope of the sigmoid, in 1/utility; None: inferred.
      lapse_rate: λ in [0, 1), the probability that an answer is given at random, of two or, with ties, of three; None:
        inferred, for each answerer.
      likelihood: "mixed" (eq. 8), "logistic" (Bradley-Terry) or "probit" (Thurstone).
      tie_threshold: δ > 0, in utility: margins within it are often answered with "no difference". None: inferred where
        answers are said to be such or not, and no threshold where nothing is said.
    """

    prior_scale: float = 1.0
    steepness: float | None = 5.0
    lapse_rate: float | None = 0.0
    likelihood: str = "mixed"
    tie_threshold: float | None = None

    def __post_init__(self) -> None:
        checks.positive("prior_scale", self.prior_scale)
        checks.between("prior_scale", self.prior_scale, LEAST_SCALE, LARGEST_SCALE)
        checks.one_of("likelihood", self.likelihood, LIKELIHOODS)
        checks.optional(checks.positive, "steepness", self.steepness)
        checks.optional(checks.share, "lapse_rate", self.lapse_rate, below_one=True)
        checks.optional(checks.positive, "tie_threshold", self.tie_threshold)

    def check_threshold(self, length: float) -> None:
        """`ValueError` where a given threshold is so far from the margins that densities are no numbers any more.

        `length` is the root mean square length of the differences; 0 where all are zero.
        """
        deviation = self.prior_scale * float(length or 1.0)
        least, most = (each * deviation for each in TIES)
        if self.tie_threshold is not None and not least <= self.tie_threshold <= most:
            raise ValueError(
                f"tie_threshold: expected {least:g} to {most:g}, as the margins have a prior standard deviation of "
                f"{deviation:g}, got {self.tie_threshold!r}"
            )

    @property
    def steepness_prior(self) -> Grid:
        """The prior of m."""
        return priors.STEEPNESS if self.steepness is None else priors.given(self.steepness)

    @property
    def lapse_rate_prior(self) -> Grid:
        """The prior of each answerer's λ."""
        return priors.LAPSE_RATE if self.lapse_rate is None else priors.given(self.lapse_rate)

    @property
    def tie_threshold_prior(self) -> Grid:
        """The prior of δ, where there is a threshold."""
        return priors.TIE_THRESHOLD if self.tie_threshold is None else priors.given(self.tie_threshold)

    def answer_likelihood(self, number_of_preferences: int, indifferent: ArrayLike | None = None) -> Likelihood:
        """The probability of each answer as a function of its margin; what is inferred is at its prior's mean.

        Args:
          number_of_preferences: K of eq. 8.
          indifferent: which answers were "no difference", bool, one entry for each margin; None for K answers of which
            none could be, unless a tie threshold is given.

        Raises:
          ValueError: an `indifferent` that is not a vector of bool.
        """
        tied = np.zeros(number_of_preferences, dtype=bool) if indifferent is None else np.asarray(indifferent)
        if tied.ndim != 1 or tied.dtype != bool:
            raise ValueError(f"indifferent: expected bool of shape (K,), got {tied.dtype} of shape {tied.shape}")
        threshold = self.tie_threshold is not None or indifferent is not None
        return likelihood_of(
            self.likelihood,
            float(max(number_of_preferences, 1)),
            steepness=self.steepness_prior.mean,
            lapse_rate=None if self.lapse_rate == 0 else self.lapse_rate_prior.mean,
            tie_threshold=self.tie_threshold_prior.mean if threshold else None,
            indifferent=tied,
        )


@dataclass(frozen=True)
class Answers:
    """Ties, sides and answerers of K answers; None where they are not known.

    Attributes:
      indifferent, shown_first, answerers: as in `sample_posterior`, shape (K,).
      names: of the answerers, by number; None: found in `answerers`, or there is one answerer.
    """

    indifferent: ArrayLike | None = None
    shown_first: ArrayLike | None = None
    answerers: ArrayLike | None = None
    names: tuple[str, ...] | None = None

    def checked(self, number: int) -> "Answers":
        """The same as arrays; `ValueError` where one is not of shape (`number`,) or not of its kind."""
        tied, sides, who, names = self.indifferent, self.shown_first, self.answerers, self.names
        if who is not None:
            given = np.asarray(who)  # of names and a NaN it makes names, "nan" among them
            given = np.asarray(who, dtype=object) if given.dtype.kind == "U" else given
            who, names = _numbered(given, names, number)
        elif names is not None and number:
            raise ValueError(f"answerers: expected who of {', '.join(names)} gave each answer, got None")
        return Answers(
            None if tied is None else checks.flags("indifferent", tied, number),
            None if sides is None else _numbers("shown_first", sides, number, -1, 1),
            who,
            names,
        )

    def tied(self, number: int) -> Bool[np.ndarray, " k"]:
        """Which of `number` answers were "no difference": none where that is not known."""
        return np.zeros(number, bool) if self.indifferent is None else np.asarray(self.indifferent)

    def of(self, rows: ArrayLike) -> "Answers":
        """The answers of some rows; answerers keep their numbers."""
        chosen = np.asarray(rows)

        def some(part: ArrayLike | None) -> Shaped[np.ndarray, " n"] | None:
            return None if part is None else np.asarray(part)[chosen]

        return Answers(some(self.indifferent), some(self.shown_first), some(self.answerers), self.names)

    def by_answerer(self, number: int) -> Float[np.ndarray, "a k"]:
        """Who gave each of K answers, one-hot; zero where that is not known."""
        if self.answerers is None:
            return np.ones((1, number)) if self.names is None else np.zeros((len(self.names), number))
        who = np.asarray(self.answerers)
        many = int(who.max(initial=0)) + 1 if self.names is None else len(self.names)
        return (np.arange(many)[:, None] == who).astype(float)

    def with_sides(self, differences: Float[np.ndarray, "*s k d"], prior_scale: float) -> Float[np.ndarray, "*s k e"]:
        """The differences with a feature for each answerer: the side, whose weight is the side bias over its scale."""
        if self.shown_first is None:
            return differences
        columns = (np.asarray(self.shown_first) * self.by_answerer(differences.shape[-2])).T
        columns = columns * priors.SIDE_BIAS_SCALE / prior_scale
        columns = np.broadcast_to(columns, (*differences.shape[:-1], columns.shape[1]))
        return np.concatenate([differences, columns], axis=-1)


NOTHING_ELSE = Answers()


def _numbered(
    who: Shaped[np.ndarray, "..."], names: tuple[str, ...] | None, number: int
) -> tuple[Integer[np.ndarray, " k"], tuple[str, ...]]:
    """The number of each of K answerers, who are given by name or by number, and the names by number."""
    if any(isinstance(each, str) for each in who.flat):
        if who.shape != (number,) or not all(isinstance(each, str) for each in who):
            raise ValueError(
                f"answerers: expected {number} names, one for each answer and '' for a person without, got "
                f"{checks.shortened(who.tolist())}"
            )
        given = [str(each) for each in who]
        names = tuple(dict.fromkeys(given)) if names is None else names
        if unknown := sorted(set(given) - set(names)):
            raise ValueError(f"answerers: expected names among {', '.join(names)}, got {', '.join(unknown)}")
        who = np.array([names.index(each) for each in given])
    most = np.iinfo(np.int64).max if names is None else len(names) - 1
    who = _numbers("answerers", who, number, 0, most)
    if names is None:  # only who answered: a number that is left out is nobody
        found, who = np.unique(who, return_inverse=True)
        names = tuple(map(str, found)) or ("0",)
    return who, names


def _numbers(name: str, values: ArrayLike, number: int, least: int, most: int) -> Integer[np.ndarray, " k"]:
    array = np.asarray(values)
    array = array.astype(int) if array.shape == (0,) else array  # an empty list has no type
    if array.shape != (number,) or array.dtype.kind not in "iu" or np.any((array < least) | (array > most)):
        raise ValueError(f"{name}: expected {number} whole numbers in {least} … {most}, got {checks.shortened(values)}")
    return array


def preference_model(
    differences: Float[Array, "k d"] | Float[np.ndarray, "k d"],
    likelihood: Likelihood,
    *,
    prior_scale: Scalar = PreferenceModel.prior_scale,
    used: Bool[Array, " k"] | bool = True,
) -> None:
    """w ~ N(0, σ²I_D); answer k is "as given" with probability p(t_k), t = differences @ w.

    Sites: `utility_weights` (D,), deterministic `margins` (K,), and `answers`, Bernoulli in the plate "preference",
    observed as 1: each row of the differences is ψ(preferred) − ψ(dominated).

    Args:
      differences: ψ(preferred) − ψ(dominated).
      likelihood: p, one of `bayespbrl.models.likelihoods`.
      prior_scale: σ > 0; may be traced, so it may be a site of an enclosing model.
      used: which rows count; one bool for all.
    """
    number, dimension = differences.shape
    weights = numpyro.sample("utility_weights", dist.Normal(0, prior_scale).expand([dimension]).to_event(1))  # eq. 7
    margins = numpyro.deterministic("margins", differences @ weights)  # eq. 5
    # eq. 8; rounding must not lift log p to 0 or above, where the logit is not a number
    log_p = jnp.minimum(log_prob(likelihood, margins), -1e-30)
    with numpyro.plate("preference", number), numpyro.handlers.mask(mask=used):
        logits = log_p - jnp.log(-jnp.expm1(log_p))
        numpyro.sample("answers", dist.Bernoulli(logits=logits), obs=jnp.ones(number, dtype=int))


def joint_preference_model(
    differences: Float[np.ndarray, "s k d"],
    model: PreferenceModel,
    *,
    answers: Answers = NOTHING_ELSE,
    number_of_preferences: int | None = None,
) -> None:
    """The model of `sample_posterior` with everything that it infers: its priors, and `preference_model` given them.

    Sites: `setting`, and `steepness_number`, `lapse_rate_number` (one for each answerer, plate "answerer") and
    `tie_threshold_number`, the numbers of the values on their grids; then those of `preference_model`, whose
    `utility_weights` have one feature more for each answerer where `shown_first` is known: the side.

    Args:
      differences: for C settings, equally probable a priori.
      model: prior and likelihood.
      answers: ties, sides and answerers.
      number_of_preferences: K of eq. 8; all rows by default.
    """
    settings = jnp.asarray(answers.with_sides(differences, model.prior_scale))
    number = settings.shape[1] if number_of_preferences is None else number_of_preferences
    by_answerer = answers.by_answerer(settings.shape[1])
    who = np.argmax(by_answerer, axis=0)

    def one_of(name: str, prior: Grid) -> Float[Array, "..."]:
        chosen = numpyro.sample(f"{name}_number", dist.Categorical(jnp.asarray(prior.probabilities)))
        return numpyro.deterministic(name, jnp.asarray(prior.values)[chosen])

    setting = numpyro.sample("setting", dist.Categorical(jnp.full(len(settings), 1 / len(settings))))
    steepness = one_of("steepness", model.steepness_prior)
    with numpyro.plate("answerer", len(by_answerer)):
        lapse_rates = one_of("lapse_rate", model.lapse_rate_prior)
    ties = answers.indifferent is not None or model.tie_threshold is not None
    likelihood = likelihood_of(
        model.likelihood,
        float(max(number, 1)),
        steepness=steepness,
        lapse_rate=None if model.lapse_rate == 0 else lapse_rates[who],
        tie_threshold=one_of("tie_threshold", model.tie_threshold_prior) if ties else None,
        indifferent=answers.tied(len(who)),
    )
    preference_model(settings[setting], likelihood, prior_scale=model.prior_scale)

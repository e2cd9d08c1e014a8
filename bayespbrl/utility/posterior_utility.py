"""The posterior of the utility over all unknowns, and the utility that the learner acts on (paper, eqs. 7-8)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from jaxtyping import Float
from xarray import DataTree

from bayespbrl import checks
from bayespbrl.features import RadialBasis, StateFeatures, linear
from bayespbrl.models.likelihoods import Likelihood, likelihood_of
from bayespbrl.models.posterior_tree import next_lapse_rates, number_of_preferences
from bayespbrl.trajectories import Trajectory, Transitions
from bayespbrl.utility.length_scales import rescaled, sums_under, values_under
from bayespbrl.utility.quality import FitQuality

# From the numbers of some settings, and weights of each side by side, (D, m), to wᵀφ or wᵀψ of each row, (n, m).
Evaluate = Callable[[np.ndarray, Sequence[np.ndarray]], Sequence[np.ndarray]]
INTERVAL = (0.05, 0.95)


@dataclass(frozen=True)
class PosteriorUtility:
    """u(s′) = wᵀφ(s′), or u(a, s′) if effort counts, with draws of w and of the length scales of φ.

    Mean, draws, `quality` and `likelihood` are all of that one posterior.

    Attributes:
      features: φ as given; a user's own in a learner over its `OwnFeatures.units`.
      multiples: of its bandwidths, one row for each of C settings, shape (C, S); S = 0 for features without any. With
        a feature of the effort one column more: 1 where it counts, else 0.
      scales: what the differences were divided by under each setting, shape (C,): a draw over it is in the units of φ.
      weights: the utility that is acted on (posterior mean, most likely draw or one draw) is the sum of wᵀφ over the
        settings, in the units of φ, shape (C, D). In a mean each setting's part has its probability in it.
      discount: γ of ψ(τ).
      quality: how far the posterior can be trusted.
      posterior: draws in ArviZ's schema, with the setting of each.
    """

    features: StateFeatures
    multiples: np.ndarray
    scales: np.ndarray
    weights: np.ndarray
    discount: float
    quality: FitQuality
    posterior: DataTree

    @property
    def number_of_features(self) -> int:
        """D."""
        return int(self.weights.shape[-1])

    def thinned(self, number: int) -> Self:
        """The same with about `number` draws, in memory; no more than `utilities_and_draws` needs is kept."""
        drawn = self.posterior["posterior"].dataset[["setting", "utility_weights"]]
        few = drawn.isel(draw=slice(None, None, spacing(drawn["setting"].size, number))).load()
        return replace(self, posterior=DataTree.from_dict({"posterior": few}))

    def likelihood(self, number: int | None = None, *, answerer: str | None = None) -> Likelihood:
        """Likelihood of the next answer given its margin under each of S draws; margins have shape (S, n).

        Args:
          number: as in `trajectory_draws`.
          answerer: whose it is, by a name that the posterior knows; any other's lapse rate is that of
            `next_lapse_rates`.
        """
        drawn, fitted = self.posterior.children["posterior"].dataset, self.posterior.attrs
        apart = slice(None, None, self._apart(number))
        known = answerer in drawn.coords.get("answerer", ())
        lapse_rates = drawn["lapse_rate"].sel(answerer=answerer).values if known else next_lapse_rates(self.posterior)
        steepness, lapse_rate = (values[:, apart].reshape(-1, 1) for values in (drawn["steepness"].values, lapse_rates))
        return likelihood_of(
            fitted["likelihood"],
            float(number_of_preferences(self.posterior)),
            steepness=steepness,
            lapse_rate=lapse_rate,
        )

    def tie_thresholds(self, number: int | None = None) -> Float[np.ndarray, "s 1"] | None:
        """The tie threshold of each of S draws, as in `likelihood`; None where no answer was a tie."""
        drawn = self.posterior.children["posterior"].dataset
        if "tie_threshold" not in drawn:
            return None
        return np.asarray(drawn["tie_threshold"].values[:, :: self._apart(number)].reshape(-1, 1))

    def side_biases(self, number: int | None = None, *, answerer: str | None = None) -> Float[np.ndarray, "s 1"] | None:
        """What each of S draws adds to the margin of the first shown, as in `likelihood`; None where nothing is known.

        Where the posterior knows answerers by name, nothing is known of any other.
        """
        drawn, apart = self.posterior.children["posterior"].dataset, self._apart(number)
        if "side_bias" not in drawn:
            return None
        bias = drawn["side_bias"]
        if "answerer" in bias.coords:
            if answerer not in bias.coords["answerer"]:
                return None
            bias = bias.sel(answerer=answerer)
        return np.asarray(bias[:, ::apart].values.reshape(-1, 1))

    def utilities(self, states: np.ndarray, *, actions: np.ndarray | None = None) -> Float[np.ndarray, " n"]:
        """The utility of n states, or with the actions that led there of n steps."""
        return self._drawn(self._of_states(states, actions), None)[0]

    def mean_utilities(self, states: np.ndarray) -> Float[np.ndarray, " n"]:
        """The posterior mean of the utility of n states, whichever utility is acted on."""
        parts = np.atleast_2d(self.posterior["utility_weights_mean"]) / self.scales[:, None]
        return replace(self, weights=parts).utilities(states)

    def prior_deviations(self, states: np.ndarray) -> Float[np.ndarray, " n"]:
        """Prior standard deviation of the utility of n states."""
        settings = [self._setting(number)(states) / scale for number, scale in enumerate(self.scales)]
        variances = [np.sum(features**2, axis=1) for features in settings]  # eq. 7: w ~ N(0, σ²I)
        return float(self.posterior.attrs["prior_scale"]) * np.sqrt(np.mean(variances, axis=0))

    def step_utilities(self, steps: Transitions) -> Float[np.ndarray, " n"]:
        """uᵢ = wᵀφ(sᵢ′) (paper, step 2): of the *next* state, as in ψ, and of the effort of the action."""
        return self.utilities(steps.next_states, actions=steps.actions)

    def utilities_and_draws(
        self, states: np.ndarray, *, number: int | None = None, actions: np.ndarray | None = None
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "s n"]]:
        """`utilities` of n states or steps and draws of them, from one evaluation of the features."""
        return self._drawn(self._of_states(states, actions), self._apart(number))

    def trajectory_utilities(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, " n"]:
        """wᵀψ(τ) of each trajectory."""
        return self._drawn(self._of_trajectories(trajectories), None)[0]

    def trajectory_draws(
        self, trajectories: Sequence[Trajectory], *, number: int | None = None
    ) -> Float[np.ndarray, "s n"]:
        """Posterior draws of wᵀψ(τ) of each trajectory, the chains one after the other."""
        return self._drawn(self._of_trajectories(trajectories), self._apart(number))[1]

    def differences(self, trajectories: Sequence[Trajectory]) -> Float[np.ndarray, "c n d"]:
        """ψ(first) − ψ of each trajectory under every setting, in the units of the posterior's differences."""
        sums = sums_under(self.features, self.multiples, trajectories, discount=self.discount)
        # eq. 5
        return np.array([(each[:1] - each[1:]) / scale for each, scale in zip(sums, self.scales, strict=True)])

    def hyperparameters(self) -> dict[str, Any]:
        """Mean and 90 % interval of all that was inferred besides the weights, as plain data.

        Of several answerers the lapse rate is that of `next_lapse_rates`, and the side bias is the mean. The weight of
        the effort is in prior standard deviations, and 0 where it does not count; `effort counts` is the probability
        that it does, where that is inferred.
        """
        drawn = self.posterior.children["posterior"].dataset
        columns = {"lapse_rate": next_lapse_rates(self.posterior).ravel()} | {
            name: drawn[name].values.reshape(drawn["setting"].size, -1).mean(axis=1)
            for name in ("steepness", "tie_threshold", "side_bias")
            if name in drawn
        }
        lengths, told = self.multiples, dict[str, Any]()
        shares = np.bincount(drawn["setting"].values.ravel(), minlength=len(self.scales)) / drawn["setting"].size
        if isinstance(self.features, RadialBasis) and self.features.effort:
            counts = self.features.effort_multiples(self.multiples)
            weight = counts[drawn["setting"].values] * drawn["utility_weights"].values[..., -1]
            columns["effort"] = weight.ravel() / self.posterior.attrs["prior_scale"]
            lengths = lengths[:, : len(self.features.bandwidths)]
            if np.ptp(counts):
                told["effort counts"] = float(shares @ counts)
        figures: dict[str, Any] = {name: float(values.mean()) for name, values in columns.items()}
        figures |= {
            f"{name} {'lower' if quantile < 0.5 else 'upper'}": float(np.quantile(values, quantile))
            for name, values in columns.items()
            for quantile in INTERVAL
        }
        _, which = np.unique(lengths, axis=0, return_inverse=True)
        return figures | {
            "bandwidth_multiples": np.exp(shares @ np.log(lengths)).tolist(),
            "most probable length scales": float(np.bincount(which.ravel(), weights=shares).max()),
            **told,
        }

    def _setting(self, number: int) -> StateFeatures:
        return rescaled(self.features, self.multiples[number])

    def _apart(self, number: int | None) -> int:
        setting = self.posterior.children["posterior"].dataset["setting"]
        return spacing(setting.size, number)

    def _of_states(self, states: np.ndarray, actions: np.ndarray | None) -> Evaluate:
        return lambda settings, weights: values_under(
            self.features, self.multiples[settings], states, weights, actions=actions
        )

    def _of_trajectories(self, trajectories: Sequence[Trajectory]) -> Evaluate:
        def values(settings: np.ndarray, weights: Sequence[np.ndarray]) -> list[np.ndarray]:
            sums = sums_under(self.features, self.multiples[settings], trajectories, discount=self.discount)
            return [linear(each, columns) for each, columns in zip(sums, weights, strict=True)]

        return values

    def _drawn(self, evaluate: Evaluate, apart: int | None) -> tuple[np.ndarray, np.ndarray]:
        """The utility of each of n rows, (n,), and every `apart`-th draw of it, (S, n); None: no draws."""
        drawn = self.posterior.children["posterior"].dataset
        every = slice(0, 0) if apart is None else slice(None, None, apart)
        settings, weights = drawn["setting"].values[:, every], drawn["utility_weights"][:, every].values
        needed = np.union1d(np.flatnonzero(self.weights.any(axis=1)), np.unique(settings)).astype(int)
        needed = needed if len(needed) else np.zeros(1, int)  # a utility of zero has values too
        chosen = [settings == number for number in needed]
        values = evaluate(
            needed,
            [
                np.column_stack([self.weights[number], weights[its].T / self.scales[number]])
                for number, its in zip(needed, chosen, strict=True)
            ],
        )
        draws = np.empty((*settings.shape, len(values[0])))
        for its, columns in zip(chosen, values, strict=True):
            draws[its] = columns[:, 1:].T
        return np.sum([columns[:, 0] for columns in values], axis=0), draws.reshape(settings.size, draws.shape[2])


def spacing(total: int, number: int | None) -> int:
    """Distance between the draws of each chain that leaves about `number` of `total`; 1 for None, which is all."""
    return 1 if number is None else -(-total // checks.whole("number", number))

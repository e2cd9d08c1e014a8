"""The paper's sampler: its draws are the posterior's once it is long enough, and R̂ says when it is not."""

import numpy as np
import pytest

from bayespbrl.models import PreferenceModel, plain_chain, plain_draws
from bayespbrl.models.likelihoods import log_prob
from bayespbrl.settings import Settings
from bayespbrl.utility.inference import Estimation

DIFFERENCES = np.random.default_rng(4).standard_normal((4, 6)) * 0.3
MODEL = PreferenceModel(steepness=3.0)


@pytest.mark.slow
def test_a_long_plain_chain_has_the_posterior_and_a_short_one_says_that_it_has_not():
    prior = np.random.default_rng(0).standard_normal((400_000, 6)) @ DIFFERENCES.T
    log_p = np.asarray(log_prob(MODEL.answer_likelihood(4), prior)).sum(axis=1)
    chances = np.exp(log_p) / np.exp(log_p).sum()
    mean = chances @ prior
    deviation = np.sqrt(chances @ (prior - mean) ** 2)
    long, short = (plain_draws(DIFFERENCES, MODEL, draws=draws, seed=2) for draws in (40_000, 2000))
    margins = np.asarray(long["posterior"]["margins"])
    assert margins.shape == (1, 1000, 4)
    np.testing.assert_allclose(margins.mean(axis=(0, 1)), mean, atol=0.1)
    np.testing.assert_allclose(margins.std(axis=(0, 1)), deviation, atol=0.1)
    assert np.all(mean > 0.15)  # the prior's is zero
    assert long.attrs["log_evidence"] == pytest.approx(np.log(np.mean(np.exp(log_p))), abs=0.2)
    assert (long.attrs["converged"], short.attrs["converged"]) == (1, 0)
    assert short.attrs["effective_sample_size_min"] < 400 < long.attrs["effective_sample_size_min"]
    # rows of zeros change nothing, once they are not counted
    padded = np.vstack([DIFFERENCES, np.zeros((1, 6))])
    same = plain_draws(padded, MODEL, draws=2000, seed=2, number_of_preferences=4)
    np.testing.assert_allclose(same["utility_weights_mean"], short["utility_weights_mean"], atol=1e-9)


@pytest.mark.parametrize("draws", [16, 200, 2000, 2999, 3998, 7998, 200_000])
def test_the_first_half_is_discarded_and_the_kept_draws_are_as_far_apart_as_fit_into_the_second(monkeypatch, draws):
    class Asked(Exception):
        pass

    def asked(state, problem, burn_in, between, *, length):
        raise Asked(burn_in, between, length)

    monkeypatch.setattr(plain_chain, "_moves", asked)
    with pytest.raises(Asked) as raised:
        plain_draws(DIFFERENCES, MODEL, draws=draws, seed=0)
    burn_in, between, length = raised.value.args
    assert burn_in + between * length == draws
    assert length <= 1000
    assert draws / 2 <= burn_in < draws / 2 + between + 1


def test_plain_draws_need_everything_else_given():
    with pytest.raises(
        ValueError, match="plain draws: expected one setting of the length scales, a steepness and a lapse rate, got "
    ):
        plain_draws(DIFFERENCES, PreferenceModel(steepness=None), draws=40, seed=0)
    with pytest.raises(ValueError, match="draws: expected a whole number >= 16"):
        plain_draws(DIFFERENCES, MODEL, draws=10, seed=0)
    with pytest.raises(ValueError, match="hyperparameters: expected 'given' with plain_draws, got 'inferred'"):
        Estimation(plain_draws=200)
    with pytest.raises(ValueError, match="plain_draws: expected numbers as steepness and lapse_rate, got "):
        Settings.from_options("gridworld", {"plain_draws": 200, "hyperparameters": "given", "steepness": None})
    kept = Settings.from_options("gridworld", {"plain_draws": 200, "hyperparameters": "given"})
    assert kept.options()["plain_draws"] == 200

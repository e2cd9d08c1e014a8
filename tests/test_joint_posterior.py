"""The posterior over weights, settings, steepness, lapse rates and tie threshold, against quadrature and simulation."""

import itertools

import numpy as np
import pytest
from scipy.special import expit, logsumexp

from bayespbrl.models import priors, sample_posterior
from bayespbrl.models.convergence import chain_convergence

INFERRED = {"steepness": None, "lapse_rate": None}
SETTINGS = np.array([[[0.9], [0.4], [-0.2], [0.7]], [[0.1], [0.8], [1.3], [-0.3]]])
SAMPLING = {"num_samples": 2000, "seed": 3}


def log_probability(t, *, m, lapse, number, threshold=None, tied=False):
    """Eq. 8 with lapses and ties, written anew."""

    def ordered(t):
        return lapse / 2 + (1 - lapse) * ((number - 1) * (t > 0) + expit(m * t)) / number

    if threshold is None:
        return np.log(ordered(t))
    p = ordered(t + threshold) - ordered(t - threshold) if tied else ordered(t - threshold)
    return np.log(np.maximum(p, 1e-300))


def quadrature(settings, *, tied=None, lapses=priors.LAPSE_RATE, sides=None, answerers=None):
    """Moments under the posterior of a scalar weight and all else, by enumeration, and the log evidence."""
    w = np.linspace(-7, 7, 1401) + 1e-4
    biases = np.linspace(-4, 4, 41) if sides is not None else np.zeros(1)
    number = settings.shape[1]
    tied = np.zeros(number, bool) if tied is None else tied
    answerers = np.zeros(number, int) if answerers is None else answerers
    thresholds = priors.TIE_THRESHOLD if tied.any() else priors.Grid(np.array([np.nan]), np.ones(1))
    log_weights, values = [], []
    for (c, rows), (m, p_m), (d, p_d), b in itertools.product(
        enumerate(settings[:, :, 0]),
        zip(*priors.STEEPNESS, strict=True),
        zip(*thresholds, strict=True),
        biases,
    ):
        margins = w[:, None] * rows + (0 if sides is None else b * priors.SIDE_BIAS_SCALE * sides)
        each = np.array(
            [
                [
                    log_probability(t, m=m, lapse=lapse, number=number, threshold=None if d != d else d, tied=tie)
                    for t, tie in zip(margins.T, tied, strict=True)
                ]
                for lapse in lapses.values
            ]
        )  # (lapse, answer, weight)
        prior = np.log(p_m * p_d / len(settings)) - 0.5 * w**2 - 0.5 * b**2
        for chosen in itertools.product(range(len(lapses.values)), repeat=answerers.max(initial=0) + 1):
            log_p = each[np.array(chosen)[answerers], np.arange(number)].sum(axis=0)
            log_weights.append(prior + log_p + np.log(lapses.probabilities[list(chosen)]).sum())
            first = lapses.values[chosen[0]]
            values.append((c, np.log(m), first, lapses.values[chosen[-1]], d, b * priors.SIDE_BIAS_SCALE))
    log_weights = np.array(log_weights)
    evidence = logsumexp(log_weights) + np.log(w[1] - w[0]) - 0.5 * np.log(2 * np.pi)
    if sides is not None:
        evidence += np.log(biases[1] - biases[0]) - 0.5 * np.log(2 * np.pi)
    p = np.exp(log_weights - logsumexp(log_weights))
    names = ("setting", "log steepness", "lapse rate", "last lapse rate", "tie threshold", "side bias")
    moments = dict(zip(names, p.sum(axis=1) @ np.array(values), strict=True))
    in_setting = np.array([c for c, *_ in values])
    moments |= {"margins": sum(p[in_setting == c].sum(axis=0) @ w * settings[c, :, 0] for c in range(len(settings)))}
    return moments, evidence


def agree(tree, expected):
    drawn = tree["posterior"].dataset
    values = {
        "setting": drawn["setting"].values,
        "log steepness": np.log(drawn["steepness"].values),
        "lapse rate": drawn["lapse_rate"].values[:, :, 0],
        "last lapse rate": drawn["lapse_rate"].values[:, :, -1],
        "margins": drawn["margins"].values,
    }
    values |= {name.replace("_", " "): drawn[name].values for name in ("tie_threshold", "side_bias") if name in drawn}
    if "side_bias" in drawn:  # the margins have the side in them
        values["margins"] = (
            values["margins"] - values["side bias"][..., None] * tree["constant_data/shown_first"].values
        )
    for name, value in values.items():
        value = np.asarray(value, float)
        error = chain_convergence(value).monte_carlo_error
        assert np.all(np.abs(value.mean(axis=(0, 1)) - expected[name]) < 4 * error + 2e-3), name


def test_everything_together_agrees_with_quadrature():
    tree = sample_posterior(SETTINGS, **INFERRED, **SAMPLING)
    expected, evidence = quadrature(SETTINGS)
    agree(tree, expected)
    assert tree.attrs["converged"]
    assert abs(tree.attrs["log_evidence"] - evidence) < 4 * tree.attrs["log_evidence_error"] + 1e-3


@pytest.mark.slow
def test_answers_that_contradict_each_other_agree_with_quadrature_where_expectation_propagation_does_not():
    settings = np.array([[[1.0]] * 4 + [[-1.0]] * 3 + [[0.3]], [[0.2]] * 4 + [[0.4]] * 3 + [[-0.1]]])
    tree = sample_posterior(settings, **INFERRED, **SAMPLING)
    expected, evidence = quadrature(settings)
    agree(tree, expected)
    assert abs(tree.attrs["log_evidence"] - evidence) < 4 * tree.attrs["log_evidence_error"] + 1e-3


@pytest.mark.slow
def test_ties_with_an_unknown_threshold_agree_with_quadrature():
    tied = np.array([False, True, False, False])
    tree = sample_posterior(SETTINGS[:1], **INFERRED, indifferent=tied, **SAMPLING)
    agree(tree, quadrature(SETTINGS[:1], tied=tied)[0])


@pytest.mark.slow
def test_a_side_bias_and_two_answerers_agree_with_quadrature():
    sides, answerers = np.array([1, -1, 1, 1]), np.array([0, 1, 1, 0])
    tree = sample_posterior(SETTINGS[:1], **INFERRED, shown_first=sides, answerers=answerers, **SAMPLING)
    agree(tree, quadrature(SETTINGS[:1], sides=sides, answerers=answerers)[0])

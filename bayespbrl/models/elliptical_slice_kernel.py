"""The NumPyro kernel of elliptical slice sampling, for any model with Gaussian latent sites."""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import Array, random
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, PRNGKeyArray, Shaped
from numpyro.handlers import seed, substitute, trace
from numpyro.infer import init_to_sample
from numpyro.infer.inspect import get_dependencies
from numpyro.infer.mcmc import MCMCKernel
from numpyro.infer.util import compute_log_probs
from numpyro.util import is_prng_key

from bayespbrl import checks
from bayespbrl.models.elliptical_slice import Ellipse, elliptical_moves

GAUSSIANS = (dist.Normal, dist.MultivariateNormal, dist.LowRankMultivariateNormal, dist.GaussianRandomWalk)
SiteValues = dict[str, Array]  # of the latent sites, by their names
Sites = dict[str, dict[str, Any]]  # a trace of a NumPyro model
Args = tuple[Any, ...]  # of the model: whatever it takes
Keywords = dict[str, Any]


class EllipticalSliceState(NamedTuple):
    """State of the chain, or of several side by side.

    Attributes:
      z: the latent sites' values.
      log_likelihood: log p(observed | z).
      candidates: angles tried per move, in the mean over the draw's moves.
      stuck: whether a move of this draw found no acceptable angle before its cap, and stayed where it was.
      diverging: whether the likelihood is zero or not a number at z. Collected like that of NUTS, so that ArviZ shows a
        model whose likelihood is so everywhere.
      rng_key: key of the next draw.
    """

    z: SiteValues
    log_likelihood: Float[Array, "*chains"]
    candidates: Float[Array, "*chains"]
    stuck: Bool[Array, "*chains"]
    diverging: Bool[Array, "*chains"]
    rng_key: Shaped[Array, "*chains_and_words"]


class EllipticalSlice(MCMCKernel):  # type: ignore[misc]  # NumPyro is untyped
    """Elliptical slice sampling of all latent sites of a NumPyro model at once.

    The latent sites must have Gaussian priors (Normal, MultivariateNormal, LowRankMultivariateNormal,
    GaussianRandomWalk, expanded or `to_event`) that do not depend on other latent sites; the likelihood may be
    anything, also discontinuous. There is nothing to tune. Composes with `numpyro.infer.Gibbs`: condition on scales and
    sample them by another block.

        mcmc = MCMC(EllipticalSlice(model), num_warmup=500, num_samples=1000)

    It is not `numpyro.infer.ESS`, the *ensemble* slice sampler.

    Args:
      model: a NumPyro model.
      moves: moves around an ellipse per recorded draw.
      batch: candidate points evaluated at once; more where evaluations are cheap. The law of the draws is the same.
      max_candidates: cap on the candidates of a move, rounded up to whole batches; a move that meets it stays and the
        state says `stuck`.
      reference: (mean (n,), covariance (n, n)) of a Gaussian over the latent sites, flattened in the order of their
        sorted names. Half of the moves, at least one, then go round its ellipses and the rest, at least one, round the
        prior's, because chains of a narrower reference stick in the tails. The covariance must be positive definite.
      ellipses: (model_args, model_kwargs) ↦ [(Ellipse, moves), ...], instead of those made from the model. For models
        that know a cheaper residual; the caller ensures that it is the model's density.
      log_likelihood: (z, model_args, model_kwargs) ↦ the state's log likelihood, where that is cheaper than the model.
    """

    sample_field: str = "z"

    def __init__(
        self,
        model: Callable[..., Any],
        *,
        moves: int = 1,
        batch: int = 4,
        max_candidates: int = 200,
        reference: tuple[ArrayLike, ArrayLike] | None = None,
        ellipses: Callable[[Args, Keywords], Sequence[tuple[Ellipse, int]]] | None = None,
        log_likelihood: Callable[[SiteValues, Args, Keywords], Float[Array, ""]] | None = None,
    ) -> None:
        self._model = model
        self._moves, self._batch = checks.whole("moves", moves), checks.whole("batch", batch)
        self._max_candidates = checks.whole("max_candidates", max_candidates)
        self._reference = None if reference is None else _checked_reference(*reference)
        self._ellipses = ellipses
        self._log_likelihood = log_likelihood or self._model_log_likelihood
        # numpyro.infer.MCMC initialises a kernel again on every run where this is missing
        self._sample_fn = self._one_draw

    @property
    def model(self) -> Callable[..., Any]:
        """The NumPyro model."""
        return self._model

    @property
    def default_fields(self) -> tuple[str, ...]:
        """Fields collected without asking."""
        return ("z", "diverging")

    def get_diagnostics_str(self, state: EllipticalSliceState) -> str:
        """The text beside NumPyro's progress bar."""
        return f"{float(state.candidates):.1f} candidates a move"

    def init(
        self,
        rng_key: Shaped[Array, "..."],
        num_warmup: int,
        init_params: Mapping[str, ArrayLike] | None,
        model_args: Args = (),
        model_kwargs: Keywords | None = None,
    ) -> EllipticalSliceState:
        """State at `init_params` (values of latent sites), and at a draw from the prior for all other sites."""
        model_kwargs = {} if model_kwargs is None else model_kwargs
        if not is_prng_key(rng_key):
            return jax.vmap(lambda key, params: self.init(key, num_warmup, params, model_args, model_kwargs))(
                rng_key, init_params
            )
        key_model, key_state = random.split(rng_key)
        sites = self._trace(key_model, {}, model_args, model_kwargs)
        self._check(sites, model_args, model_kwargs)
        z = {name: site["value"] for name, site in sites.items() if _is_latent(site)}
        size = sum(jnp.size(value) for value in z.values())
        if self._reference is not None and (known := np.size(self._reference[0])) != size:
            raise ValueError(f"reference: expected a mean of the model's {size} values, got {known}")
        given = dict(init_params or {})
        if not set(given) <= set(z):
            raise ValueError(f"init_params: expected names among {sorted(z)}, got {sorted(given)}")
        for name, value in given.items():
            if jnp.shape(value) != jnp.shape(z[name]):
                raise ValueError(
                    f"init_params: expected shape {jnp.shape(z[name])} for {name!r}, got {jnp.shape(value)}"
                )
            z[name] = jnp.asarray(value, dtype=z[name].dtype)
        log_likelihood = self._log_likelihood(z, model_args, model_kwargs)
        one = jnp.ones_like(log_likelihood)
        no = jnp.zeros((), bool)
        return EllipticalSliceState(z, log_likelihood, one, no, ~jnp.isfinite(log_likelihood), key_state)

    def sample(
        self, state: EllipticalSliceState, model_args: Args = (), model_kwargs: Keywords | None = None
    ) -> EllipticalSliceState:
        """One draw: all moves round all ellipses. A batch of keys means a batch of chains."""
        model_kwargs = {} if model_kwargs is None else model_kwargs
        if not is_prng_key(state.rng_key):
            return jax.vmap(lambda one: self._sample_fn(one, model_args, model_kwargs))(state)
        return self._sample_fn(state, model_args, model_kwargs)

    def _one_draw(self, state: EllipticalSliceState, model_args: Args, model_kwargs: Keywords) -> EllipticalSliceState:
        key, *keys = random.split(state.rng_key, 3)
        x, unravel = ravel_pytree(state.z)
        ellipses = (
            self._model_ellipses(x, unravel, keys[1], model_args, model_kwargs)
            if self._ellipses is None
            else self._ellipses(model_args, model_kwargs)
        )
        tried, stuck, total = jnp.zeros((), int), jnp.zeros((), bool), sum(moves for _, moves in ellipses)
        for subkey, (ellipse, moves) in zip(random.split(keys[0], len(ellipses)), ellipses, strict=True):
            x, more, failed = elliptical_moves(
                subkey, x, ellipse, moves=moves, batch=self._batch, max_candidates=self._max_candidates
            )
            tried, stuck = tried + more, stuck | failed
        z = unravel(x)
        log_likelihood = self._log_likelihood(z, model_args, model_kwargs).astype(state.log_likelihood.dtype)
        candidates = (tried / total).astype(state.candidates.dtype)
        return EllipticalSliceState(z, log_likelihood, candidates, stuck, ~jnp.isfinite(log_likelihood), key)

    def _model_ellipses(
        self,
        x: Float[Array, " n"],
        unravel: Callable[[Float[Array, " n"]], SiteValues],
        key: PRNGKeyArray,
        model_args: Args,
        model_kwargs: Keywords,
    ) -> list[tuple[Ellipse, int]]:
        """The prior's ellipse and, where there is one, the reference's, with residuals evaluated by the model."""
        sites = self._trace(key, unravel(x), model_args, model_kwargs)
        latent = {name: site["fn"] for name, site in sites.items() if _is_latent(site)}
        centre, _ = ravel_pytree({name: jnp.broadcast_to(fn.mean, fn.shape()) for name, fn in latent.items()})
        centre = centre.astype(x.dtype)

        def prior_noise(key: PRNGKeyArray, moves: int) -> Float[Array, "{moves} n"]:
            def one(key: PRNGKeyArray) -> Float[Array, " n"]:
                keys = dict(zip(latent, random.split(key, len(latent)), strict=True))
                return ravel_pytree({name: fn.sample(keys[name]) for name, fn in latent.items()})[0]

            return jax.vmap(one)(random.split(key, moves)).astype(x.dtype) - centre

        def log_likelihood(v: Float[Array, " n"]) -> Float[Array, ""]:
            return self._log_probs(unravel(centre + v), model_args, model_kwargs)[1]

        prior = Ellipse(lambda x: x - centre, prior_noise, jax.vmap(log_likelihood), lambda v: centre + v)
        if self._reference is None:
            return [(prior, self._moves)]
        mean, covariance = (jnp.asarray(part, dtype=x.dtype) for part in self._reference)
        root = jnp.linalg.cholesky(covariance)

        def residual(v: Float[Array, " n"]) -> Float[Array, ""]:
            # log prior × likelihood / reference, up to a constant (Nishihara, Murray & Adams 2014, section 3)
            log_prior, log_likelihood = self._log_probs(unravel(mean + root @ v), model_args, model_kwargs)
            return log_prior + log_likelihood + 0.5 * jnp.sum(v**2)

        reference = Ellipse(
            lambda x: jax.scipy.linalg.solve_triangular(root, x - mean, lower=True),
            lambda key, moves: random.normal(key, (moves, len(mean)), dtype=x.dtype),
            jax.vmap(residual),
            lambda v: mean + root @ v,
        )
        return [(reference, max(self._moves // 2, 1)), (prior, self._moves - self._moves // 2)]

    def _trace(self, key: PRNGKeyArray, values: SiteValues, model_args: Args, model_kwargs: Keywords) -> Sites:
        model = substitute(substitute(seed(self._model, key), substitute_fn=init_to_sample), data=values)
        sites: Sites = trace(model).get_trace(*model_args, **model_kwargs)
        return sites

    def _log_probs(
        self, z: SiteValues, model_args: Args, model_kwargs: Keywords
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """log prior and log likelihood at z; the constants of the prior are left in."""
        # the key is never used: every latent site is substituted
        model = seed(self._model, random.key(0))
        parts, sites = compute_log_probs(model, model_args, model_kwargs, z)
        zero = jnp.zeros((), ravel_pytree(z)[0].dtype)
        prior = sum((value for name, value in parts.items() if _is_latent(sites[name], z)), zero)
        return prior, sum((value for name, value in parts.items() if not _is_latent(sites[name], z)), zero)

    def _model_log_likelihood(self, z: SiteValues, model_args: Args, model_kwargs: Keywords) -> Float[Array, ""]:
        return self._log_probs(z, model_args, model_kwargs)[1]

    def _check(self, sites: Sites, model_args: Args, model_kwargs: Keywords) -> None:
        """Check that latent sites are Gaussian, unscaled, unmasked and independent, and that no plate is subsampled."""
        latent = [name for name, site in sites.items() if _is_latent(site)]
        if not latent:
            raise ValueError(f"model: expected at least one latent sample site, got {sorted(sites) or 'no site'}")
        for name, site in sites.items():
            if site["type"] == "plate" and (used := len(site["value"])) != site["args"][0]:
                raise ValueError(
                    f"model: expected whole plates, got {used} of {site['args'][0]} rows in plate {name!r}"
                )
        for name in latent:
            fn = sites[name]["fn"]
            while isinstance(fn, dist.ExpandedDistribution | dist.Independent):
                fn = fn.base_dist
            if not isinstance(fn, GAUSSIANS):
                raise ValueError(
                    f"model: expected Gaussian latent sites, got {type(fn).__name__} at site {name!r}; "
                    "sample such sites with another block of numpyro.infer.Gibbs"
                )
            if sites[name]["scale"] is not None:
                raise ValueError(f"model: expected latent sites without a scale, got one at site {name!r}")
        dependencies = get_dependencies(self._model, model_args, model_kwargs)["prior_dependencies"]
        for name in latent:
            others = sorted(set(dependencies[name]) & set(latent) - {name})
            if others:
                raise ValueError(
                    f"model: expected latent sites independent a priori, got {name!r} depending on {others}; "
                    "reparametrise, or sample them with different blocks of numpyro.infer.Gibbs"
                )
        self._check_steps(latent, model_args, model_kwargs)

    def _check_steps(self, latent: Sequence[str], model_args: Args, model_kwargs: Keywords) -> None:
        """Check that no latent site of a `scan` depends on its own earlier steps: the dependencies see one site."""
        first, second = (self._trace(random.key(number), {}, model_args, model_kwargs) for number in (0, 1))
        for name in latent:
            parameters = zip(jax.tree.leaves(first[name]["fn"]), jax.tree.leaves(second[name]["fn"]), strict=True)
            if not all(isinstance(one, jax.core.Tracer) or np.array_equal(one, other) for one, other in parameters):
                raise ValueError(
                    f"model: expected latent sites independent a priori, got {name!r}, whose prior changes with "
                    "the draw; in a scan, sample the increments and add them up"
                )

    def postprocess_fn(self, model_args: Args, model_kwargs: Keywords | None) -> Callable[[SiteValues], SiteValues]:
        """From the latent sites to these and the model's deterministic ones."""

        def fn(z: SiteValues) -> SiteValues:
            model = substitute(seed(self._model, random.key(0)), data=z)
            sites = trace(model).get_trace(*model_args, **(model_kwargs or {}))
            found = {name: site["value"] for name, site in sites.items() if site["type"] == "deterministic"}
            return {**z, **found}

        return fn

    def get_constrain_fn(self, model_args: Args, model_kwargs: Keywords | None) -> Callable[[SiteValues], SiteValues]:
        """Gaussian sites are unconstrained: the identity."""
        return lambda z: z

    def refresh(
        self, state: EllipticalSliceState, model_args: Args, model_kwargs: Keywords | None
    ) -> EllipticalSliceState:
        """The log likelihood at z under new model arguments or conditioning values."""
        log_likelihood = self._log_likelihood(state.z, model_args, model_kwargs or {})
        return state._replace(log_likelihood=log_likelihood, diverging=~jnp.isfinite(log_likelihood))

    def wrap_model(self, wrapper: Callable[[Callable[..., Any]], Callable[..., Any]]) -> "EllipticalSlice":
        """A copy of this kernel with another model; `ValueError` where it has ellipses of the caller's."""
        if self._ellipses is not None:
            raise ValueError(f"ellipses: expected None of a kernel that changes its model, got {self._ellipses}")
        kernel = copy.copy(self)
        kernel._model = wrapper(self._model)
        kernel._sample_fn, kernel._log_likelihood = kernel._one_draw, kernel._model_log_likelihood
        return kernel


def _checked_reference(mean: ArrayLike, covariance: ArrayLike) -> tuple[ArrayLike, ArrayLike]:
    """The reference's mean and covariance; `ValueError` unless the covariance fits and is positive definite."""
    if any(isinstance(part, jax.core.Tracer) for part in (mean, covariance)):
        return mean, covariance  # within a compiled function there are no values to look at
    mean, covariance = np.asarray(mean, dtype=np.float64), checks.matrix("reference", covariance)
    checks.finite("reference", mean)
    if mean.ndim != 1 or covariance.shape != (len(mean), len(mean)):
        raise ValueError(f"reference: expected shapes (n,) and (n, n), got {mean.shape} and {covariance.shape}")
    try:
        if not np.allclose(covariance, covariance.T):
            raise np.linalg.LinAlgError
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh((covariance + covariance.T) / 2)[0]
        raise ValueError(
            f"reference: expected a symmetric positive definite covariance, got one whose smallest eigenvalue is "
            f"{smallest:.3g}"
        ) from None
    return mean, covariance


def _is_latent(site: dict[str, Any], z: SiteValues | None = None) -> bool:
    """A sample site that is not observed; once its value is substituted, one of the names in `z`."""
    if site["type"] != "sample":
        return False
    return site["name"] in z if z is not None else not site["is_observed"]

"""Elliptical slice sampling for any NumPyro model with Gaussian latent sites (Murray, Adams & MacKay 2010).

A draw is one or more moves x ← c + (x − c) cos α + (ν − c) sin α round an ellipse through the current point and a
fresh Gaussian ν. With the model's prior as that Gaussian the slice is one of the likelihood; with any other Gaussian
reference it is one of prior × likelihood / reference, and still exact (Nishihara, Murray & Adams 2014).
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax import lax, random
from jax.flatten_util import ravel_pytree
from numpyro.handlers import seed, substitute, trace
from numpyro.infer import init_to_sample
from numpyro.infer.inspect import get_dependencies
from numpyro.infer.mcmc import MCMCKernel
from numpyro.infer.util import compute_log_probs
from numpyro.util import is_prng_key

# So many batches of candidate angles are drawn for all moves at once; a move that needs more draws them itself, with a
# random generator in its inner loop.
BATCHES_AHEAD = 2
GAUSSIANS = (dist.Normal, dist.MultivariateNormal, dist.LowRankMultivariateNormal, dist.GaussianRandomWalk)


class EllipticalSliceState(NamedTuple):
    """State of the chain.

    Attributes:
      z: the latent sites' values.
      log_likelihood: log p(observed | z).
      candidates: angles tried per move, in the mean over the draw's moves.
      stuck: whether a move of this draw found no acceptable angle before its cap, and stayed where it was.
      rng_key: key of the next draw.
    """

    z: dict[str, jax.Array]
    log_likelihood: jax.Array
    candidates: jax.Array
    stuck: jax.Array
    rng_key: jax.Array


class Ellipse(NamedTuple):
    """A Gaussian to draw ellipses from, and the residual to slice, in coordinates v linear in the displacement x − c.

    Whatever the residual needs that is linear in x (margins, whitened coordinates) is part of v, so that a move costs
    only vector arithmetic: v ← v cos α + v′ sin α.

    Attributes:
      lift: x ↦ v.
      noise: (key, moves) ↦ v′ of fresh draws of the Gaussian, shape (moves, ...).
      residual: v of shape (J, ...) ↦ log(target / Gaussian) at each, shape (J,).
      lower: v ↦ x.
    """

    lift: Callable[[jax.Array], jax.Array]
    noise: Callable[[jax.Array, int], jax.Array]
    residual: Callable[[jax.Array], jax.Array]
    lower: Callable[[jax.Array], jax.Array]


def shrink(angle: jax.Array, low: jax.Array, high: jax.Array, uniforms: jax.Array) -> tuple[jax.Array, ...]:
    """The next candidate angles if `angle` and all that follow are rejected: the bracket shrinks towards 0 each time.

    Which angles come next does not depend on the density, only whether they are needed does: they can be drawn ahead.

    Args:
      angle, low, high: rejected angle and its bracket, shapes (...).
      uniforms: shape (..., J).

    Returns:
      angles of shape (..., J), and the bracket within which the last was drawn.
    """

    # a loop rather than unrolled: the compiler would fuse the steps into each other, again and again
    def step(bracket, uniform):
        angle, low, high = bracket
        low, high = jnp.where(angle < 0, angle, low), jnp.where(angle < 0, high, angle)
        angle = low + (high - low) * uniform
        return (angle, low, high), angle

    (_, low, high), angles = lax.scan(step, (angle, low, high), jnp.moveaxis(uniforms, -1, 0))
    return jnp.moveaxis(angles, 0, -1), low, high


def elliptical_moves(
    key: jax.Array, x: jax.Array, ellipse: Ellipse, *, moves: int, batch: int, max_candidates: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`moves` elliptical slice steps from `x`; the new x, the number of candidates tried, and whether any got stuck.

    `batch` candidates are evaluated at once, `max_candidates` at most, rounded up to whole batches; a move without an
    acceptable one stays.
    """
    ahead = min(BATCHES_AHEAD, -(-max_candidates // batch))
    key_noise, key_uniform, key_more = random.split(key, 3)
    v = ellipse.lift(x)
    noise = ellipse.noise(key_noise, moves)
    uniforms = random.uniform(key_uniform, (moves, ahead * batch + 1), dtype=x.dtype)
    heights = jnp.log(uniforms[:, 0])
    first = 2 * jnp.pi * uniforms[:, 1]
    rest, low, high = shrink(first, first - 2 * jnp.pi, first, uniforms[:, 2:])
    angles = jnp.concatenate([first[:, None], rest], axis=1).reshape(moves, ahead, batch)
    brackets = jnp.stack([angles[:, -1, -1], low, high], axis=1)
    keys = random.split(key_more, moves)

    # One loop over the batches of all moves, not a loop of loops: where chains run side by side, none waits for the
    # slowest at every move, only at the end.
    def evaluate(walk: _Walk) -> _Walk:
        candidates, bracket = _next_candidates(walk, angles, brackets, keys)
        axes = (slice(None),) + (None,) * v.ndim
        fresh = noise[walk.move]
        values = ellipse.residual(walk.v * jnp.cos(candidates)[axes] + fresh * jnp.sin(candidates)[axes])
        # NaN compares as false, so that a NaN candidate is rejected
        accepted = values > walk.value + heights[walk.move]
        first_accepted, found = jnp.argmax(accepted), jnp.any(accepted)
        failed = ~found & ((walk.batches + 1) * batch >= max_candidates)
        angle = jnp.where(found, candidates[first_accepted], 0.0)
        return _Walk(
            v=walk.v * jnp.cos(angle) + fresh * jnp.sin(angle),
            value=jnp.where(found, values[first_accepted], walk.value),
            move=walk.move + (found | failed),
            batches=jnp.where(found | failed, 0, walk.batches + 1),
            bracket=bracket,
            tried=walk.tried + jnp.where(found, first_accepted + 1, batch),
            stuck=walk.stuck | failed,
        )

    # a current point that is impossible or NaN is left for any that is possible
    value = ellipse.residual(v[None])[0]
    value = jnp.where(value > -jnp.inf, value, -jnp.inf)
    zero = jnp.zeros((), int)
    start = _Walk(v, value, zero, zero, brackets[0], zero, jnp.zeros((), bool))
    end = lax.while_loop(lambda walk: walk.move < moves, evaluate, start)
    return ellipse.lower(end.v), end.tried, end.stuck


class _Walk(NamedTuple):
    """Where a chain is within its moves: the point v and its residual, the move, the batches of candidates that this
    move has seen, the bracket (last angle, low, high) beyond those drawn ahead, the candidates tried by all moves, and
    whether any move found none to accept."""

    v: jax.Array
    value: jax.Array
    move: jax.Array
    batches: jax.Array
    bracket: jax.Array
    tried: jax.Array
    stuck: jax.Array


def _next_candidates(
    walk: _Walk, angles: jax.Array, brackets: jax.Array, keys: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The next batch of angles of the walk's move: drawn ahead, or now where those are used up; and the bracket."""
    _, ahead, batch = angles.shape

    def draw(state):
        _, bracket, wanted = state
        last, low, high = jnp.where(wanted == ahead, brackets[walk.move], bracket)
        uniforms = random.uniform(random.fold_in(keys[walk.move], wanted * batch), (batch,), dtype=low.dtype)
        candidates, low, high = shrink(last, low, high, uniforms)
        return candidates, jnp.stack([candidates[-1], low, high]), -jnp.ones_like(wanted)

    # A loop that runs once or not at all: a conditional, in a batch of chains, would draw in any case. What it draws
    # from is part of its state, or the compiler would move the drawing before the loop.
    prepared = angles[walk.move, jnp.minimum(walk.batches, ahead - 1)]
    start = (prepared, walk.bracket, jnp.where(walk.batches < ahead, -1, walk.batches))
    candidates, bracket, _ = lax.while_loop(lambda state: state[2] >= 0, draw, start)
    return candidates, bracket


class EllipticalSlice(MCMCKernel):
    """Elliptical slice sampling of all latent sites of a NumPyro model at once.

    The latent sites must have Gaussian priors (Normal, MultivariateNormal, LowRankMultivariateNormal,
    GaussianRandomWalk, expanded or `to_event`) that do not depend on other latent sites; the likelihood may be
    anything, also discontinuous.
    There is nothing to tune. Composes with `numpyro.infer.Gibbs`: condition on scales and sample them by another block.

        mcmc = MCMC(EllipticalSlice(model), num_warmup=500, num_samples=1000)

    It is not `numpyro.infer.ESS`, the *ensemble* slice sampler.

    Args:
      model: a NumPyro model.
      moves: moves round an ellipse per recorded draw.
      batch: candidate points evaluated at once; more where evaluations are cheap. The law of the draws is the same.
      max_candidates: cap on the candidates of a move, rounded up to whole batches; a move that meets it stays and the
        state says `stuck`.
      reference: (mean (n,), covariance (n, n)) of a Gaussian over the latent sites, flattened in the order of their
        sorted names. Half of the moves, at least one, then go round its ellipses and the rest, at least one, round the
        prior's, whose tails no narrower reference can be trusted with.
      ellipses: (model_args, model_kwargs) ↦ [(Ellipse, moves), ...], instead of those made from the model. For models
        that know a cheaper residual; it is on the caller that it is the model's density.
      log_likelihood: (z, model_args, model_kwargs) ↦ the state's log likelihood, where that is cheaper than the model.
    """

    sample_field: str = "z"

    def __init__(
        self,
        model: Callable,
        *,
        moves: int = 1,
        batch: int = 4,
        max_candidates: int = 200,
        reference: tuple[Any, Any] | None = None,
        ellipses: Callable[[tuple, dict], Sequence[tuple[Ellipse, int]]] | None = None,
        log_likelihood: Callable[[dict, tuple, dict], jax.Array] | None = None,
    ) -> None:
        for name, value in (("moves", moves), ("batch", batch), ("max_candidates", max_candidates)):
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name}: expected an integer >= 1, got {value!r}")
        self._model = model
        self._moves, self._batch, self._max_candidates = moves, batch, max_candidates
        self._reference, self._ellipses = reference, ellipses
        self._log_likelihood = log_likelihood or self._model_log_likelihood
        # numpyro.infer.MCMC initialises a kernel again on every run where this is missing
        self._sample_fn = self._one_draw

    @property
    def model(self) -> Callable:
        """The NumPyro model."""
        return self._model

    @property
    def default_fields(self) -> tuple[str, ...]:
        """Fields collected without asking."""
        return ("z",)

    def get_diagnostics_str(self, state: EllipticalSliceState) -> str:
        """For the progress bar."""
        return f"{float(state.candidates):.1f} candidates a move"

    def init(self, rng_key, num_warmup, init_params, model_args=(), model_kwargs=None):
        """State at `init_params` (values of latent sites), and at a draw from the prior where they say nothing."""
        model_kwargs = {} if model_kwargs is None else model_kwargs
        if not is_prng_key(rng_key):
            return jax.vmap(lambda key, params: self.init(key, num_warmup, params, model_args, model_kwargs))(
                rng_key, init_params
            )
        key_model, key_state = random.split(rng_key)
        sites = self._trace(key_model, {}, model_args, model_kwargs)
        self._check(sites, model_args, model_kwargs)
        z = {name: site["value"] for name, site in sites.items() if _is_latent(site)}
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
        return EllipticalSliceState(z, log_likelihood, one, jnp.zeros((), bool), key_state)

    def sample(self, state, model_args=(), model_kwargs=None):
        """One draw: all moves round all ellipses. A batch of keys means a batch of chains."""
        model_kwargs = {} if model_kwargs is None else model_kwargs
        if not is_prng_key(state.rng_key):
            return jax.vmap(lambda one: self._sample_fn(one, model_args, model_kwargs))(state)
        return self._sample_fn(state, model_args, model_kwargs)

    def _one_draw(self, state, model_args, model_kwargs):
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
        return EllipticalSliceState(
            z,
            self._log_likelihood(z, model_args, model_kwargs).astype(state.log_likelihood.dtype),
            (tried / total).astype(state.candidates.dtype),
            stuck,
            key,
        )

    def _model_ellipses(self, x, unravel, key, model_args, model_kwargs):
        """The prior's ellipse and, where there is one, the reference's, with residuals evaluated by the model."""
        sites = self._trace(key, unravel(x), model_args, model_kwargs)
        latent = {name: site["fn"] for name, site in sites.items() if _is_latent(site)}
        centre, _ = ravel_pytree({name: jnp.broadcast_to(fn.mean, fn.shape()) for name, fn in latent.items()})
        centre = centre.astype(x.dtype)

        def prior_noise(key, moves):
            def one(key):
                keys = dict(zip(latent, random.split(key, len(latent)), strict=True))
                return ravel_pytree({name: fn.sample(keys[name]) for name, fn in latent.items()})[0]

            return jax.vmap(one)(random.split(key, moves)).astype(x.dtype) - centre

        def log_likelihood(v):
            return self._log_probs(unravel(centre + v), model_args, model_kwargs)[1]

        prior = Ellipse(lambda x: x - centre, prior_noise, jax.vmap(log_likelihood), lambda v: centre + v)
        if self._reference is None:
            return [(prior, self._moves)]
        mean, covariance = (jnp.asarray(part, dtype=x.dtype) for part in self._reference)
        root = jnp.linalg.cholesky(covariance)

        def residual(v):
            log_prior, log_likelihood = self._log_probs(unravel(mean + root @ v), model_args, model_kwargs)
            return log_prior + log_likelihood + 0.5 * jnp.sum(v**2)

        reference = Ellipse(
            lambda x: jax.scipy.linalg.solve_triangular(root, x - mean, lower=True),
            lambda key, moves: random.normal(key, (moves, len(mean)), dtype=x.dtype),
            jax.vmap(residual),
            lambda v: mean + root @ v,
        )
        return [(reference, max(self._moves // 2, 1)), (prior, self._moves - self._moves // 2)]

    def _trace(self, key, values, model_args, model_kwargs):
        model = substitute(substitute(seed(self._model, key), substitute_fn=init_to_sample), data=values)
        return trace(model).get_trace(*model_args, **model_kwargs)

    def _log_probs(self, z, model_args, model_kwargs):
        """log prior and log likelihood at z; the constants of the prior are left in."""
        # the key is never used: every latent site is substituted
        model = seed(self._model, random.key(0))
        parts, sites = compute_log_probs(model, model_args, model_kwargs, z)
        zero = jnp.zeros((), ravel_pytree(z)[0].dtype)
        prior = sum((value for name, value in parts.items() if _is_latent(sites[name], z)), zero)
        return prior, sum((value for name, value in parts.items() if not _is_latent(sites[name], z)), zero)

    def _model_log_likelihood(self, z, model_args, model_kwargs):
        return self._log_probs(z, model_args, model_kwargs)[1]

    def _check(self, sites, model_args, model_kwargs):
        """Every latent site is Gaussian, unscaled, unmasked and independent of the others, or there is an error."""
        latent = [name for name, site in sites.items() if _is_latent(site)]
        if not latent:
            raise ValueError("model: expected at least one latent sample site, got none")
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

    def postprocess_fn(self, model_args, model_kwargs):
        """Latent sites and the model's deterministic ones."""

        def fn(z):
            sites = trace(substitute(seed(self._model, random.key(0)), data=z)).get_trace(
                *model_args, **(model_kwargs or {})
            )
            found = {name: site["value"] for name, site in sites.items() if site["type"] == "deterministic"}
            return {**z, **found}

        return fn

    def get_constrain_fn(self, model_args, model_kwargs):
        """Gaussian sites are unconstrained: the identity."""
        return lambda z: z

    def refresh(self, state, model_args, model_kwargs):
        """The log likelihood at z under new model arguments or conditioning values."""
        return state._replace(log_likelihood=self._log_likelihood(state.z, model_args, model_kwargs or {}))

    def wrap_model(self, wrapper):
        """A copy of this kernel with another model; ellipses made by hand for the old one do not survive."""
        if self._ellipses is not None:
            raise ValueError("ellipses: a kernel with its own ellipses cannot follow another model")
        kernel = copy.copy(self)
        kernel._model = wrapper(self._model)
        kernel._sample_fn, kernel._log_likelihood = kernel._one_draw, kernel._model_log_likelihood
        return kernel


def _is_latent(site: dict, z: dict | None = None) -> bool:
    """A sample site that is not observed; once its value is substituted, one of the names in `z`."""
    if site["type"] != "sample":
        return False
    return site["name"] in z if z is not None else not site["is_observed"]

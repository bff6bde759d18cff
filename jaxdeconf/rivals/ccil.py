"""Masks by intervention: CCIL (de Haan, Jayaraman & Levine 2019, arXiv 1905.11979).

A graph G in {0, 1}^O says which latents a policy may use. One policy is trained for all graphs at
once, `f([z * G, G])`, with G drawn anew for each sample. Then a graph is chosen: by what the expert
answers in states that the policy came to under random graphs (query), or by the returns of episodes
under some (return). Behind the mask the method clones as Masked does: cloning f itself, the paper's
form, lacks what the latents lack. Shapes: N episodes, T steps, n samples, L frames, O active
latents, M graphs, R rollouts, A action.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf.demos import Demos
from jaxdeconf.keys import named
from jaxdeconf.learn import disentangle
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import FitConfig, FitState, Loss, Training, Variables, start
from jaxdeconf.method import Ask, Evidence, Method, Price, masked
from jaxdeconf.nets import mlp, vae
from jaxdeconf.vision import raster

_LISTED = 12  # latents up to which every graph is scored; of more, as many graphs at random
_DISAGREEING = 64  # graphs whose predictions say where the expert is asked

Select = Callable[[Callable[[], Demos], Evidence, Ask], Array]


@dataclass(frozen=True)
class CcilConfig:
    """What the choice of a graph costs; ours, but for the rounds and the temperature."""

    hidden: tuple[int, ...] = (256, 256)  # the paper's has 50, on 3 numbers
    steps: int = 3000
    batch_size: int = 256
    rollouts: int = 25  # the paper has 1: of CartPole's returns that is noise
    queries: int = 500  # answers of the expert
    rounds: int = 20  # graphs whose returns are seen; the paper's
    temperature: float = 10.0  # of their choice; the paper's


class Samples(NamedTuple):
    """What the policy of all graphs learns."""

    latents: Array  # [n, L, O], the present frame's last
    actions: Array  # [n, A] over the limit


def predict(layers: mlp.Layers, latents: Array, graph: Array) -> Array:
    """[..., A] the policy's actions for latents [..., L, O] under graphs [..., O] of 0 and 1."""
    given = latents * graph[..., None, :]
    return mlp.apply(layers, jnp.concatenate([given.reshape(*graph.shape[:-1], -1), graph], -1))


def objective(_: FitConfig) -> Loss:
    """The squared error of the action under a random graph a sample."""

    def loss(variables: Variables, data: Samples, indices: Array, key: Array, step: Array):
        latents = data.latents[indices]
        shape = latents.shape[0], latents.shape[2]
        graph = jax.random.bernoulli(key, 0.5, shape).astype(latents.dtype)
        predicted = predict(variables["params"], latents, graph)
        return jnp.mean((predicted - data.actions[indices]) ** 2), ({}, {})

    return loss


def training(samples: Samples, config: CcilConfig, key: Array, made_from: Any = None) -> Training:
    """The training of the policy of all graphs, not yet begun."""
    count, frames, size = samples.latents.shape
    fit = FitConfig(steps=config.steps, batch_size=min(config.batch_size, count), decay=0.1)
    sizes = (frames + 1) * size, *config.hidden, samples.actions.shape[1]

    def begin(_: Samples) -> FitState:
        layers = mlp.init(named(key, "CCIL initial weights"), sizes)
        return start({"params": layers, "batch_stats": {}})

    def trained(state: FitState) -> mlp.Layers:
        return state.variables["params"]

    shuffles = named(key, "CCIL training")
    return Training(objective, fit, count, shuffles, lambda: samples, begin, trained, made_from)


def graphs(size: int, key: Array) -> Array:
    """[M, O] every graph of so many latents, or a random choice of them."""
    if size <= _LISTED:
        return (jnp.arange(2**size)[:, None] >> jnp.arange(size)) % 2 * 1.0
    return jax.random.bernoulli(key, 0.5, (2**_LISTED, size)) * 1.0


class Answered(NamedTuple):
    """What the expert's answers say of each graph."""

    graphs: Array  # [M, O] of 0 and 1
    errors: Array  # [M] mean squared error of the policy's actions to the answers
    best: Array  # [O] bool, the graph of the least error
    weights: Array  # [O] of a linear model of minus the error on the graph, as published
    linear: Array  # [O] bool, the graph that is likeliest by it: where the weight is positive


@jax.jit
def answered(layers: mlp.Layers, every: Array, states: Samples, weight: Array) -> Answered:
    """Scores graphs [M, O] by the expert's answers; `weight` [n] is 0 for what does not count."""

    def error(graph: Array) -> Array:
        alike = jnp.broadcast_to(graph, (len(weight), len(graph)))
        wrong = (predict(layers, states.latents, alike) - states.actions) ** 2
        return (wrong.mean(axis=1) * weight).sum() / weight.sum()

    errors = jax.lax.map(error, every, batch_size=8)
    centred = every - every.mean(axis=0)
    weights = jnp.linalg.lstsq(centred, errors.mean() - errors)[0]
    return Answered(every, errors, every[jnp.argmin(errors)] > 0, weights, weights > 0)


@jax.jit
def disagreement(layers: mlp.Layers, some: Array, latents: Array) -> Array:
    """[n] variance over graphs [M, O] of what the policy does at latents [n, L, O]."""

    def actions(graph: Array) -> Array:
        return predict(layers, latents, jnp.broadcast_to(graph, (len(latents), len(graph))))

    return jax.lax.map(actions, some).var(axis=0).mean(axis=-1)


def ridge(every: Array, returns: Array) -> Array:
    """[O] weights of returns [M] on graphs [M, O], with penalty 1 and a free intercept."""
    centred = every - every.mean(axis=0)
    gram = centred.T @ centred + jnp.eye(every.shape[1])
    return jnp.linalg.solve(gram, centred.T @ (returns - returns.mean()))


class _Policy(NamedTuple):
    """The policy of all graphs, and what it drives with."""

    encoder: Encoder
    active: np.ndarray  # [O] which latents
    frames: int  # L
    layers: mlp.Layers

    def rolled(self, simulator: Any, every: Array, key: Array) -> Any:
        """Trajectories [R, T], one under each of the graphs [R, O]."""
        of_rows, of_drive = jax.random.split(key)
        count = len(simulator.trajectories.states)
        rows = jax.random.randint(of_rows, (len(every),), 0, count)
        before = jnp.zeros((len(every), self.frames - 1, len(self.active)))
        parameters = self.encoder.variables, self.active, self.layers
        act = _acting(self.encoder.network)
        return simulator.seen(act, parameters, (every, before), rows, of_drive)


@cache
def _acting(network: vae.VAEConfig) -> Callable[[Any, Any, Array], tuple[Any, Array]]:
    """What the policy does at a frame, for `Simulator.seen`."""

    def act(parameters: Any, memory: Any, frame: Array) -> tuple[Any, Array]:
        (variables, active, layers), (graph, before) = parameters, memory
        image = raster.dequantize(frame[None])
        mean, _, _ = vae.encode(network, variables, image, train=False)
        seen = jnp.concatenate([before, mean[:, active]])
        return (graph, seen[1:]), predict(layers, seen, graph)

    return act


def _latents(encoder: Encoder, active: np.ndarray, images: Array, frames: int) -> Array:
    """[N, T, L, O] of images [N, T, H, W, 3]; 0, the prior's mean, before the first."""
    count, steps = images.shape[:2]
    flat = jnp.asarray(images).reshape(-1, *images.shape[2:])
    mean, _ = disentangle.encode(encoder.network, encoder.variables, flat)
    latents = mean[:, active].reshape(count, steps, -1)
    padded = jnp.pad(latents, ((0, 0), (frames - 1, 0), (0, 0)))
    return jnp.stack([padded[:, i : i + steps] for i in range(frames)], axis=2)


def _trained(demos: Demos, encoder: Encoder | None, ask: Ask, config: CcilConfig) -> _Policy:
    """The policy of all graphs: the same for both ways to choose one."""
    assert encoder is not None
    steps, frames = ask.config.trajectory_steps, ask.config.frames
    active = np.flatnonzero(np.asarray(encoder.active))
    latents = _latents(encoder, active, demos.images[:, :steps], frames)
    within = np.ones(latents.shape[:2], bool)
    if demos.valid is not None:
        within = np.asarray(demos.valid)[:, :steps]
    samples = Samples(latents[within], jnp.asarray(demos.actions[:, :steps])[within])
    learn = training(samples, config, ask.key, (encoder, ask.config.frames))
    layers = learn.trained(ask.watch("CCIL policy", learn))
    return _Policy(encoder, active, frames, layers)


def ask_expert(demos: Demos, evidence: Evidence, ask: Ask, config: CcilConfig) -> Answered:
    """The expert's answers where the policies of different graphs disagree most, and their say."""
    policy, simulator = _trained(demos, evidence.encoder, ask, config), evidence.simulator
    size = len(policy.active)
    of_graphs, of_drive, of_some, of_all = jax.random.split(named(ask.key, "CCIL queries"), 4)
    random = jax.random.bernoulli(of_graphs, 0.5, (config.rollouts, size)) * 1.0
    told = simulator.labelled(policy.rolled(simulator, random, of_drive))
    latents = _latents(policy.encoder, policy.active, told.images, policy.frames)
    answers, weight = told.actions.reshape(-1, told.actions.shape[-1]), told.weights.reshape(-1)
    states = Samples(latents.reshape(-1, *latents.shape[2:]), answers)
    some = jax.random.bernoulli(of_some, 0.5, (_DISAGREEING, size)) * 1.0
    apart = jnp.where(weight > 0, disagreement(policy.layers, some, states.latents), -1.0)
    _, chosen = jax.lax.top_k(apart, min(config.queries, len(weight)))
    asked = jax.tree.map(lambda a: a[chosen], states)
    return answered(policy.layers, graphs(size, of_all), asked, weight[chosen])


class Returned(NamedTuple):
    """What returns say of the graphs that were tried."""

    graphs: Array  # [M, O] of 0 and 1, in the order of their rounds
    returns: Array  # [M] minus the mean stage cost, over rollouts
    weights: Array  # [O] of a ridge regression of the one on the other
    best: Array  # [O] bool, where the weight is positive


def try_graphs(demos: Demos, evidence: Evidence, ask: Ask, config: CcilConfig) -> Returned:
    """Returns of graphs that are drawn by a linear model of the returns so far."""
    policy, simulator = _trained(demos, evidence.encoder, ask, config), evidence.simulator
    size, weights = len(policy.active), jnp.zeros(len(policy.active))
    tried, returns = [], []
    for key in jax.random.split(named(ask.key, "CCIL returns"), config.rounds):
        of_graph, of_drive = jax.random.split(key)
        likely = jax.nn.sigmoid(weights / config.temperature)
        graph = jax.random.bernoulli(of_graph, likely, (size,)) * 1.0
        alike = jnp.broadcast_to(graph, (config.rollouts, size))
        cost = simulator.cost(policy.rolled(simulator, alike, of_drive))
        tried.append(graph)
        returns.append(-cost.mean())
        weights = ridge(jnp.stack(tried), jnp.stack(returns))
    return Returned(jnp.stack(tried), jnp.stack(returns), weights, weights > 0)


def _selecting(choose: Callable[..., Answered | Returned], config: CcilConfig) -> Select:
    """The mask [latents] of all active ones but those of the best graph."""

    def select(demos: Callable[[], Demos], evidence: Evidence, ask: Ask) -> Array:
        best = choose(demos(), evidence, ask, config).best
        assert evidence.encoder is not None
        active = np.flatnonzero(np.asarray(evidence.encoder.active))
        return evidence.encoder.active.at[active].set(~best)

    return select


by_answers = partial(_selecting, ask_expert)
by_returns = partial(_selecting, try_graphs)

_USUAL = CcilConfig()
ROWS: dict[str, Method] = {
    "CcilQuery": Method(
        masked,
        "Masked, but the mask is the one that agrees best with answers of the expert.",
        needs=("encoder", "simulator"),
        kind="oracle",
        rival=True,
        select=by_answers(_USUAL),
        price=lambda count, steps: Price(_USUAL.queries, _USUAL.rollouts),
    ),
    "CcilReturn": Method(
        masked,
        "Masked, but the mask is found by the returns of episodes under some masks.",
        needs=("encoder", "simulator"),
        kind="oracle",
        rival=True,
        select=by_returns(_USUAL),
        price=lambda count, steps: Price(episodes=_USUAL.rounds * _USUAL.rollouts),
    ),
}

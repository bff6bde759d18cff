"""Training speed: our convolution, XLA's own, and PyTorch; many models at once; loop and scan.

    python -m benchmarks.training                      # the laptop preset's networks
    python -m benchmarks.training --networks all       # and the paper's: minutes a row on a CPU

Every row is a full Adam step (forward, backward, update) at batch 64 on 64 × 64 images unless it
says forward; scan is many steps in one program. The contestants take turns, so that a busy machine
slows all alike; times are medians over turns. "GFLOP/s" counts three forward passes' multiply-adds
a step; "roof" is its share of a 2048³ float32 matrix product timed in the same turns. "error" is
the largest difference between the gradients by our convolution and by XLA's, relative to the
largest gradient. (Most of it is XLA's: against float64, for the width-16 ResNet with the 7×7 stem,
ours is off by 4e-7 and XLA's by 3e-4, since its slow path sums some 65,000 terms one after
another.)
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable
from math import prod
from unittest.mock import patch

import jax
import jax.numpy as jnp
import optax
from jax import lax

from jaxdeconf.nets import layers, network, vae
from jaxdeconf.nets.cpu import conv_general_dilated as ours
from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig

Config = NetworkConfig | VAEConfig
NETWORKS: dict[str, Config] = {
    "resnet 16 imagenet": NetworkConfig(width=16, stem="imagenet"),
    "vae 8-16-32-32-64": VAEConfig((8, 16, 32, 32, 64)),
    "vae 16-32-32-64-64": VAEConfig((16, 32, 32, 64, 64)),
    "resnet 16 cifar": NetworkConfig(width=16, stem="cifar"),
    "resnet 64 imagenet": NetworkConfig(width=64, stem="imagenet"),
    "vae paper": VAEConfig(),
    "resnet 64 cifar": NetworkConfig(width=64, stem="cifar"),
}
LAPTOP = 3  # of them
BATCH, CHUNK = 64, 8  # CHUNK: steps of a scan
SIZE = (64, 64)
MODELS = (1, 2, 4, 8)


def built(config: Config):
    """Variables, a batch of images, and forward(params, batch_stats, images) -> output, stats."""
    if isinstance(config, NetworkConfig):

        def forward(params, batch_stats, images):
            variables = {"params": params, "batch_stats": batch_stats}
            return network.apply(config, variables, images, True)

        variables = network.init(config, jax.random.key(0), (*SIZE, 6), 1)
        return variables, jax.random.uniform(jax.random.key(1), (BATCH, *SIZE, 6)), forward

    def reconstruct(params, batch_stats, images):
        variables = {"params": params, "batch_stats": batch_stats}
        mean, _, batch_stats = vae.encode(config, variables, images, True)
        return vae.decode(config, {**variables, "batch_stats": batch_stats}, mean, SIZE, True)

    variables = vae.init(config, jax.random.key(0), SIZE)
    return variables, jax.random.uniform(jax.random.key(1), (BATCH, *SIZE, 3)), reconstruct


def training(config: Config):
    """A training state, a batch, the Adam step on them, the forward pass and the gradient."""
    variables, images, forward = built(config)
    adam = optax.adam(1e-3)

    def loss(params, batch_stats, images):
        output, batch_stats = forward(params, batch_stats, images)
        target = images if isinstance(config, VAEConfig) else 1.0
        return jnp.mean((output - target) ** 2), batch_stats

    def step(state, images):
        params, batch_stats, moments = state
        (value, batch_stats), gradient = jax.value_and_grad(loss, has_aux=True)(
            params, batch_stats, images
        )
        updates, moments = adam.update(gradient, moments, params)
        return (optax.apply_updates(params, updates), batch_stats, moments), value

    def run_forward(state, images):
        return forward(state[0], state[1], images)[0]

    def gradient(state, images):
        return jax.grad(loss, has_aux=True)(state[0], state[1], images)[0]

    state = (variables["params"], variables["batch_stats"], adam.init(variables["params"]))
    return state, images, step, run_forward, gradient


def compiled(function: Callable, *arguments, convolution=ours):
    """The compiled function, seconds to compile, and its temporary memory in MiB."""

    def fresh(*arguments):  # jit caches a trace by function: another convolution, another function
        return function(*arguments)

    with patch.object(layers, "conv_general_dilated", convolution):
        lowered = jax.jit(fresh).lower(*arguments)
    began = time.perf_counter()
    program = lowered.compile()
    seconds = time.perf_counter() - began
    memory = program.memory_analysis()
    return program, seconds, memory.temp_size_in_bytes / 2**20 if memory else float("nan")


def scanned(step: Callable) -> Callable:
    """The steps over a stack of batches, as `learn.fit` runs them: in one program."""

    def fresh(state, images):  # scan caches a trace by function, too
        return step(state, images)

    return lambda state, batches: lax.scan(fresh, state, batches)


def seconds(program: Callable, *arguments) -> float:
    """One run, to the end."""
    began = time.perf_counter()
    jax.block_until_ready(program(*arguments))
    return time.perf_counter() - began


def interleaved(contestants: dict[str, Callable[[], float]], repeats: int) -> dict[str, float]:
    """Median of what each returns, taking turns; the first turn warms up.

    A turn is the better of two runs: the first pays for the caches as another left them.
    """
    turns = [
        {name: min(run(), run()) for name, run in contestants.items()} for _ in range(repeats + 1)
    ][1:]
    return {name: statistics.median(turn[name] for turn in turns) for name in contestants}


def forward_flops(run_forward, state, images) -> float:
    """Twice the multiply-adds of the convolutions of one forward pass."""
    total = 0

    def counting(x, w, strides, padding, lhs_dilation=None, **keywords):
        nonlocal total
        y = lax.conv_general_dilated(x, w, strides, padding, lhs_dilation, **keywords)
        total += 2 * y.size * prod(w.shape[:3]) / prod(lhs_dilation or (1,))
        return y

    with patch.object(layers, "conv_general_dilated", counting):
        jax.eval_shape(lambda *arguments: run_forward(*arguments), state, images)
    return total


def gradient_error(gradient, state, images) -> float:
    """Largest difference between our gradients and XLA's, over the largest gradient."""
    mine, theirs = (
        jax.tree.leaves(compiled(gradient, state, images, convolution=c)[0](state, images))
        for c in (ours, lax.conv_general_dilated)
    )
    largest = max(float(jnp.abs(b).max()) for b in theirs)
    differences = (float(jnp.abs(a - b).max()) for a, b in zip(mine, theirs, strict=True))
    return max(differences) / largest


def torch_contestant(config: Config) -> dict[str, Callable[[], float]]:
    """PyTorch's step, where it is installed."""
    try:
        from benchmarks.torch_twins import Race
    except ImportError:
        return {}
    return {"pytorch": Race(config, BATCH, len(os.sched_getaffinity(0))).seconds}


def race(name: str, config: Config, repeats: int) -> None:
    """One network: every contestant's time, rate, share of the roof, memory and compile time."""
    state, images, step, run_forward, gradient = training(config)
    batches = jnp.broadcast_to(images, (CHUNK, *images.shape))
    programs = {
        "xla": compiled(step, state, images, convolution=lax.conv_general_dilated),
        "ours": compiled(step, state, images),
        "ours, scan": compiled(scanned(step), state, batches),
        "ours, forward": compiled(run_forward, state, images),
    }
    if name in list(NETWORKS)[:LAPTOP]:  # the wide ones would take an hour
        programs["xla, scan"] = compiled(
            scanned(step), state, batches, convolution=lax.conv_general_dilated
        )

    def timed(label: str) -> Callable[[], float]:
        program = programs[label][0]
        if "scan" in label:
            return lambda: seconds(program, state, batches) / CHUNK
        return lambda: seconds(program, state, images)

    square = jnp.ones((2048, 2048))
    product = jax.jit(jnp.matmul)
    contestants = {label: timed(label) for label in programs} | torch_contestant(config)
    contestants["roof"] = lambda: seconds(product, square, square)
    times = interleaved(contestants, repeats)
    roof = 2 * 2048**3 / times.pop("roof")
    flops = BATCH * forward_flops(run_forward, state, images[:1])
    error = gradient_error(gradient, state, images)
    print(f"\n{name}: roof {roof / 1e9:.0f} GFLOP/s, gradient error {error:.1e}")
    for label, time_ in times.items():
        rate = (1 if "forward" in label else 3) * flops / time_
        line = (
            f"  {label:14s} {1e3 * time_:8.1f} ms {BATCH / time_:7.0f} images/s "
            f"{rate / 1e9:6.1f} GFLOP/s {rate / roof:5.0%} of roof, "
            f"{times['xla'] / time_:5.2f} × xla"
        )
        if label in programs:
            line += f", compile {programs[label][1]:.1f} s, {programs[label][2]:.0f} MiB"
        print(line, flush=True)


def many_models(name: str, config: Config, repeats: int) -> None:
    """A model's step, and that of M models in one jitted, vmapped step on the same batch."""
    state, images, step, *_ = training(config)
    alone = compiled(step, state, images)[0]
    contestants = {"alone": lambda: seconds(alone, state, images)}
    for models in MODELS:
        states = jax.tree.map(lambda a, m=models: jnp.broadcast_to(a, (m, *jnp.shape(a))), state)
        program = compiled(jax.vmap(step, (0, None)), states, images)[0]
        contestants[f"M={models}"] = lambda p=program, s=states, m=models: seconds(p, s, images) / m
    times = interleaved(contestants, repeats)
    rates = ", ".join(f"{label}: {BATCH / time_:.0f}" for label, time_ in times.items())
    print(f"\n{name}, vmap, model-images/s: {rates}", flush=True)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--networks", nargs="*", default=list(NETWORKS)[:LAPTOP])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--models", action=argparse.BooleanOptionalAction, default=True)
    options = parser.parse_args()
    names = list(NETWORKS) if options.networks == ["all"] else options.networks
    unknown = set(names) - set(NETWORKS)
    if unknown:
        raise ValueError(f"networks: expected some of {list(NETWORKS)}, got {sorted(unknown)}")
    cores = len(os.sched_getaffinity(0))
    print(f"{jax.devices()[0].device_kind}, {cores} cores, jax {jax.__version__}")
    for name in names:
        race(name, NETWORKS[name], options.repeats)
        if options.models:
            many_models(name, NETWORKS[name], options.repeats)


if __name__ == "__main__":
    main()

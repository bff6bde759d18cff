"""The methods, a row each: what a policy is cloned on, what that takes, and by which loss.

The paper's are one `clone` on different views of the same frames (Section V-B). Everything that
goes by method follows from this table: order and colours, what is cloned and driven, what depends
on what. To add one, add a row; nothing else names a method.
"""

from collections.abc import Callable, Collection
from functools import cache
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import Array

from jaxdeconf import checks
from jaxdeconf.demos import Demos
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import View
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import Objective, Variables
from jaxdeconf.nets import vae
from jaxdeconf.vision import raster


class Evidence(NamedTuple):
    """What there is beside the demonstrations; None where it is not to be had."""

    encoder: Encoder | None = None
    mask: Array | None = None  # [O] bool, True where a latent is masked
    # Image [H, W, 3] in [0, 1] -> the same with the nuisance covered: by who knows where it is.
    cover: Callable[[Array], Array] | None = None
    # States [n, S] -> what the expert would do in them, over the limit [n, A].
    expert: Callable[[Array], Array] | None = None


def given(demos: Demos, _: Evidence) -> Demos:
    """The demonstrations as they are."""
    return demos


Need = Literal["encoder", "mask", "cover", "expert", "previous_actions"]


class Method(NamedTuple):
    """One row: how a policy is cloned."""

    view: Callable[[Evidence], tuple[View, Any]]  # what the network sees: a view, its parameters
    note: str  # a sentence for the report
    needs: tuple[Need, ...] = ()  # of the evidence, and of the demonstrations
    objective: Objective = clone.objective  # CloneConfig -> loss on clone.Demonstrations
    data: Callable[[Demos, Evidence], Demos] = given  # what is imitated
    # "oracle": it is told what others must find out. "control": it shows what a part does alone.
    kind: Literal["fair", "oracle", "control"] = "fair"


def available(demos: Demos, evidence: Evidence) -> set[str]:
    """The needs that these meet."""
    holders = {need: demos if need == "previous_actions" else evidence for need in get_args(Need)}
    return {need for need, holder in holders.items() if getattr(holder, need) is not None}


def require(name: str, met: Collection[str]) -> None:
    """Refuses a method that is not in the table, or that needs more than is met.

    Raises:
      ValueError: naming the method and what it needs.
    """
    checks.one_of("methods", name, tuple(METHODS))
    for need in METHODS[name].needs:
        if need not in met:
            words = need.replace("_", " ")
            raise ValueError(f"methods: expected one that needs no {words}, got {name!r}")


def masking() -> tuple[str, ...]:
    """The methods that need a mask."""
    return tuple(name for name, method in METHODS.items() if "mask" in method.needs)


def identity(_: Variables, images: Array) -> Array:
    """Uint8 frames [B, H, W, 3] as they are."""
    return images


@cache
def covered(cover: Callable[[Array], Array]) -> View:
    """Frames with the nuisance covered; the same view for the same cover, so it compiles once."""

    def view(_: Variables, images: Array) -> Array:
        return raster.quantize(jax.vmap(cover)(raster.dequantize(images)))

    return view


@cache
def reconstructed(config: vae.VAEConfig) -> View:
    """The β-VAE's reconstruction of the latents that are kept, others at their prior mean.

    Its parameters are {"variables": of the β-VAE, "keep": [O] bool}.
    """

    def view(parameters: Variables, images: Array) -> Array:
        variables = parameters["variables"]
        mean, _, _ = vae.encode(config, variables, raster.dequantize(images), train=False)
        latents = jnp.where(parameters["keep"], mean, 0.0)
        _, height, width, _ = images.shape
        drawn, _ = vae.decode(config, variables, latents, (height, width), train=False)
        return raster.quantize(drawn)

    return view


def _as_they_are(_: Evidence) -> tuple[View, Any]:
    return identity, {}


def _by_hand(evidence: Evidence) -> tuple[View, Any]:
    assert evidence.cover is not None
    return covered(evidence.cover), {}


def _kept(encoder: Encoder | None, keep: Array) -> tuple[View, Any]:
    assert encoder is not None
    parameters = {"variables": encoder.variables, "keep": keep}
    return reconstructed(encoder.network), parameters


def _masked(evidence: Evidence) -> tuple[View, Any]:
    assert evidence.encoder is not None
    return _kept(evidence.encoder, evidence.encoder.active & ~jnp.asarray(evidence.mask))


def _unmasked(evidence: Evidence) -> tuple[View, Any]:
    assert evidence.encoder is not None
    return _kept(evidence.encoder, evidence.encoder.active)


METHODS: dict[str, Method] = {
    "BcVanilla": Method(_as_they_are, "The frames as they are."),
    "BcManual": Method(
        _by_hand,
        "The nuisance covered by a human who knows where it is.",
        needs=("cover",),
        kind="oracle",
    ),
    "Masked": Method(
        _masked,
        "Reconstructed by the β-VAE without the latents that Algorithm 1 masked.",
        needs=("encoder", "mask"),
    ),
    "Reconstructed": Method(
        _unmasked,
        "Reconstructed by the same β-VAE with nothing masked: what the reconstruction does alone.",
        needs=("encoder",),
        kind="control",
    ),
}

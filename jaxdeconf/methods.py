"""The methods, a row each: what a policy is cloned on, what that takes, and by which loss.

They are one `clone` on different views of the same frames (Section V-B). Inpainted is ours, the
others are the paper's. Everything that goes by method follows from this table: order and colours,
what is cloned and driven, what depends on what. To add one, add a row; nothing else names a method.
"""

from collections.abc import Callable, Collection
from typing import Any, Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import checks
from jaxdeconf.demos import Demos
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations, View
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import Objective, Training
from jaxdeconf.views import covered, identity, inpainted, reconstructed, shown


class Evidence(NamedTuple):
    """What there is beside the demonstrations; None where it is not to be had."""

    encoder: Encoder | None = None
    mask: Array | None = None  # [O] bool, True where a latent is masked
    region: Array | None = None  # [H, W] bool, True where masked latents reach; see `find_region`
    # Image [H, W, 3] in [0, 1] -> the same with the nuisance covered: by who knows where it is.
    cover: Callable[[Array], Array] | None = None
    # States [n, S] -> what the expert would do in them, over the limit [n, A].
    expert: Callable[[Array], Array] | None = None


def given(demos: Demos, _: Evidence) -> Demos:
    """The demonstrations as they are."""
    return demos


Need = Literal["encoder", "mask", "region", "cover", "expert", "previous_actions"]


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


def imitated(lengths: np.ndarray, config: CloneConfig) -> int:
    """How many steps are cloned of episodes of these lengths [N]."""
    return int(np.minimum(lengths, config.trajectory_steps or lengths.max()).sum())


def cloning(
    method: Method,
    demos: Callable[[], Demos],
    samples: int,
    evidence: Evidence,
    key: Array,
    config: CloneConfig,
) -> Training:
    """A method's training, not yet begun; `demos` makes what is cloned, `samples` steps of it."""
    view, parameters = method.view(evidence)

    def data() -> Demonstrations:
        imitate = method.data(demos(), evidence)
        cloned = shown(imitate, view, parameters, config.trajectory_steps)
        checks.same_length("data", len(cloned.actions), samples, "steps")
        return cloned

    training = clone.training(config, data, samples, view, parameters, key, method.objective)
    if method.data is given:
        return training
    # Then what is imitated may follow from all that there is.
    return training._replace(made_from=(parameters, evidence.encoder, evidence.mask))


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


def _inpainted(evidence: Evidence) -> tuple[View, Any]:
    assert evidence.encoder is not None
    _, parameters = _masked(evidence)
    parameters["region"] = jnp.asarray(evidence.region)
    return inpainted(evidence.encoder.network), parameters


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
    "Inpainted": Method(
        _inpainted,
        "The frames as they are, but where the masked latents reach: there as Masked sees them.",
        needs=("encoder", "mask", "region"),
    ),
    "Reconstructed": Method(
        _unmasked,
        "Reconstructed by the same β-VAE with nothing masked: what the reconstruction does alone.",
        needs=("encoder",),
        kind="control",
    ),
}

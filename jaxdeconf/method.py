"""What a method against causal confusion is: a view of the frames, and what training on it takes.

A row of `methods.METHODS` is one of these; runs, sweeps and comparisons know no other kind. A plain
one is a view and nothing else. What others ask for beside has a field of its own, and a default.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxdeconf import checks, views
from jaxdeconf.demos import Demos, Exploration
from jaxdeconf.learn import clone
from jaxdeconf.learn.clone import CloneConfig, Demonstrations, View
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.learn.fit import FitState, Objective, Training, Variables, Watch, finish


class Evidence(NamedTuple):
    """What there is beside the demonstrations; None where it is not to be had."""

    encoder: Encoder | None = None
    mask: Array | None = None  # [O] bool, True where a latent is masked
    region: Array | None = None  # [H, W] bool, True where masked latents reach; see `find_region`
    # Image [H, W, 3] in [0, 1] -> the same with the nuisance covered: by who knows where it is.
    cover: Callable[[Array], Array] | None = None
    # States [N, T, S] of episodes -> what the expert would do in them, over the limit [N, T, A].
    expert: Callable[[Array], Array] | None = None
    exploration: Exploration | None = None  # frames under random actions, and what these were
    simulator: Any = None  # the system itself, to set, shake and drive; `rivals.simulator`


Need = Literal[
    "encoder", "mask", "region", "cover", "expert", "exploration", "simulator", "previous_actions"
]


class Ask(NamedTuple):
    """How a method is to be cloned."""

    config: CloneConfig
    key: Array  # every random choice follows from it, by name
    watch: Watch = finish  # what trainings pass through that come before the policy's own


class Price(NamedTuple):
    """What a method asks for beside the demonstrations."""

    labels: int = 0  # of the expert: its action in a state
    episodes: int = 0  # that somebody drives


def as_they_are(_: Evidence) -> tuple[View, Any]:
    """A view of the frames as they are."""
    return views.identity, {}


def masked(evidence: Evidence) -> tuple[View, Any]:
    """A view by the β-VAE, of its active latents without the masked ones."""
    assert evidence.encoder is not None
    return _kept(evidence.encoder, evidence.encoder.active & ~jnp.asarray(evidence.mask))


def unmasked(evidence: Evidence) -> tuple[View, Any]:
    """A view by the β-VAE, of all its active latents."""
    assert evidence.encoder is not None
    return _kept(evidence.encoder, evidence.encoder.active)


def inpainted(evidence: Evidence) -> tuple[View, Any]:
    """A view of the frames as they are, but for the region that masked latents reach.

    Where that is the whole image, it is `masked`.
    """
    assert evidence.encoder is not None
    assert evidence.region is not None
    if evidence.region.all():
        return masked(evidence)
    return views.inpainted, views.still(evidence.encoder, evidence.region)


def _kept(encoder: Encoder, keep: Array) -> tuple[View, Any]:
    parameters = {"variables": encoder.variables, "keep": keep}
    return views.reconstructed(encoder.network), parameters


def given(demos: Demos, _: Evidence, __: Ask) -> Demos:
    """The demonstrations as they are."""
    return demos


def _same(config: CloneConfig) -> CloneConfig:
    return config


def _as_drawn(variables: Variables, _: Evidence, __: Array) -> Variables:
    return variables


class Method(NamedTuple):
    """One row: how a policy is cloned."""

    view: Callable[[Evidence], tuple[View, Any]]  # what the network sees: a view, its parameters
    note: str  # a sentence for the report
    needs: tuple[Need, ...] = ()  # of the evidence, and of the demonstrations
    # "oracle": it is told what others must find out. "control": it shows what a part does alone.
    kind: Literal["fair", "oracle", "control"] = "fair"
    rival: bool = False  # from elsewhere: cloned where it is asked for by name
    objective: Objective = clone.objective  # CloneConfig -> loss on clone.Demonstrations
    # Its own number, `CloneConfig.strength` where that is None: the weight of a penalty, say.
    strength: float | None = None
    config: Callable[[CloneConfig], CloneConfig] = _same  # how its training differs from others'
    # The mask [O] that it takes in place of the evidence's. The demonstrations are made when asked.
    select: Callable[[Callable[[], Demos], Evidence, Ask], Array] | None = None
    data: Callable[[Demos, Evidence, Ask], Demos] = given  # what is imitated, as many steps
    # What its loss needs of each step beside the frames: a pytree [N, T, ...].
    extra: Callable[[Demos, Evidence, Ask], Any] | None = None
    # Adds to a policy's first variables: networks that train along, as more of "params"; and what
    # the loss only reads, as "frozen".
    begin: Callable[[Variables, Evidence, Array], Variables] = _as_drawn
    # (N demonstrations, of T steps) -> what it asks for beside those; None: for nothing.
    price: Callable[[int, int], Price] | None = None

    @property
    def needs_latents(self) -> bool:
        """Whether the β-VAE comes before it."""
        return not {"encoder", "mask", "region"}.isdisjoint(self.needs)

    @property
    def kind_of_data(self) -> tuple[Any, ...]:
        """Equal for methods whose data, and variables, have the same fields."""
        return self.data, self.extra, self.begin


def available(demos: Demos, evidence: Evidence) -> set[str]:
    """The needs that these meet."""
    holders = {need: demos if need == "previous_actions" else evidence for need in get_args(Need)}
    return {need for need, holder in holders.items() if getattr(holder, need) is not None}


def imitated(lengths: np.ndarray, config: CloneConfig) -> int:
    """How many steps are cloned of episodes of these lengths [N]."""
    return int(np.minimum(lengths, config.trajectory_steps or lengths.max()).sum())


def configured(method: Method, config: CloneConfig) -> CloneConfig:
    """A method's own config, made of the one that all are asked for."""
    if config.strength is None:
        config = replace(config, strength=method.strength)
    return method.config(config)


def cloning(
    method: Method, demos: Callable[[], Demos], samples: int, evidence: Evidence, ask: Ask
) -> Training:
    """A method's training, not yet begun.

    Args:
      method: the row.
      demos: makes what is cloned.
      samples: steps of it.
      evidence: what there is beside.
      ask: how it is cloned.
    """
    ask = ask._replace(config=configured(method, ask.config))
    if method.select is not None:
        evidence = evidence._replace(mask=method.select(demos, evidence, ask))
    view, parameters = method.view(evidence)

    def data(watch: Watch) -> Demonstrations:
        made, asked = demos(), ask._replace(watch=watch)
        imitate = method.data(made, evidence, asked)
        extra = None if method.extra is None else method.extra(imitate, evidence, asked)
        cloned = views.shown(imitate, view, parameters, ask.config.trajectory_steps, extra)
        checks.same_length("data", len(cloned.actions), samples, "steps")
        return cloned

    def begin(variables: Variables) -> Variables:
        return method.begin(variables, evidence, ask.key)

    training = clone.training(
        ask.config,
        lambda: data(ask.watch),
        samples,
        view,
        parameters,
        ask.key,
        method.objective,
        begin,
    )
    if method.data is given and method.extra is None:
        return training
    # Then what is imitated may follow from all that there is.
    made_from = parameters, evidence.encoder, evidence.mask
    return training._replace(made_from=made_from, like=lambda: data(_untrained))


def _untrained(_: str, training: Training) -> FitState:
    """The watch of who wants shapes alone."""
    return training.start(training.data())

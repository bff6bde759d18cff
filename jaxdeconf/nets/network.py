"""The policy's network: frames in, actions out.

Plain functions, `init`, `apply` and `look`, hide Flax; the variables are plain pytrees that vmap
over models. A kind of network is a Flax module in a file of its own, and a name in `KINDS`.
Shapes: B batch, H × W pixels, C channels (3 a frame, L frames stacked), A action.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from jaxdeconf import checks
from jaxdeconf.nets import layers
from jaxdeconf.nets.initial import draw
from jaxdeconf.nets.layers import Variables
from jaxdeconf.nets.places import Places, background
from jaxdeconf.nets.resnet import ResNet
from jaxdeconf.traced import traceable

KINDS: dict[str, Callable[..., nn.Module]] = {"resnet": ResNet, "places": Places}


@traceable
@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network; hashable, so it can be a static argument of jit.

    Raises:
      ValueError: for a size below one or an unknown kind, stem, norm or dtype.
    """

    # "resnet": ResNet-18 (nets/resnet.py), the paper's. "places": where what is not background is
    # and how it moved (nets/places.py), ours, for a camera that stands still.
    kind: Literal["resnet", "places"] = "resnet"
    width: int = 64  # channels of the first layer; He et al.: the next stages double it
    # Of a ResNet. "cifar": 3×3, full resolution, as is usual (11.17 M parameters). "imagenet": 7×7
    # stride 2 and a 3×3 stride 2 max-pool; about nine times cheaper, for a CPU.
    stem: Literal["cifar", "imagenet"] = "cifar"
    norm: Literal["batch", "none"] = "batch"  # of a ResNet; He et al.: batch normalisation
    dtype: Literal["float32", "bfloat16"] = "float32"  # of activations; parameters stay float32
    stages: int = 4  # of a ResNet, He et al.'s; fewer keep the last one's resolution high
    hidden: tuple[int, ...] = ()  # widths of layers before the output; He et al.: none
    motion: float = 10.0  # "places": so much larger is a change of place than a place

    def __post_init__(self):
        checks.one_of("kind", self.kind, tuple(KINDS))
        checks.integer("width", self.width)
        checks.one_of("stem", self.stem, ("cifar", "imagenet"))
        checks.one_of("norm", self.norm, ("batch", "none"))
        checks.one_of("dtype", self.dtype, ("float32", "bfloat16"))
        checks.integer("stages", self.stages, most=4)
        if not isinstance(self.hidden, tuple):
            raise ValueError(f"hidden: expected a tuple of positive integers, got {self.hidden!r}")
        for width in self.hidden:
            checks.integer("hidden", width)
        checks.not_negative("motion", self.motion)


def init(
    config: NetworkConfig, key: Array, input_shape: tuple[int, int, int], outputs: int
) -> Variables:
    """Fresh variables.

    Args:
      config: the network's shape.
      key: PRNG key.
      input_shape: (H, W, C) of one image; C = 3·L for L stacked frames.
      outputs: A, the number of regressed action components.
    Returns:
      {"params": ..., "batch_stats": ...}; what training does not change but by looking at data,
      such as running statistics, is in `batch_stats`.
    """
    network = KINDS[config.kind](config, outputs)
    shapes = jax.eval_shape(lambda: network.init(key, jnp.zeros((1, *input_shape)), train=False))
    variables = draw(shapes, key, gain=2)
    return {"params": variables["params"], "batch_stats": variables.get("batch_stats", {})}


def with_background(variables: Variables, frames: Array) -> Variables:
    """Fresh variables that know the background of frames [n, H, W, 3] uint8.

    Those of a network that has no use for it are as they were.
    """
    stats = variables["batch_stats"]
    if "background" not in stats:
        return variables
    return {**variables, "batch_stats": {**stats, "background": background(frames)}}


def apply(
    config: NetworkConfig, variables: Variables, images: Array, train: bool
) -> tuple[Array, Any]:
    """The network's outputs, and its running statistics after this batch.

    Args:
      config: the one given to `init`.
      variables: what `init` returned, or trained from it.
      images: [B, H, W, C] float in [0, 1].
      train: normalise by the batch's statistics and update the running ones (True), or use the
        running ones as they are (False). Static.
    Returns:
      [B, A] float32 outputs, and the `batch_stats` to carry on with (unchanged if not `train`).
    """
    outputs, _, batch_stats = look(config, variables, images, train)
    return outputs, batch_stats


def look(
    config: NetworkConfig,
    variables: Variables,
    images: Array,
    train: bool,
    gate: Callable[[Array], Array] | None = None,
) -> tuple[Array, Array, Any]:
    """What `apply` returns, and between the two the features [B, F] that the last layer is given.

    Args:
      config, variables, images, train: as in `apply`.
      gate: of the last map [B, h, w, channels], just before it is pooled, to one of that shape.
    """
    outputs = variables["params"]["head"]["bias"].shape[0]
    network = KINDS[config.kind](config, outputs)
    (out, features), batch_stats = layers.run(network, variables, images, train, gate=gate)
    return out, features, batch_stats

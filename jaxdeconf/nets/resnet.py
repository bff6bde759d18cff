"""Pre-activation ResNet-18 (He et al. 2016, "Identity Mappings in Deep Residual Networks").

Shapes: B batch, L frames, H × W pixels, A action, F features.
"""

from functools import partial
from typing import Any

from flax import linen as nn
from jax import Array

from jaxdeconf.nets import layers
from jaxdeconf.nets.cpu import max_pool
from jaxdeconf.nets.layers import Config

_conv = partial(layers.conv, use_bias=False)


def _norm_relu(config: Config, x: Array, train: bool, name: str) -> Array:
    return nn.relu(layers.norm(config, x, train, name))


class _Block(nn.Module):
    """Twice BN, ReLU, 3×3, plus a shortcut: 1×1 from the activated input if shapes change."""

    config: Config
    features: int
    stride: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        activated = _norm_relu(self.config, x, train, "norm_1")
        shortcut = x
        if self.stride != 1 or x.shape[-1] != self.features:
            shortcut = _conv(self.config, self.features, 1, "shortcut", self.stride)(activated)
        y = _conv(self.config, self.features, 3, "conv_1", self.stride)(activated)
        y = _norm_relu(self.config, y, train, "norm_2")
        return shortcut + _conv(self.config, self.features, 3, "conv_2")(y)


class ResNet(nn.Module):
    """The network, of all frames at once."""

    config: Config
    outputs: int

    @nn.compact
    def __call__(self, images: Array, train: bool, gate: Any = None) -> tuple[Array, Array]:
        """Actions [B, A] of images [B, H, W, 3 L] in [0, 1]; the features [B, F] before."""
        width = self.config.width
        x = 2 * images - 1
        if self.config.stem == "cifar":
            x = _conv(self.config, width, 3, "stem")(x)
        else:
            x = max_pool(_conv(self.config, width, 7, "stem", stride=2)(x))
        for stage, stride in enumerate((1, 2, 2, 2)[: self.config.stages]):
            for block in range(2):
                x = _Block(
                    self.config,
                    features=width * 2**stage,
                    stride=stride if block == 0 else 1,
                    name=f"stage_{stage + 1}_block_{block + 1}",
                )(x, train)
        x = _norm_relu(self.config, x, train, "norm")
        x = x if gate is None else gate(x)
        return layers.answer(self.config, self.outputs, x.mean((1, 2)))

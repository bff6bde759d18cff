"""The same networks in PyTorch, layer for layer, for `benchmarks.training` to race against."""

import time

# pyright: reportMissingImports=false
import torch
from torch import nn
from torch.nn import functional as F

from jaxdeconf.nets.network import NetworkConfig
from jaxdeconf.nets.vae import VAEConfig

SIDE = 64  # of an image, pixels


class Block(nn.Module):
    """A pre-activation block."""

    def __init__(self, inputs: int, outputs: int, stride: int):
        super().__init__()
        self.norm_1, self.norm_2 = nn.BatchNorm2d(inputs), nn.BatchNorm2d(outputs)
        self.conv_1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.conv_2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        changes = stride != 1 or inputs != outputs
        self.shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False) if changes else None

    def forward(self, x):
        """[N, C, H, W] to the same of the next layer."""
        activated = F.relu(self.norm_1(x))
        shortcut = x if self.shortcut is None else self.shortcut(activated)
        return shortcut + self.conv_2(F.relu(self.norm_2(self.conv_1(activated))))


class ResNet(nn.Module):
    """`jaxdeconf.nets.resnet` with 6 input channels and one output."""

    def __init__(self, config: NetworkConfig):
        super().__init__()
        width = config.width
        if config.stem == "cifar":
            layers = [nn.Conv2d(6, width, 3, 1, 1, bias=False)]
        else:
            layers = [nn.Conv2d(6, width, 7, 2, 3, bias=False), nn.MaxPool2d(3, 2, 1)]
        inputs = width
        for stage, stride in enumerate((1, 2, 2, 2)):
            layers += [Block(inputs, width * 2**stage, stride)]
            inputs = width * 2**stage
            layers += [Block(inputs, inputs, 1)]
        self.body = nn.Sequential(*layers, nn.BatchNorm2d(inputs), nn.ReLU())
        self.head = nn.Linear(inputs, 1)

    def forward(self, x):
        """[N, 6, 64, 64] to [N, 1]."""
        return self.head(self.body(2 * x - 1).mean((2, 3)))


class VAE(nn.Module):
    """`jaxdeconf.nets.vae` without the linear path, decoding the mean."""

    def __init__(self, config: VAEConfig):
        super().__init__()
        channels = config.channels
        down, up, inputs = [], [], 3
        for outputs in channels:
            down += [nn.Conv2d(inputs, outputs, 3, 2, 1), nn.BatchNorm2d(outputs), nn.LeakyReLU()]
            inputs = outputs
        self.shape = (inputs, *2 * (SIDE // 2 ** len(channels),))
        flat = self.shape[0] * self.shape[1] * self.shape[2]
        for outputs in (*channels[-2::-1], channels[0]):
            up += [
                nn.ConvTranspose2d(inputs, outputs, 3, 2, 1, output_padding=1),
                nn.BatchNorm2d(outputs),
                nn.LeakyReLU(),
            ]
            inputs = outputs
        self.down, self.up = nn.Sequential(*down), nn.Sequential(*up, nn.Conv2d(inputs, 3, 3, 1, 1))
        self.mean = nn.Linear(flat, config.latents)
        self.dense = nn.Linear(config.latents, flat)

    def forward(self, x):
        """[N, 3, 64, 64] to the same."""
        mean = self.mean(self.down(2 * x - 1).flatten(1))
        return 0.5 * (torch.tanh(self.up(self.dense(mean).view(-1, *self.shape))) + 1)


class Race:
    """One network and its optimiser; `seconds()` times one full Adam step."""

    def __init__(self, config: NetworkConfig | VAEConfig, batch: int, threads: int):
        torch.set_num_threads(threads)
        resnet = isinstance(config, NetworkConfig)
        self.network = ResNet(config) if resnet else VAE(config)
        self.network.to(memory_format=torch.channels_last)
        self.images = torch.rand(batch, 6 if resnet else 3, SIDE, SIDE).to(
            memory_format=torch.channels_last
        )
        self.target = torch.ones(batch, 1) if resnet else self.images
        self.adam = torch.optim.Adam(self.network.parameters(), 1e-3)

    def seconds(self) -> float:
        """Forward, backward, update."""
        began = time.perf_counter()
        self.adam.zero_grad()
        torch.mean((self.network(self.images) - self.target) ** 2).backward()
        self.adam.step()
        return time.perf_counter() - began

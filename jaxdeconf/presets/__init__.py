"""Configs by system and size: smoke (every stage, in a minute), laptop (a CPU), paper (a GPU)."""

from jaxdeconf.pipeline.config import Config
from jaxdeconf.presets import cartpole, reacher

# system -> preset -> config
PRESETS: dict[str, dict[str, Config]] = {
    "cartpole": cartpole.PRESETS,
    "reacher": reacher.PRESETS,
}

"""Everything that decides how a dataset is masked."""

from dataclasses import dataclass, field
from typing import Literal

from jaxdeconf import checks
from jaxdeconf.learn import disentangle as vae
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.mask import MaskConfig


@dataclass(frozen=True)
class Masking:
    """How a dataset is masked. Defaults are for a CPU, in minutes."""

    demos: str = ""  # the demonstrations, a file or a folder
    exploration: str | None = None  # frames under random actions, in the same form
    format: str | None = None  # of both; None: by what lies there
    frames: str | None = None  # the camera's key; None: the only one
    actions: str | None = None  # their key
    initial_states: str | None = None  # a key, or FILE.npy of [N, S]: what episodes were set to
    states: tuple[str, ...] = ()  # columns of them, by name; none: all
    drop_short: int = 1  # steps; shorter demonstrations are written, but nothing is made of them
    size: int = 64  # pixels a side at which the β-VAE learns
    horizon: int | None = None  # H; None: the least in which all states that move an action show
    threshold: float = MaskConfig.threshold  # gamma
    alpha: float | None = MaskConfig.alpha  # family-wise error of the tests
    # 2: also what two states move only together, as the angle between an arm and its target does.
    states_together: Literal[1, 2] = MaskConfig.states_together
    # Where episodes show only larger correlations than this one, what Algorithm 1 masks is masked
    # only if it tells the previous action: with few episodes it masks causes, too.
    min_power: float = 0.3
    unvaried: Literal["refuse", "mask", "keep"] = "refuse"  # latents that first frames do not vary
    clone: bool = False  # compare policies cloned from frames as recorded and as written
    seed: int = 0
    disentangle: DisentangleConfig = field(default_factory=lambda: vae.CPU)

    def __post_init__(self):
        checks.integer("seed", self.seed, least=0, most=2**32 - 1)
        checks.integer("size", self.size)
        checks.integer("drop_short", self.drop_short)
        vae.check_size(self.disentangle, (self.size, self.size))
        if self.horizon is not None:
            checks.integer("horizon", self.horizon)
        # What the mask will be made with; raises for its own fields.
        self.rule(self.horizon or 1)
        checks.number("min_power", self.min_power, "a number in (0, 1)", 0.0, 1.0)
        checks.one_of("unvaried", self.unvaried, ("refuse", "mask", "keep"))

    def rule(self, horizon: int) -> MaskConfig:
        """Algorithm 1's config for a reaction horizon."""
        return MaskConfig(horizon, self.threshold, self.alpha, states_together=self.states_together)

"""What a masking found, typed once: what results.json holds and the report reads.

Shapes: O latents, S state, H reaction horizon, A action. What was not come to is None, or empty.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxdeconf.owndata.check import Check
from jaxdeconf.owndata.clones import Clone
from jaxdeconf.owndata.judge import Leakage


class Written(NamedTuple):
    """How the new dataset's frames were made."""

    mode: str  # "inpaint", or "reconstruct" where the masked latents' reach is not local
    region_pixels: int  # redrawn, of the β-VAE's frame
    size: list[int]  # (H, W) of the dataset's frames


class Found(NamedTuple):
    """Everything that results.json of a masking holds."""

    refused: str | None  # why nothing was written
    check: Check
    state_names: list[str]  # [S] that vary
    action_names: list[str]  # [A]
    statistic: str
    mask: np.ndarray = np.zeros(0, bool)  # [O] bool, as it was written
    asked: np.ndarray = np.zeros(0, bool)  # [O] bool, as Algorithm 1 alone has it
    active: np.ndarray = np.zeros(0, bool)  # [O] bool
    kl: np.ndarray = np.zeros(0)  # [O] nats
    threshold: float = float("nan")  # gamma, as it was used
    state_observation: np.ndarray = np.zeros(0)  # [S, O] the statistic
    state_action: np.ndarray = np.zeros(0)  # [S, H, A] the statistic
    nuisance_share: np.ndarray = np.zeros(0)  # [O] R² of the previous action
    spread: np.ndarray = np.zeros(0)  # [O] in first frames over that in exploration frames
    stability: np.ndarray = np.zeros(0)  # [O] share of resamples that mask it so
    elsewhere: dict[str, list[int]] = {}  # noqa: RUF012  latents that other H and γ mask
    written: Written | None = None
    leakage: Leakage | None = None
    retention: dict[str, list[float]] = {}  # noqa: RUF012  of states that move actions: [raw, written]
    clones: dict[str, Clone] = {}  # noqa: RUF012  from frames "recorded" and "written", if asked for
    seconds: dict[str, float] = {}  # noqa: RUF012  by stage
    peak_memory_mb: float = float("nan")
    versions: dict[str, str] = {}  # noqa: RUF012
    config: dict[str, Any] = {}  # noqa: RUF012

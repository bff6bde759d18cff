"""What a run found, typed once: what results.json and a sweep's rows hold and reports read.

Shapes: O latents, S state, H reaction horizon, A action, T time, V traversal values, n frames.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from jaxdeconf.pipeline.plain import UNREADABLE, from_plain, write_arrays, write_json

FILE, PICTURES = "results.json", "pictures.npz"

Found = TypeVar("Found", bound=NamedTuple)


class Losses(NamedTuple):
    """Rollout loss: mean stage cost a step, over rollouts."""

    mean: float
    std: float
    per_epoch: list[list[float]] = []  # noqa: RUF012  [epoch, mean, std] while it was trained
    error: float = float("nan")  # standard error of the mean: over rollouts, or over seeds
    median: float = float("nan")

    @classmethod
    def of(cls, values: np.ndarray) -> "Losses":
        """Of rollouts, or of the means of seeds, [n]; the error of one alone is not known."""
        count = len(values)
        with np.errstate(invalid="ignore"):
            error = values.std(ddof=1) / np.sqrt(count) if count > 1 else np.nan
            numbers = values.mean(), values.std(), error, np.median(values)
        mean, std, error, median = map(float, numbers)
        return cls(mean, std, [], error, median)


class Judged(NamedTuple):
    """A policy's numbers."""

    rollout_loss: Losses
    outcome: float  # mean over rollouts, in the system's own terms
    copycat: float  # mean change of the action over its limit when only the nuisance is redrawn
    # R² of what the nuisance shows, or of its square, regressed from what the policy sees.
    leakage: float
    train_loss: float  # mean since the evaluation before the last
    # Error of telling an action from the one before, on its rollouts over that on the expert's:
    # meant to be below 1 of a copycat (Wen et al. 2020).
    predictability: float = float("nan")
    # Two of comparisons alone. The mean derivative of the action with respect to the one that the
    # nuisance shows:
    copycat_slope: float = float("nan")
    # And HSCIC, on the expert's rollouts, of its action and the expert's one before, given the
    # expert's own action (Seo et al. 2023): 0 is none of the one before left.
    past_leakage: float = float("nan")


class Sight(NamedTuple):
    """What a policy is shown of some of the expert's frames, and where it looks."""

    seen: np.ndarray  # uint8 [n, H, W, 3]
    salient: np.ndarray  # float [n, H, W], see `evaluate.saliency`


class JudgedExpert(NamedTuple):
    """The expert's numbers."""

    rollout_loss: float  # on the evaluation's initial states
    outcome: float
    violation_rate: float  # share of its steps outside the soft limits
    unconverged: float  # share of its steps whose plan had not converged


class PValues(NamedTuple):
    """Of one test each."""

    state_observation: np.ndarray  # [S, O]
    state_action: np.ndarray  # [S, H, A]


class Reconstruction(NamedTuple):
    """Summed squared error a frame, colours in [0, 1]."""

    nuisance: float  # on its pixels
    elsewhere: float


class OutcomeForm(NamedTuple):
    """How a system's outcome is shown; see `systems.system.Outcome`."""

    name: str
    form: str
    note: str


class Results(NamedTuple):
    """Everything that results.json holds."""

    system: str
    preset: str
    seed: int
    state_names: list[str]  # [S]
    action_names: list[str]  # [A]
    outcome: OutcomeForm
    reaction_horizon: int  # H
    statistic: str  # of the mask
    threshold: float  # gamma, as it was used
    mask: np.ndarray  # [O] bool
    region: float | None  # share of pixels that masked latents reach; None: no method asked
    state_observation: np.ndarray  # [S, O] the statistic
    state_action: np.ndarray  # [S, H, A]
    p_values: PValues
    active: np.ndarray  # [O] bool
    kl: np.ndarray  # [O] nats
    nuisance_correlation: np.ndarray  # [O] |Spearman| with what the nuisance shows
    nuisance_share: np.ndarray  # [O] R²: what that explains of each latent
    reconstruction: Reconstruction
    expert: JudgedExpert
    policies: dict[str, Judged]  # by method, in the table's order
    seconds: dict[str, float]  # by stage
    peak_memory_mb: float
    versions: dict[str, str]
    config: dict[str, Any]


class Row(NamedTuple):
    """A point of a sweep: what a run of its config would find, without curves."""

    point: int
    values: dict[str, Any]  # of the axes, seed included
    diverged: list[str]  # "disentangle", or methods
    policies: dict[str, Judged] = {}  # noqa: RUF012
    # None of a β-VAE that diverged:
    threshold: float | None = None
    mask: np.ndarray | None = None  # [O] bool
    active: np.ndarray | None = None  # [O] bool
    nuisance_share: np.ndarray | None = None  # [O]
    precision: float | None = None  # of the mask's latents, the share that is the nuisance's
    recall: float | None = None  # of the nuisance's latents, the share that is masked
    expert: JudgedExpert | None = None
    seconds: dict[str, float] = {}  # noqa: RUF012  of each policy's training, with its batch


class Pictures(NamedTuple):
    """What a run's figures show, as NumPy arrays; images are uint8 RGB."""

    strips: dict[str, np.ndarray]  # view -> [n, H, W, 3], of the same expert trajectory
    traversals: np.ndarray  # [O, V, H, W, 3] one latent at each value, the others at their mean
    traversal_values: np.ndarray  # [V] in prior standard deviations
    region: np.ndarray  # [H, W] bool, the pixels that masked latents reach; [0, 0] if unknown
    rollouts: dict[str, np.ndarray]  # policy -> [T, H, W, 3], from the same start
    alive: dict[str, np.ndarray]  # policy -> bool [T], False once it has ended out of bounds
    dt: float  # s a frame


# Share of a latent's variance that the previous action explains: of the nuisance's latents, and of
# every other active one.
SAME, APART = 0.9, 0.1


def save(directory: Path, results: NamedTuple, pictures: Pictures) -> None:
    """Writes results.json and pictures.npz, each in one step; the results last: they end a run."""
    write_arrays(directory / PICTURES, dict(_flat(pictures)))
    write_json(directory / FILE, results)


def finished(directory: Path, kind: type[Found] = Results) -> Found | None:
    """The results of a run that was done before, if it was, and they can be read."""
    try:
        return load(directory, kind)[0]
    except UNREADABLE:
        return None


def load(directory: Path, kind: type[Found] = Results) -> tuple[Found, Pictures]:
    """What `save` wrote, of that kind.

    Raises:
      UNREADABLE, see `plain`: if it is not there, or not what it was.
    """
    results = from_plain(kind, json.loads((directory / FILE).read_text(encoding="utf-8")))
    with np.load(directory / PICTURES) as arrays:
        found: dict[str, Any] = {name: {} for name in ("strips", "rollouts", "alive")}
        for name in arrays.files:
            field, _, key = name.partition("/")
            if key:
                found[field][key] = arrays[name]
            else:
                found[field] = arrays[name]
    found["dt"] = float(found["dt"])
    return results, Pictures(**found)


def _flat(pictures: Pictures):
    for field, value in pictures._asdict().items():
        if isinstance(value, dict):
            yield from ((f"{field}/{key}", array) for key, array in value.items())
        else:
            yield field, np.asarray(value)

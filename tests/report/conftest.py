"""Runs and pictures that a report is made of: their types are real, their numbers made up."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from jaxdeconf.pipeline.results import (
    Judged,
    JudgedExpert,
    Losses,
    OutcomeForm,
    Pictures,
    PValues,
    Reconstruction,
    Results,
)

STATES, HORIZON, LATENTS, VALUES, STEPS, FALLEN = 4, 3, 6, 5, 100, 20
LOSSES = {"BcVanilla": 9.1, "BcManual": 1.3, "Masked": 1.5, "Reconstructed": 8.0}


def judged(loss: float) -> Judged:
    curve = [[e, loss * (1 + 3 * math.exp(-e / 4)), loss / (1 + 0.4 * e)] for e in (1, 5, 10, 20)]
    losses = Losses(loss, curve[-1][2], curve, curve[-1][2] / 10, 0.9 * loss)
    return Judged(losses, min(1.0, 2.0 / loss), 0.1 * loss, 0.1 * loss, 0.01 * loss)


def run_of(seed: int = 0, losses: dict[str, float] = LOSSES, **changes) -> Results:
    """A run in which o₃ is the nuisance's latent and is masked."""
    rng = np.random.default_rng(seed)
    state_observation = 10.0 ** rng.uniform(-3.5, -0.5, (STATES, LATENTS))
    state_observation[:, 2] = [2e-4, -1e-4, 5e-5, -3e-4]
    state_observation[:, 4:] = -2e-4
    return Results(
        system="cartpole",
        preset="laptop",
        seed=seed,
        state_names=["x (m)", "x_dot (m/s)", "theta (rad)", "theta_dot (rad/s)"],
        action_names=["force (N)"],
        outcome=OutcomeForm("survival", ".0%", "Survival: share of rollouts in bounds."),
        reaction_horizon=HORIZON,
        statistic="hoeffding",
        threshold=1e-3,
        mask=np.array([False, False, True, False, True, True]),
        region=0.04,
        state_observation=state_observation,
        state_action=10.0 ** rng.uniform(-3.5, -0.8, (STATES, HORIZON, 1)),
        p_values=PValues(rng.uniform(0, 1, (STATES, LATENTS)), np.full((STATES, HORIZON, 1), 1e-5)),
        active=np.array([True, True, True, True, False, False]),
        kl=np.array([3.1, 2.7, 1.9, 1.2, 0.01, 0.002]),
        nuisance_correlation=np.array([0.03, 0.05, 0.986, 0.11, 0.2, 0.02]),
        nuisance_share=np.array([0.01, -0.016, 0.97, 0.08, 0.05, 0.0]),
        reconstruction=Reconstruction(0.52, 3.1),
        expert=JudgedExpert(0.95, 1.0, 0.031, 0.0004),
        policies={name: judged(loss) for name, loss in losses.items()},
        seconds={"collect": 21.3, "disentangle": 310.0, "mask": 0.8, "report": 4.0},
        peak_memory_mb=2100.0,
        versions={"python": "3.11.2", "jax": "0.10.2", "jaxdeconf": "0.1.0", "device": "cpu"},
        config={"seed": seed, "clone": {"learning_rate": 1e-3, "widths": [64, 128]}},
    )._replace(**changes)


def film(height: int, width: int, steps: int = STEPS) -> np.ndarray:
    """uint8 [T, H, W, 3]: a shaded bar that wanders over white, and a square whose colour moves."""
    y, x = np.mgrid[:height, :width]
    time = np.linspace(0.0, 1.0, steps)[:, None, None]
    bar = np.clip(abs(x - width * (0.3 + 0.4 * time)) - width / 12, 0.0, 1.0) * (y > height / 2)
    shade = np.where(y > height / 2, bar, 1.0)[..., None]
    frames = 255 * (shade + (1 - shade) * np.array([0.8, 0.5, 0.2]))
    corner = (slice(None), slice(height // 5), slice(width // 5))
    frames[corner] = 255 * np.stack([time, 1.0 - time, 0.0 * time], axis=-1)
    return frames.round().astype(np.uint8)


def pictures_of(height: int = 64, width: int = 64, names=tuple(LOSSES), steps=STEPS) -> Pictures:
    """The first policy has left the bounds by step FALLEN; nobody else does."""
    shown, alive = film(height, width, steps), np.ones(steps, bool)
    grid = shown[: LATENTS * VALUES].reshape(LATENTS, VALUES, height, width, 3)
    return Pictures(
        strips={name: shown[:30:3] for name in ("Frame", "BcManual", "Masked", "Reconstructed")},
        traversals=grid,
        traversal_values=np.linspace(-2, 2, VALUES),
        region=np.indices((height, width)).max(axis=0) < height // 5,
        rollouts={name: shown for name in ("Expert", *names)},
        alive={
            name: np.arange(steps) < FALLEN if name in names[:1] else alive
            for name in ("Expert", *names)
        },
        dt=0.05,
    )


@pytest.fixture(scope="session")
def make() -> Callable[..., Results]:
    return run_of


@pytest.fixture(scope="session")
def draw() -> Callable[..., Pictures]:
    return pictures_of


@pytest.fixture(scope="session")
def pictures() -> Pictures:
    return pictures_of()


@pytest.fixture(scope="session")
def brief() -> Pictures:
    return pictures_of(steps=30)

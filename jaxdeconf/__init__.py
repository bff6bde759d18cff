"""Deconfounded imitation learning: find the nuisance a cloned policy would copy, and mask it.

    collect or read ─▶ disentangle ─▶ mask ─▶ clone ─▶ evaluate ─▶ report
    demonstrations     β-VAE          Alg. 1   BC       closed     figures,
    and frames under   on random      s₁, o₁,  a method loop       numbers,
    random actions     frames         a₁..a_H  a row    rollouts   pages

`deconfound` is the workflow on arrays, `METHODS` the table of methods, `run` the whole of it for a
simulator, kept and resumed; docs/architecture.md has the map. Pfrommer, Bai, Lee & Sojoudi (2023),
"Initial State Interventions for Deconfounded Imitation Learning".
"""

from jaxdeconf import systems
from jaxdeconf.deconfound import clone_policy, deconfound, learn_latents, mask_latents
from jaxdeconf.demos import Demos
from jaxdeconf.evaluate import copycat, drive, rollout_loss
from jaxdeconf.independence import (
    dependence,
    hoeffding_d,
    p_value,
    permutation_p_value,
    refined_d,
    required_trajectories,
    threshold,
)
from jaxdeconf.mask import Mask, find_mask
from jaxdeconf.method import Evidence, Method
from jaxdeconf.methods import METHODS
from jaxdeconf.owndata.view import load_view
from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.run import run
from jaxdeconf.region import find_region
from jaxdeconf.systems import System
from jaxdeconf.version import __version__

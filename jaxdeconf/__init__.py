"""Deconfounded imitation learning: find the nuisance a cloned policy would copy, and mask it.

    key ─▶ collect ─▶ disentangle ─▶ mask ─▶ clone ─▶ evaluate ─▶ report
           expert &     β-VAE         Alg. 1    BC       closed     figures,
           random       on random     on s₁,o₁, on four  loop       tables,
           trajectories frames        a₁..a_H   views    rollouts   checkpoints

`systems` what moves, `vision` how it looks, `expert` the controller to imitate, `independence`
Hoeffding's D, `mask` Algorithm 1, `nets` networks, `learn` training, `evaluate` and `leakage`
scores, `pipeline` runs, disk and screen. Pfrommer, Bai, Lee & Sojoudi (2023), "Initial State
Interventions for Deconfounded Imitation Learning".
"""

__version__ = "0.1.0"

"""Tests of independence by ranks: statistics of all pairs of columns, and their null law.

hoeffding_d, refined_d    D and the refined R, N log N a pair, on one scale; R for ties, too
p_value, threshold        their asymptotic law under independence, and its inverse
dependence                D, R, p and false discovery rate of two tables' columns
permutation_p_value       exact in level for any statistic and few samples
required_trajectories     how many samples show a given dependence; least_strength is its inverse
"""

from jaxdeconf.independence.dependence import Dependence, dependence
from jaxdeconf.independence.hoeffding import hoeffding_d
from jaxdeconf.independence.null import p_value, threshold
from jaxdeconf.independence.permutation import permutation_p_value
from jaxdeconf.independence.power import least_strength, required_trajectories
from jaxdeconf.independence.refined import refined_d

__all__ = [
    "Dependence",
    "dependence",
    "hoeffding_d",
    "least_strength",
    "p_value",
    "permutation_p_value",
    "refined_d",
    "required_trajectories",
    "threshold",
]

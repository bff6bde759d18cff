"""Tests of independence by ranks: statistics of all pairs of columns, and their null law.

hoeffding_d, refined_d    D and the refined R, exactly, N log N a pair, on one scale
p_value, threshold        their asymptotic law under independence, and its inverse
permutation_p_value       for discrete data, where that law is too wide
"""

from jaxdeconf.independence.hoeffding import hoeffding_d
from jaxdeconf.independence.null import p_value, threshold
from jaxdeconf.independence.permutation import permutation_p_value
from jaxdeconf.independence.refined import refined_d

__all__ = ["hoeffding_d", "p_value", "permutation_p_value", "refined_d", "threshold"]

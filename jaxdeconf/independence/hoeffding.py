"""Hoeffding's D between every column of x and every column of y, exactly.

Source: Hoeffding, "A non-parametric test of independence", Ann. Math. Stat. 19 (1948); ties by
midranks as in Hollander, Wolfe & Chicken (2014), eq. 8.92, and R's Hmisc. With a, b the numbers
of samples below sample i in x and in y, and c in both, N (N-1) ... (N-4) D_n is

    sum_i  a (a-1) b (b-1) - 2 (N-2) (a-1) (b-1) c + (N-2) (N-3) c (c-1).

Its terms grow like N^4 and cancel. With e = a b - (N-2) c and d = N-1-a-b+c the same sum is

    sum_i  e (e + 1 - a - b) - (N-2) c (d - 1),

whose terms are no larger than the answer: float64 sums it exactly, but for rounding.
"""

from jax import Array
from jax.typing import ArrayLike

from jaxdeconf.independence.statistic import Below, Statistic, Total
from jaxdeconf.independence.table import all_pairs


def hoeffding_d(x: ArrayLike, y: ArrayLike) -> Array:
    """Hoeffding's D, on the scale 30 D_n, for every pair of a column of x and a column of y.

    Args:
      x: [N] or [N, S] real numbers, N >= 5. NumPy arrays are ranked in their own precision.
      y: [N] or [N, P] real numbers.
    Returns:
      [], [P], [S] or [S, P]: D, in [-0.5, 1] without ties; its mean under independence is 0 and
      values above 0 indicate dependence. Default float type, but computed in 64 bits even where
      jax_enable_x64 is off.
    Raises:
      ValueError: on shapes, lengths or types that do not fit, and on NaN outside of jit. Inside
        of jit a NaN in a column makes that column's results NaN.
    """
    return all_pairs(x, y, HOEFFDING)


def _hoeffding(below: Below, n: int, total: Total) -> Array:
    a, b, c = below.x, below.y, below.both
    e = a * b - (n - 2) * c
    d = n - 1 - a - b + c
    return total(e * (e + 1 - a - b) - (n - 2) * c * (d - 1))


HOEFFDING = Statistic(_hoeffding, weighted=False)

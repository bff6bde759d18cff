"""The refined Hoeffding statistic R, which is zero only under independence.

Source: Blum, Kiefer & Rosenblatt, "Distribution free tests of independence based on the sample
distribution function", Ann. Math. Stat. 32 (1961). Where Hoeffding's D integrates (F - G H)^2
over the joint law dF, and can vanish on a singular one, R integrates it over dG dH. Its unbiased
estimate R_n is a U-statistic like D_n (Even-Zohar 2020, arXiv:2010.09712, computes it from counts
of patterns). Here it follows from dominance counts alone. With c_ij the samples below sample i in
x and below sample j in y, and a, b as for D,

    R_n = mean over distinct i, j, k, l    of  [k, l below i in x and below j in y]
        - 2 mean over distinct i, j, k, l, m of [k below i in x and j in y, l below i in x,
                                                 m below j in y]  +  1/9,

whose sums over i, j are of products of min(A_k, A_l), with A the samples above: one sum of
y-ranks over the samples below in both, beside their count, gives them all in O(N log N).
"""

from jax import Array
from jax.typing import ArrayLike

from jaxdeconf.independence.statistic import Below, Statistic, Total
from jaxdeconf.independence.ties import with_ties


def refined_d(x: ArrayLike, y: ArrayLike) -> Array:
    """The refined R on the scale 30 R_n, for every pair of a column of x and a column of y.

    On this scale R has D's law under independence, so `p_value` and `threshold` hold for it, for
    columns with ties as well: where ties matter, it is the R of continuous columns that has the
    p-value of theirs (see `ties`).

    Args:
      x: [N] or [N, S] real numbers, N >= 5.
      y: [N] or [N, P] real numbers.
    Returns:
      [], [P], [S] or [S, P]: R, in [-1/6, 1/3]; types and errors as `hoeffding_d`.
    """
    return with_ties(x, y, REFINED)[0]


def _refined(below: Below, n: int, total: Total) -> Array:
    a, b, q, w = below.x, below.y, below.both, below.y_of_both
    above_x, above_y = n - 1 - a, n - 1 - b
    # For each sample k the sum of min(A_k, A_l) over the l above k, and over all l but k.
    up_x, up_y = _sum_above(above_x, below.tied_x), _sum_above(above_y, below.tied_y)
    all_x, all_y = above_x * a + up_x, above_y * b + up_y
    four = total(2 * (above_x * (w - b * q) + above_y * up_x) - q * (q - 1))
    five = total(
        all_x * all_y
        - q * (a - 1) * (b - 1)
        - ((b - 1) * (above_x * q + up_x) - above_x * (w - q))
        - ((a - 1) * (w - b * q) + above_y * ((n - 2) * above_x - up_x))
        - q * (q - 1) / 2
    )
    five = five + n * (n - 1.0) * (n - 2.0) / 6
    # 1/9 without ties: the chance that two samples lie below a third, in x times in y.
    mean_x, mean_y = (2 * total(v * (n - 1 - v)) / (n * (n - 1.0) * (n - 2.0)) for v in (a, b))
    product = n * (n - 1.0) * (n - 2.0) * (n - 3.0) * (n - 4.0) * mean_x * mean_y
    return (n - 2) * four - 2 * five + product


def _sum_above(above: Array, tied: Array) -> Array:
    return (above * (above - 1) + tied * (tied + 1)) / 2


REFINED = Statistic(_refined, weighted=True)

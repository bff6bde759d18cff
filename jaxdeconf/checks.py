"""What an argument must be; a wrong one raises ValueError in one line: name, expected, got.

Inside a jax transformation there are no values to look at: types and shapes are checked all the
same, when the function is traced.
"""

import math
import operator
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

# Counts, steps and indices are int32 on the device.
_MOST = 2**31 - 1
_TYPES = {
    "numbers": (np.floating, np.integer),
    "floats": (np.floating,),
    "bool": (np.bool_,),
    "uint8": (np.uint8,),
}


def integer(name: str, value: Any, least: int = 1, most: int = _MOST) -> int:
    """An integer, as int; True and 2.0 are none."""
    try:
        given = None if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        given = None
    if given is None or given < least:
        raise _wrong(name, f"an integer >= {least}" if least != 1 else "a positive integer", value)
    if given > most:
        raise _wrong(name, f"an integer <= {most}", value)
    return given


def number(name: str, value: Any, expected: str, above: float, below: float = math.inf) -> None:
    """A finite number strictly between two bounds; `expected` is what the message calls it."""
    if isinstance(value, Tracer):
        return
    try:
        given = math.nan if isinstance(value, str | bytes | bool) else float(value)
    except (OverflowError, TypeError, ValueError):  # an integer beyond any float, or no number
        given = math.nan
    if not math.isfinite(given) or not above < given < below:
        raise _wrong(name, expected, value)


def positive(name: str, value: Any) -> None:
    """A finite number above 0."""
    number(name, value, "a positive number", 0.0)


def not_negative(name: str, value: Any) -> None:
    """A finite number from 0 on."""
    number(name, value, "a number >= 0", -math.ulp(0.0))


def one_of(name: str, value: Any, choices: Sequence[str]) -> None:
    """One of some words."""
    if value not in tuple(choices):
        raise _wrong(name, f"one of {', '.join(map(str, choices))}", value)


def size(name: str, value: Any) -> None:
    """(height, width) of an image."""
    if not isinstance(value, tuple) or len(value) != 2:
        raise _wrong(name, "(height, width)", value)
    for pixels in value:
        integer(name, pixels)


def instance(name: str, value: Any, kind: type) -> None:
    """An object of a class."""
    if not isinstance(value, kind):
        raise _wrong(name, f"a {kind.__name__}", value)


def key(name: str, value: Any) -> None:
    """One random key, of `jax.random.key` or, as older code has them, `jax.random.PRNGKey`."""
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not (typed and shape == ()) and not (dtype == np.uint32 and shape == (2,)):
        got = value if dtype is None else f"{dtype} of shape {shape}"
        raise ValueError(f"{name}: expected one random key, as jax.random.key(0), got {got!s:.80}")


def array(
    name: str,
    value: Any,
    form: str,
    shape: tuple[int | None, ...],
    of: str = "numbers",
    finite: bool = False,
) -> Any:
    """An array; gives it back, NumPy's or JAX's, as it came.

    Args:
      name: of the argument.
      value: what came.
      form: how the message writes the shape, "[N, S]".
      shape: the size of every axis; None is any size but 0.
      of: "numbers", "floats", "bool" or "uint8".
      finite: whether NaN and infinity are refused.
    """
    given, types = plain(name, value), _TYPES[of]
    fits = len(given.shape) == len(shape) and all(
        size == wanted or (wanted is None and size > 0)
        for size, wanted in zip(given.shape, shape, strict=True)
    )
    if not fits or not any(jnp.issubdtype(given.dtype, kind) for kind in types):
        got = f"{given.dtype} of shape {given.shape}"
        raise ValueError(f"{name}: expected {of} of shape {form}, got {got}")
    if finite and not isinstance(given, Tracer):
        finite_numbers(name, np.asarray(given))
    return given


def plain(name: str, value: Any) -> Any:
    """A value as an array, NumPy's or JAX's, if no mask, unit or time is lost on the way."""
    if np.ma.is_masked(value):
        raise ValueError(f"{name}: expected no masked values, got {np.ma.count_masked(value)}")
    unit = getattr(value, "units", getattr(value, "unit", None))  # pint, unyt; astropy
    if unit is not None:
        raise ValueError(f"{name}: expected numbers without a unit, got some in {unit}")
    try:
        given = value if isinstance(value, jax.Array) else np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name}: expected an array, got rows of different lengths") from error
    if given.dtype.kind in "mM":  # to NumPy, a time span is an integer
        raise ValueError(f"{name}: expected numbers, got {given.dtype} of shape {given.shape}")
    return given


def finite_numbers(name: str, values: np.ndarray) -> None:
    """No NaN and no infinity in an array of numbers."""
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        place = tuple(bad[0].tolist())
        raise ValueError(f"{name}: expected finite numbers, got {values[place]} at {list(place)}")


def same_length(name: str, length: int, wanted: int, what: str) -> None:
    """As many rows as another argument has; `what` says of what."""
    if length != wanted:
        raise ValueError(f"{name}: expected {wanted} {what}, got {length}")


def _wrong(name: str, expected: str, value: Any) -> ValueError:
    shown = " ".join(repr(value).split())  # an array's has line breaks
    return ValueError(f"{name}: expected {expected}, got {shown:.80}")

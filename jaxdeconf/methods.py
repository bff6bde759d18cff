"""The methods, a row each. To add one, add a row; nothing else names a method. Rivals' are theirs.

They are one `clone` on different views of the same frames (Section V-B). Inpainted is ours, the
others are the paper's. Everything that goes by method follows from this table: order and colours,
what is cloned and driven, what depends on what.
"""

from collections.abc import Collection
from typing import Any

from jaxdeconf import checks
from jaxdeconf.learn.clone import View
from jaxdeconf.method import Evidence, Method, as_they_are, inpainted, masked, unmasked
from jaxdeconf.rivals import fair, oracles
from jaxdeconf.views import covered


def usual() -> tuple[str, ...]:
    """The methods of a run that asks for none: the paper's, and ours."""
    return tuple(name for name, method in METHODS.items() if not method.rival)


def named_by(kind: str) -> tuple[str, ...]:
    """The methods of a kind, in the table's order; "all" are all."""
    return tuple(name for name, row in METHODS.items() if kind in ("all", row.kind))


def require(name: str, met: Collection[str]) -> None:
    """Refuses a method that is not in the table, or that needs more than is met.

    Raises:
      ValueError: naming the method and what it needs.
    """
    checks.one_of("methods", name, tuple(METHODS))
    for need in METHODS[name].needs:
        if need not in met:
            words = need.replace("_", " ")
            raise ValueError(f"methods: expected one that needs no {words}, got {name!r}")


def masking() -> tuple[str, ...]:
    """The methods that need a mask."""
    return tuple(name for name, method in METHODS.items() if "mask" in method.needs)


def _by_hand(evidence: Evidence) -> tuple[View, Any]:
    assert evidence.cover is not None
    return covered(evidence.cover), {}


METHODS: dict[str, Method] = {
    "BcVanilla": Method(as_they_are, "The frames as they are."),
    "BcManual": Method(
        _by_hand,
        "The nuisance covered by a human who knows where it is.",
        needs=("cover",),
        kind="oracle",
    ),
    "Masked": Method(
        masked,
        "Reconstructed by the β-VAE without the latents that Algorithm 1 masked.",
        needs=("encoder", "mask"),
    ),
    "Inpainted": Method(
        inpainted,
        "The frames as they are, but for a patch that stands still where the masked latents reach.",
        needs=("encoder", "mask", "region"),
    ),
    "Reconstructed": Method(
        unmasked,
        "Reconstructed by the same β-VAE with nothing masked: what the reconstruction does alone.",
        needs=("encoder",),
        kind="control",
    ),
}
METHODS |= fair.ROWS | oracles.ROWS

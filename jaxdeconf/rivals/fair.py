"""Rivals that are told no more than the demonstrations hold, and their controls: a row each."""

from jaxdeconf.method import Method, as_they_are, unmasked
from jaxdeconf.rivals import codes, controls, fca, keyframes, latent_dropout, oreo, palr

ROWS: dict[str, Method] = {
    "Palr": Method(
        as_they_are,
        "Features that depend on the previous action by the present one alone (HSCIC).",
        needs=("previous_actions",),
        rival=True,
        objective=palr.objective,
        strength=10.0,  # the authors' α
        config=palr.in_larger_batches,
    ),
    "PalrPlain": Method(
        as_they_are,
        "The frames as they are, in Palr's batches.",
        kind="control",
        rival=True,
        config=palr.in_larger_batches,
    ),
    "Fca": Method(
        as_they_are,
        "Features from which an adversary cannot tell the previous action.",
        needs=("previous_actions",),
        rival=True,
        objective=fca.objective,
        strength=2.0,  # the authors' for Hopper
        begin=fca.begin,
    ),
    "Keyframes": Method(
        as_they_are,
        "More weight on the tenth of the steps whose action the one before tells least of.",
        needs=("previous_actions",),
        rival=True,
        strength=5.0,  # the authors' weight
        data=keyframes.weighted,
    ),
    "Oreo": Method(
        as_they_are,
        "All places of a random half of a VQ-VAE's codes dropped from the last map in training.",
        rival=True,
        objective=oreo.objective,
        strength=0.5,  # the authors' share
        config=oreo.dropping_codes,
        extra=codes.codes,
    ),
    "OreoPlain": Method(
        as_they_are,
        "The frames as they are, on Oreo's network.",
        kind="control",
        rival=True,
        config=oreo.on_a_map,
    ),
    "LatentDropout": Method(
        unmasked,
        "Learnt on reconstructions by the β-VAE without a random part of the latents.",
        needs=("encoder",),
        rival=True,
        objective=latent_dropout.objective,
        strength=0.5,
        config=controls.dropping,
        extra=latent_dropout.latents,
        begin=latent_dropout.begin,
    ),
    "OneFrame": Method(
        as_they_are,
        "The present frame alone: void here, where that frame itself shows the nuisance.",
        kind="control",
        rival=True,
        config=controls.of_one_frame,
    ),
    "Cutout": Method(
        as_they_are,
        "A random square of each frame covered in training.",
        kind="control",
        rival=True,
        objective=controls.cutout_objective,
    ),
    "Dropout": Method(
        as_they_are,
        "A random part of the network's last map dropped in training.",
        kind="control",
        rival=True,
        objective=controls.dropout_objective,
        strength=0.5,
        config=controls.dropping,
    ),
    "Longer": Method(
        as_they_are,
        "The frames as they are, 2.5 times as many samples.",
        kind="control",
        rival=True,
        config=controls.longer,
    ),
}

"""Methods: what each one shows its policy, and what it needs for that."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf import method, methods, systems, views
from jaxdeconf.demos import Demos
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.method import Evidence
from jaxdeconf.methods import METHODS
from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.vision import raster

SYSTEM = systems.get("cartpole")
CONFIG = VAEConfig(channels=(2,), latents=3, norm="none")
ACTIVE, MASK = jnp.array([True, True, False]), jnp.array([False, True, False])
DEMOS = Demos(np.zeros((5, 2, 16, 24, 3), np.uint8), np.zeros((5, 2, 1)), np.zeros((5, 2)))


@pytest.fixture(scope="module")
def evidence():
    return Evidence(
        Encoder(CONFIG, vae.init(CONFIG, jax.random.key(0), (64, 64)), jnp.ones(3), ACTIVE),
        MASK,
        jnp.zeros((64, 64), bool),
        SYSTEM.nuisance.cover,
        lambda states: states[:, :1],
    )


@pytest.mark.parametrize(
    ("name", "keep"), [("Masked", [True, False, False]), ("Reconstructed", [True, True, False])]
)
def test_reconstructions_keep_the_active_latents_but_the_masked(name, keep, evidence):
    view, parameters = METHODS[name].view(evidence)
    np.testing.assert_array_equal(parameters["keep"], keep)
    assert view is views.reconstructed(CONFIG)
    assert parameters["variables"] is evidence.encoder.variables


def test_the_papers_other_methods_show_the_frames_and_the_covered_frames(evidence, grains):
    grains = raster.dequantize(grains)
    view, parameters = METHODS["BcVanilla"].view(Evidence())
    np.testing.assert_array_equal(view(parameters, grains), grains)
    view, parameters = METHODS["BcManual"].view(evidence)
    expected = views.covered(SYSTEM.nuisance.cover)({}, grains)
    np.testing.assert_array_equal(view(parameters, grains), expected)


@pytest.mark.parametrize("name", METHODS)
def test_a_method_makes_its_view_of_what_it_needs_alone(name, evidence):
    row = METHODS[name]
    needed = {need: getattr(evidence, need) for need in row.needs if need != "previous_actions"}
    if row.select is not None:  # a mask of its own
        needed["mask"] = evidence.mask
    view, _ = row.view(Evidence(**needed))
    assert callable(view)
    assert row.note.endswith(".")
    assert row.kind in ("fair", "oracle", "control")


def test_what_is_available_is_what_is_there(evidence):
    assert method.available(DEMOS, Evidence()) == set()
    assert method.available(DEMOS, evidence) == {"encoder", "mask", "region", "cover", "expert"}
    told = Demos(DEMOS.images, DEMOS.actions, DEMOS.initial_states, None, DEMOS.actions)
    assert method.available(told, Evidence(mask=MASK)) == {"mask", "previous_actions"}


def test_a_method_is_refused_for_the_first_need_that_is_not_met():
    methods.require("BcVanilla", ())
    methods.require("Masked", {"mask", "encoder", "expert"})
    with pytest.raises(ValueError, match=r"^methods: expected .* needs no mask, got 'Masked'$"):
        methods.require("Masked", {"encoder"})
    with pytest.raises(ValueError, match=r"^methods: expected one of BcVanilla, .* got 'Bc'$"):
        methods.require("Bc", {"encoder"})


def test_those_that_need_a_mask_are_read_off_the_table(monkeypatch):
    assert methods.masking() == ("Masked", "Inpainted")
    monkeypatch.setitem(METHODS, "Mine", METHODS["BcVanilla"]._replace(needs=("expert", "mask")))
    assert methods.masking() == ("Masked", "Inpainted", "Mine")

"""What a masking will take. Reference: how it must grow; the constants are fitted to maskings."""

from dataclasses import replace

import numpy as np
import pytest

from jaxdeconf.formats.source import Source
from jaxdeconf.learn import disentangle
from jaxdeconf.owndata import cost
from jaxdeconf.owndata.config import Masking
from jaxdeconf.owndata.cost import expected


def source(episodes, size=(64, 64)):
    lengths = np.full(episodes, 20)
    return Source(
        lengths, np.zeros((0, 1)), None, None, [], "frames", size, lambda: iter(()), print
    )


@pytest.fixture(autouse=True)
def machine(monkeypatch):
    """One on which a product takes 40 ms."""
    monkeypatch.setattr(cost, "_product", lambda: 0.04)


def test_minutes_grow_with_steps_and_pixels_and_with_a_slow_machine(monkeypatch):
    config, data = Masking(), (source(600), source(600))
    one = expected(config, *data).minutes
    large = expected(replace(config, size=96), *data).minutes
    long = replace(disentangle.CPU, steps=3150)
    assert expected(replace(config, disentangle=long), *data).minutes == pytest.approx(large)
    assert one < large < 96**2 / 64**2 * one
    monkeypatch.setattr(cost, "_product", lambda: 0.08)
    assert expected(config, *data).minutes == pytest.approx(2 * one)


def test_memory_grows_with_frames_at_the_size_that_is_learnt_and_with_an_episode():
    def memory(*data, size=64):
        return expected(Masking(size=size), *data).memory_mb

    few, many = memory(source(1), source(1)), memory(source(601), source(1))
    frames = 600 * 20 * 64 * 64 * 3 / 2**20
    assert frames < many - few < 3 * frames
    large = memory(source(1, (480, 640)), source(1))
    assert large - few == pytest.approx(3 * 20 * 3 * (480 * 640 - 64 * 64) / 2**20)


def test_a_product_is_timed():
    assert 0.0 < cost._product() < 10.0

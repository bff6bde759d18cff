"""Frames at the size that the β-VAE learns."""

import numpy as np
import pytest

from jaxdeconf.owndata import dataset


@pytest.mark.parametrize("shape", [(32, 32), (48, 64), (20, 50), (96, 96)])
def test_frames_come_to_size_by_area_and_back_in_their_shape(shape):
    """Reference: the mean of what a pixel covers, where sides divide."""
    image = np.random.default_rng(4).integers(0, 256, (2, *shape, 3), dtype=np.uint8)
    small = dataset.fitted(image, 32)
    assert small.shape == (2, 32, 32, 3)
    top, left, height, width = dataset.inner(shape, 32)
    assert height / width == pytest.approx(shape[0] / shape[1], rel=0.1)
    assert not small[:, :top].any()
    assert not small[:, :, :left].any()
    if shape == (96, 96):
        mean = image.reshape(2, 32, 3, 32, 3, 3).mean(axis=(2, 4))
        assert np.abs(small - mean).max() < 1.0  # twice rounded
    assert dataset.unfitted(small, shape).shape == image.shape

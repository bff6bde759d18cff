"""The rasteriser: distances against brute force, areas against geometry, gradients against finite
differences in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.vision import raster

WHITE = jnp.ones((64, 64, 3))
GRID = raster.pixel_centers((64, 64))
INK = (0.2, 0.4, 0.9)


def points(seed=0, count=200):
    xy = np.random.default_rng(seed).uniform(0, 32, (count, 2))
    return xy, (jnp.asarray(xy[:, 0]), jnp.asarray(xy[:, 1]))


@pytest.mark.parametrize(
    ("size", "pixel"), [((64, 64), (5.5, 3.5)), ((32, 32), (11, 7)), ((32, 48), (-5, 7))]
)
def test_pixel_centers_run_over_columns_and_rows(size, pixel):
    x, y = (np.broadcast_to(axis, size) for axis in raster.pixel_centers(size))
    assert (x[3, 5], y[3, 5]) == pixel
    np.testing.assert_allclose((x.mean(), y.mean()), 32, rtol=1e-6)  # the scene's middle


def test_capsule_and_disc_match_brute_force():
    xy, grid = points()
    start, end = np.array([4.0, 20.0]), np.array([25.0, 9.0])
    segment = start + np.linspace(0, 1, 4001)[:, None] * (end - start)
    nearest = np.linalg.norm(xy[:, None] - segment, axis=-1).min(axis=1)
    np.testing.assert_allclose(raster.capsule(grid, start, end, 2.5), nearest - 2.5, atol=1e-4)
    radial = np.linalg.norm(xy - start, axis=1)
    np.testing.assert_allclose(raster.disc(grid, start, 3.0), radial - 3, atol=1e-4)
    # A segment of no length is a disc.
    np.testing.assert_allclose(raster.capsule(grid, start, start, 3.0), radial - 3, atol=1e-4)


def test_rectangle_matches_brute_force():
    xy, grid = points()
    center, half = np.array([14.0, 17.0]), np.array([6.0, 3.0])
    side = np.linspace(-1, 1, 2001)
    one = np.ones_like(side)
    edges = [(side, one), (side, -one), (one, side), (-one, side)]
    outline = center + half * np.concatenate([np.column_stack(edge) for edge in edges])
    nearest = np.linalg.norm(xy[:, None] - outline, axis=-1).min(axis=1)
    inside = (np.abs(xy - center) < half).all(axis=1)
    assert inside.any()
    expected = np.where(inside, -nearest, nearest)
    np.testing.assert_allclose(raster.rectangle(grid, center, half), expected, atol=5e-3)


@pytest.mark.parametrize("size", [(64, 64), (96, 96), (48, 80)])
def test_painted_area_is_the_shape_area(size):
    points = raster.pixel_centers(size)
    ink = 1 - raster.paint(jnp.ones((*size, 3)), raster.disc(points, (15.7, 16.2), 7.3), (0, 0, 0))
    pixels_per_unit = min(size) / 64
    np.testing.assert_allclose(ink[..., 0].sum(), np.pi * (7.3 * pixels_per_unit) ** 2, rtol=3e-3)
    assert 0 <= ink.min() <= ink.max() <= 1


@pytest.mark.parametrize("side", [32, 64, 128])
def test_edges_are_one_pixel_wide(side):
    """An edge between two pixels is sharp at any resolution."""
    box = raster.rectangle(raster.pixel_centers((side, side)), (24.0, 32.0), (8.0, 16.0))
    expected = np.zeros((side, side))
    expected[side // 4 : 3 * side // 4, side // 4 : side // 2] = 1
    np.testing.assert_allclose(raster.coverage(box), expected, atol=1e-6)


def shapes(parameters):
    """One image of every shape, from 11 parameters."""
    p = parameters
    image = raster.paint(WHITE, raster.rectangle(GRID, p[0:2], p[2:4]), INK)
    image = raster.paint(image, raster.capsule(GRID, p[4:6], p[6:8], 1.6), (0.9, 0.1, 0.3))
    return raster.paint(image, raster.disc(GRID, p[8:10], p[10]), (0.1, 0.8, 0.2))


GENERIC = (9.37, 8.1, 4.2, 3.7, 20.2, 5.1, 27.6, 14.3, 12.4, 23.8, 5.2)
DEGENERATE = {
    "capsule of no length": (9.3, 8.1, 4.2, 3.7, 20.0, 5.0, 20.0, 5.0, 12.4, 23.8, 5.2),
    "points on pixel centres": (9.5, 8.5, 4.0, 4.0, 20.5, 5.5, 27.5, 5.5, 12.5, 23.5, 5.0),
    "empty shapes": (9.5, 8.5, 0.0, 0.0, 20.5, 5.5, 20.5, 5.5, 12.5, 23.5, 0.0),
    "far outside": (-1e6, 1e6, 4.0, 4.0, 1e6, 5.5, 1e6, 1e6, -1e6, -1e6, 5.0),
}


def test_gradients_match_finite_differences():
    with jax.enable_x64(True):
        at, h = jnp.array(GENERIC), 1e-5
        weights = jnp.asarray(np.random.default_rng(0).normal(size=WHITE.shape))
        loss = jax.jit(lambda p: jnp.sum(weights * shapes(p)))
        gradient = jax.grad(loss)(at)
        steps = h * jnp.eye(len(GENERIC))
        numeric = jnp.array([(loss(at + d) - loss(at - d)) / (2 * h) for d in steps])
        np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6)
        assert jnp.abs(gradient).min() > 1e-3


@pytest.mark.parametrize("parameters", DEGENERATE.values(), ids=DEGENERATE.keys())
def test_gradients_stay_finite(parameters):
    jacobian = jax.jit(jax.jacfwd(shapes))(jnp.array(parameters))
    gradient = jax.jit(jax.grad(lambda p: shapes(p).sum()))(jnp.array(parameters))
    assert jnp.isfinite(jacobian).all()
    assert jnp.isfinite(gradient).all()


def test_quantize_and_back():
    levels = jnp.arange(256, dtype=jnp.uint8)
    np.testing.assert_array_equal(raster.quantize(raster.dequantize(levels)), levels)
    np.testing.assert_array_equal(raster.quantize(jnp.array([-0.2, 0.5, 1.7])), [0, 128, 255])

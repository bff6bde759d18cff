"""Frames as other people store them, as uint8 RGB [T, H, W, 3], and back.

Met are channels first or last, one, three or four of them, uint8, floats in [0, 1] or in [0, 255].
"""

import io
from collections.abc import Iterable

import numpy as np

from jaxdeconf.formats.source import Redraw


def rgb(name: str, stored: np.ndarray) -> np.ndarray:
    """uint8 [T, H, W, 3] of stored frames.

    Raises:
      ValueError: if they are no images; names their type and shape, or their range.
    """
    last = _channels_last(stored)
    if last is None or stored.dtype.kind not in "uf" or stored.dtype.itemsize > 8:
        got = f"{stored.dtype} of shape {list(stored.shape)}"
        raise ValueError(f"{name}: expected images [T, H, W, 3], uint8 or floats, got {got}")
    values = np.repeat(last, 3, axis=-1) if last.shape[-1] == 1 else last[..., :3]
    if values.dtype == np.uint8:
        return values
    low, high = float(values.min()), float(values.max())
    if not (low >= 0.0 and high <= 255.0):
        raise ValueError(f"{name}: expected values in [0, 1] or [0, 255], got {low:g} to {high:g}")
    return np.round(values * _levels(stored)).astype(np.uint8)


def redrawn(name: str, stored: np.ndarray, redraw: Redraw) -> np.ndarray:
    """Stored frames with what `redraw` changes of them; all else to the bit."""
    before = rgb(name, stored)
    after = redraw(before)
    last = _channels_last(stored)
    assert last is not None
    new, colours = last.copy(), last.shape[-1]
    drawn = after.mean(axis=-1, keepdims=True) if colours == 1 else after
    changed = (before != after).any(axis=-1, keepdims=True)
    if stored.dtype != np.uint8:
        drawn = drawn / _levels(stored)
    depth = min(colours, 3)
    new[..., :depth] = np.where(changed, drawn, last[..., :depth]).astype(stored.dtype)
    return new if last.shape == stored.shape else np.moveaxis(new, -1, 1)


def decoded(name: str, files: Iterable[bytes]) -> np.ndarray:
    """uint8 [T, H, W, C] of image files, PNG or JPEG.

    Raises:
      ValueError: if their sizes differ; OSError, if one is none.
    """
    from PIL import Image  # late, as in `owndata.dataset`

    images = [np.atleast_3d(np.asarray(Image.open(io.BytesIO(file)))) for file in files]
    if len(sizes := {image.shape for image in images}) > 1:
        raise ValueError(f"{name}: expected images of one size, got {sorted(sizes)}")
    return np.stack(images)


def png(image: np.ndarray) -> bytes:
    """An image [H, W, C] as a PNG file, which loses nothing."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image.squeeze(-1) if image.shape[-1] == 1 else image).save(file, "PNG")
    return file.getvalue()


def _channels_last(stored: np.ndarray) -> np.ndarray | None:
    if stored.ndim != 4:
        return None
    if stored.shape[-1] in (1, 3, 4):
        return stored
    return np.moveaxis(stored, 1, -1) if stored.shape[1] in (1, 3, 4) else None


def _levels(stored: np.ndarray) -> float:
    """By what floats are multiplied: those that never exceed 1 are shares."""
    return 255.0 if float(stored.max()) <= 1.0 else 1.0

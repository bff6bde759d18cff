"""Rollouts side by side as an animated GIF that loops.

A GIF has 256 colours in all, and the nuisance *is* a colour: the palette is chosen for the largest
error, not the mean one, in which white would drown it. Frames live as palette indices from then on;
captions use greys reserved in the palette.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from jaxdeconf.pipeline.figures import COLORS

_ZOOM, _GAP, _HEADER, _FOOTER = 3, 8, 34, 26  # pixels, but the first: image pixels a frame pixel
_GREYS = 16  # white to black, for anti-aliased text
_SHORTEST = 0.02  # s; browsers slow down a GIF with shorter frames to 10 a second


def write_rollouts(
    path: Path, rollouts: Mapping[str, np.ndarray], alive: Mapping[str, np.ndarray], dt: float
) -> None:
    """Writes the GIF in real time.

    Args:
      path: where to.
      rollouts: name -> uint8 [T, 64, 64, 3], from the same start; drawn in this order.
      alive: name -> bool [T], False once the rollout has ended; it is greyed from then on.
      dt: seconds a frame; below 0.02 s, every k-th frame is shown.
    """
    stride = max(1, round(np.ceil(_SHORTEST / dt - 1e-9)))
    names, length = list(rollouts), len(next(iter(rollouts.values())))
    steps = np.arange(0, length, stride)
    clips = np.stack([_greyed(rollouts[name], alive[name])[steps] for name in names])
    palette, clips = _to_palette(clips, [COLORS[name] for name in names])
    ends = [None if alive[name].all() else int(np.argmin(alive[name])) for name in names]
    still = _captions(names, clips.shape[2])
    pages = []
    for frame, step in enumerate(steps):
        page = still.copy()
        for panel in range(len(names)):
            x = _GAP + panel * (clips.shape[2] * _ZOOM + _GAP)
            picture = clips[panel, frame].repeat(_ZOOM, axis=0).repeat(_ZOOM, axis=1)
            page[_HEADER : _HEADER + picture.shape[0], x : x + picture.shape[1]] = picture
            end = ends[panel]
            if end is not None and step >= end:
                _write(
                    page,
                    f"lost at {end * dt:.2f} s",
                    (x + picture.shape[1] / 2, _HEADER + 14),
                    16,
                    "mm",
                )
        _write(page, f"t = {step * dt:.2f} s", (_GAP, page.shape[0] - _FOOTER / 2), 14, "lm")
        image = Image.fromarray(page, "P")
        image.putpalette(palette.tobytes())
        pages.append(image)
    # Rounded to the GIF's hundredths of a second so that errors do not add up.
    shown_to = np.round(np.append(steps[1:], steps[-1] + stride) * dt * 100.0)
    durations = (np.diff(shown_to, prepend=0.0) * 10.0).astype(int).tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    pages[0].save(
        path, save_all=True, append_images=pages[1:], duration=durations, loop=0, optimize=False
    )


def _greyed(frames: np.ndarray, alive: np.ndarray) -> np.ndarray:
    """Frames uint8 [T, H, W, 3] with those after the rollout's end in pale grey."""
    grey = (127.5 + 0.5 * (frames @ np.array([0.299, 0.587, 0.114]))).astype(np.uint8)
    ended = np.broadcast_to(grey[..., None], frames.shape)
    return np.where(np.asarray(alive)[:, None, None, None], frames, ended)


def _to_palette(images: np.ndarray, reserved: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """A palette uint8 [256, 3] and images uint8 [..., 3] as indices uint8 [...] into it.

    It opens with the greys and the reserved colours. Each further one is that of the images which
    those before it serve worst (Gonzalez 1985, farthest-point clustering): none is left far off.
    """
    packed = images.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32)
    distinct, where = np.unique(packed, return_inverse=True)
    colors = np.stack([distinct >> 16, distinct >> 8, distinct], axis=-1) & 255
    palette = np.zeros((256, 3), np.uint8)
    palette[:_GREYS] = np.linspace(255, 0, _GREYS).round()[:, None]
    palette[_GREYS : _GREYS + len(reserved)] = [ImageColor.getrgb(color) for color in reserved]
    index, distance = np.zeros(len(colors), np.uint8), np.full(len(colors), np.inf)
    for entry in range(256):
        if entry >= _GREYS + len(reserved):
            palette[entry] = colors[distance.argmax()]
        moved = ((colors.astype(float) - palette[entry]) ** 2).sum(axis=-1)
        index = np.where(moved < distance, entry, index).astype(np.uint8)
        distance = np.minimum(distance, moved)
    return palette, index[where].reshape(images.shape[:-1])


def _captions(names: list[str], side: int) -> np.ndarray:
    """The page uint8 [H, W] without its pictures: names over bars in the policies' colours."""
    width = _GAP + len(names) * (side * _ZOOM + _GAP)
    page = np.zeros((_HEADER + side * _ZOOM + _FOOTER, width), np.uint8)
    for panel, name in enumerate(names):
        x = _GAP + panel * (side * _ZOOM + _GAP)
        _write(page, name, (x, 14), 17, "lm")
        page[_HEADER - 8 : _HEADER - 4, x : x + side * _ZOOM] = _GREYS + panel
        page[_HEADER - 1 : _HEADER + side * _ZOOM + 1, x - 1 : x + side * _ZOOM + 1] = (
            3  # its frame
        )
    return page


def _write(page: np.ndarray, text: str, at: tuple[float, float], size: int, anchor: str) -> None:
    """Lays text over a page of indices in the reserved greys; `at` is Pillow's anchor, [x, y]."""
    mask = Image.new("L", (page.shape[1], page.shape[0]))
    font = ImageFont.load_default(size)
    ImageDraw.Draw(mask).text(at, text, fill=255, font=font, anchor=anchor)
    shade = (np.asarray(mask) // (256 // _GREYS)).astype(np.uint8)
    np.copyto(page, shade, where=shade > 0)

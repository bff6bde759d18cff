"""Rollouts side by side as an animated GIF that loops.

A GIF has 256 colours in all, and the nuisance *is* a colour: the palette is chosen for the largest
error (maximum coverage), not the mean one, in which white would drown it, and is one for all pages.
"""

import io
from collections.abc import Mapping
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxdeconf.pipeline.results import Pictures
from jaxdeconf.report import canvas

_WIDTH, _GAP, _HEADER, _FOOTER = 180, 8, 34, 26  # pixels; the first is what panels come close to
_FRAME = "#CCCCCC"
_COLORS = 1 << 16  # of which a palette is chosen in seconds
_SHORTEST = 0.02  # s; browsers slow down a GIF with shorter frames to 10 a second


def animate(pictures: Pictures, colors: Mapping[str, str]) -> bytes:
    """A GIF in real time; of steps shorter than 0.02 s, every k-th is shown.

    Args:
      pictures: of rollouts from the same start; greyed from where one has ended.
      colors: policy -> that of its bar; those named here are drawn, in this order.
    """
    stride = max(1, round(np.ceil(_SHORTEST / pictures.dt - 1e-9)))
    steps = np.arange(0, len(next(iter(pictures.rollouts.values()))), stride)
    pages = [_page(pictures, colors, step) for step in steps.tolist()]
    width, height = pages[0].size
    film = Image.new("RGB", (width, height * len(pages)))  # one under another, for one palette
    for place, page in enumerate(pages):
        film.paste(page, (0, place * height))
    if film.getcolors(_COLORS) is None:  # a camera's: coarser by an unseen step, minutes faster
        film = film.point([min(255, 4 * round(value / 4)) for value in range(256)] * 3)
    film = film.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    pages = [film.crop((0, y, width, y + height)) for y in range(0, film.height, height)]
    # Rounded to the GIF's hundredths of a second so that errors do not add up.
    shown_to = np.round(np.append(steps[1:], steps[-1] + stride) * pictures.dt * 100.0)
    durations = (np.diff(shown_to, prepend=0.0) * 10.0).astype(int).tolist()
    frames = {"save_all": True, "append_images": pages[1:], "duration": durations}
    file = io.BytesIO()
    pages[0].save(file, "GIF", loop=0, optimize=False, **frames)
    return file.getvalue()


def _page(pictures: Pictures, colors: Mapping[str, str], step: int) -> Image.Image:
    """One step: the pictures under their names and colours, and the time."""
    height, width = next(iter(pictures.rollouts.values())).shape[1:3]
    zoom = canvas.zoom(width, _WIDTH)
    height, width = zoom * height, zoom * width
    size = (_GAP + len(colors) * (width + _GAP), _HEADER + height + _FOOTER)
    page = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(page)
    for panel, (name, color) in enumerate(colors.items()):
        x, y = _GAP + panel * (width + _GAP), _HEADER
        draw.text((x, 14), name, "black", _font(name, width), "lm")
        draw.rectangle((x, y - 8, x + width - 1, y - 5), color)
        draw.rectangle((x - 1, y - 1, x + width, y + height), _FRAME)
        picture = Image.fromarray(pictures.rollouts[name][step])
        picture, alive = (
            picture.resize((width, height), Image.Resampling.NEAREST),
            pictures.alive[name],
        )
        if not alive[step]:
            picture = picture.convert("L").point([128 + grey // 2 for grey in range(256)])
        page.paste(picture, (x, y))
        if not alive[step]:
            lost = f"lost at {np.argmin(alive) * pictures.dt:.2f} s"
            draw.text((x + width / 2, y + 14), lost, "black", _font(lost, width, 16), "mm")
    clock = (_GAP, size[1] - _FOOTER / 2)
    draw.text(clock, f"t = {step * pictures.dt:.2f} s", "black", _font("", width, 14), "lm")
    return page


@cache
def _font(text: str, width: int, size: float = 17.0):
    """Pillow's own font, smaller where a text would be wider than a panel."""
    long = ImageFont.load_default(size).getlength(text)
    return ImageFont.load_default(min(size, size * width / max(long, 1.0)))

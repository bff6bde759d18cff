"""The view that a masking leaves: from a camera's frames to the same without the nuisance.

    DIR/view/view.json     the size that was learnt, and the β-VAE's shape
    DIR/view/arrays.npz    the pixels that stand still, and what they show; of a view that redraws
                           the whole frame, the β-VAE's weights and the latents that are kept

NumPy in and out, nothing pickled. Shapes: B batch, H × W pixels of the camera's, Z × Z of ours.
"""

import json
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxdeconf import checks
from jaxdeconf.learn.clone import show
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.method import Evidence, inpainted
from jaxdeconf.nets import vae
from jaxdeconf.owndata.dataset import fitted, unfitted
from jaxdeconf.pipeline.checkpoint import named_arrays, read_arrays
from jaxdeconf.pipeline.plain import UNREADABLE, from_plain, write_json
from jaxdeconf.views import reconstructed

_BATCH = 64  # frames at a time
_FORM = 3  # what is held, and what is drawn of it


class View:
    """Frames without what the masked latents show; to be put before a policy at run time.

    A view is what the dataset was written with: `view(frames)` of a frame of the old dataset is the
    frame of the new one. Where only a part of the image is redrawn, no network is asked.
    """

    def __init__(self, network: vae.VAEConfig, parameters: Any, size: int):
        """Of parameters as of `views.inpainted`, or of `views.reconstructed`; use `load_view`."""
        self.network, self.parameters = network, parameters
        whole = np.ones((size, size), bool)
        self.region = np.asarray(parameters["region"]) if self.local else whole
        self._patches: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    @property
    def local(self) -> bool:
        """Whether only a part of the image is redrawn."""
        return "region" in self.parameters

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """Redraws frames.

        Args:
          frames: uint8 [H, W, 3], or several, [B, H, W, 3].
        Returns:
          The same, new; all pixels but the region's as they were.
        Raises:
          ValueError: if they are of another type or shape.
        """
        given = np.asarray(frames)
        shape = (None,) * (given.ndim == 4) + (None, None, 3)
        checks.array("frames", given, "[H, W, 3] or [B, H, W, 3]", shape, "uint8")
        if self.local:
            return np.where(*self._patch(given.shape[-3:-1]), given)
        if given.ndim == 3:
            return self(given[None])[0]
        parts = [self._redrawn(given[i : i + _BATCH]) for i in range(0, len(given), _BATCH)]
        return np.concatenate(parts)

    def _patch(self, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """What stands still in frames of a shape: where, [H, W, 1] bool, and uint8 [H, W, 3]."""
        if shape not in self._patches:
            still = unfitted(np.asarray(self.parameters["still"])[None], shape)[0]
            self._patches[shape] = self.region_at(shape)[..., None], still
        return self._patches[shape]

    def _redrawn(self, frames: np.ndarray) -> np.ndarray:
        size, shape = len(self.region), frames.shape[1:3]
        # Batches of a power of two: a program for each of seven sizes, not for each there is.
        padded = np.zeros((1 << (len(frames) - 1).bit_length(), size, size, 3), np.uint8)
        padded[: len(frames)] = fitted(frames, size)
        drawn = np.asarray(_draw(reconstructed(self.network), self.parameters, padded))
        return unfitted(drawn[: len(frames)], shape)

    def region_at(self, shape: tuple[int, int]) -> np.ndarray:
        """[H, W] bool: the pixels, of frames of that shape, that are redrawn."""
        return unfitted(self.region[None].astype(np.uint8), shape, smooth=False)[0] > 0


@partial(jax.jit, static_argnames="view")
def _draw(view: Any, parameters: Any, images: Array) -> Array:
    return show(view, parameters, images)


def make_view(encoder: Encoder, mask: Array, region: Array) -> View:
    """The view of what was found."""
    _, parameters = inpainted(Evidence(encoder, mask, region))
    return View(encoder.network, parameters, len(region))


def save_view(folder: Path, view: View) -> None:
    """Writes a view; `view.json` last, which makes it one."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = named_arrays(view.parameters)
    np.savez(folder / "arrays.npz", **arrays)
    about = {"form": _FORM, "network": view.network, "size": len(view.region), "local": view.local}
    write_json(folder / "view.json", about)


def load_view(directory: Path | str) -> View:
    """The view that `jaxdeconf mask --out DIR` left.

    Args:
      directory: DIR, or the folder `view` in it.
    Raises:
      ValueError: if there is none, it is damaged, or a version that drew otherwise left it.
    """
    folder = Path(directory)
    folder = folder / "view" if (folder / "view").is_dir() else folder
    try:
        about = json.loads((folder / "view.json").read_text(encoding="utf-8"))
        if about.get("form") != _FORM:
            raise ValueError("one of another version, which draws otherwise: mask the data again")
        network, size = from_plain(vae.VAEConfig, about["network"]), about["size"]
        like = {"region": 0, "still": 0} if about["local"] else _whole(network, size)
        return View(network, read_arrays(folder / "arrays.npz", like), size)
    except UNREADABLE as error:
        raise ValueError(f"{folder}: expected a view of jaxdeconf mask, got {error}") from error


def _whole(network: vae.VAEConfig, size: int) -> Any:
    fresh = jax.eval_shape(lambda key: vae.init(network, key, (size, size)), jax.random.key(0))
    return {"variables": fresh, "keep": 0}

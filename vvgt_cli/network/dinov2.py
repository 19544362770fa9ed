"""DINOv2's weights as the start of the image encoder, from a file: nothing is downloaded."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from vvgt_cli.errors import DataError
from vvgt_cli.network.appearance import ImageEncoder
from vvgt_cli.network.checkpoint import load_weights, read_tensors

UNUSED = {"mask_token"}  # of its training alone
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the colours that DINOv2 saw (ImageNet's)


def load_dinov2(encoder: ImageEncoder, path: str | Path) -> None:
    """Load a DINOv2 checkpoint (``dinov2_vitl14_pretrain.pth`` and its kin); every name and shape is checked.

    Its class token becomes the camera token. The first layer takes in the normalisation of colours, and does not see
    alpha and the channels after it yet. Positions are interpolated (bicubic) to the encoder's grid. Registers stay as
    they are where the file has none.

    Raises:
        DataError: not such a file, or of another size than the encoder.
    """
    state = {name: value for name, value in read_tensors(path).items() if name not in UNUSED}
    own = encoder.state_dict()
    for name in ("patch_embed.proj.weight", "patch_embed.proj.bias", "pos_embed"):
        if name not in state:
            raise DataError(f"{path}: no {name}; expected the weights of a DINOv2 encoder")
    state.setdefault("register_tokens", own["register_tokens"])
    weight, bias = state["patch_embed.proj.weight"], state["patch_embed.proj.bias"]
    if weight.dim() != 4 or weight.shape[1] != 3:
        raise DataError(f"{path}: patch_embed.proj.weight is {tuple(weight.shape)}; expected three colours")
    scaled = weight / torch.tensor(DEVIATION)[:, None, None]
    state["patch_embed.proj.bias"] = bias - (scaled * torch.tensor(MEAN)[:, None, None]).sum(dim=(1, 2, 3))
    rest = own["patch_embed.proj.weight"].shape[1] - 3
    state["patch_embed.proj.weight"] = functional.pad(scaled, (0, 0, 0, 0, 0, rest))
    state["pos_embed"] = positions(state["pos_embed"], own["pos_embed"].shape[1] - 1)
    load_weights(encoder, state, str(path))


def positions(embedding: Tensor, patches: int) -> Tensor:
    """Position embedding (1, 1 + m^2, width) for another number of patches, (1, 1 + patches, width)."""
    old, new = round((embedding.shape[1] - 1) ** 0.5), round(patches**0.5)
    if old == new or old * old != embedding.shape[1] - 1:
        return embedding  # if it is no square, its shape is refused after this
    grid = embedding[:, 1:].reshape(1, old, old, -1).permute(0, 3, 1, 2)  # (1, width, old, old)
    grid = functional.interpolate(grid, size=(new, new), mode="bicubic", antialias=True)
    return torch.cat([embedding[:, :1], grid.flatten(2).transpose(1, 2)], dim=1)

"""Configurations of the network: plain dataclasses, checked when made, three named sizes (docs/network.md)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from vvgt_cli.errors import DataError, UsageError

VARIANTS = ("full", "wo_3dt", "wo_vbm", "wo_vgf")  # the paper's Tab. 2
STAGES = 5  # of the geometry transformer's encoder; its decoder has one fewer
SCALES = 3  # S of the paper: maps at 1, 2 and 4 times the patch grid
PARAMETERS = 14  # of a Gaussian: mean 3, log-scale 3, quaternion 4, opacity logit 1, colour 3
STEP = 13  # of a step in a Gaussian's own frame: centre 3, log-scale 3, turn 3, opacity logit 1, colour 3
SLOPES = STEP + 9  # see `vvgt_cli.network.prepare.slope_rows`
PATCH = 14  # pixels, DINOv2's
MAX_NUMBER, MAX_BLOCKS = 1 << 16, 1 << 8  # of any number in a configuration; of blocks in a stage


@dataclass(frozen=True)
class ImageConfig:
    """2D appearance transformer and its maps.

    Attributes:
        size: pixels along an image's edge, a multiple of `PATCH`.
        views: number of views it is made for; a subset of more is used.
        width, heads: of every token; the width of a head must be a multiple of 4 (RoPE turns pairs along two axes).
        encoder: ViT blocks, each view by itself.
        alternating: pairs of a block within views and a block over all views.
        taps: alternating pairs (from 0) whose output becomes maps: the L layers of Eq. 7.
        map_width: channels of a map.
        registers: tokens without a meaning of their own (Darcet et al. 2024).
    """

    size: int = 224
    views: int = 8
    width: int = 160
    heads: int = 5
    encoder: int = 4
    alternating: int = 4
    taps: tuple[int, ...] = (0, 1, 2, 3)
    map_width: int = 64
    registers: int = 4

    def __post_init__(self) -> None:
        """Check the values."""
        object.__setattr__(self, "taps", tuple(self.taps))
        if self.size < PATCH or self.size % PATCH:
            raise DataError(f"image size {self.size}: expected a multiple of the patch, {PATCH}")
        if self.heads < 1 or self.width < 1 or self.width % (4 * self.heads):
            raise DataError(f"image width {self.width}, {self.heads} heads: expected a multiple of 4 a head")
        if not self.taps or min(self.taps) < 0 or max(self.taps) >= self.alternating:
            raise DataError(f"taps {self.taps}: expected numbers of the {self.alternating} alternating pairs, from 0")
        if min(self.views, self.encoder, self.map_width) < 1 or self.registers < 0:
            raise DataError("image config: views, encoder and map_width must be at least 1, registers at least 0")

    @property
    def grid(self) -> int:
        """Return the patches along an image's edge."""
        return self.size // PATCH


@dataclass(frozen=True)
class GeometryConfig:
    """3D geometry transformer, epipolar attention and head.

    Attributes:
        widths, depths, heads: of the five encoder stages; a stage of depth 0 only embeds and pools.
        decoder_widths, decoder_depths, decoder_heads: of stages 0 to 3 on the way back.
        window: points that attend to each other.
        epipolar_stage: encoder stage after whose blocks the views are read (the paper's "second layer").
        epipolar_width: D of Eq. 7.
        head: "residual" adds to every parameter, "direct" predicts all but the position (Eq. 6), "step" scales and
            corrects the gradient in each Gaussian's own axes (needs ``gradients``; not in the paper).
        reach: largest move of a centre in standard deviations along each own axis.
        gradients: whether the gradients of the image error are an input too (not in the paper).
    """

    widths: tuple[int, ...] = (32, 64, 96, 128, 160)
    depths: tuple[int, ...] = (1, 1, 1, 1, 1)
    heads: tuple[int, ...] = (2, 4, 6, 8, 10)
    decoder_widths: tuple[int, ...] = (48, 64, 96, 128)
    decoder_depths: tuple[int, ...] = (1, 1, 1, 1)
    decoder_heads: tuple[int, ...] = (3, 4, 6, 8)
    window: int = 128
    epipolar_stage: int = 2
    epipolar_width: int = 64
    head: str = "residual"
    reach: float = 2.0
    gradients: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("widths", "depths", "heads", "decoder_widths", "decoder_depths", "decoder_heads"):
            values = tuple(getattr(self, name))
            object.__setattr__(self, name, values)
            count = STAGES - name.startswith("decoder")
            least = 0 if name.endswith("depths") else 1
            most = MAX_BLOCKS if name.endswith("depths") else MAX_NUMBER
            if len(values) != count or min(values) < least or max(values) > most:
                raise DataError(f"geometry {name} {values}: expected {count} numbers from {least} to {most}")
        pairs = zip(self.widths + self.decoder_widths, self.heads + self.decoder_heads, strict=True)
        if any(width % heads for width, heads in pairs):
            raise DataError("geometry: every width must be a multiple of its heads")
        if self.head not in ("residual", "direct", "step"):
            raise DataError(f"head {self.head!r}: expected residual, direct or step")
        if self.head == "step" and not self.gradients:
            raise DataError("head 'step' scales gradients: expected gradients to be on")
        if not 0 <= self.epipolar_stage < STAGES or self.window < 1 or self.epipolar_width < 1 or not self.reach > 0:
            raise DataError("geometry config: epipolar_stage, window, epipolar_width or reach is out of range")

    @property
    def inputs(self) -> int:
        """Return how many numbers describe a Gaussian to the network."""
        return PARAMETERS + (SLOPES if self.gradients else 0)


@dataclass(frozen=True)
class NetworkConfig:
    """Whole network.

    Attributes:
        name: of the size, for model cards.
        image, geometry: the two sides.
        variant: "full", or an ablation of the paper: "wo_3dt" predicts Gaussians per pixel from the 2D side, "wo_vbm"
            is the full network started from uniform random samples, "wo_vgf" is the 3D side alone.
        rendering: whether images have eight channels, target and rendering of the Gaussians (not in the paper).
        rounds: number of runs, each on the previous output and on other views (not in the paper).
    """

    name: str = "small"
    image: ImageConfig = field(default_factory=ImageConfig)
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    variant: str = "full"
    rendering: bool = False
    rounds: int = 1

    def __post_init__(self) -> None:
        """Check the values."""
        if self.rounds < 1:
            raise DataError(f"rounds {self.rounds}: expected at least 1")
        if self.variant not in VARIANTS:
            raise UsageError(f"variant {self.variant!r}: expected one of {', '.join(VARIANTS)}")

    @property
    def channels(self) -> int:
        """Return the channels of an input image: premultiplied RGBA, once or twice."""
        return 8 if self.rendering else 4

    @property
    def total_views(self) -> int:
        """Return the views it is made for, all rounds together."""
        return self.rounds * self.image.views

    @property
    def has_images(self) -> bool:
        """Return whether the network has the 2D side."""
        return self.variant != "wo_vgf"

    @property
    def has_geometry(self) -> bool:
        """Return whether the network has the 3D side."""
        return self.variant != "wo_3dt"

    @property
    def start(self) -> str:
        """Return the method of `vvgt_cli.closed_form` whose Gaussians training starts from."""
        return "uniform" if self.variant == "wo_vbm" else "moments"

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkConfig:
        """Return the configuration of `dataclasses.asdict`; raise DataError for missing, unknown or invalid ones."""
        sides = {"image": ImageConfig, "geometry": GeometryConfig}
        try:
            known = {name: _exactly(side, values[name]) for name, side in sides.items()}
            return _exactly(cls, {**values, **known})
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"network config: {error}; expected the fields of this version") from None


def _exactly(kind: type, values: Any) -> Any:
    """Return ``kind(**values)`` if ``values`` has all its fields and no others: no default replaces a lost value."""
    wanted = {entry.name for entry in fields(kind)}
    if not isinstance(values, dict) or set(values) != wanted:
        given = set(values) if isinstance(values, dict) else set()
        raise ValueError(f"{kind.__name__} differs in {', '.join(sorted(wanted ^ given)) or 'kind'}")
    usual = kind()
    for name, value in values.items():
        if not _alike(value, getattr(usual, name)):
            raise ValueError(f"{kind.__name__}.{name} {value!r}: expected a value like {getattr(usual, name)!r}")
    return kind(**values)


def _alike(value: Any, usual: Any) -> bool:
    """Return whether a value has the type of a usual one, and no number in it is beyond `MAX_NUMBER`."""
    if isinstance(usual, tuple):
        return isinstance(value, list | tuple) and all(_alike(entry, 0) for entry in value)
    if isinstance(usual, bool) or not isinstance(usual, int | float):
        return isinstance(value, type(usual))
    kinds = int if isinstance(usual, int) else (int, float)
    return isinstance(value, kinds) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER


NAMED = {
    "small": NetworkConfig(),
    "base": NetworkConfig(
        name="base",
        image=ImageConfig(views=16, width=384, heads=6, encoder=8, alternating=8, taps=(1, 3, 5, 7), map_width=128),
        geometry=GeometryConfig(
            widths=(32, 64, 128, 192, 256), depths=(2, 2, 2, 2, 2), heads=(2, 4, 8, 12, 16),
            decoder_widths=(64, 64, 128, 192), decoder_depths=(2, 2, 2, 2), decoder_heads=(4, 4, 8, 12),
            window=256, epipolar_width=128,
        ),
    ),
    # not the paper's: the 3D side alone, fed with the slopes of the image error, which it makes a step of
    "lean": NetworkConfig(
        name="lean",
        image=ImageConfig(views=10),  # twice: of 24 views four are left to judge
        geometry=GeometryConfig(
            widths=(48, 48, 48, 48, 48), depths=(0, 0, 0, 0, 0),  # pooling alone tells a Gaussian of those around it
            heads=(4, 4, 4, 4, 4), decoder_widths=(48, 48, 48, 48), decoder_depths=(0, 0, 0, 0),
            decoder_heads=(4, 4, 4, 4), head="step", gradients=True,
        ),
        variant="wo_vgf",
        rounds=2,
    ),
    # DINOv2-L's encoder and VGGT's 24 pairs with its taps; PTV3 as published
    "paper": NetworkConfig(
        name="paper",
        image=ImageConfig(
            size=518, views=24, width=1024, heads=16, encoder=24, alternating=24, taps=(4, 11, 17, 23), map_width=256
        ),
        geometry=GeometryConfig(
            widths=(32, 64, 128, 256, 512), depths=(2, 2, 2, 6, 2), heads=(2, 4, 8, 16, 32),
            decoder_widths=(64, 64, 128, 256), decoder_depths=(2, 2, 2, 2), decoder_heads=(4, 4, 8, 16),
            window=1024, epipolar_width=128,
        ),
    ),
}  # fmt: skip

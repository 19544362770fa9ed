"""Configuration of a training run, as a dataclass and as YAML."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vvgt_cli.closed_form import METHODS
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.network import NAMED, NetworkConfig

SMALLEST_LPIPS = 16  # pixels: VGG-16 pools four times
GROWTH = 1.3  # of Gaussians with the size of images


@dataclass(frozen=True)
class SceneConfig:
    """Scenes to make from the volumes.

    Attributes:
        size: pixels along an image's edge, or several, of which each scene gets one.
        gaussians: smallest and largest number of Gaussians of a scene at the first size, drawn log-uniformly; it grows
            with the size to the power `GROWTH`.
        start: initial Gaussians, a method of `vvgt_cli.closed_form`; "uniform" for the ablation "wo_vbm".
        back_projection: improve them by back-projection of the views, as `vvgt convert` does.
        functions: transfer functions suggested per volume.
        held_functions: those of them (from 0) that are never trained on.
        per_volume: training scenes per volume, each with a function of its own.
        bands: smallest and largest number of suggested functions in a scene's function.
        densities: smallest and largest factor of a band's extinction, drawn log-uniformly: fog and solid bodies.
        inputs: views that the network may read, the default training set.
        targets: other views, for the loss.
        held: scenes of held-out volumes, and as many of held-out functions.
        seed: random seed of the scenes.
    """

    size: int | tuple[int, ...] = 256
    gaussians: tuple[int, int] = (8_000, 40_000)
    start: str = "moments"
    back_projection: bool = True
    functions: int = 10
    held_functions: tuple[int, ...] = (3, 7)
    per_volume: int = 3
    bands: tuple[int, int] = (1, 1)
    densities: tuple[float, float] = (1.0, 8.0)
    inputs: int = 24
    targets: int = 8
    held: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("gaussians", "held_functions", "bands", "densities"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not isinstance(self.size, int):
            object.__setattr__(self, "size", tuple(self.size))
        if self.start not in METHODS:
            raise UsageError(f"scenes.start {self.start!r}: expected one of {', '.join(METHODS)}")
        if len(self.gaussians) != 2 or not 1 <= self.gaussians[0] <= self.gaussians[1]:
            raise UsageError(f"scenes.gaussians {self.gaussians}: expected the fewest and the most")
        trained = self.functions - len(set(self.held_functions))
        if trained < 1 or not set(self.held_functions) <= set(range(self.functions)):
            raise UsageError(f"scenes.held_functions {self.held_functions}: expected some of {self.functions}, from 0")
        if len(self.bands) != 2 or not 1 <= self.bands[0] <= self.bands[1] <= trained:
            raise UsageError(f"scenes.bands {self.bands}: expected the fewest and the most, 1 to {trained}")
        if len(self.densities) != 2 or not 0 < self.densities[0] <= self.densities[1]:
            raise UsageError(f"scenes.densities {self.densities}: expected the least and the largest, above 0")
        if not self.sizes or min(*self.sizes, self.per_volume, self.inputs, self.targets, self.held) < 1:
            raise UsageError("scenes: size, per_volume, inputs, targets and held must be at least 1")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Return all sizes of images."""
        return (self.size,) if isinstance(self.size, int) else self.size


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss of a rendered view.

    Attributes:
        l1: mean absolute difference of RGBA.
        ssim: 1 - SSIM of RGB.
        decibel: minus a tenth of the gain in PSNR over the Gaussians that the network was given (not in the paper):
            scenes of 30 and of 45 dB count alike.
        lpips: LPIPS of RGB (the paper: 0.05), which needs both its files.
        lpips_backbone: VGG-16 as torchvision stores it.
        lpips_linear: LPIPS' linear weights for it, version 0.1.
    """

    l1: float = 0.8
    ssim: float = 0.2
    decibel: float = 0.0
    lpips: float = 0.0
    lpips_backbone: str = ""
    lpips_linear: str = ""

    def __post_init__(self) -> None:
        """Check the weights."""
        weights = self.l1, self.ssim, self.decibel, self.lpips
        if min(weights) < 0 or not sum(weights) > 0:
            raise UsageError("loss: weights must be at least 0, one of them above")
        if bool(self.lpips) != bool(self.lpips_backbone) or bool(self.lpips) != bool(self.lpips_linear):
            raise UsageError("loss: lpips needs lpips_backbone and lpips_linear, files of weights, and they need lpips")


@dataclass(frozen=True)
class TrainConfig:
    """A training run, without its folders.

    Attributes:
        network, scenes, loss: configurations.
        steps: of the optimiser.
        batch: scenes per step, over all processes.
        views: target views in the loss of a scene.
        view_sets: sets of input views, drawn once for each scene; images and slopes of each are made once.
        keep: inputs kept in memory, a few megabytes each.
        rate, last_rate: AdamW's, from the end of the warm-up down to the last step along a cosine.
        warmup: steps of a linear rise.
        weight_decay: AdamW's.
        clip: largest norm of the gradient; a longer one is shortened.
        check_every: steps between two validations.
        save_every: steps between two checkpoints.
        seed: of weights, scenes and views.
    """

    network: NetworkConfig = field(default_factory=lambda: NAMED["small"])
    scenes: SceneConfig = field(default_factory=SceneConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    steps: int = 40_000
    batch: int = 8
    views: int = 4
    view_sets: int = 4
    keep: int = 256
    rate: float = 1e-4
    last_rate: float = 1e-6
    warmup: int = 100
    weight_decay: float = 0.01
    clip: float = 1.0
    check_every: int = 500
    save_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        counts = ("steps", "batch", "views", "view_sets", "keep", "check_every", "save_every")
        if min(getattr(self, name) for name in counts) < 1 or self.warmup < 0:
            raise UsageError(f"train config: {', '.join(counts)} must be at least 1, warmup at least 0")
        if not 0 < self.last_rate <= self.rate or not self.clip > 0 or self.weight_decay < 0:
            raise UsageError("train config: expected 0 < last_rate <= rate, clip above 0, weight_decay at least 0")
        if (self.network.variant == "wo_vbm") != (self.scenes.start == "uniform"):
            raise UsageError("train config: scenes.start is 'uniform' for the variant wo_vbm, and only there")
        if self.views > self.scenes.targets:
            raise UsageError(f"train config: views {self.views}, but a scene has {self.scenes.targets} targets")
        if self.network.total_views > self.scenes.inputs:
            raise UsageError(
                f"train config: the network reads {self.network.total_views} views, scenes.inputs gives fewer"
            )
        if self.loss.lpips and min(self.scenes.sizes) < SMALLEST_LPIPS:
            raise UsageError(f"loss.lpips: pictures of {min(self.scenes.sizes)} px; expected {SMALLEST_LPIPS} or more")
        if not self.network.has_geometry and self.loss.decibel:
            raise UsageError("loss.decibel compares with the Gaussians given; the variant wo_3dt gets none")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainConfig:
        """Return the defaults updated by ``values``; ``network`` may be the name of a configuration.

        Raises:
            DataError: an unknown field, or an invalid value.
            UsageError: values that do not fit together.
        """
        values = dict(values)
        network = values.pop("network", "small")
        if isinstance(network, str):
            if network not in NAMED:
                raise DataError(f"network {network!r}: expected one of {', '.join(NAMED)}, or all fields of a network")
            network = NAMED[network]
        else:
            network = NetworkConfig.from_dict(network)
        try:
            scenes, loss = SceneConfig(**values.pop("scenes", {})), LossConfig(**values.pop("loss", {}))
            return cls(network=network, scenes=scenes, loss=loss, **values)
        except TypeError as error:
            raise DataError(f"train config: {error}; expected fields of TrainConfig") from None


def read_config(path: str | Path) -> TrainConfig:
    """Read a configuration from YAML; missing fields have their defaults.

    Raises:
        UsageError: no such file.
        DataError: not YAML, or not a configuration.
    """
    import yaml

    if not Path(path).is_file():
        raise UsageError(f"{path}: no such file; expected a training configuration (YAML)")
    try:
        values = yaml.safe_load(Path(path).read_text("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not YAML ({' '.join(str(error).split())[:150]})") from None
    if not isinstance(values, dict | None):
        raise DataError(f"{path}: a {type(values).__name__}; expected fields and values")
    try:
        return TrainConfig.from_dict(values or {})
    except (DataError, UsageError) as error:
        raise DataError(f"{path}: {error}") from None


def config_text(config: TrainConfig) -> str:
    """Return the YAML that `read_config` reads."""
    import yaml

    plain = json.loads(json.dumps(asdict(config)))  # YAML's safe form has no tuples
    return str(yaml.safe_dump(plain, sort_keys=False))

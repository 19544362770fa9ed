"""Scenes to train on: volume x function x views, with the Gaussians to start from; made once and kept in files.

A folder of data holds volumes in ``train/`` and ``held/``; what is made of them goes to ``scenes/``.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.sets import fibonacci_views
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.progress import Console
from vvgt_cli.training.config import SceneConfig

VERSION = 1  # raised when scenes are made otherwise
FEWEST = 256  # Gaussians: a scene with less shows next to nothing
FULL = 65535  # images are kept as uint16
TARGET_SHIFT = 0.31  # of the targets' Fibonacci sphere: none of the three default sets'


@dataclass(frozen=True)
class Recipe:
    """A scene to be made.

    Attributes:
        volume: file.
        function: number of the suggested function, from 0.
        density: factor of extinction.
        gaussians: budget.
    """

    volume: str
    function: int
    density: float
    gaussians: int


@dataclass(frozen=True)
class TrainingScene:
    """A scene that was made.

    Attributes:
        name: volume and function.
        gaussians: to start from.
        cameras, images: of the views that the network may be shown; (n, h, w, 4) uint16, of a file.
        targets, target_images: of those that the loss is taken on.
    """

    name: str
    gaussians: Gaussians
    cameras: Sequence[Camera]
    images: np.ndarray
    targets: Sequence[Camera]
    target_images: np.ndarray


def as_float(images: np.ndarray) -> np.ndarray:
    """float32 in [0, 1]."""
    return images.astype(np.float32) / np.float32(FULL)


def recipes(folder: Path, config: SceneConfig) -> dict[str, list[Recipe]]:
    """Scenes by "train", "held volumes" and "held functions".

    Raises:
        UsageError: folders or volumes that are not there.
    """
    rng = np.random.default_rng(config.seed)
    volumes = {part: _volumes(folder / part) for part in ("train", "held")}
    held = sorted(set(config.held_functions))
    trained = [f for f in range(config.functions) if f not in held]

    def make(volume: str, function: int) -> Recipe:
        low, high = np.log(config.gaussians)
        budget = round(float(np.exp(rng.uniform(low, high))))
        return Recipe(volume, int(function), float(rng.choice(config.densities)), budget)

    train = [make(v, f) for v in volumes["train"] for f in rng.permutation(trained)[: config.per_volume]]
    return {
        "train": train,
        "held volumes": [make(v, rng.choice(trained)) for v in _some(volumes["held"], config.held)],
        "held functions": [make(v, rng.choice(held)) for v in _some(volumes["train"], config.held) if held],
    }


def _volumes(folder: Path) -> list[str]:
    if not folder.is_dir():
        raise UsageError(f"--data {folder.parent}: no folder {folder.name}/; expected volumes in train/ and in held/")
    found = sorted(str(path) for path in folder.iterdir() if path.is_file())
    if not found:
        raise UsageError(f"--data {folder.parent}: {folder.name}/ is empty; expected volumes ('vvgt synth' makes some)")
    return found


def _some(entries: Sequence[str], count: int) -> list[str]:
    """``count`` of them, evenly spread, again from the first where there are fewer."""
    return [entries[i * len(entries) // count if len(entries) >= count else i % len(entries)] for i in range(count)]


def prepare_scenes(folder: Path, config: SceneConfig, console: Console) -> dict[str, list[TrainingScene]]:
    """All scenes, those made that are not there yet; a scene that shows next to nothing is left out.

    Raises:
        UsageError: see `recipes`; also data of which no scene is left.
        DataError: a volume that cannot be read.
    """
    (folder / "scenes").mkdir(exist_ok=True)
    out: dict[str, list[TrainingScene]] = {}
    for part, wanted in recipes(folder, config).items():
        places = []
        for number, recipe in enumerate(wanted):
            place = folder / "scenes" / _key(recipe, config)
            if not place.exists():
                _make(place, recipe, config)
                console.say(f"scene {number + 1} of {len(wanted)} ({part}): {_about(place)['name']}")
            places.append(place)
        out[part] = [_load(place, config) for place in places if _about(place)["gaussians"] >= FEWEST]
        if not out[part]:
            raise UsageError(f"--data {folder}: no scene left ({part}); other volumes may show more")
        console.say(f"{part}: {len(out[part])} scenes, {len(places) - len(out[part])} left out as empty")
    return out


def _key(recipe: Recipe, config: SceneConfig) -> str:
    """Hash of all that a scene depends on."""
    with open(recipe.volume, "rb") as stream:
        content = hashlib.file_digest(stream, "sha256").hexdigest()
    whole = {
        name: asdict(config)[name] for name in ("size", "start", "mended", "functions", "inputs", "targets", "seed")
    }
    text = json.dumps([VERSION, content, recipe.function, recipe.density, recipe.gaussians, whole])
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _about(place: Path) -> dict[str, Any]:
    about: dict[str, Any] = json.loads((place / "about.json").read_text("utf-8"))
    return about


def view_sets(config: SceneConfig) -> tuple[list[Camera], list[Camera]]:
    """Cameras to show and cameras of the loss."""
    shown = default_views("train", config.inputs, size=config.size)
    return shown, fibonacci_views(config.targets, TARGET_SHIFT, size=config.size, name="target")


def _make(place: Path, recipe: Recipe, config: SceneConfig) -> None:
    """Write a scene's folder beside its place and move it there."""
    name, gaussians, images = _render(recipe, config)
    scratch = place.with_name(f".{place.name}.{secrets.token_hex(4)}")
    scratch.mkdir()
    try:
        g = gaussians
        np.savez(scratch / "gaussians.npz", means=g.means, log_scales=g.log_scales, quaternions=g.quaternions,
                 opacity_logits=g.opacity_logits, colors=g.colors)  # fmt: skip
        np.save(scratch / "images.npy", np.rint(np.clip(images, 0, 1) * FULL).astype(np.uint16))
        (scratch / "about.json").write_text(json.dumps({"name": name, "gaussians": len(g), **asdict(recipe)}), "utf-8")
        os.replace(scratch, place)
    except OSError as error:
        if place.exists():  # another process was first
            return
        raise DataError(f"{place}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _render(recipe: Recipe, config: SceneConfig) -> tuple[str, Gaussians, np.ndarray]:
    """Name, Gaussians and images (inputs, then targets) of a scene."""
    from vvgt_cli.dvr import RenderSettings, Scene, render_views
    from vvgt_cli.synth.sources import open_volume
    from vvgt_cli.transfer.readers import minimal
    from vvgt_cli.transfer.suggest import suggest
    from vvgt_cli.vbm import VbmOptions, backproject, initialise
    from vvgt_cli.volume import statistics

    volume = open_volume(recipe.volume)
    numbers = statistics(volume)
    chosen = suggest(numbers, config.functions, sum(volume.dims) / 3, sum(volume.spacing) / 3)[recipe.function]
    function: Any = minimal.read(json.loads(chosen.to_json()), chosen.name)
    distance = chosen.unit_distance / recipe.density
    scene = Scene.build(volume, function, distance, (numbers.lo, numbers.hi))
    options = VbmOptions(recipe.gaussians, config.size, config.start, config.seed)
    begun = initialise(scene, options)
    name = f"{Path(recipe.volume).stem}, {chosen.name}, density x {recipe.density:g}"
    shown, targets = view_sets(config)
    if len(begun.gaussians) < FEWEST:
        return name, begun.gaussians, np.zeros((0, config.size, config.size, 4), np.float32)
    images = render_views(scene, [*shown, *targets], RenderSettings(step=0.5, samples=2))
    gaussians = begun.gaussians
    if config.mended:
        gaussians, _ = backproject(begun, shown, images[: len(shown)])
    return name, gaussians, images


def _load(place: Path, config: SceneConfig) -> TrainingScene:
    with np.load(place / "gaussians.npz") as file:
        gaussians = Gaussians(**{name: file[name] for name in file.files})
    images = np.load(place / "images.npy", mmap_mode="r")
    shown, targets = view_sets(config)
    return TrainingScene(
        str(_about(place)["name"]), gaussians, shown, images[: len(shown)], targets, images[len(shown) :]
    )

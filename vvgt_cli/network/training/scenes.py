"""Training scenes: volume x function x views, with initial Gaussians; made once and stored in files.

A data folder holds volumes in ``train/`` and ``held/``; the scenes go to ``scenes/``.
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

from vvgt_cli.cameras import Camera, default_views, fibonacci_views
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.look.suggest import Suggestion
from vvgt_cli.network.training.config import GROWTH, SceneConfig
from vvgt_cli.progress import Console

VERSION = 4  # raised when scenes are made otherwise
FEWEST = 256  # Gaussians: a scene with less shows next to nothing
FULL = 65535  # images are kept as uint16
TARGET_SHIFT = 0.31  # of the targets' Fibonacci sphere: none of the three default sets'


@dataclass(frozen=True)
class Recipe:
    """A scene to make.

    Attributes:
        volume: file.
        functions: indices of the suggested functions that are shown together, from 0.
        densities: factors of their extinction.
        size: pixels along an image's edge.
        gaussians: budget.
    """

    volume: str
    functions: tuple[int, ...]
    densities: tuple[float, ...]
    size: int
    gaussians: int


@dataclass(frozen=True)
class TrainingScene:
    """A scene.

    Attributes:
        name: volume and function.
        gaussians: to start from.
        cameras, images: of the views that the network may read; (n, h, w, 4) uint16, memory-mapped.
        targets, target_images: of the views of the loss.
    """

    name: str
    gaussians: Gaussians
    cameras: Sequence[Camera]
    images: np.ndarray
    targets: Sequence[Camera]
    target_images: np.ndarray


def as_float(images: np.ndarray) -> np.ndarray:
    """Return uint16 images as float32 in [0, 1]."""
    return images.astype(np.float32) / np.float32(FULL)


def recipes(folder: Path, config: SceneConfig) -> dict[str, list[Recipe]]:
    """Return recipes by "train", "held volumes" and "held functions".

    Raises:
        UsageError: missing folders or volumes.
    """
    rng = np.random.default_rng(config.seed)
    volumes = {part: _volumes(folder / part) for part in ("train", "held")}
    held = sorted(set(config.held_functions))
    trained = [f for f in range(config.functions) if f not in held]

    def make(volume: str, functions: list[int]) -> Recipe:
        count = min(int(rng.integers(config.bands[0], config.bands[1] + 1)), len(functions))
        chosen = tuple(int(f) for f in rng.permutation(functions)[:count])
        even = lambda limits: np.exp(rng.uniform(*np.log(limits)))  # noqa: E731
        densities = tuple(float(even(config.densities)) for _ in chosen)
        size = int(rng.choice(config.sizes))
        budget = round(float(even(config.gaussians) * (size / config.sizes[0]) ** GROWTH))
        return Recipe(volume, chosen, densities, size, budget)

    return {
        "train": [make(v, trained) for v in volumes["train"] for _ in range(config.per_volume)],
        "held volumes": [make(v, trained) for v in _subset(volumes["held"], config.held)],
        "held functions": [make(v, held) for v in _subset(volumes["train"], config.held) if held],
    }


def _volumes(folder: Path) -> list[str]:
    if not folder.is_dir():
        raise UsageError(f"--data {folder.parent}: no folder {folder.name}/; expected volumes in train/ and in held/")
    files = sorted(str(path) for path in folder.iterdir() if path.is_file())
    if not files:
        raise UsageError(f"--data {folder.parent}: {folder.name}/ is empty; expected volumes ('vvgt synth' makes some)")
    return files


def _subset(entries: Sequence[str], count: int) -> list[str]:
    """Return ``count`` entries, evenly spread, repeated if there are fewer."""
    return [entries[i * len(entries) // count if len(entries) >= count else i % len(entries)] for i in range(count)]


def make_scenes(folder: Path, config: SceneConfig, console: Console, share: tuple[int, int]) -> None:
    """Make the missing scenes; with ``share`` (i, n) every n-th, from i.

    Raises:
        UsageError, DataError: as `prepare_scenes`.
    """
    (folder / "scenes").mkdir(exist_ok=True)
    for part, wanted in recipes(folder, config).items():
        for number, recipe in enumerate(wanted):
            place = folder / "scenes" / _key(recipe, config)
            if number % share[1] == share[0] and not place.exists():
                _make(place, recipe, config)
                console.message(f"scene {number + 1} of {len(wanted)} ({part}): {_about(place)['name']}")


def prepare_scenes(folder: Path, config: SceneConfig, console: Console) -> dict[str, list[TrainingScene]]:
    """Return all scenes, after making missing ones; scenes with fewer than `FEWEST` Gaussians are skipped.

    Raises:
        UsageError: missing folders or volumes, or no scene that shows enough.
        DataError: a volume that cannot be read.
    """
    make_scenes(folder, config, console, (0, 1))
    out: dict[str, list[TrainingScene]] = {}
    for part, wanted in recipes(folder, config).items():
        if not wanted:
            continue
        places = [folder / "scenes" / _key(recipe, config) for recipe in wanted]
        out[part] = [_load(place, config) for place in places if _about(place)["gaussians"] >= FEWEST]
        if not out[part]:
            raise UsageError(f"--data {folder}: no scene shows enough ({part}); try other volumes")
        console.message(f"{part}: {len(out[part])} scenes, {len(places) - len(out[part])} skipped as empty")
    return out


def _key(recipe: Recipe, config: SceneConfig) -> str:
    """Return a hash of everything that a scene depends on."""
    with open(recipe.volume, "rb") as stream:
        content = hashlib.file_digest(stream, "sha256").hexdigest()
    whole = {
        name: asdict(config)[name] for name in ("start", "back_projection", "functions", "inputs", "targets", "seed")
    }
    drawn = {name: value for name, value in asdict(recipe).items() if name != "volume"}
    text = json.dumps([VERSION, content, drawn, whole])
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _about(place: Path) -> dict[str, Any]:
    return json.loads((place / "about.json").read_text("utf-8"))


def view_sets(config: SceneConfig, size: int) -> tuple[list[Camera], list[Camera]]:
    """Return the cameras of the input views and those of the loss."""
    shown = default_views("train", config.inputs, size=size)
    return shown, fibonacci_views(config.targets, TARGET_SHIFT, size=size, name="target")


def _make(place: Path, recipe: Recipe, config: SceneConfig) -> None:
    """Write a scene's folder under a temporary name and move it into place."""
    name, gaussians, images = _render(recipe, config)
    scratch = place.with_name(f".{place.name}.{secrets.token_hex(4)}")
    scratch.mkdir()
    try:
        g = gaussians
        fields: dict[str, Any] = g.arrays()
        np.savez(scratch / "gaussians.npz", **fields)
        np.save(scratch / "images.npy", np.rint(np.clip(images, 0, 1) * FULL).astype(np.uint16))
        (scratch / "about.json").write_text(json.dumps(asdict(recipe) | {"name": name, "gaussians": len(g)}), "utf-8")
        os.replace(scratch, place)
    except OSError as error:
        if place.exists():  # another process was first
            return
        raise DataError(f"{place}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _render(recipe: Recipe, config: SceneConfig) -> tuple[str, Gaussians, np.ndarray]:
    """Return name, Gaussians and images (inputs, then targets) of a scene."""
    from vvgt_cli.closed_form import VbmOptions, backproject, initialise
    from vvgt_cli.dvr import RenderSettings, Scene, render_views
    from vvgt_cli.look.readers import minimal
    from vvgt_cli.look.suggest import suggest
    from vvgt_cli.volume import read_volume, statistics

    volume = read_volume(recipe.volume)
    stats = statistics(volume)
    size = recipe.size
    bands = suggest(stats, config.functions, sum(volume.dims) / 3, sum(volume.spacing) / 3)
    chosen = [bands[number] for number in recipe.functions]
    function: Any = minimal.read(merge_bands(chosen, recipe.densities), "bands")
    scene = Scene.build(volume, function, chosen[0].unit_distance, (stats.lo, stats.hi))
    options = VbmOptions(recipe.gaussians, size, config.start, config.seed)
    begun = initialise(scene, options)
    parts = [f"{band.name} x {factor:.2g}" for band, factor in zip(chosen, recipe.densities, strict=True)]
    name = f"{Path(recipe.volume).stem}, {size} px, {' and '.join(parts)}"
    shown, targets = view_sets(config, size)
    if len(begun.gaussians) < FEWEST:
        return name, begun.gaussians, np.zeros((0, size, size, 4), np.float32)
    images = render_views(scene, [*shown, *targets], RenderSettings(step=0.5, samples=2))
    gaussians = begun.gaussians
    if config.back_projection:
        gaussians, _ = backproject(begun, shown, images[: len(shown)])
    return name, gaussians, images


def merge_bands(bands: Sequence[Suggestion], factors: Sequence[float]) -> dict[str, Any]:
    """Return a function that shows all ``bands``, extinctions times ``factors``, in the minimal JSON form.

    Opacities are per the bands' distance; where bands overlap they add up, below 1, and colours are means by opacity.
    """
    x = np.unique(np.concatenate([band.x for band in bands]))
    opacity, light = np.zeros(len(x)), np.zeros((len(x), 3))
    for band, factor in zip(bands, factors, strict=True):
        own = 1 - (1 - np.interp(x, band.x, band.opacity, left=0, right=0)) ** factor
        opacity += own
        light += own[:, None] * np.column_stack([np.interp(x, band.x, channel) for channel in band.rgb.T])
    rgb = np.where(opacity[:, None] > 0, light / np.maximum(opacity, 1e-12)[:, None], bands[0].rgb[0])
    points = [
        {"x": float(v), "rgb": [float(c) for c in color], "opacity": float(o)}
        for v, color, o in zip(x, np.clip(rgb, 0, 1), np.minimum(opacity, 0.999), strict=True)
    ]
    return {"name": "bands", "opacity_unit_distance": bands[0].unit_distance, "points": points}


def _load(place: Path, config: SceneConfig) -> TrainingScene:
    with np.load(place / "gaussians.npz") as file:
        gaussians = Gaussians(**{name: file[name] for name in file.files})
    images = np.load(place / "images.npy", mmap_mode="r")
    about = _about(place)
    shown, targets = view_sets(config, about["size"])
    return TrainingScene(str(about["name"]), gaussians, shown, images[: len(shown)], targets, images[len(shown) :])

"""`Lighting`: lights and coefficients, given by presets and users (docs/light.md)."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.space import world_axis

AMBIENT, DIFFUSE, SPECULAR, POWER = 0.1, 0.7, 0.2, 10.0  # vtkVolumeProperty's
COEFFICIENTS = ("ambient", "diffuse", "specular", "specular_power")
HEADLIGHT, NONE = "headlight", "none"
MAX_LIGHT = 1000.0  # of a coefficient: a highlight with a larger power is a point
UNIT = 1e-12  # from 1: of a direction that is a unit vector, which stays as it is stated
AXES = {axis: tuple(float(letter == axis) for letter in "xyz") for axis in "xyz"}
SUN = "sun"
SKIES = ("studio", "overcast", "window", SUN)  # light from all around, traced along paths
WORDS = ("left", "right", "anterior", "posterior", "superior", "inferior", "above", "below")
EXPECTED = (
    f"expected {', '.join(SKIES)}, FILE.hdr, {HEADLIGHT}, X,Y,Z, x, -x, y, -y, z, -z, {', '.join(WORDS[:-1])} or "
    f"{WORDS[-1]}"
)

PICTURES = (".hdr", ".exr")  # of skies
Direction = tuple[float, float, float]


def is_sky(light: str) -> bool:
    """Return whether a light is one from all around: one of `SKIES`, or a picture of `PICTURES`."""
    return light in SKIES or light.lower().endswith(PICTURES)


@dataclass(frozen=True)
class Lighting:
    """White lights and the response of matter: ``c = ka c0 + kd |n.l| c0 + ks |n.h|^p``.

    Attributes:
        headlight: a light at the eye.
        directions: unit vectors towards lights at infinity, world axes.
        ambient, diffuse, specular, specular_power: ka, kd, ks, p.
        sky: one of `SKIES` or the path of a picture, which lights alone, in place of the model above: ``directions``
            then holds the one in which its viewer stands, or the sun.

    Raises:
        UsageError: no light, a direction of length zero, a coefficient outside of [0, `MAX_LIGHT`], other lights beside
            a sky.
    """

    headlight: bool = True
    directions: tuple[Direction, ...] = ()
    ambient: float = AMBIENT
    diffuse: float = DIFFUSE
    specular: float = SPECULAR
    specular_power: float = POWER
    sky: str | None = None

    def __post_init__(self) -> None:
        """Check lights and coefficients."""
        if self.sky is not None and (self.headlight or len(self.directions) != 1):
            raise UsageError(
                f"--light {self.sky}: a sky lights alone; remove other lights, but one direction, X,Y,Z, where its "
                f"{SUN if self.sky == SUN else 'viewer'} stands"
            )
        if not (self.headlight or self.directions):
            raise UsageError(f"no light; {EXPECTED}")
        for name in COEFFICIENTS:
            value = getattr(self, name)
            if not 0 <= value <= MAX_LIGHT:
                raise UsageError(f"--{name.replace('_', '-')} {value:g}: expected 0 to {MAX_LIGHT:g}")

    @property
    def depends_on_view(self) -> bool:
        """Return whether colours change with the eye."""
        return self.sky is None and ((self.headlight and self.diffuse > 0) or self.specular > 0)

    def text(self) -> str:
        """Return one line for the header of a `.ply`; `parse_lighting` reads it."""
        words = [repr(float(getattr(self, name))) for name in COEFFICIENTS]
        words += [HEADLIGHT] * self.headlight + [",".join(repr(v) for v in d) for d in self.directions]
        return " ".join(words + ([] if self.sky is None else ["sky", quote(self.sky)]))

    def key(self) -> str:
        """Return `text` with the SHA-256 of a sky's picture, by which certificates and checkpoints know the light."""
        picture = Path(self.sky) if self.sky is not None and self.sky not in SKIES else None
        seen = "" if picture is None or not picture.is_file() else hashlib.sha256(picture.read_bytes()).hexdigest()
        return self.text() + seen


def parse_lighting(text: str) -> Lighting:
    """Parse a line of `Lighting.text`; raise ValueError or UsageError for another text."""
    words = text.split()
    numbers: list[Any] = [float(word) for word in words[:4]]
    rest, sky = words[4:], None
    if "sky" in rest:
        *rest, _, sky = rest
        sky = unquote(sky)
    toward = [word for word in rest if "," in word]
    if unknown := set(rest) - {HEADLIGHT, *toward}:
        raise ValueError(unknown)
    return replace(Lighting(HEADLIGHT in rest, _directions(toward, None), *numbers), sky=sky)


@dataclass(frozen=True)
class LightOptions:
    """Lighting options of a user; None leaves the choice to the function's file, else to VTK's defaults.

    Attributes:
        lights: ``none``, ``headlight``, one of `SKIES`, a picture, ``X,Y,Z``, an axis or a word of `WORDS`; empty:
            those of the function's file.
        ambient, diffuse, specular, specular_power: coefficients.
    """

    lights: tuple[str, ...] = ()
    ambient: float | None = None
    diffuse: float | None = None
    specular: float | None = None
    specular_power: float | None = None

    @classmethod
    def of(cls, lighting: Lighting | None) -> LightOptions:
        """Return the options that ask for a light other than a sky; None: for none."""
        if lighting is None:
            return cls((NONE,))
        lights = (HEADLIGHT,) * lighting.headlight + tuple(",".join(map(repr, d)) for d in lighting.directions)
        return cls(lights, **{name: getattr(lighting, name) for name in COEFFICIENTS})

    def lighting(self, preset: Lighting | None, space: str | None) -> Lighting | None:
        """Return a scene's light, None if unlit; ``preset`` is the function file's. Raise UsageError if invalid."""
        given = {name: getattr(self, name) for name in COEFFICIENTS if getattr(self, name) is not None}
        if NONE in self.lights or not (self.lights or preset):
            if len(self.lights) > 1:
                raise UsageError(f"--light {' --light '.join(self.lights)}: expected none, or other lights, not both")
            if given:
                name = next(iter(given)).replace("_", "-")
                raise UsageError(f"--{name}: there is no light; add --light headlight or a direction, --light X,Y,Z")
            return None
        if not self.lights:
            assert preset is not None
            return replace(preset, **given)
        if skies := [light for light in self.lights if is_sky(light)]:
            return self._sky(skies[0], space, given)
        fixed = _directions([light for light in self.lights if light != HEADLIGHT], space)
        if len(self.lights) - len(fixed) > 1:
            raise UsageError("--light headlight: given twice; expected once")
        kept = {} if preset is None else {name: getattr(preset, name) for name in COEFFICIENTS}
        return Lighting(HEADLIGHT in self.lights, fixed, **(kept | given))

    def _sky(self, sky: str, space: str | None, given: dict[str, Any]) -> Lighting:
        """Return the light of a sky: its viewer stands in front of a body, else at -y, the sun above."""
        ahead = "above" if sky == SUN else "-y" if space is None else "anterior"
        front = [light for light in self.lights if light != sky] or [ahead]
        if unused := sorted(set(given) & set(COEFFICIENTS)):
            raise UsageError(
                f"--{unused[0].replace('_', '-')}: matter under --light {sky} scatters all that its colour does not "
                "absorb; remove it"
            )
        if len(front) > 1 or front[0] == HEADLIGHT or is_sky(front[0]):
            front = []
        return Lighting(False, _directions(front, space), sky=sky)


MATTE = Lighting(ambient=0.2, diffuse=1.0, specular=0.0)  # as most presets of 3D Slicer have it


def _directions(lights: Sequence[str], space: str | None) -> tuple[Direction, ...]:
    return tuple(_direction(light, space) for light in lights)


def _direction(light: str, space: str | None) -> Direction:
    """Return the unit vector towards a light."""
    word = {"above": "z", "below": "-z"}.get(light, light)
    if word in WORDS:
        if space is None and word not in ("left", "right"):
            raise UsageError(f"--light {light}: the volume states no anatomical space; {EXPECTED.replace('or ', '')}")
        word = {"left": "-x", "right": "x"}[word] if space is None else world_axis(word, space)
    if word.lstrip("-") in AXES and word.count("-") < 2:
        x, y, z = (-v if word[0] == "-" and v else v for v in AXES[word[-1]])
        return x, y, z
    try:
        x, y, z = (float(v) for v in word.split(","))
    except ValueError:
        raise UsageError(f"--light {light}; {EXPECTED}") from None
    largest = max(abs(x), abs(y), abs(z))
    if not 0 < largest < math.inf:
        raise UsageError(f"--light {light}: its length is {'0' if largest == 0 else 'not finite'}; {EXPECTED}")
    length = largest * math.hypot(x / largest, y / largest, z / largest)
    if abs(length - 1) < UNIT:
        return x, y, z
    return x / length, y / length, z / length


def preset_lighting(what: str, shade: bool, fields: dict[str, Any]) -> Lighting | None:
    """Return a volume property's light, a headlight if shaded, else None; raise DataError for invalid coefficients."""
    if not shade:
        return None
    try:
        return Lighting(**fields)
    except UsageError as error:
        raise DataError(f"{what}: shading with {str(error).lstrip('-')}") from None

"""The function that a Volume object's material makes of the values of its grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from mathutils import Vector

SAMPLES = 1025  # values at which the material is evaluated
GREY = np.array([0.2126, 0.7152, 0.0722])  # of a colour where Blender's nodes want a number
MATHS: dict[str, np.ufunc] = {
    "ADD": np.add, "SUBTRACT": np.subtract, "MULTIPLY": np.multiply, "DIVIDE": np.divide, "POWER": np.power,
    "MINIMUM": np.minimum, "MAXIMUM": np.maximum, "GREATER_THAN": np.greater, "LESS_THAN": np.less,
    "ABSOLUTE": np.abs, "SQRT": np.sqrt, "EXPONENT": np.exp,
}  # fmt: skip


def display(linear: np.ndarray) -> np.ndarray:
    """Return the sRGB colours of linear light."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)


def _constant(value: Any, count: int) -> np.ndarray:
    """Return a number (n,), or a colour (n, 3), as often as there are values."""
    found = np.array(value, dtype=np.float64)
    return np.tile(found[:3], (count, 1)) if found.ndim else np.full(count, found)


class Material:
    """The Principled Volume of a Volume object's material, and the name of the one ``grid`` that it shows.

    Raises:
        RuntimeError: another shader, or several grids.
    """

    def __init__(self, item: Any, names: list[str]) -> None:
        """Find the shader and the grid."""
        self.what = item.active_material.name if item.active_material else f"{item.name} without a material"
        output = item.active_material and item.active_material.node_tree.get_output_node("ALL")
        node: Any = self._source(output.inputs["Volume"]).node if output and output.inputs["Volume"].links else None
        if node is None or node.type != "PRINCIPLED_VOLUME":
            raise RuntimeError(f"{self.what}: no Principled Volume at its output; expected one (a ramp in its colours)")
        self.node, self.density = node, node.inputs["Density Attribute"].default_value
        self.used = {self.density: None}  # in order
        for key in ("Density", "Color", "Emission Strength", "Emission Color"):
            self.at(key, np.zeros(1))
        used = [name for name in self.used if name in names]
        if len(used) != 1:
            found = f"{', '.join(used) or 'none'} of the grids {', '.join(names)}"
            raise RuntimeError(f"{self.what}: shows {found}; expected one")
        self.grid = used[0]

    def _source(self, socket: Any) -> Any:
        """Return the output that a linked input gets its value from."""
        found = socket.links[0].from_socket
        return self._source(found.node.inputs[0]) if found.node.type == "REROUTE" else found

    def at(self, key: Any, values: np.ndarray) -> np.ndarray:
        """Return an input, of the shader or a node, for values of the grid: (n,), or (n, 3) of a colour.

        Raises:
            RuntimeError: a node of another kind.
        """
        socket = self.node.inputs[key] if isinstance(key, str) else key
        constant = None if socket.is_linked else _constant(socket.default_value, len(values))
        found = self._output(self._source(socket), values) if constant is None else constant
        if (socket.type == "RGBA") != (found.ndim == 2):
            found = found @ GREY if found.ndim == 2 else np.repeat(found[:, None], 3, axis=1)
        return found

    def _output(self, output: Any, values: np.ndarray) -> np.ndarray:
        node = output.node
        if node.type in ("VALUE", "RGB"):
            return _constant(output.default_value, len(values))
        if node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY" and output.identifier in ("Fac", "Color"):
            self.used[node.attribute_name] = None
            return values
        if node.type == "VOLUME_INFO" and output.identifier != "Color":
            self.used[output.identifier.lower()] = None
            return values
        if node.type == "VALTORGB":
            ramp = [node.color_ramp.evaluate(x) for x in self.at(node.inputs[0], values).tolist()]
            return np.array(ramp)[:, 3] if output.identifier == "Alpha" else np.array(ramp)[:, :3]
        with np.errstate(all="ignore"):
            if node.type == "MAP_RANGE" and (node.data_type, node.interpolation_type) == ("FLOAT", "LINEAR"):
                x, low, high, start, end = (self.at(socket, values) for socket in node.inputs[:5])
                share = np.where(high == low, 0, (x - low) / (high - low))
                mapped: np.ndarray = start + (end - start) * (np.clip(share, 0, 1) if node.clamp else share)
                return mapped
            if node.type == "MATH" and node.operation in MATHS:
                maths = MATHS[node.operation]
                found: np.ndarray = maths(*(self.at(socket, values) for socket in node.inputs[: maths.nin])) * 1.0
                found = np.where(np.isfinite(found), found, 0)
                return np.clip(found, 0, 1) if node.use_clamp else found
        expected = "a grid, Color Ramp, Map Range (linear), Math, Value or RGB"
        raise RuntimeError(f"{self.what}: node {node.name!r} cannot be taken; expected {expected}")

    def function(self, low: float, high: float, item: Any) -> tuple[dict[str, Any], list[str]]:
        """Return the material over a range of values as a function for ``vvgt``, and what it leaves out.

        Colours are the emission per optical depth, or those of scattered light where nothing is emitted.

        Raises:
            RuntimeError: no density in this range.
        """
        values = np.linspace(low, high, SAMPLES)
        density = self.at("Density", values) * (values if self.density == self.grid else 1)
        dense, scattered = density > 0, self.at("Color", values)
        if not dense.any():
            raise RuntimeError(f"{self.what}: no density from {low:g} to {high:g}, the values of grid {self.grid}")
        emitted = np.maximum(self.at("Emission Strength", values), 0)[:, None] * self.at("Emission Color", values)
        glows = bool(emitted.any())
        colours = (emitted / np.where(dense, density, np.inf)[:, None]) if glows else scattered
        depth = np.where(dense, density, 0)
        if item.data.render.space == "OBJECT":  # as Cycles has it
            depth /= (item.matrix_world.to_3x3() @ Vector([3**-0.5] * 3)).length
        notes = {
            "scattering": glows and scattered[dense].any(), "lights (colours are shown as they are)": not glows,
            "emission where density is 0": emitted[~dense].any(), "colours above 1": (colours[dense] > 1).any(),
            "Absorption Color": self.at("Absorption Color", values).any(),
            "Blackbody": self.at("Blackbody Intensity", values).any(),
            "Color Attribute": bool(self.node.inputs["Color Attribute"].default_value),
        }  # fmt: skip
        rows = zip(values, np.clip(display(colours), 0, 1), 1 - np.exp(-depth / depth.max()), strict=True)
        points = [{"x": float(x), "rgb": rgb.tolist(), "opacity": float(a)} for x, rgb, a in rows]
        function = {"name": self.what, "points": points, "opacity_unit_distance": 1 / float(depth.max())}
        return function, [note for note, found in notes.items() if found]

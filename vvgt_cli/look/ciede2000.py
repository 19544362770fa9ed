"""The "Lab/CIEDE2000" colour space of ParaView: shortest colour paths (vtkCIEDE2000)."""

from __future__ import annotations

import heapq
from functools import lru_cache

import numpy as np

from vvgt_cli.look.colorspace import lab_to_rgb, rgb_to_lab

GRID = 17  # samples an axis of the RGB cube
NEIGHBOURS = [(i, j, k) for k in (-1, 0, 1) for j in (-1, 0, 1) for i in (-1, 0, 1) if (i, j, k) != (0, 0, 0)]
RGB = tuple[float, float, float]


def delta_e(lab1: np.ndarray, lab2: np.ndarray) -> np.ndarray:
    """CIEDE2000 distance of L*a*b* colours (..., 3) -> (...) (Sharma, Wu, Dalal 2005; k_L = k_C = k_H = 1)."""
    (l1, a1, b1), (l2, a2, b2) = np.moveaxis(lab1, -1, 0), np.moveaxis(lab2, -1, 0)
    mean7 = (0.5 * (np.hypot(a1, b1) + np.hypot(a2, b2))) ** 7
    g = 0.5 * (1 - np.sqrt(mean7 / (mean7 + 25.0**7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.arctan2(b1, a1) % (2 * np.pi), np.arctan2(b2, a2) % (2 * np.pi)
    grey = c1 * c2 == 0
    dh = h2 - h1
    dh = np.where(dh < -np.pi, dh + 2 * np.pi, np.where(dh > np.pi, dh - 2 * np.pi, dh))
    dh = 2 * np.sqrt(c1 * c2) * np.sin(0.5 * np.where(grey, 0.0, dh))
    dl, dc = l2 - l1, c2 - c1
    mean_l, mean_c, total_h = 0.5 * (l1 + l2), 0.5 * (c1 + c2), h1 + h2
    far = np.where(total_h < 2 * np.pi, 0.5 * total_h + np.pi, 0.5 * total_h - np.pi)
    mean_h = np.where(grey, total_h, np.where(np.abs(h1 - h2) <= np.pi, 0.5 * total_h, far))
    t = 1 - 0.17 * np.cos(mean_h - np.radians(30)) + 0.24 * np.cos(2 * mean_h)
    t += 0.32 * np.cos(3 * mean_h + np.radians(6)) - 0.20 * np.cos(4 * mean_h - np.radians(63))
    theta = np.radians(30) * np.exp(-(((mean_h - np.radians(275)) / np.radians(25)) ** 2))
    rc = 2 * np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7))
    sl = 1 + 0.015 * (mean_l - 50) ** 2 / np.sqrt(20 + (mean_l - 50) ** 2)
    sc, sh = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * t
    rt = -np.sin(2 * theta) * rc
    result: np.ndarray = np.sqrt((dl / sl) ** 2 + (dc / sc) ** 2 + (dh / sh) ** 2 + rt * (dc / sc) * (dh / sh))
    return result


@lru_cache(maxsize=1)
def _edges() -> list[list[tuple[float, int]]]:
    """For every grid colour, (distance, index) of its neighbours; index is r + 17 (g + 17 b)."""
    axis = np.arange(GRID) / (GRID - 1)
    b, g, r = np.meshgrid(axis, axis, axis, indexing="ij")
    lab = rgb_to_lab(np.stack([r, g, b], axis=-1))  # (b, g, r, 3)
    edges: list[list[tuple[float, int]]] = [[] for _ in range(GRID**3)]
    index = np.arange(GRID**3).reshape(GRID, GRID, GRID)
    for i, j, k in NEIGHBOURS:
        here = tuple(slice(max(0, -d), GRID - max(0, d)) for d in (k, j, i))
        there = tuple(slice(max(0, d), GRID - max(0, -d)) for d in (k, j, i))
        weight = delta_e(lab[here], lab[there]).ravel()
        for a, b_, w in zip(index[here].ravel(), index[there].ravel(), weight, strict=True):
            edges[a].append((float(w), int(b_)))
    return edges


def _position(rgb: RGB) -> int:
    r, g, b = (int(c * (GRID - 1) + 0.5) for c in rgb)
    return r + GRID * (g + GRID * b)


def _grid_rgb(index: int) -> RGB:
    return (
        index % GRID / (GRID - 1),
        index // GRID % GRID / (GRID - 1),
        index // GRID**2 / (GRID - 1),
    )


@lru_cache(maxsize=256)
def color_path(rgb1: RGB, rgb2: RGB) -> tuple[np.ndarray, np.ndarray]:
    """Shortest path between two colours on the 17^3 RGB grid: L*a*b* nodes (m, 3) and path lengths (m,).

    Dijkstra from the second colour, as CIEDE2000::GetColorPath; both ends snap to the grid.
    """
    edges, start, goal = _edges(), _position(rgb2), _position(rgb1)
    distance = {start: 0.0}
    towards: dict[int, int] = {}
    front = [(0.0, _grid_rgb(start), start)]  # ties are broken by the position (r, g, b), as VTK's set does
    done: set[int] = set()
    while front:
        length, _, here = heapq.heappop(front)
        if here in done:
            continue
        if here == goal:
            break
        done.add(here)
        for weight, there in edges[here]:
            if length + weight < distance.get(there, np.inf):
                distance[there] = length + weight
                towards[there] = here
                heapq.heappush(front, (length + weight, _grid_rgb(there), there))
    path, here = [goal], goal
    while here != start:
        here = towards[here]
        path.append(here)
    lengths = distance[goal] - np.array([distance[node] for node in path])
    return rgb_to_lab(np.array([_grid_rgb(node) for node in path])), lengths


def along_path(rgb1: RGB, rgb2: RGB, s: np.ndarray) -> np.ndarray:
    """RGB (n, 3) at fractions s (n,) of the path's length, linear in L*a*b* between its nodes.

    Rounded to 8 bits a component, as VTK hands these colours on.
    """
    lab, length = color_path(rgb1, rgb2)
    at = np.asarray(s) * length[-1]
    rgb = lab_to_rgb(np.stack([np.interp(at, length, lab[:, c]) for c in range(3)], axis=-1))
    return np.floor(255 * rgb + 0.5) / 255

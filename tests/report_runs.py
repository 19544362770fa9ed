"""Reports with numbers of the kind that runs give, for tests of what is made of them."""

import math

ROWS = (  # name, label, kind, K, seconds, dB, steps
    ("closed form, K = 1.56k", "1.56k", "closed form", 1_562, 1.1, 26.4, 0),
    ("closed form, K = 6.25k", "6.25k", "closed form", 6_250, 1.4, 29.6, 0),
    ("closed form, K = 25k", "25k", "closed form", 25_000, 2.3, 32.1, 0),
    ("closed form, K = 100k", "100k", "closed form", 99_998, 5.0, 33.6, 0),
    ("network small", "network", "network", 99_998, 17.2, 33.9, 0),
    ("25 steps", "25 steps", "steps", 99_998, 8.2, 34.7, 25),
    ("100 steps", "100 steps", "steps", 99_998, 17.0, 36.1, 100),
    ("200 steps", "200 steps", "steps", 99_998, 27.0, 36.8, 200),
    ("400 steps", "400 steps", "steps", 99_998, 46.0, 37.4, 400),
    ("3DGS, 400 steps", "3DGS", "baseline", 88_210, 52.0, 24.3, 400),
    ("iVR-GS setting, 400 steps", "iVR-GS setting", "baseline", 97_120, 55.0, 31.2, 400),
)


def _stages(kind, seconds, steps):
    shares = {"read": 0.02, "scene": 0.01, "closed form": 0.2, "views": 0.3, "back-projection": 0.2, "write": 0.02}
    if kind == "baseline":
        shares = {"read": 0.01, "samples": 0.02, "views": 0.1, "write": 0.01}
    if kind == "network":
        shares = {name: share / 3 for name, share in shares.items()} | {
            "network": 0.7,
            "check views of a network": 0.05,
        }
    if steps:
        shares |= {"refinement": 1 - sum(shares.values())}
    total = sum(shares.values())
    stages = [{"name": name, "seconds": seconds * share / total} for name, share in shares.items()]
    return [*stages, {"name": "test views", "seconds": 0.8}]


def run(name, label, kind, gaussians, seconds, psnr, steps, views=2):
    per_view = [{"psnr": psnr + 0.3 * math.sin(7 * v)} for v in range(views)]
    scores = {"psnr": psnr, "psnr_foreground": psnr - 3, "ssim": 0.9, "flip": 0.05, "per_view": per_view}
    return {
        "name": name, "label": label, "kind": kind, "views": 28, "gaussians": gaussians, "bytes": 68 * gaussians + 900,
        "stages": _stages(kind, seconds, steps), "scores": scores, "seconds": seconds + 0.8, "command": "convert",
        "refinement": {"steps": steps} if steps else None, "options": {"steps": steps, "max_gaussians": 100_000},
    }  # fmt: skip


def runs():
    return [run(*row) for row in ROWS]


def document(**changes):
    return {
        "format": "vvgt-report", "schema": 1, "command_line": "vvgt report bonsai.nii.gz --tf tree.json -o bonsai",
        "volume": {"name": "bonsai", "dims": [256, 256, 256], "dtype": "uint8"},
        "transfer_function": {"name": "tree", "unit_distance": 1.0, "unit_distance_label": "mean-spacing"},
        "machine": {"system": "Linux", "architecture": "x86_64", "cpu": "A CPU", "cpus": 2, "threads": 2,
                    "load": [0.1, 0.2, 0.3]},
        "versions": {"vvgt": "0.1.0", "python": "3.11.7", "numpy": "2.0"},
        "reference": {"views": 10, "size": 400, "step": 0.125, "rays": 9},
        "unit_costs": {"views, a view": 0.05, "refinement, a step": 0.09, "closed form, a run": 1.2},
        "runs": runs(), **changes,
    }  # fmt: skip

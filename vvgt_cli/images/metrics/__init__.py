"""PSNR, SSIM, FLIP and texture as the conventions define them."""

from vvgt_cli.images.metrics.flip import flip, flip_map
from vvgt_cli.images.metrics.psnr import psnr
from vvgt_cli.images.metrics.scores import Scores, ViewScore, mean_scores, score_view, score_views
from vvgt_cli.images.metrics.ssim import ssim
from vvgt_cli.images.metrics.texture import Texture, texture

__all__ = [
    "Scores", "Texture", "ViewScore", "flip", "flip_map", "mean_scores", "psnr", "score_view", "score_views", "ssim",
    "texture",
]  # fmt: skip

"""The VVGT network: torch for training and export, onnxruntime to run it (docs/network.md)."""

from vvgt_cli.network.config import NAMED, GeometryConfig, ImageConfig, NetworkConfig

__all__ = ["NAMED", "GeometryConfig", "ImageConfig", "NetworkConfig"]

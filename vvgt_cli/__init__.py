"""Scientific volumes to 3D Gaussian splats (VVGT)."""

__version__ = "0.1.0"

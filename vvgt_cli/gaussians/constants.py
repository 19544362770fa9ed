"""Constants shared by the standard 3DGS programs (conventions: Gaussians)."""

DILATION = 0.3  # px^2 on the diagonal of the projected covariance
MAX_ALPHA = 0.99
MIN_ALPHA = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4  # a splat that would reduce it further is skipped and ends the pixel
NEAR = 0.01  # unit-frame depth
TILE = 16  # pixels

"""Scientific volumes to 3D Gaussian splats (VVGT)."""

import os

# Read when numba is imported. With TBB a parallel region costs the more the more have run before (docs/log.md).
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")

__version__ = "0.1.0"

"""The processor that kernels are compiled for: as numba finds it, but for the width of its vectors.

LLVM keeps to vectors of 256 bits on Intel's processors with AVX-512, for the clock of the first of them fell with wider
ones. The splatter's loops over rows of 16 pixels are one vector of 512 bits; from `WIDE` on (Ice Lake, Zen 4) clocks
hardly fall (docs/log/refinement.md).
"""

from __future__ import annotations

from typing import Any

from numba.core import config as numba_config
from numba.core.codegen import JITCPUCodegen

config: Any = numba_config  # it takes its attributes from the environment, which type checkers do not see
WIDE = "+avx512vbmi2"


def features(found: str) -> str:
    """LLVM's features for those that numba has ``found``; what NUMBA_CPU_FEATURES says is left as it is."""
    if config.CPU_FEATURES is not None or WIDE not in found.split(","):
        return found
    return f"{found},-prefer-256-bit"


def widen() -> None:
    """Compile by `features` in this process: to be called before numba has compiled anything."""
    codegen: Any = JITCPUCodegen  # no public way
    usual = codegen._customize_tm_options

    def customize(self: Any, options: dict[str, Any]) -> None:
        usual(self, options)
        options["features"] = features(options["features"])

    codegen._customize_tm_options = customize

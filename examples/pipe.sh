#!/usr/bin/env bash
# Raw values from another program, through vvgt, to pictures: no file between them but the one that tee keeps.
set -euo pipefail
python3 - <<'PYTHON' |
import math, struct, sys
n = 32
axis = [(2 * i + 1) / n - 1 for i in range(n)]
values = [255 * math.exp(-4 * (x * x + 2 * y * y + z * z)) for z in axis for y in axis for x in axis]
sys.stdout.buffer.write(struct.pack(f"{n**3}B", *map(int, values)))
PYTHON
  vvgt convert - --dims 32 32 32 --dtype uint8 --tf magma --max-gaussians 2000 --screen 128 -o - |
  tee blob.ply |
  vvgt render - --orbit 4 --size 128 --background 1 1 1 -o turn
vvgt info - < blob.ply
ls turn

#!/usr/bin/env bash
# A transfer function of one's own: drawn over the histogram, used, and the result scored.
set -euo pipefail
cat > ripples.json <<'JSON'
{"range": [0, 1], "points": [
  {"x": 0.0, "rgb": [0.1, 0.2, 0.8], "opacity": 0.0},
  {"x": 0.45, "rgb": [0.2, 0.7, 0.9], "opacity": 0.0},
  {"x": 0.5, "rgb": [0.9, 0.9, 0.3], "opacity": 0.6},
  {"x": 0.55, "rgb": [0.9, 0.3, 0.1], "opacity": 0.0},
  {"x": 1.0, "rgb": [0.9, 0.1, 0.1], "opacity": 0.0}
]}
JSON
vvgt info ripples.json
vvgt tf show ripples.json --volume example:marschner-lobb -o ripples.png
vvgt convert example:marschner-lobb --tf ripples.json --max-gaussians 20000 --screen 200 -o ripples.ply
vvgt evaluate ripples.ply --volume example:marschner-lobb --tf ripples.json --screen 200

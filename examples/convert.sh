#!/usr/bin/env bash
# A real volume to .ply, with a preview and a report; then what the files hold.
set -euo pipefail
vvgt convert example:channels -o channels.ply --max-gaussians 20000 --preview channels.png --report channels.json
vvgt info channels.ply
python3 -c 'import json; print("PSNR", json.load(open("channels.json"))["scores"]["psnr"])'

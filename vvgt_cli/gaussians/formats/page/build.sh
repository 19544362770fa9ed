#!/usr/bin/env bash
# build.sh OUT: viewer.js.gz and LICENSES.txt of page.mjs and the npm packages of package.json, into the folder OUT (make
# page: this one). Needs node 20 or newer and npm; packages go to a cache folder. The same versions give the same bytes.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
out=$(cd "${1:-$here}" && pwd)
cache=${XDG_CACHE_HOME:-$HOME/.cache}/vvgt-page-viewer
mkdir -p "$cache"
if ! cmp -s "$here/package.json" "$cache/installed.json"; then
  cp "$here/package.json" "$cache/package.json"
  (cd "$cache" && npm install --no-audit --no-fund --no-package-lock >&2)
  cp "$here/package.json" "$cache/installed.json"
fi
# our own controls and keys instead of the viewer's; its camera, which its handle does not lead to; no double-click of its
# own; no glide where less motion is asked for; no pictures of a headset's controllers, which it would fetch from elsewhere
viewer=$cache/node_modules/@playcanvas/supersplat-viewer/dist
python3 - "$viewer" <<'PY'
import sys
from pathlib import Path

folder = Path(sys.argv[1])
text = (folder / "viewer.js").read_text("utf-8")
for old, new in (
    ("config.ui", "false"),
    ("        seek: (time) =>", "        cameraManager: () => viewer.cameraManager,\n        seek: (time) =>"),
    ("        this.camera.copy(resetCamera);", "        this.resetCamera = resetCamera;\n        this.camera.copy(resetCamera);"),
    ("    async _pickSceneTarget(offsetX, offsetY) {", "    async _pickSceneTarget(offsetX, offsetY) {\n        return null;"),
    ("    parent.script.create(XrControllers);", ""),
    ("import { XrControllers } from 'playcanvas/scripts/esm/xr/xr-controllers.mjs';", ""),
    ("DAMPING = 0.95;", "DAMPING = matchMedia('(prefers-reduced-motion: reduce)').matches ? 0 : 0.95;"),
):
    if old not in text:
        sys.exit(f"the viewer has no {old!r}: see build.sh")
    text = text.replace(old, new)
(folder / "ours.js").write_text(text, "utf-8")
PY
NODE_PATH="$cache/node_modules" "$cache/node_modules/.bin/esbuild" "$here/page.mjs" --bundle --minify --format=iife \
  --alias:@playcanvas/supersplat-viewer/viewer="$viewer/ours.js" --target=es2022 --charset=utf8 --loader:.glsl=text --legal-comments=none --log-level=error --outfile="$cache/viewer.js"
python3 - "$cache/viewer.js" "$out/viewer.js.gz" <<'PY'
import gzip
import sys

with open(sys.argv[1], "rb") as source, open(sys.argv[2], "wb") as target:
    target.write(gzip.compress(source.read(), 9, mtime=0))
PY
for name in @playcanvas/supersplat-viewer playcanvas; do
  version=$(node -p "require('$cache/node_modules/$name/package.json').version")
  printf '%s %s\n\n' "$name" "$version"
  cat "$cache/node_modules/$name/LICENSE"
  printf '\n'
done > "$out/LICENSES.txt"

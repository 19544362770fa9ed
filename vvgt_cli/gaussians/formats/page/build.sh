#!/usr/bin/env bash
# build.sh OUT: viewer.js.gz and LICENSES.txt of page.mjs and the npm packages of package.json, into the folder OUT (make
# page: this one). Needs node 20 or newer and npm; packages go to a cache folder. The same versions give the same bytes.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
out=$(cd "${1:-$here}" && pwd)
cache=${XDG_CACHE_HOME:-$HOME/.cache}/vvgt-page
mkdir -p "$cache"
if ! cmp -s "$here/package.json" "$cache/installed.json"; then
  cp "$here/package.json" "$cache/package.json"
  (cd "$cache" && npm install --no-audit --no-fund --no-package-lock >&2)
  cp "$here/package.json" "$cache/installed.json"
fi
# the viewer's handle does not lead to its camera: how far what it turns about is away, and a pose to go to at once
handle=$cache/node_modules/@playcanvas/supersplat-viewer/dist/viewer.js
grep -q 'cameraManager: ()' "$handle" || sed -i 's/^        seek: (time) => viewer.seek(time),$/        cameraManager: () => viewer.cameraManager,\n&/' "$handle"
grep -q 'cameraManager: ()' "$handle" || { echo "the viewer's handle is another one: see build.sh" >&2; exit 1; }
grep -q 'this.resetCamera = resetCamera' "$handle" || sed -i 's/^        this.camera.copy(resetCamera);$/        this.resetCamera = resetCamera;\n&/' "$handle"
grep -q 'this.resetCamera = resetCamera' "$handle" || { echo "the viewer's camera is another one: see build.sh" >&2; exit 1; }
NODE_PATH="$cache/node_modules" "$cache/node_modules/.bin/esbuild" "$here/page.mjs" --bundle --minify --format=iife \
  --target=es2022 --charset=utf8 --loader:.css=text --loader:.glsl=text --legal-comments=none --log-level=error --outfile="$cache/viewer.js"
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

#!/usr/bin/env bash
# splat_transform.sh FILE...: read each file with @playcanvas/splat-transform 3.7 and assert that it finds
# Gaussians, no NaN and no inf. Exit 3: node >= 22 cannot be had here.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
node=node
packages=(@playcanvas/splat-transform@3.7.0)
major=$(node -p 'process.versions.node.split(".")[0]' 2>/dev/null || echo 0)
command -v npm >/dev/null || exit 3
if [ "$major" -lt 22 ]; then
  packages+=(node@22)
  node="$work/node_modules/node/bin/node"
fi
(cd "$work" && timeout 180 npm install --silent --no-audit --no-fund --no-save "${packages[@]}" >/dev/null 2>&1) || exit 3
"$node" --version >/dev/null || exit 3
cli="$work/node_modules/@playcanvas/splat-transform/bin/cli.mjs"
for file in "$@"; do
  "$node" "$cli" -q "$file" --stats json null > "$work/stats.json"
  "$node" "$here/assert_stats.mjs" "$work/stats.json" "$file"
done

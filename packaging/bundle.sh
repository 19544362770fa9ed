#!/usr/bin/env bash
# bundle.sh FOLDER [EXTRAS]: write FOLDER/vvgt-VERSION-SYSTEM-PYTHON.tar, which installs vvgt without a network:
#   tar xf vvgt-*.tar && vvgt-*/install PREFIX
# It holds wheels of vvgt and all that it depends on, for the system and Python that run this, and compiled kernels for
# this processor.
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p "$1"
to=$(cd "$1" && pwd)
extras=${2:+[$2]}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export PIP_DISABLE_PIP_VERSION_CHECK=1
python=${PYTHON:-python3}

name=vvgt-$("$python" - <<'END'
import runpy, sys, sysconfig
version = runpy.run_path("vvgt_cli/version.py")["VERSION"]
print(f"{version}-{sysconfig.get_platform()}-cp{sys.version_info[0]}{sys.version_info[1]}")
END
)
bundle=$work/$name
mkdir -p "$bundle/wheels" "$bundle/kernels"
"$python" -m venv "$work/python"
# shellcheck disable=SC2086  # two words, or none
"$work/python/bin/pip" wheel -q ${CONSTRAINTS--c constraints.txt} -w "$bundle/wheels" ".$extras"

cat >"$bundle/install" <<'END'
#!/bin/sh
# install PREFIX: install vvgt into a new environment in the folder PREFIX, without a network, and warm its kernels.
# PYTHON names the Python to use (default: python3).
set -eu
here=$(cd "$(dirname "$0")" && pwd)
"${PYTHON:-python3}" -m venv "$1"
"$1/bin/pip" --isolated install -q --disable-pip-version-check --no-index --find-links "$here/wheels" "vvgt@EXTRAS@"
package=$("$1/bin/python" -c 'import vvgt_cli; print(vvgt_cli.__path__[0])')
mkdir -p "$package/__pycache__"
cp -r "$here/kernels" "$package/__pycache__/"
"$1/bin/vvgt" warmup
END
sed -i "s/@EXTRAS@/$extras/" "$bundle/install"
chmod +x "$bundle/install"

# all kernels are compiled: those in this user's cache are not looked for
env -u NUMBA_CACHE_DIR XDG_CACHE_HOME="$work/cache" "$bundle/install" "$work/tried" >"$work/log" || { cat "$work/log"; exit 1; }
cp -r "$work"/tried/lib/python*/site-packages/vvgt_cli/__pycache__/kernels "$bundle/"
tar -C "$work" -cf "$to/$name.tar" "$name"
echo "$to/$name.tar"

#!/usr/bin/env bash
# figures.sh SCENES.tsv DATA FUNCTIONS OUT [SCENE ...]: measure what the README's table states, and print the table.
#
# For a machine that does nothing else: half an hour on one thread for all scenes of docs/data.md. OUT keeps the CSV and
# pages of benchmarks/reports.py, dvr_vtk.py and share.py, which say more; the same command goes on where it was. SCENES
# are those to measure (default: all), REPORT options of `vvgt report` for a quick try.
set -euo pipefail
scenes=$(realpath "$1") data=$(realpath "$2") functions=$(realpath "$3") out=$(realpath -m "$4")
shift 4
cd "$(dirname "$0")/.."
export PYTHONPATH=$PWD OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
python=${PYTHON:-python3}
mkdir -p "$out/files"
only() { grep -v '^#' "$scenes" | { [ $# -eq 0 ] && cat || grep -E "^($(IFS='|'; echo "$*"))"$'\t'; }; }
only "$@" >"$out/scenes.tsv"

# shellcheck disable=SC2086  # several words, or none
"$python" benchmarks/reports.py "$out/scenes.tsv" "$data" "$functions" -o "$out/reports" -- \
  --steps 56 --steps 152 --picture-size 200 ${REPORT:-}
[ -f "$out/dvr-vtk.csv" ] || "$python" benchmarks/dvr_vtk.py "$out/scenes.tsv" "$data" "$functions" -o "$out/dvr-vtk.csv"
while IFS=$'\037' read -r name volume options function; do # not tabs, of which several count as one
  # shellcheck disable=SC2086  # several words, or none
  [ -f "$out/files/$name.ply" ] || "$python" -m vvgt_cli.commands.main convert "$data/$volume" $options \
    --tf "$functions/$function" --opacity-unit-distance mean-spacing -q -o "$out/files/$name.ply"
done < <(tr '\t' '\037' <"$out/scenes.tsv")
[ -f "$out/share.csv" ] ||
  "$python" benchmarks/share.py "$out/scenes.tsv" "$data" "$functions" "$out/files" -o "$out/share.csv"

"$python" - "$out" <<'END'
import csv, json, sys
from pathlib import Path
from statistics import mean

out = Path(sys.argv[1])
reports = sorted((out / "reports").glob("*/report.json"))
runs = {}
for path in reports:
    found = json.loads(path.read_text("utf-8"))["runs"]  # the closed form's last is of all Gaussians
    of = {run["kind"] if run["kind"] == "closed form" else run["label"]: run for run in found}
    for label, run in of.items():
        runs.setdefault(label, []).append((run["scores"]["psnr"], run["cost"]))
machine = json.loads(reports[0].read_text("utf-8"))["machine"]
print(f"\n{machine['cpu']}, {machine['threads']} threads; {len(reports)} scenes\n")
print("| what | |\n| --- | --- |")
for label in ("closed form", "56 steps", "152 steps"):
    psnr, seconds = zip(*runs[label])
    print(f"| {label} | {mean(psnr):.1f} dB in {mean(seconds):.0f} s |")
best = {(row["scene"], row["size"]): float(row["ratio"]) for row in csv.DictReader((out / "dvr-vtk.csv").open())}
if best:  # the last row of a scene and size is that of no more error
    print(f"| ray casting, beside VTK | {min(best.values()):.1f} to {max(best.values()):.1f} times as fast |")
rows = list(csv.DictReader((out / "share.csv").open()))
for suffix in (".ply", ".compressed.ply"):
    mine = [row for row in rows if row["format"] == suffix]
    size, cost = mean(float(row["megabytes"]) for row in mine), max(float(row["cost"]) for row in mine)
    print(f"| {suffix} | {size:.1f} MB, at most {cost:.3f} dB lost |")
END

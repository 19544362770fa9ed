#!/usr/bin/env bash
# Data for training: functions made for a volume, views under each of them in two parts as a job array would, and what a
# reader of transforms.json finds.
set -euo pipefail
functions=()
for file in $(vvgt tf suggest example:marschner-lobb:32 -n 2 -o bands); do
  functions+=(--tf "$file")
done
for part in 1/2 2/2; do
  vvgt render-views example:marschner-lobb:32 "${functions[@]}" --views 6 --test-views 2 --size 64 -o views --shard "$part"
done
python3 - <<'PYTHON'
import json
for name in ("band_1", "band_2"):
    views = json.load(open(f"views/{name}/transforms.json"))
    print(name, len(views["train_filenames"]), "to train on,", len(views["test_filenames"]), "to test by, from", views["ply_file_path"])
PYTHON

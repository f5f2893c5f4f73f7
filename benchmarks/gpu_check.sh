#!/usr/bin/env bash
# On a machine with a GPU: shows that both methods train there, and how long iterations and pictures take at 504 and
# 1008 pixels. Under eight minutes in all. It uses fern where that is, and else the sample scene.
#
#   PYTHON=/path/to/python bash benchmarks/gpu_check.sh [folder for the results]
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python}
results=${1:-.bench/gpu}
export PYTHONPATH=$PWD PYTHONUNBUFFERED=1 PYTHONWARNINGS=ignore
data=${SPARSESTYLE_DATA:-../shared/data}
sample=()
[ -d "$data/llff/fern" ] || sample=(--sample)

"$python" - <<'PY'
import torch

import sparsestyle_ns.method_configs
from sparsestyle_ns.utils.machine import device_name, versions

assert torch.cuda.is_available(), "torch finds no GPU"
print(device_name(torch.device("cuda")), versions())
PY

scene=$("$python" -c '
import sys

from benchmarks._measure import Options
from benchmarks._scene import find_scene

found = find_scene(Options(sample="--sample" in sys.argv))
print(found.folder, found.style_image, sep="\t")
' "${sample[@]}" | tail -n 1)
IFS=$'\t' read -r folder painting <<<"$scene"

# Trains coarse-fewshot-draft first, as there is no run of it in the folder.
runs=$(mktemp -d)
trap 'rm -r "$runs"' EXIT
SECONDS=0
timeout 150 "$python" -m nerfstudio.scripts.train hier-style-draft --data "$folder" --style-image "$painting" \
    --pipeline.backbone vgg16-shift-tolerant --output-dir "$runs" --max-num-iterations 20 \
    --machine.device-type cuda --vis tensorboard --viewer.quit-on-train-completion True llff-data >"$runs/log" 2>&1 ||
    { tail -n 40 "$runs/log"; exit 1; }
echo "Both drafts, stage 2 with 20 iterations: $SECONDS s"

timeout 240 "$python" -m benchmarks.before --sides 504 1008 --no-whole --device cuda --repeats 5 \
    --coarse-iterations 300 --output-dir "$results" "${sample[@]}"

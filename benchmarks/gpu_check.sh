#!/usr/bin/env bash
# One command for a machine with a GPU: does everything here work there, does it give what a CPU gives, and how fast?
# Under eight minutes on a large card; nothing is fetched. Fern where that is, else the sample scene, which is made.
#
#   bash benchmarks/gpu_check.sh                            # gpu_check.json and gpu_check.md in benchmarks/results
#   bash benchmarks/gpu_check.sh --skip whole bench         # without some of the parts
#   bash benchmarks/gpu_check.sh --device cpu --quick       # shows that the script works
#   PYTHON=/path/to/python bash benchmarks/gpu_check.sh
#
# The last line says "gpu_check: passed", or which parts failed; the exit status is 0 only in the first case.
set -euo pipefail
cd "$(dirname "$0")/.."
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1 PYTHONWARNINGS=ignore
exec "${PYTHON:-python}" -m benchmarks.gpu_check "$@"

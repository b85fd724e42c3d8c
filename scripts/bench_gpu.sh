#!/usr/bin/env bash
# Measure the engine `heightfield` on a GPU: agreement with the processor, and frames per second. Takes about 4 minutes.
#
#   scripts/bench_gpu.sh wheels          download the packages that a bare machine with Python 3.12, NumPy and numba lacks
#   OUT=out scripts/bench_gpu.sh         measure; writes OUT/gpu.json after each step
#
# On a bare machine, scripts/bare_python.sh uses the packages in .wheels.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/bare_python.sh
out=${OUT:-runs/bench}

if [ "${1:-}" = wheels ]; then
  scripts/paper_gpu.sh wheels
  download_wheels numba-cuda cuda-bindings cuda-core cuda-pathfinder
  exit
fi

start_python
"$python" -m benchmarks.scene.gpu --out "$out/gpu.json" "$@"

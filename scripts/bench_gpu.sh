#!/usr/bin/env bash
# Measure the engine `heightfield` on a GPU: agreement with the processor, and frames per second. Takes about 4 minutes.
#
#   scripts/bench_gpu.sh wheels          download the packages that a bare machine with Python 3.12, NumPy and numba lacks
#   OUT=out scripts/bench_gpu.sh         measure; writes OUT/gpu.json after each step
#
# If there is no .venv, the packages in .wheels are installed into a temporary folder, and the code of this checkout is
# used without installing it.
set -euo pipefail
cd "$(dirname "$0")/.."
out=${OUT:-runs/bench}

if [ "${1:-}" = wheels ]; then
  scripts/paper_gpu.sh wheels
  exec "${PYTHON:-python3}" -m pip download --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
    --platform manylinux_2_28_x86_64 --platform manylinux_2_24_x86_64 --platform manylinux2014_x86_64 \
    -d .wheels -c constraints.txt numba-cuda cuda-bindings cuda-core cuda-pathfinder
fi

python=${PYTHON:-python3}
if [ -x .venv/bin/python ]; then
  python=${PYTHON:-.venv/bin/python}
elif ls .wheels/*.whl >/dev/null 2>&1; then
  site=$(mktemp -d)
  trap 'rm -rf "$site"' EXIT
  "$python" -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --target "$site" .wheels/*.whl
fi
export PYTHONPATH="${site:+$site:}$PWD/shared:$PWD/render:$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
"$python" -m benchmarks.scene.gpu --out "$out/gpu.json" "$@"

#!/usr/bin/env bash
# Run the paper's experiment on one GPU within minutes. All cores render frames while networks train on finished
# datasets. Writes at most eight files of 16 MiB into OUT.
#
#   scripts/paper_gpu.sh wheels                download the packages that a bare machine with Python 3.12 and torch lacks
#   MINUTES=8 OUT=out scripts/paper_gpu.sh     run the experiment
#
# PRESET=tiny: a trial run, which also works without a GPU. CALIBRATE=1: choose the density of the headline ground again.
# If there is no .venv, the packages in .wheels are installed into a temporary folder, and the code of this checkout is
# used without installing it.
set -euo pipefail
cd "$(dirname "$0")/.."
minutes=${MINUTES:-8} out=${OUT:-runs/paper-gpu-files} preset=${PRESET:-paper}

if [ "${1:-}" = wheels ]; then
  exec "${PYTHON:-python3}" -m pip download --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
    --platform manylinux_2_28_x86_64 --platform manylinux_2_17_x86_64 --platform manylinux2014_x86_64 \
    -d .wheels -c constraints.txt license-expression boolean.py pydantic pydantic_core annotated-types \
    typing-inspection typing_extensions ruamel.yaml captum affine OpenEXR trimesh platformdirs pyzmq
fi

python=${PYTHON:-python3}
if [ -x .venv/bin/python ]; then
  python=${PYTHON:-.venv/bin/python}
elif ls .wheels/*.whl >/dev/null 2>&1; then
  site=$(mktemp -d)
  trap 'rm -rf "$site"' EXIT
  "$python" -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --target "$site" .wheels/*.whl
fi
export PYTHONPATH="${site:+$site:}$PWD/shared:$PWD/render:$PWD/train${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
[ "$preset" = tiny ] && runs=runs/paper-tiny || runs=runs/paper-gpu
# Pack the finished runs even if the experiment fails.
"$python" scripts/paper.py --preset "$preset" --part gpu --attitude ${CALIBRATE:+--calibrate} --minutes "$minutes" || code=$?
"$python" scripts/paper_files.py pack "$runs" "$out"
exit "${code:-0}"

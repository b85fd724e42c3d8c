#!/usr/bin/env bash
# Run the paper's experiment on one GPU within minutes. All cores render frames while networks train on finished
# datasets. Writes at most eight files of 16 MiB into OUT.
#
#   scripts/paper_gpu.sh wheels                download the packages that a bare machine with Python 3.12 and torch lacks
#   MINUTES=8 OUT=out scripts/paper_gpu.sh     run the experiment
#
# PRESET=tiny: a trial run, which also works without a GPU. CALIBRATE=1: choose the density of the headline ground again.
# On a bare machine, scripts/bare_python.sh uses the packages in .wheels.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/bare_python.sh
minutes=${MINUTES:-8} out=${OUT:-runs/paper-gpu-files} preset=${PRESET:-paper}

if [ "${1:-}" = wheels ]; then
  download_wheels license-expression boolean.py pydantic pydantic_core annotated-types typing-inspection \
    typing_extensions ruamel.yaml captum affine OpenEXR trimesh platformdirs pyzmq
  exit
fi

start_python
[ "$preset" = tiny ] && runs=runs/paper-tiny || runs=runs/paper-gpu
# Pack the finished runs even if the experiment fails.
"$python" scripts/paper.py --preset "$preset" --part gpu --attitude ${CALIBRATE:+--calibrate} --minutes "$minutes" || code=$?
"$python" scripts/paper_files.py pack "$runs" "$out"
exit "${code:-0}"

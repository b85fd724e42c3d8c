# Read by paper_gpu.sh and bench_gpu.sh: Python on a machine that is often bare and has no network.
#
# Sets `python` to the interpreter of .venv or, without one, to python3 with the packages in .wheels, which are installed
# into a temporary folder. The code of this checkout is used without installing it. The variable PYTHON overrides both.

# Download wheels for a bare machine with Python 3.12 into .wheels.
download_wheels() {
  local platforms=()
  for version in manylinux_2_28 manylinux_2_24 manylinux_2_17 manylinux2014; do
    platforms+=(--platform "${version}_x86_64")
  done
  "${PYTHON:-python3}" -m pip download --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
    "${platforms[@]}" -d .wheels -c constraints.txt "$@"
}

start_python() {
  python=${PYTHON:-python3}
  if [ -x .venv/bin/python ]; then
    python=${PYTHON:-.venv/bin/python}
  elif ls .wheels/*.whl >/dev/null 2>&1; then
    site=$(mktemp -d)
    trap 'rm -rf "$site"' EXIT
    "$python" -m pip install -q --no-index --no-deps --no-compile --no-cache-dir --target "$site" .wheels/*.whl
  fi
  export PYTHONPATH="${site:+$site:}$PWD/shared:$PWD/render:$PWD/train:$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
}

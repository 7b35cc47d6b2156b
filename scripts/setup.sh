# Sourced by the other scripts: a virtual environment with the package installed, made once.
# Torch comes first and pinned: a plain install would bring gigabytes of CUDA packages.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
venv="${DMCVB_VENV:-.venv}"
if [ ! -e "$venv/.ready" ] || [ pyproject.toml -nt "$venv/.ready" ] || [ scripts/constraints.txt -nt "$venv/.ready" ]; then
  "${PYTHON:-python3}" -m venv "$venv"
  "$venv/bin/python" -m pip install --quiet --upgrade "pip>=24"
  if ! "$venv/bin/python" -c "import torch" 2>/dev/null; then
    echo "installing torch ..."
    "$venv/bin/python" -m pip install --quiet --constraint scripts/constraints.txt torch
  fi
  echo "installing dmcvb-gen ..."
  "$venv/bin/python" -m pip install --quiet --constraint scripts/constraints.txt --editable ".[test]"
  touch "$venv/.ready"
fi
. "$venv/bin/activate"

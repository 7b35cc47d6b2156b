# Sourced by the other scripts: a virtual environment with the package and the extras that they name, made once.
#   extras=train . scripts/setup.sh
# Torch comes first and pinned. Which build comes is pip's index to say: PyPI's brings gigabytes of CUDA, an index of
# CPU builds (set PIP_INDEX_URL or PIP_EXTRA_INDEX_URL to it) does not.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
venv="${DMCVB_VENV:-.venv}"
extras="${extras:-train}"
ready="$venv/.ready-$extras"
if [ ! -e "$ready" ] || [ pyproject.toml -nt "$ready" ] || [ scripts/constraints.txt -nt "$ready" ]; then
  "${PYTHON:-python3}" -m venv "$venv"
  "$venv/bin/python" -m pip install --quiet --quiet --upgrade "pip>=24"
  if ! "$venv/bin/python" -c "import torch" 2>/dev/null; then
    echo "installing torch ..."
    "$venv/bin/python" -m pip install --quiet --quiet --constraint scripts/constraints.txt torch
  fi
  echo "installing dmcvb-gen[$extras] ..."
  "$venv/bin/python" -m pip install --quiet --quiet --constraint scripts/constraints.txt --editable ".[$extras]"
  touch "$ready"
fi
. "$venv/bin/activate"

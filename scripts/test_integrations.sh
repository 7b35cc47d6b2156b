#!/usr/bin/env bash
# Opens exports with the heavy programs that they are for, each in a virtual environment of its own that is thrown away:
#   bash scripts/test_integrations.sh [lerobot] [tfds] [zarr2]      (all by default; LeRobot and TensorFlow weigh gigabytes)
# PYTHON312: an interpreter for LeRobot. VENVS: a folder where the environments are kept for the next time.
extras=test
. "$(dirname "$0")/setup.sh"
chosen=("$@")
[ ${#chosen[@]} -gt 0 ] || chosen=(lerobot tfds zarr2)
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
venvs="${VENVS:-$work}"

echo "making a walker and a maze release and their exports ..."
python tests/integrations/heavy/make_exports.py "$work" "${chosen[@]}"

make_venv() { # name, python, packages ...
  [ -e "$venvs/venv-$1/.ready" ] && return
  "$2" -m venv "$venvs/venv-$1"
  "$venvs/venv-$1/bin/python" -m pip install --quiet "${@:3}"
  touch "$venvs/venv-$1/.ready"
}

reading=(zarr pydantic fsspec click rich tqdm filelock tenacity) # what dmcvb_gen.open needs
for what in "${chosen[@]}"; do
  case "$what" in
    lerobot) make_venv lerobot "${PYTHON312:-python3.12}" "lerobot[dataset]>=0.6" ;; # needs Python 3.12
    tfds) make_venv tfds "${PYTHON:-python3}" tensorflow-cpu tensorflow-datasets "${reading[@]}" ;;
    zarr2) make_venv zarr2 "${PYTHON:-python3}" "zarr<3" "numcodecs<0.16" ;;
    *) echo "unknown program $what; give lerobot, tfds or zarr2" && exit 2 ;;
  esac
  PYTHONPATH="$PWD" "$venvs/venv-$what/bin/python" "tests/integrations/heavy/check_$what.py" "$work"
  [ "$venvs" = "$work" ] && rm -rf "$work/venv-$what"
done

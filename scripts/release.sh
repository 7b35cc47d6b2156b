#!/usr/bin/env bash
# A release from recipe to proof: rolled out, verified, validated, carded, published, fetched, made again in part.
#   bash scripts/release.sh [RECIPE [OUT]]     dmcvb-mini and releases/RECIPE by default
# Rerun the command to resume. A line a stage; what each printed is in OUT.log. Options by environment:
#   WORKERS (2), TENTH (its seed, 0), VALIDATE ("--profile smoke --benchmark b1 --agents bc,state-bc,id+bc", to see that
#   agents train on every subset; "--profile brief ..." for scores takes minutes a cell; "" leaves it out)
extras=train,hf
. "$(dirname "$0")/setup.sh"
recipe="${1:-dmcvb-mini}"
out="${2:-releases/$(basename "$recipe" .yaml)}"
workers="${WORKERS:-2}"
validate="${VALIDATE---profile smoke --benchmark b1 --agents bc,state-bc,id+bc}"
log="$out.log"
mkdir -p "$(dirname "$out")"

stage() { # NAME COMMAND...: runs it, one line before and after
  local name="$1" begun=$SECONDS
  shift
  printf '%-10s %s\n' "$name" "$*" | cut -c1-150
  if ! "$@" >>"$log" 2>&1; then
    echo "$name failed after $((SECONDS - begun)) s; the last lines of $log:"
    tail -5 "$log"
    exit 1
  fi
  printf '%-10s done in %s s\n' "$name" "$((SECONDS - begun))"
}

tenth() { # a random tenth of the subsets, made again
  local name patterns=()
  while read -r name; do patterns+=(--only "$name"); done < <(dmcvb-gen info "$out" --json | TENTH="${TENTH:-0}" python -c '
import json, os, random, sys
names = sorted(subset["name"] for subset in json.load(sys.stdin)["subsets"])
for name in random.Random(int(os.environ["TENTH"])).sample(names, -(-len(names) // 10)):
    print(name)')
  dmcvb-gen regenerate "$out" --check --workers "$workers" "${patterns[@]}"
}

stage rollout dmcvb-gen rollout --recipe "$recipe" --out "$out" --workers "$workers"
stage verify dmcvb-gen verify "$out" --workers "$workers"
if [ -n "$validate" ]; then
  # shellcheck disable=SC2086
  stage validate dmcvb-gen validate "$out" $validate --workers "$workers" --threads 1 --out "$out.report"
fi
stage card dmcvb-gen card "$out"
stage publish dmcvb-gen publish "$out" "file://$(realpath "$out").published"
stage fetch dmcvb-gen fetch "file://$(realpath "$out").published" --out "$out.fetched"
stage compare dmcvb-gen diff "$out" "$out.fetched"
stage tenth tenth
dmcvb-gen info "$out" --json | python -c 'import json, sys; print("root digest", json.load(sys.stdin)["digest"])'

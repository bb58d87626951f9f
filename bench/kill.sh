#!/usr/bin/env bash
# kill.sh PROGRAM DATA [KILLS [OPTION..]]: kills a run with checkpoints by SIGKILL at random moments and resumes it, until KILLS kills
# (default 100), and compares its scene with that of an uninterrupted run. A run that finishes before that is started again.
#
#   bench/kill.sh target/release/irradia ../shared/data/fox_colmap 100 --steps 300 --downscale 4
set -euo pipefail
[ $# -ge 2 ] || { sed -n 2,5p "$0" >&2; exit 2; }
program=$(readlink -f "$1"); data=$(readlink -f "$2"); kills=${3:-100}; shift $(( $# < 3 ? $# : 3 ))
options=("$@"); [ ${#options[@]} -gt 0 ] || options=(--steps 300 --downscale 4)
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT; cd "$folder"
RANDOM=${SEED:-1}

begin=("$program" train "$data" --set checkpoint_every=10 "${options[@]}" --out)
scene() { cat $(find "$1" -maxdepth 1 -name scene.ply -o -maxdepth 1 -name field.safetensors) | sha256sum; }

started=$(date +%s%N)
"${begin[@]}" unbroken >log 2>&1 || { tail -3 log >&2; exit 1; }
wanted=$(scene unbroken)
whole=$(( ($(date +%s%N) - started) / 1000000 ))

killed=0; runs=0; wrong=0
while [ "$killed" -lt "$kills" ] || [ -e run/run.json ]; do
  if [ -e run/run.json ]; then "$program" train --resume run >log 2>&1 & else "${begin[@]}" run >log 2>&1 & fi
  child=$!
  if [ "$killed" -lt "$kills" ]; then
    # Between 0 and half the time of the whole run.
    wait_ms=$(( (RANDOM * 32768 + RANDOM) % (whole / 2 + 1) ))
    sleep "$((wait_ms / 1000)).$(printf %03d $((wait_ms % 1000)))"
    if kill -KILL "$child" 2>/dev/null; then killed=$((killed + 1)); fi
  fi
  ended=0; wait "$child" 2>/dev/null || ended=$?
  if [ "$ended" != 0 ] && [ "$ended" != 137 ]; then echo "exit code $ended:" >&2; tail -3 log >&2; exit 1; fi
  if [ "$ended" = 0 ]; then
    runs=$((runs + 1))
    left=$(find run -name '*.tmp' | wc -l)
    if [ "$(scene run)" != "$wanted" ] || [ "$left" != 0 ]; then wrong=$((wrong + 1)); fi
    rm -rf run
  fi
done
echo "$killed kills in $runs runs: $wrong runs with other bytes or temporary files left"
[ "$wrong" = 0 ]

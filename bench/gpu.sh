#!/usr/bin/env bash
# gpu.sh: runs all GPU measurements on this machine and writes the figures into RESULTS.md between its markers. Needs a driver and Rust;
# under 8 minutes on a graphics card. DATA=FOLDER names the photographs (fox and others), ../shared/data by default.
#
#   bash bench/gpu.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
data="${DATA:-../shared/data}"
scratch="$(mktemp -d)"
trap 'rm -rf "$scratch"' EXIT
rows="$scratch/rows.md"

cargo build --release --quiet
cargo build --release --quiet -p irradia --example speed
irradia=target/release/irradia
{
    printf '\nMeasured by `bench/gpu.sh` at `%s` on:\n\n```\n' "$(git rev-parse --short HEAD)"
    "$irradia" devices
    printf '```\n\nFrames and steps, and the milliseconds of each kernel in a step by the device'"'"'s clock:\n\n```\n'
    timeout 240 target/release/examples/speed gpu || true
    printf '```\n'
} >"$rows"

# Time to 27 dB on fox at full size on both devices; 1,500 steps of other scenes on the GPU; a hash grid on both devices.
printf '\n| scene | recipe | device | steps | held-out PSNR dB | seconds of training |\n|---|---|---|---:|---:|---:|\n' >>"$rows"
run() { # run SCENE DEVICE OPTION..
    local scene="$1" device="$2" out="$scratch/$1-$2"
    shift 2
    timeout 60 "$irradia" train "$data/$scene" --device "$device" --out "$out" --overwrite "$@" >/dev/null 2>&1 || return 0
    awk -v scene="$scene" -v device="$device" -F'[:,]' '
        /^  "recipe"/ { gsub(/[ "]/, "", $2); recipe = $2 } /^  "steps"/ { steps = $2 } /^  "psnr"/ { psnr = $2 } /^  "training_seconds"/ { seconds = $2 }
        END { printf "| %s | %s | %s |%d | %.2f | %.1f |\n", scene, recipe, device, steps, psnr, seconds }' "$out/report.json" >>"$rows"
}
if [ -d "$data/fox" ]; then
    run fox gpu --full-size --until-psnr 27
    run fox cpu --full-size --until-psnr 27
    for scene in chair fern lund_door maryRose; do
        run "$scene" gpu --steps 1500
    done
    for device in gpu cpu; do
        run chair "$device" --recipe hashgrid --steps 1000
    done
fi

# gsplat on the same card, where PyTorch and gsplat are installed.
if command -v python3 >/dev/null && python3 -c 'import torch, gsplat; assert torch.cuda.is_available()' 2>/dev/null; then
    printf '\ngsplat on the same splats, without a loss:\n\n```\n' >>"$rows"
    for case in 1000000@1920x1080 3000000@1920x1080; do
        target/release/examples/speed export "$scratch/splats" "$case"
        timeout 60 python3 bench/peer_gsplat.py "$scratch/splats" >>"$rows" || true
    done
    printf '```\n' >>"$rows"
else
    printf '\ngsplat was not measured: it is not installed, or PyTorch finds no CUDA.\n' >>"$rows"
fi

awk -v rows="$rows" '
    /<!-- gpu:begin -->/ { print; while ((getline line < rows) > 0) print line; print ""; skips = 1 }
    /<!-- gpu:end -->/ { skips = 0 }
    !skips && !/<!-- gpu:begin -->/ { print }' RESULTS.md >"$scratch/RESULTS.md"
cp "$scratch/RESULTS.md" RESULTS.md
cat "$rows"

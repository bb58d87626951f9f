#!/usr/bin/env bash
# gpu.sh: measures everything about the GPU of this machine, and writes it into RESULTS.md between its markers. Needs a driver and Rust;
# under 8 minutes on a graphics card. DATA=FOLDER names the photographs (fox and others), ../shared/data when absent.
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

# Time to 27 dB on fox at full size, and to the same PSNR with `fast` on both devices.
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
    printf '\ngsplat, forward and backward with 1,000,000 random splats at 1920 x 1080, ms:\n\n```\n' >>"$rows"
    timeout 90 python3 - >>"$rows" <<'PY' || true
import time, torch, gsplat
n, d = 1_000_000, "cuda"
torch.manual_seed(1)
means = torch.randn(n, 3, device=d) * 2 + torch.tensor([0.0, 0.0, 9.0], device=d)
args = [means, torch.randn(n, 4, device=d), torch.full((n, 3), -4.5, device=d).exp(), torch.rand(n, device=d), torch.randn(n, 16, 3, device=d) * 0.1]
args = [a.requires_grad_() for a in args]
K = torch.tensor([[[1500.0, 0, 960], [0, 1500, 540], [0, 0, 1]]], device=d)
view = torch.eye(4, device=d)[None]
def frame():
    return gsplat.rasterization(*args, view, K, 1920, 1080, sh_degree=3, packed=False)[0]
def timed(work, count=50):
    for _ in range(5): work()
    torch.cuda.synchronize(); start = time.time()
    for _ in range(count): work()
    torch.cuda.synchronize(); return 1e3 * (time.time() - start) / count
with torch.no_grad(): print(f"forward {timed(frame):.2f}")
print(f"forward and backward {timed(lambda: frame().sum().backward()):.2f}")
PY
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

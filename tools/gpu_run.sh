#!/usr/bin/env bash
# Everything that is measured on a machine with a GPU, in one go of about 8 minutes: piles at rest, speeds, one large bake.
#
#     PYTHONPATH=... WARP_CACHE_PATH=... tools/gpu_run.sh RESULTS
#
# Run it in the project's root; RESULTS is a folder that gets the log, the numbers as JSON, a contact sheet, the bake's settings and
# episodes, and, for the next run, the compiled kernels (unpack wpcache.txz to WARP_CACHE_PATH first: cold kernels cost minutes).
# The bake itself goes to the temporary folder and is removed; 512 short episodes at 640x360 are about 100,000 views, 2 million
# files and 20 GB. Longer episodes, or full HD, fill a small disk.
#
# Environment:
#     PYTHON             interpreter (python3)
#     DATA               folder of data (.gpu/data): ycbv_models/, hdri/ and cache/ in it are used if they are there
#     DEVICE             cuda:0
#     WORLDS             512: of measurements and bake
#     ARRANGEMENTS       64: of piles at rest
#     BENCH_RESOLUTION   1920x1080
#     BAKE_RESOLUTION    640x360
#     BAKE_EPISODES      512
#     BAKE_SETTINGS      "move.rounds=1 move.speed=0.4": short episodes
#     REST_LIMIT BENCH_LIMIT BAKE_LIMIT   most seconds of each step (130 170 240)
#     TOTAL_LIMIT        most seconds of all steps (470); the last ones get what is left
#
# DATA/cache is a cache folder as XDG has it, so that concave objects need not be decomposed on the GPU machine, which takes minutes.
# Fill it where there is time, by any command that loads the same models with the same settings:
#     XDG_CACHE_HOME=$PWD/.gpu/data/cache python tools/rest_report.py --models .gpu/data/ycbv_models --arrangements 1 --device cpu

set -uo pipefail

if [ $# -ne 1 ]; then
    echo "usage: tools/gpu_run.sh RESULTS" >&2
    exit 2
fi
mkdir -p "$1" || exit 2
results=$(cd "$1" && pwd)

python=${PYTHON:-python3}
data=${DATA:-.gpu/data}
device=${DEVICE:-cuda:0}
worlds=${WORLDS:-512}
deadline=$((SECONDS + ${TOTAL_LIMIT:-470}))
failed=0
export PYTHONUNBUFFERED=1 COLUMNS=160

synpick=("$python" -c 'import sys; from synpick_warp.cli import main; sys.exit(main())')
models=() lights=()
[ -d "$data/ycbv_models" ] && models=(--models "$data/ycbv_models")
[ -d "$data/hdri" ] && lights=(--lights "$data/hdri")
[ -d "$data/cache" ] && XDG_CACHE_HOME=$(cd "$data/cache" && pwd) && export XDG_CACHE_HOME

bakes=$(mktemp -d) || exit 2
trap 'rm -rf "$bakes"' EXIT

# step NAME LIMIT COMMAND...: runs it for at most LIMIT seconds, and not past the deadline. An interrupted bake keeps its whole scenes.
step() {
    local name=$1 limit=$2 left=$((deadline - SECONDS)) begun=$SECONDS code
    shift 2
    if [ "$left" -lt 5 ]; then
        echo "== $name: no time left"
        failed=1
        return
    fi
    echo "== $name"
    timeout -s INT -k 15 "$((limit < left ? limit : left))" "$@"
    code=$?
    echo "== $name: exit code $code after $((SECONDS - begun)) s"
    [ "$code" -eq 0 ] || failed=1
}

measure() {
    command -v nvidia-smi >/dev/null && nvidia-smi --query-gpu=name,driver_version,memory.total,clocks.max.sm --format=csv,noheader

    step "piles at rest" "${REST_LIMIT:-130}" "$python" tools/rest_report.py --device "$device" "${models[@]}" \
        --arrangements "${ARRANGEMENTS:-64}" --json "$results/rest.json"

    step "speeds" "${BENCH_LIMIT:-170}" "$python" tools/bench.py --device "$device" "${models[@]}" "${lights[@]}" \
        --worlds "$worlds" --resolution "${BENCH_RESOLUTION:-1920x1080}" --parts physics,render,write --json "$results/bench.json"

    local settings=() assignment file
    for assignment in ${BAKE_SETTINGS-move.rounds=1 move.speed=0.4}; do
        settings+=(--set "$assignment")
    done
    step "bake" "${BAKE_LIMIT:-240}" "${synpick[@]}" bake --mode move --device "$device" "${models[@]}" "${lights[@]}" \
        --worlds "$worlds" --episodes "${BAKE_EPISODES:-512}" --resolution "${BAKE_RESOLUTION:-640x360}" "${settings[@]}" --out "$bakes/set"
    for file in config.toml episodes.jsonl; do
        [ -f "$bakes/set/$file" ] && cp "$bakes/set/$file" "$results/"
    done
    df -h "$bakes" | tail -1

    # What follows is quick, and wanted above all when something failed: it has its own time.
    deadline=$((SECONDS + 60))
    step "contact sheet" 20 "${synpick[@]}" preview "$bakes/set" --views 8 --out "$results/contact-sheet.png"
    if [ -n "${WARP_CACHE_PATH:-}" ] && [ -d "$WARP_CACHE_PATH" ]; then
        step "kernel cache" 40 tar -cJf "$results/wpcache.txz" -C "$WARP_CACHE_PATH" .
    fi
    return "$failed"
}

measure 2>&1 | tee "$results/run.log"
exit "${PIPESTATUS[0]}"

#!/usr/bin/env bash
# Runs all measurements on a GPU machine in less than 10 minutes: settled piles, benchmarks, image quality, picking sequences, a bake,
# comparison of devices, determinism, tests.
#
#     PYTHONPATH=... WARP_CACHE_PATH=... tools/gpu_run.sh RESULTS
#
# Run it in the project's root. RESULTS is the output folder: log, measured values as JSON, of the bake a contact sheet, an explained
# episode, settings, episodes and attempts, and the compiled kernels for the next run (unpack wpcache.txz to WARP_CACHE_PATH first:
# compiling takes minutes). Each step gets its fraction of the remaining time and is interrupted at its limit. The default of four steps
# gives an overview; figures to publish come from runs of one or two steps, such as STEPS="bench render". The large bake of tools/README.md:
#     STEPS=bake BAKE_MODE=move BAKE_EPISODES=512 BAKE_WORLDS=512 BAKE_SETTINGS="move.rounds=1 move.speed=0.4" tools/gpu_run.sh RESULTS
# The bake is written to the temporary folder and removed; 512 short episodes at 640x360 are about 100,000 views, 2 million
# files and 20 GB. Longer episodes, or full HD, fill a small disk.
#
# Environment:
#     STEPS              "rest bench pick bake": steps to run, in this order; also "render", "devices", "sameness" and "tests"
#     PYTHON             interpreter (python3)
#     DATA               folder of data (.gpu/data): its folders ycbv_models/, hdri/ and cache/ are used if they exist
#     DEVICE             cuda:0
#     ARRANGEMENTS       64: arrangements of the step rest
#     WORLDS             512: worlds of the step bench
#     BENCH_PARTS        physics,perception,render,write; also sensor
#     BENCH_RESOLUTION   1920x1080
#     BENCH_SETTINGS     none, such as "bake.mode=move bake.formats=[bop,shards,usd,zarr,lerobot,coco]"; writers write to TMPDIR
#     RENDER_SCENES      10: piles whose denoised image is compared with the reference; RENDER_SAMPLES 1024, RENDER_SIZE 960x540
#     SAME_WORLDS        8,1,512: world counts with which the same episodes are simulated; the first and the last also bake
#     SAME_EPISODES      8
#     SAME_TICKS         60: maximum ticks of these simulations; bakes are complete
#     SAME_SETTINGS      "move.rounds=1 move.speed=0.6 pick.failures=1 arrangement.volume=1e-3 target.forgive=false": short episodes
#     PICK_EPISODES      64: sequences of each of the modes pick and target
#     PICK_SETTINGS      none, such as "pick.failures=4"
#     BAKE_MODE          mixed; or pick, target, move
#     BAKE_WORLDS        64
#     BAKE_EPISODES      64
#     BAKE_RESOLUTION    640x360
#     BAKE_FORMATS       bop; or any of bop,shards,usd,zarr
#     BAKE_SETTINGS      "move.rounds=1 move.speed=0.4 pick.failures=1": short episodes
#     TEST_WORKERS       14: processes of the tests; TESTS "tests": paths of the tests
#     REST_LIMIT BENCH_LIMIT RENDER_LIMIT DEVICES_LIMIT SAME_LIMIT PICK_LIMIT BAKE_LIMIT TESTS_LIMIT   maximum seconds of each step (its fraction of the remaining time)
#     TOTAL_LIMIT        maximum seconds of all steps (490)
#
# DATA/cache is used as XDG_CACHE_HOME: it stores the convex decomposition of concave objects, which takes minutes. Fill it on another
# machine by any command that loads the same models with the same settings:
#     XDG_CACHE_HOME=$PWD/.gpu/data/cache python -m tools.reports.rest --models .gpu/data/ycbv_models --arrangements 1 --device cpu

set -uo pipefail

if [ $# -ne 1 ]; then
    echo "usage: tools/gpu_run.sh RESULTS" >&2
    exit 2
fi
# Weights of the steps in sharing the remaining time; these are all steps.
declare -A weights=([rest]=60 [bench]=130 [render]=200 [devices]=60 [sameness]=200 [pick]=210 [bake]=90 [tests]=240)
read -ra steps <<<"${STEPS:-rest bench pick bake}"
for name in "${steps[@]}"; do
    if [ -z "${weights[$name]:-}" ]; then
        echo "gpu_run: no such step: $name; steps: ${!weights[*]}" >&2
        exit 2
    fi
done
mkdir -p "$1" || exit 2
results=$(cd "$1" && pwd)

python=${PYTHON:-python3}
data=${DATA:-.gpu/data}
device=${DEVICE:-cuda:0}
deadline=$((SECONDS + ${TOTAL_LIMIT:-490}))
failed=0
export PYTHONUNBUFFERED=1 COLUMNS=160

synpick=("$python" -m synpick_warp)
models=() lights=()
[ -d "$data/ycbv_models" ] && models=(--models "$data/ycbv_models")
[ -d "$data/hdri" ] && lights=(--lights "$data/hdri")
[ -d "$data/cache" ] && XDG_CACHE_HOME=$(cd "$data/cache" && pwd) && export XDG_CACHE_HOME

read -ra tests <<<"${TESTS:-tests}"
bakes=$(mktemp -d) || exit 2
trap 'rm -rf "$bakes"' EXIT

# step NAME LIMIT COMMAND...: runs the command for at most LIMIT seconds, and not past the deadline. Interrupted tools print the results
# so far; an interrupted bake keeps its committed scenes.
step() {
    local name=$1 limit=$2 left=$((deadline - SECONDS)) started=$SECONDS code
    shift 2
    if [ "$left" -lt 5 ]; then
        echo "== $name: no time left"
        failed=1
        return
    fi
    echo "== $name"
    timeout -s INT -k 15 "$((limit < left ? limit : left))" "$@"
    code=$?
    echo "== $name: exit code $code after $((SECONDS - started)) s"
    [ "$code" -eq 0 ] || failed=1
}

# time_limit STEP...: the first step's part of the remaining time, which all given steps share by weight.
time_limit() {
    local first=$1 total=0 name
    for name in "$@"; do
        total=$((total + weights[$name]))
    done
    echo $(((deadline - SECONDS) * weights[$first] / total))
}

# parse_settings ASSIGNMENTS: turns them into --set options, in the array settings.
parse_settings() {
    local assignment
    settings=()
    for assignment in $1; do
        settings+=(--set "$assignment")
    done
}

measure_rest() {
    step "piles at rest" "${REST_LIMIT:-$1}" "$python" -m tools.reports.rest --device "$device" "${models[@]}" \
        --arrangements "${ARRANGEMENTS:-64}" --json "$results/rest.json"
}

measure_bench() {
    parse_settings "${BENCH_SETTINGS:-}"
    step "benchmarks" "${BENCH_LIMIT:-$1}" "$python" -m tools.bench --device "$device" "${models[@]}" "${lights[@]}" \
        --worlds "${WORLDS:-512}" --resolution "${BENCH_RESOLUTION:-1920x1080}" --parts "${BENCH_PARTS:-physics,perception,render,write}" \
        "${settings[@]}" --json "$results/bench.json"
}

measure_render() {
    step "image quality" "${RENDER_LIMIT:-$1}" "$python" -m tools.reports.render --device "$device" "${models[@]}" "${lights[@]}" \
        --scenes "${RENDER_SCENES:-10}" --samples "${RENDER_SAMPLES:-1024}" --size "${RENDER_SIZE:-960x540}" \
        --sheet "$results/pictures.jpg" --json "$results/render.json"
}

measure_devices() {
    step "two devices" "${DEVICES_LIMIT:-$1}" "$python" -m tools.compare pictures --devices "cpu,$device" "${models[@]}" "${lights[@]}"
}

# Determinism: bakes with the first and the last world count, compared byte by byte, and simulations with all world counts.
measure_sameness() {
    local worlds=${SAME_WORLDS:-8,1,512} count all=${SAME_LIMIT:-$1}
    parse_settings "${SAME_SETTINGS-move.rounds=1 move.speed=0.6 pick.failures=1 arrangement.volume=1e-3 target.forgive=false}"
    for count in "${worlds%%,*}" "${worlds##*,}"; do
        step "bake in $count worlds" "$((all / 4))" "${synpick[@]}" bake --mode mixed --device "$device" "${models[@]}" "${lights[@]}" \
            --worlds "$count" --episodes "${SAME_EPISODES:-8}" --resolution 320x180 --formats bop,shards,usd,zarr "${settings[@]}" \
            --set "render.layers=[normals,albedo,nocs,classes,flow,scene_flow,depth_sensor]" --out "$bakes/same-$count"
    done
    step "both bakes" 60 "$python" -m tools.compare runs "$bakes/same-${worlds%%,*}" "$bakes/same-${worlds##*,}"
    step "trajectories" 30 "$python" -m tools.checks.trajectory "$bakes/same-${worlds%%,*}"
    step "world counts" "$((all / 2))" "$python" -m tools.compare worlds --device "$device" "${models[@]}" --worlds "$worlds" \
        --episodes "${SAME_EPISODES:-8}" --ticks "${SAME_TICKS:-60}" --set bake.mode=mixed "${settings[@]}" --json "$results/worlds.json"
}

# The tests on the device: names as they come in tests.log, results as JUnit XML. Pytest plugins installed on the machine are disabled.
measure_tests() {
    step "tests" "${TESTS_LIMIT:-$1}" "$python" -m pytest --device "$device" -n "${TEST_WORKERS:-14}" -v --tb=short -p no:benchmark \
        -p no:cacheprovider --junitxml="$results/tests.xml" "${tests[@]}" >"$results/tests.log" 2>&1
    grep -E "^(FAILED|ERROR|== tests)" "$results/tests.log"
    tail -n 1 "$results/tests.log"
}

measure_pick() {
    parse_settings "${PICK_SETTINGS:-}"
    step "picking" "${PICK_LIMIT:-$1}" "$python" -m tools.reports.pick --device "$device" "${models[@]}" \
        --episodes "${PICK_EPISODES:-64}" "${settings[@]}" --json "$results/picks.json"
}

measure_bake() {
    local file
    parse_settings "${BAKE_SETTINGS-move.rounds=1 move.speed=0.4 pick.failures=1}"
    step "bake" "${BAKE_LIMIT:-$1}" "${synpick[@]}" bake --mode "${BAKE_MODE:-mixed}" --device "$device" "${models[@]}" "${lights[@]}" \
        --worlds "${BAKE_WORLDS:-64}" --episodes "${BAKE_EPISODES:-64}" --resolution "${BAKE_RESOLUTION:-640x360}" --formats "${BAKE_FORMATS:-bop}" "${settings[@]}" \
        --out "$bakes/set"
    for file in config.toml episodes.jsonl attempts.jsonl; do
        [ -f "$bakes/set/$file" ] && cp "$bakes/set/$file" "$results/"
    done
    df -h "$bakes" | tail -1
}

measure() {
    local i
    command -v nvidia-smi >/dev/null && nvidia-smi --query-gpu=name,driver_version,memory.total,clocks.max.sm --format=csv,noheader
    for i in "${!steps[@]}"; do
        "measure_${steps[$i]}" "$(time_limit "${steps[@]:$i}")"
    done

    # The following steps are quick, and help most after a failure: they have a deadline of their own.
    deadline=$((SECONDS + 60))
    if [ -d "$bakes/set" ]; then
        step "contact sheet" 20 "${synpick[@]}" preview "$bakes/set" --views 8 --out "$results/contact-sheet.png"
        local episode picture=$results/explained.png
        episode=$(grep -o -m 1 '"episode": [0-9]*' "$bakes/set/attempts.jsonl" 2>/dev/null | grep -o '[0-9]*')
        [ -n "$episode" ] && step "explained episode" 20 "${synpick[@]}" explain "$bakes/set" --episode "$episode" --out "$picture"
    fi
    if [ -n "${WARP_CACHE_PATH:-}" ] && [ -d "$WARP_CACHE_PATH" ]; then
        step "kernel cache" 40 tar -cJf "$results/wpcache.txz" -C "$WARP_CACHE_PATH" .
    fi
    return "$failed"
}

measure 2>&1 | tee "$results/run.log"
exit "${PIPESTATUS[0]}"

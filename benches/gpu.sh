#!/usr/bin/env bash
# Runs every GPU measurement of this project and writes one JSON file.
#
#   benches/gpu.sh                                   # wgpu, the example capture
#   benches/gpu.sh --device vulkan --capture fox     # SPIR-V, a capture of yours
#   benches/gpu.sh --device cuda --python .venv/bin/python   # and gsplat beside it
#   benches/gpu.sh --smoke                           # tiny sizes, to try the script itself
#
# Needs cargo, bash and coreutils; the comparison with gsplat also a Python with torch, gsplat, numpy and Pillow. A failed
# section is recorded and the others continue; the exit status is then 1.

set -uo pipefail
cd "$(dirname "$0")/.."

usage() {
    sed -n '2,9p' "$0" | sed 's/^# \{0,1\}//'
    cat <<TEXT

  --device D       wgpu (WGSL), vulkan (SPIR-V) or cuda [default: wgpu]
  --capture DIR    a folder with images/ and sparse/0/; may be given several times [default: the example]
  --downscale K    of all captures [default: 2]
  --python PYTHON  a Python that has gsplat: the same scenes with it
  --out FILE       the JSON [default: out/gpu/gpu.json]; logs and scenes go beside it
  --smoke          tiny sizes and few tests
TEXT
}

fail() {
    echo "error: $*" >&2
    exit 2
}

device=wgpu downscale=2 python='' out=out/gpu/gpu.json smoke=false
captures=()
while (($#)); do
    case "$1" in
        --smoke) smoke=true; shift; continue ;;
        -h | --help) usage; exit 0 ;;
    esac
    (($# >= 2)) || fail "$1 needs a value, or is unknown; see --help"
    case "$1" in
        --device) device=$2 ;;
        --capture) captures+=("$2") ;;
        --downscale) downscale=$2 ;;
        --python) python=$2 ;;
        --out) out=$2 ;;
        *) fail "$1 is unknown; see --help" ;;
    esac
    shift 2
done
((${#captures[@]})) || captures=(examples/data/saharov)
for capture in "${captures[@]}"; do
    [[ -d $capture/sparse/0 ]] || fail "--capture $capture: there is no $capture/sparse/0"
done
[[ $downscale =~ ^[1-9][0-9]*$ ]] || fail "--downscale must be a whole number from 1"
case "$device" in
    wgpu) features=(--features wgpu) runs_on=wgpu ;;
    vulkan) features=(--features vulkan) runs_on=vulkan ;;
    cuda) features=(--features cuda) runs_on=cuda ;;
    *) fail "--device must be wgpu, vulkan or cuda" ;;
esac
[[ -z $python ]] || command -v "$python" >/dev/null || fail "--python $python: no such program"
command -v cargo >/dev/null || fail "cargo is not there; see README.md"

if $smoke; then
    downscale=16 seconds=0 steps=(10 20)
    grid=(--gaussians 200,2000 --pixels 3000,12000)
    synthetic=(1000 3000) photo=96x54
    tests=(--test work) accuracy=false
else
    seconds=10 steps=(7000 30000)
    grid=()
    synthetic=(100000 1000000 5000000) photo=1920x1080
    tests=() accuracy=true
fi

folder=$(dirname "$out")
mkdir -p "$folder" || fail "--out $out: its folder cannot be made"
parts=$(mktemp -d) || fail "no temporary folder"
trap 'rm -rf "$parts"' EXIT
failed=0

# Quotes a text for JSON.
quoted() {
    local text=${1//\\/\\\\}
    text=${text//\"/\\\"}
    text=${text//$'\t'/ }
    text=${text//$'\n'/\\n}
    printf '"%s"' "$(printf '%s' "$text" | tr -d '\000-\010\013-\037')"
}

# Writes all sections so far to the output file, in order.
assemble() {
    local first=true part
    {
        printf '{\n'
        for part in "$parts"/*.json; do
            $first || printf ',\n'
            first=false
            cat "$part"
        done
        printf '\n}\n'
    } >"$out.tmp" && mv "$out.tmp" "$out"
}

number=0
# section NAME RESULT COMMAND...: runs the command; RESULT is the JSON file that it writes, or - for none.
section() {
    local name=$1 result=$2 status start stop log value=null
    shift 2
    log="$folder/${name//[^A-Za-z0-9_.-]/_}.log"
    [[ $result == - ]] || rm -f "$result"
    echo "== $name: $*" >&2
    start=$(date +%s.%N)
    "$@" >"$log" 2>&1
    status=$?
    stop=$(date +%s.%N)
    if ((status)); then
        failed=1
        echo "   failed with status $status; see $log" >&2
        tail -3 "$log" >&2
    fi
    [[ $result != - && -s $result ]] && value=$(<"$result")
    number=$((number + 1))
    printf '%s: {"command": %s, "status": %d, "seconds": %s, "said": %s, "result": %s}' \
        "$(quoted "$name")" "$(quoted "$*")" "$status" \
        "$(awk "BEGIN { printf \"%.3f\", $stop - $start }")" \
        "$(quoted "$(tail -c 4000 "$log" | tail -25)")" "$value" \
        >"$parts/$(printf '%04d' "$number").json"
    assemble
}

machine() {
    echo "commit: $(git rev-parse HEAD 2>/dev/null || echo unknown)$(git diff --quiet HEAD 2>/dev/null || echo ', changed')"
    echo "date: $(date -u +%Y-%m-%dT%H:%M:%SZ)"
    echo "system: $(uname -srm)"
    echo "rustc: $(rustc --version)"
    grep -m1 'model name' /proc/cpuinfo 2>/dev/null
    nvidia-smi --query-gpu=name,driver_version,memory.total,clocks.max.sm,power.limit --format=csv 2>/dev/null || echo "no nvidia-smi"
}

target=$(cargo metadata --format-version 1 --no-deps 2>/dev/null | sed 's/.*"target_directory":"\([^"]*\)".*/\1/')
[[ -n $target ]] || fail "cargo metadata says nothing of a target folder"
splat=("$target/release/splat" --device "$runs_on")
measure=(--downscale "$downscale" --seconds "$seconds")

section machine - machine
section build - cargo build --release --workspace --bin splat ${features[@]+"${features[@]}"}
[[ -x $target/release/splat ]] || fail "there is no $target/release/splat; see $folder/build.log"

# Through wgpu, or SPIR-V with --device vulkan. With --device cuda, the next two sections check the kernels on CUDA.
section tests - env SPLAT_REQUIRE_WGPU=1 cargo test --release --workspace ${features[@]+"${features[@]}"} ${tests[@]+"${tests[@]}"}
section gradcheck "$folder/gradcheck.json" \
    "${splat[@]}" gradcheck tests/fixtures/*.safetensors --json "$folder/gradcheck.json"
# All kernels of an image and its gradients, under NVIDIA's checker if the CUDA toolkit is installed.
if [[ $device == cuda ]] && command -v compute-sanitizer >/dev/null; then
    for tool in memcheck racecheck; do
        section "$tool" - compute-sanitizer --tool "$tool" --error-exitcode 1 \
            "${splat[@]}" gradcheck tests/fixtures/*.safetensors
    done
fi
if $accuracy; then
    section accuracy "$folder/accuracy.json" "${splat[@]}" bench accuracy --json "$folder/accuracy.json"
fi

for capture in "${captures[@]}"; do
    name=$(basename "$capture")
    section "step $name" "$folder/step_$name.json" \
        "${splat[@]}" bench step "$capture" "${measure[@]}" --json "$folder/step_$name.json"
    section "rasterize $name" "$folder/rasterize_$name.json" \
        "${splat[@]}" bench rasterize "$capture" "${measure[@]}" --json "$folder/rasterize_$name.json"
done
section scaling "$folder/scaling.json" \
    "${splat[@]}" bench scaling ${grid[@]+"${grid[@]}"} --json "$folder/scaling.json" --svg "$folder/scaling.svg"
section "scaling at full size" "$folder/scaling_large.json" \
    "${splat[@]}" bench scaling --gaussians "$(IFS=,; echo "${synthetic[*]}")" --pixels "$photo" --json "$folder/scaling_large.json"

for capture in "${captures[@]}"; do
    name=$(basename "$capture")
    for count in "${steps[@]}"; do
        run="$folder/train_${name}_$count"
        section "train $name $count" "$run/metrics.json" \
            "${splat[@]}" train "$capture" --downscale "$downscale" --steps "$count" --out "$run"
        section "rasterize $name after $count" "$folder/rasterize_${name}_$count.json" \
            "${splat[@]}" bench rasterize "$run/scene.ply" --capture "$capture" "${measure[@]}" --json "$folder/rasterize_${name}_$count.json"
    done
done

if [[ -n $python ]]; then
    section "gsplat errors" "$folder/gsplat_errors.json" \
        "$python" benches/gsplat_errors.py tests/fixtures/*.safetensors \
        --ours "$folder/gradcheck.json" --json "$folder/gsplat_errors.json"
    # A capture's initial Gaussians, as measured by `bench step`, here and with gsplat.
    beside_gsplat() {
        local name=$1 capture=$2 downscale=$3
        # After one step the Gaussians are still the initial ones.
        section "first scene $name" - "${splat[@]}" train "$capture" --downscale "$downscale" --steps 1 --out "$folder/first_$name"
        section "rasterize first $name" "$folder/rasterize_first_$name.json" \
            "${splat[@]}" bench rasterize "$folder/first_$name/scene.ply" --capture "$capture" --downscale "$downscale" \
            --seconds "$seconds" --json "$folder/rasterize_first_$name.json"
        section "gsplat $name" "$folder/gsplat_$name.json" \
            "$python" benches/gsplat_side_by_side.py "$folder/first_$name/scene.ply" "$capture" --downscale "$downscale" \
            --ours "$folder/rasterize_first_$name.json" --ours-step "$folder/step_$name.json" --json "$folder/gsplat_$name.json"
    }
    for count in "${synthetic[@]}"; do
        name=synthetic_$count
        rm -rf "${folder:?}/$name"
        section "capture $name" - "${splat[@]}" bench capture "$count" "$photo" --out "$folder/$name"
        section "step $name" "$folder/step_$name.json" \
            "${splat[@]}" bench step "$folder/$name" --seconds "$seconds" --json "$folder/step_$name.json"
        beside_gsplat "$name" "$folder/$name" 1
    done
    for capture in "${captures[@]}"; do
        name=$(basename "$capture")
        beside_gsplat "$name" "$capture" "$downscale"
        last="${steps[${#steps[@]} - 1]}"
        section "gsplat $name after $last" "$folder/gsplat_${name}_$last.json" \
            "$python" benches/gsplat_side_by_side.py "$folder/train_${name}_$last/scene.ply" "$capture" --downscale "$downscale" \
            --ours "$folder/rasterize_${name}_$last.json" --json "$folder/gsplat_${name}_$last.json"
    done
fi

echo "$out"
exit "$failed"

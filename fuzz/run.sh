#!/usr/bin/env bash
# Fuzzes readers, guided by coverage, for the given seconds of processor time each:
#
#   fuzz/run.sh PARSER... SECONDS        fuzz/run.sh all 1800
#
# PARSER: colmap_binary, colmap_text, transforms, ply, points, fixture, checkpoint, config, gaussians, or all. Prints one line per
# parser; exit status 1 if any input fails. The same seed (environment variable SEED) repeats a run of one build.
set -euo pipefail
cd "$(dirname "$0")/.."
if [ $# -lt 2 ]; then
  sed -n '2,7s/^# \{0,1\}//p' "$0" >&2
  exit 2
fi
export RUSTC_WORKSPACE_WRAPPER="$PWD/fuzz/instrument.sh"
# With --workspace the features match those of the tests, so dependencies are not compiled again.
cargo build --release --workspace --bin splat-fuzz
target=$(cargo metadata --no-deps --format-version 1 | sed 's/.*"target_directory":"\([^"]*\)".*/\1/')
exec "$target/release/splat-fuzz" "${@:1:$#-1}" --seconds "${!#}" --seed "${SEED:-1}"

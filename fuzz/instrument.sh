#!/bin/sh
# A wrapper of rustc for cargo (RUSTC_WORKSPACE_WRAPPER): the two crates with readers get counters on every edge of
# their control flow, and checks of overflow. Dependencies are not wrapped, and are not compiled again.
rustc=$1
shift
case " $* " in
*" --crate-name splat_trainer "* | *" --crate-name splat_model "*)
  exec "$rustc" "$@" \
    -C passes=sancov-module \
    -C llvm-args=-sanitizer-coverage-level=3 \
    -C llvm-args=-sanitizer-coverage-inline-8bit-counters \
    -C llvm-args=-sanitizer-coverage-pc-table \
    -C overflow-checks=on -C debug-assertions=on
  ;;
*) exec "$rustc" "$@" ;;
esac

#!/bin/sh
# A rustc wrapper for cargo (RUSTC_WORKSPACE_WRAPPER) that compiles the crates with readers with counters on every edge of
# their control flow, and with overflow checks. Dependencies are not wrapped, and not compiled again.
rustc=$1
shift
case " $* " in
*" --crate-name splat_data "* | *" --crate-name splat_lab "* | *" --crate-name splat_model "* | *" --crate-name splat_trainer "*)
  exec "$rustc" "$@" \
    -C passes=sancov-module \
    -C llvm-args=-sanitizer-coverage-level=3 \
    -C llvm-args=-sanitizer-coverage-inline-8bit-counters \
    -C llvm-args=-sanitizer-coverage-pc-table \
    -C overflow-checks=on -C debug-assertions=on
  ;;
*) exec "$rustc" "$@" ;;
esac

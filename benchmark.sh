#!/usr/bin/env bash
# The whole comparison, or a part of it: ./benchmark.sh --help. The variable PYTHON names another Python than that of .venv.
# It may be called from anywhere and through a link; files and directories that it is told are the caller's.
here=$(dirname "$(readlink -f "$0")")
exec "${PYTHON:-$here/.venv/bin/python}" "$here/benchmark/compare.py" "$@"

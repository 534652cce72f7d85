#!/usr/bin/env bash
# The whole comparison, or a part of it: ./benchmark.sh --help. The variable PYTHON names another Python than that of .venv.
cd "$(dirname "$0")" || exit
exec "${PYTHON:-.venv/bin/python}" -m benchmark.compare "$@"

#!/usr/bin/env bash
# What only a GPU can tell, in one go of at most 8 minutes: tests marked `cuda`, latencies at
# 1024x2048, 50 training steps of the recipe cityscapes in fp16, what every method costs a step.
# Writes FOLDER/gpu.json; FOLDER is $OUT where none is given. Nothing is downloaded or installed:
# torch and the other packages of pyproject.toml are there, or it says which are not.
# With --cpu-rehearsal all of it runs on the CPU, as far as it goes, at tiny sizes.
#
#     benchmarks/gpu.sh [--cpu-rehearsal] [FOLDER]
set -euo pipefail
cd "$(dirname "$0")/.."
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
exec "${PYTHON:-python3}" benchmarks/gpu.py "$@"

#!/usr/bin/env bash
# The ablations of CityGaussianV2 at their length, within 540 seconds on one NVIDIA GPU; bench/gpu_paper.py says what, and in
# which order. Wants surfkit with its test packages installed in the Python that PYTHON names.
#
#     bench/gpu_paper.sh                                # the same as parity=90 table=50 rows=380
#     bench/gpu_paper.sh rows=500                       # goes on with the rows
#     bench/gpu_paper.sh --device cpu --steps 60 --scale 8 --points 5000 --rounds 1 --out /tmp/tried --work /tmp/tried
exec "${PYTHON:-python3}" "$(dirname "$0")/gpu_paper.py" "$@"

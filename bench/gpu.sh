#!/usr/bin/env bash
# Everything that needs an NVIDIA GPU, in less than ten minutes: the tests that are skipped without one, then bench/gpu.py.
# Wants surfkit with its test packages installed in the Python that PYTHON names. Results are written to bench/results/.
set -uo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
"$python" - <<'CHECK' || exit 2
import sys
from surfkit.raster.cuda.gpu import CudaRasterizer
sys.exit(f"bench/gpu.sh: {why}" if (why := CudaRasterizer().missing()) else 0)
CHECK
status=0
timeout 240 "$python" -m pytest -m cuda tests/raster/nvrtc tests/raster tests/train || status=$?
timeout 300 "$python" bench/gpu.py "$@" || status=$?
exit $status

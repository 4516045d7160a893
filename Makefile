# Two commands set everything up: `make demo` and `make test`.
VENV ?= .venv
PYTHON ?= python3
PY = $(VENV)/bin/python
STEPS ?= 1000
SCALE ?= 1.5
OUT ?= runs/demo
WORKERS ?= logical

.PHONY: demo test lint docs bench fuzz clean

demo: $(VENV)/.installed
	$(VENV)/bin/surfkit train recipe:surface --test-every 8 --scale $(SCALE) --steps $(STEPS) --out $(OUT)

# In a process for each core, four at most, as each takes 1 GB of memory; `WORKERS=0` is in this one. One that dies
# ends the run: pytest-xdist would begin its test again in another, and may wait for ever.
test: $(VENV)/.installed
	$(PY) -m pytest -n $(WORKERS) --maxprocesses 4 --max-worker-restart 0 --dist loadfile

lint: $(VENV)/.installed
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check .
	$(PY) .ci/types

# The site of docs/, in site/; a link or an anchor that leads nowhere is an error.
docs: $(VENV)/.installed
	$(PY) docs/generate.py
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict --quiet

bench: $(VENV)/.installed
	OMP_WAIT_POLICY=PASSIVE $(PY) bench/raster.py
	OMP_WAIT_POLICY=PASSIVE $(PY) bench/dgd.py
	OMP_WAIT_POLICY=PASSIVE $(PY) bench/survey.py
	OMP_WAIT_POLICY=PASSIVE $(PY) bench/mesh.py
	OMP_WAIT_POLICY=PASSIVE $(PY) bench/stereo.py

# Half an hour: damaged files of every kind, through the command line.
fuzz: $(VENV)/.installed
	$(PY) bench/fuzz.py --cases 10000

# Reinstalled when what is compiled or declared changes; the Python files are used in place.
$(VENV)/.installed: pyproject.toml constraints.txt CMakeLists.txt $(wildcard surfkit/*/*.h surfkit/raster/native/* surfkit/*/cpu/* surfkit/*/*/cpu/*)
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --upgrade pip
	$(PY) -m pip install --quiet -c constraints.txt -e ".[test,dev,docs]"
	$(PY) -m pip install --quiet --no-deps $(addprefix -e ,$(wildcard plugins/surfkit-*))
	touch $@

clean:
	rm -rf build site $(VENV)

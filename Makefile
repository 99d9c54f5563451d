# Needs Python 3.11 to 3.13 as python3, with pip, and nothing else: "make demo" and "make test" set up .venv themselves.
# The environment is made without its own pip and filled by the system's, since Debian keeps ensurepip in another package.
# It gets the versions in requirements/, with their hashes; "make lock" brings these up to date with pyproject.toml and
# with what has been published since.

PYTHON ?= python3
BIN := .venv/bin
PIP := $(PYTHON) -m pip --python $(BIN)/python --disable-pip-version-check
# uses only what the lock file has installed, and fails where pyproject.toml asks for more
CLEAN := $(PYTHON) -m pip --python build/clean/bin/python --disable-pip-version-check install --quiet
SELF := $(PIP) install --quiet --no-index --no-build-isolation --editable
COMPILE := $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest --upgrade \
	--generate-hashes --custom-compile-command "make lock"

# tests of one file share fixtures, so they stay in one process; no file takes more than a minute
PYTEST := $(BIN)/pytest --numprocesses auto --maxprocesses 4 --dist loadfile

.PHONY: demo test test-all costs ready check docs pictures package processors soak fuzz fuzz-guided audit lock clean

demo: .venv/installed
	$(BIN)/dudmap demo

test: ready
	$(PYTEST)

test-all: ready .venv/publishing
	$(PYTEST) -m "slow or not slow"

# processor seconds of each file, see tests/costs.py
costs: ready
	$(PYTEST) --costs

# a new checkout: most kernels are compiled once for all test processes, while another core does the checks
ready: .venv/developed
	$(MAKE) --jobs 2 check .numba_cache/common

.numba_cache/common: | .venv/developed
	NUMBA_CACHE_DIR=$(CURDIR)/$@ $(BIN)/dudmap warmup --quiet

check: .venv/developed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: .venv/publishing
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet docs docs/_build/html

# all pictures of README and docs that show rendered worlds or pages; needs a Chromium
pictures: .venv/developed
	$(BIN)/python docs/pictures.py
	$(BIN)/python docs/page_pictures.py
	$(BIN)/python docs/moving_picture.py

# sdist, wheel (from the sdist) without kernels, wheel with the kernels for this Python on Linux, and the latter in an
# environment that has nothing but what it requires
package: .venv/publishing
	rm -rf dist build/clean build/kernels
	$(BIN)/python -m build --no-isolation --outdir dist
	$(BIN)/python -m dudmap.lab.wheel_kernels build/kernels
	DUDMAP_KERNELS=build/kernels $(BIN)/python -m build --no-isolation --wheel --outdir dist
	$(BIN)/twine check --strict dist/*
	$(PYTHON) -m venv --without-pip build/clean
	$(CLEAN) --requirement requirements/run.txt
	$(CLEAN) --no-index --no-deps dist/*-manylinux*.whl
	cd build/clean && bin/dudmap --version && bin/dudmap demo --help >/dev/null && bin/dudmap config >/dev/null && \
		bin/python -c 'import dudmap; [getattr(dudmap, name) for name in dudmap.__all__]'

processors: .venv/developed
	$(BIN)/python tests/processors.py

# hostile files for all loaders: make fuzz SECONDS=60 LOADERS="bag,map", see CONTRIBUTING.md
SECONDS ?= 60
LOADERS ?=
fuzz: .venv/developed
	$(BIN)/python tests/fuzz/campaign.py --seconds $(SECONDS) --loaders "$(LOADERS)"

# 20,000 frames, 22 minutes at 15 Hz, see docs/reliability.md: make soak FRAMES=20000
FRAMES ?= 20000
soak: .venv/developed
	$(BIN)/dudmap benchmark soak --max-frames $(FRAMES)

# the same as fuzz for one loader, guided by coverage: make fuzz-guided LOADER=sens
LOADER ?= sens
fuzz-guided: .venv/developed
	$(PIP) install --quiet atheris
	$(BIN)/python tests/fuzz/guided.py "$(LOADER)" -max_total_time=$(SECONDS)

# known weaknesses of the packages in the lock file; asks the service of PyPI or OSV, so it needs the network
audit: $(BIN)/python
	$(PIP) install --quiet pip-audit
	$(BIN)/pip-audit --requirement requirements/run.txt --require-hashes --disable-pip

lock: $(BIN)/python
	$(PIP) install --quiet --upgrade uv
	$(COMPILE) --group build pyproject.toml --extra dev --output-file requirements/dev.txt
	$(COMPILE) --group build pyproject.toml --constraint requirements/dev.txt --output-file requirements/run.txt
	$(COMPILE) --group publish --constraint requirements/dev.txt --output-file requirements/publish.txt

clean:
	rm -rf .venv .numba_cache build dist docs/_build

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
		{ echo "$(PYTHON) is not Python 3.11 to 3.13; name one that is: make demo PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -m pip --version >/dev/null 2>&1 || \
		{ echo "$(PYTHON) has no pip; on Debian: apt install python3-pip" >&2; exit 1; }
	$(PYTHON) -m venv --without-pip .venv

.venv/installed: $(BIN)/python pyproject.toml requirements/run.txt
	$(PIP) install --quiet --requirement requirements/run.txt
	$(SELF) .
	@touch $@

.venv/developed: $(BIN)/python pyproject.toml requirements/dev.txt
	$(PIP) install --quiet --requirement requirements/dev.txt
	$(SELF) '.[dev]'
	@touch $@ .venv/installed

# for the site and the packages, which no quick test needs
.venv/publishing: .venv/developed requirements/publish.txt
	$(PIP) install --quiet --requirement requirements/publish.txt
	@touch $@
